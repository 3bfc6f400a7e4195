"""The errors a user can act on, each with the exit code of the command line."""

import contextlib


class BtfError(Exception):
    """Something went wrong that the message explains (exit code 1)."""

    exit_code = 1


class InputError(BtfError):
    """An input cannot be used: which one, what was found, what was expected, what to try (exit code 3)."""

    exit_code = 3


class NumericalError(BtfError):
    """A method could not reach its tolerance (exit code 4)."""

    exit_code = 4


@contextlib.contextmanager
def naming(path):
    """Put a file's name in front of what goes wrong in the block, unless the message has it."""
    try:
        yield
    except BtfError as error:
        if str(path) in str(error):
            raise
        raise type(error)(f"{path}: {error}") from error
