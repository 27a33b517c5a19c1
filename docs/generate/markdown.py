"""Words, tables and headings as Markdown."""

import re
from collections.abc import Iterable, Iterator


def text(words: str) -> str:
    """Words of the code as Markdown that shows them as they are, names in double backticks as code."""
    plain, *rest = re.split(r"``(.+?)``", " ".join(words.split()))
    pairs = zip(rest[::2], rest[1::2], strict=True)
    return escaped(plain) + "".join(f"`{code}`{escaped(after)}" for code, after in pairs)


def escaped(words: str) -> str:
    """Words with a backslash before each character that means something in Markdown."""
    return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", words)


def table(titles: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    """Lines of a table whose cells are Markdown; no line where it has no rows."""
    found = list(rows)
    if found:
        yield ""
        yield from ("| " + " | ".join(cells) + " |" for cells in (titles, ("---",) * len(titles), *found))
        yield ""


def anchor(heading: str) -> str:
    """Anchor that GitHub and MyST give to a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
