"""Test that sentences are short."""

import re
import statistics

import pytest

from docs.generate import REGION
from tests.documentation.blocks import DOCS, ROOT

MEDIAN, LONG, SHARE = 16, 30, 0.95  # words, words, share of sentences that are no longer
PROSE = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted(DOCS.rglob("*.md")),
]


def sentences(text):
    """Sentences of a page, without headings, tables, code, formulas and generated regions."""
    text = REGION.sub("", text)
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^\s*```.*?^\s*```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"\$\$.*?\$\$(?: \([\d, ]+\))?", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`|\$[^$]*\$", "code", text)
    text = re.sub(r"^(#|\||\(|\[).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"^\s*(?:[-*]|\d+\.) ", "\n\n", text, flags=re.MULTILINE)
    for paragraph in re.split(r"\n\s*\n", text):
        for sentence in re.split(r"(?<=[.!?])\s+(?=[^a-z]|code|projservo)", " ".join(paragraph.split())):
            words = re.findall(r"[\w'’°%/-]*\w[\w'’°%/-]*", sentence)
            if len(words) > 1:
                yield len(words), sentence


@pytest.mark.parametrize("page", PROSE, ids=lambda page: f"{page.parent.name}/{page.stem}")
def test_sentences_are_short(page):
    found = list(sentences(page.read_text(encoding="utf-8")))
    if not found:
        return
    long = sorted((one for one in found if one[0] > LONG), reverse=True)
    assert statistics.median(count for count, _ in found) <= MEDIAN
    assert len(long) <= max((1 - SHARE) * len(found), 1), long
