"""The stages of an experiment: record in, record out."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called by a stage as ``progress(what, done, total)``; it only shows, it never decides."""


def silent(what: str, done: int, total: int) -> None:
    """Show nothing."""
