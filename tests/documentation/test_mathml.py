"""Formulas of the documentation as browsers get them."""

import importlib
import re
import xml.etree.ElementTree as ET

import pytest

from tests.documentation.blocks import PAGES

FORMULA = re.compile(r"\$\$(.+?)\$\$|\$([^$\n]+?)\$", re.S)
ACCENTS = {"ˆ", "˙", "‾", "¯"}


@pytest.fixture(scope="module")
def mathml():
    pytest.importorskip("sphinx", reason="Sphinx is not installed: pip install '.[docs]'")
    return importlib.import_module("docs.extensions.mathml")


def tree(mathml, tex):
    text = mathml.tex2mathml(mathml.readable(tex), as_block=True)
    text = re.sub(r"&(?!amp;|lt;|gt;)\w+;", "", text)  # names of signs that HTML knows and XML does not
    return ET.fromstring(re.sub(r' xmlns="[^"]*"', "", text))


def formulas():
    for page in ("mathematics", "laws", "planning"):
        text = re.sub(r"```.*?```", "", PAGES[page].read_text(encoding="utf-8"), flags=re.S)
        yield from (display or inline for display, inline in FORMULA.findall(text))


def test_matrices_are_whole_and_accents_stand_over_their_letter_alone(mathml):
    found = list(formulas())
    assert len(found) > 60
    for tex in found:
        root = tree(mathml, tex)
        parents = {child: parent for parent in root.iter() for child in parent}
        assert all(parents[cell].tag == "mtr" for cell in root.iter("mtd")), tex
        assert all(parents[row].tag == "mtable" for row in root.iter("mtr")), tex
        assert not any(mark.text in ACCENTS for over in root.iter("munderover") for mark in over), tex
        for over in root.iter("mover"):
            if over[1].text in ACCENTS:
                assert len("".join(over[0].itertext()).strip()) == 1, tex
