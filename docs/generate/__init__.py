"""Generated regions of the pages: references that the code writes about itself.

A region stands between ``<!-- generated: NAME -->`` and ``<!-- end of NAME -->``; ``python -m docs.generate``
writes all of them anew.
"""

import re
from pathlib import Path

from docs.generate.regions import WRITERS

DOCS = Path(__file__).parents[1]
REGION = re.compile(
    r"(?P<begin>^<!-- generated: (?P<name>[\w-]+) -->\n).*?(?P<end>^<!-- end of (?P=name) -->$)",
    flags=re.MULTILINE | re.DOTALL,
)


def generated(text: str) -> str:
    """Return a page with the present text in its regions; a KeyError names a region that has no writer."""
    return REGION.sub(_written, text)


def _written(match: re.Match[str]) -> str:
    lines = "\n".join(WRITERS[match["name"]]()).strip()
    return f"{match['begin']}\n{lines}\n\n{match['end']}"


def regions_of(text: str) -> list[str]:
    """Names of the regions of a page in their order."""
    return [match["name"] for match in REGION.finditer(text)]
