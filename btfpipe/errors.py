"""The errors a user can act on, each with the exit code of the command line."""

import contextlib
import math


class BtfError(Exception):
    """Something went wrong that the message explains (exit code 1)."""

    exit_code = 1


class InputError(BtfError):
    """An input cannot be used: which one, what was found, what was expected, what to try (exit code 3)."""

    exit_code = 3


class NumericalError(BtfError):
    """A method did not converge, or met a matrix that it cannot solve (exit code 4)."""

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


def amount(size, whole=math.ceil):
    """Bytes as messages write them: whole MB, or KB below one."""
    unit, name = (1 << 20, "MB") if size >= 1 << 20 else (1 << 10, "KB")
    return f"{whole(size / unit)} {name}"


def too_little(need, memory):
    """What a message says after "they need" of work whose `need` of bytes exceeds --memory."""
    return f"{amount(need)}; --memory allows {amount(memory, math.floor)}. Raise it"
