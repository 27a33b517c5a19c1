"""The two ways in which a call ends without its result."""


class InputError(ValueError):
    """Usage, configuration or data that cannot be read or make no sense (exit code 2).

    The message is one line a user can act on: where, what is wrong, what to do.
    """


class WorkFailed(RuntimeError):  # noqa: N818 - a verdict, not a programming error
    """The data were read, but the work they ask for cannot be done (exit code 1)."""
