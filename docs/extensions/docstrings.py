"""Sections of docstrings (Parameters, Returns, ...) as definition lists, for autodoc.

The project's docstrings say after the colon what an argument is, its shape and unit, not its type, so
that readers of numpydoc sections that look for types there do not fit.
"""

import dataclasses
import re
from collections.abc import Iterator
from typing import Any

from sphinx.application import Sphinx

RULE = re.compile(r"-{3,}")
ENTRY = re.compile(r"(?P<names>\w+(?:, \w+)*) : (?P<text>.*)")


def _sections(lines: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Title and lines of each section; the title of what comes before the first is empty."""
    title = ""
    body: list[str] = []
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if RULE.fullmatch(line):
            continue
        if RULE.fullmatch(following):
            yield title, body
            title, body = line, []
        else:
            body.append(line)
    yield title, body


def _entries(body: list[str]) -> Iterator[str]:
    """Lines of a section, ``name : text`` as terms and definitions; an exception is a term by itself."""
    for k, line in enumerate(body):
        entry = ENTRY.fullmatch(line)
        following = body[k + 1] if k + 1 < len(body) else ""
        if entry:
            yield from ("", ", ".join(f"``{name}``" for name in entry["names"].split(", ")))
            yield f"    {entry['text']}"
        elif following.startswith("    ") and not line.startswith(" "):
            yield from ("", f"``{line}``")
        else:
            yield line


def rewritten(lines: list[str]) -> list[str]:
    """The lines of a docstring with its sections as lists."""
    result: list[str] = []
    for title, body in _sections(lines):
        if title:
            result += ["", f"**{title}**", ""]
        result += _entries(body) if title else body
    return result


def _docstring(app: Sphinx, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    lines[:] = rewritten(lines)


def _signature(
    app: Sphinx, what: str, name: str, found: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None] | None:
    """No signature for records, which repeats their fields, and for protocols, which are never made."""
    plain = dataclasses.is_dataclass(found) or hasattr(found, "_fields") or hasattr(found, "_is_protocol")
    return ("", None) if what == "class" and plain else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Rewrite what autodoc finds."""
    app.connect("autodoc-process-docstring", _docstring)
    app.connect("autodoc-process-signature", _signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
