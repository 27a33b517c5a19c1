"""What the code writes about itself: JSON Schemas, and generated regions of the pages.

A region stands between ``<!-- generated: NAME -->`` and ``<!-- end of NAME -->``; ``python -m docs.generate``
writes all of them anew.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from docs.generate.regions import WRITERS
from projservo_cli.config.schema import as_text, json_schema, sweep_schema

DOCS = Path(__file__).parents[1]
CONFIGS = DOCS.parent / "configs"
REGION = re.compile(
    r"(?P<begin>^<!-- generated: (?P<name>[\w-]+) -->\n).*?(?P<end>^<!-- end of (?P=name) -->$)",
    flags=re.MULTILINE | re.DOTALL,
)


def files() -> Iterator[tuple[Path, str]]:
    """Yield schemas and pages, each with the text that it is to have."""
    yield CONFIGS / "schema.json", as_text(json_schema())
    yield CONFIGS / "sweep.schema.json", as_text(sweep_schema())
    for page in sorted(DOCS.rglob("*.md")):
        yield page, generated(page.read_text(encoding="utf-8"))


def generated(text: str) -> str:
    """Return a page with the present text in its regions; a KeyError names a region that has no writer."""
    return REGION.sub(_written, text)


def _written(match: re.Match[str]) -> str:
    lines = "\n".join(WRITERS[match["name"]]()).strip()
    return f"{match['begin']}\n{lines}\n\n{match['end']}"


def regions_of(text: str) -> list[str]:
    """Names of the regions of a page in their order."""
    return [match["name"] for match in REGION.finditer(text)]
