"""The errors a user can act on, each with the exit code of the command line."""


class BtfError(Exception):
    """Something went wrong that the message explains (exit code 1)."""

    exit_code = 1


class InputError(BtfError):
    """An input cannot be used: which one, what was found, what was expected, what to try (exit code 3)."""

    exit_code = 3


class NumericalError(BtfError):
    """A method could not reach its tolerance (exit code 4)."""

    exit_code = 4
