"""Words and tables as Markdown."""

import re
from collections.abc import Iterable, Iterator


def text(words: str) -> str:
    """Words of the code as Markdown that shows them as they are."""
    return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", " ".join(words.split()))


def table(titles: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    """Lines of a table whose cells are Markdown; nothing where it has no rows."""
    found = list(rows)
    if found:
        yield ""
        yield from ("| " + " | ".join(cells) + " |" for cells in (titles, ("---",) * len(titles), *found))
        yield ""
