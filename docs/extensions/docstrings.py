"""Sections of docstrings (Parameters, Returns, ...) as definition lists, for autodoc.

The project's docstrings say after the colon what an argument is, its shape and unit, not its type, so
that napoleon, which looks for types there and links them, does not fit.
"""

import re
from typing import Any

from sphinx.application import Sphinx


def rewritten(lines: list[str]) -> list[str]:
    """The lines of a docstring with its sections as lists."""
    text = "\n".join(lines)
    text = re.sub(r"^(\w[\w ]*)\n-{3,}$", r"\n**\1**\n", text, flags=re.MULTILINE)
    text = re.sub(r"^(\w+(?:, \w+)*) : ", r"\n``\1``\n    ", text, flags=re.MULTILINE)
    text = re.sub(r"^(\w+)(?=\n    \S)", r"\n``\1``", text, flags=re.MULTILINE)  # an exception
    return text.split("\n")


def _docstring(app: Sphinx, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    lines[:] = rewritten(lines)


def _signature(app: Sphinx, what: str, *about: Any) -> tuple[str, None] | None:
    """None for classes, most of which are records: it would repeat their fields."""
    return ("", None) if what == "class" else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Rewrite what autodoc finds."""
    app.connect("autodoc-process-docstring", _docstring)
    app.connect("autodoc-process-signature", _signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
