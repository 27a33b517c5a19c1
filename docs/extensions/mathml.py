"""Formulas as MathML, which browsers show by themselves: no script, no network."""

import re
import unicodedata
from html import escape
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

# An accent of docutils reaches over all that follows it, and takes an index of its letter for a limit, unless
# it stands in braces of its own with nothing between it and the index.
ACCENT = re.compile(r"\\(hat|dot|overline)\s*(\{[^{}]*\}|\\[a-zA-Z]+|\w)")
# A bold letter is not shown bold, and swallows the next cell of a matrix; as a character of its own it is a
# letter like any other.
BOLD = re.compile(r"\\boldsymbol\s*(?:\{([A-Za-z])\}|([A-Za-z]))")
TEX = re.compile(r"\$\$|\$[^$]*[\\^_][^$]*\$")  # what is between two dollars and looks like a formula
FROM_NETWORK = re.compile(r'<(?:script|img|link)\b[^>]*(?:src|href)="(?:https?:)?//[^"]*')
LOG = logging.getLogger(__name__)


def readable(tex: str) -> str:
    """A formula as docutils understands it."""
    return ACCENT.sub(r"{\\\1{\2}}{}", BOLD.sub(_bold, tex))


def _bold(match: re.Match[str]) -> str:
    letter = match[1] or match[2]
    case = "CAPITAL" if letter.isupper() else "SMALL"
    return unicodedata.lookup(f"MATHEMATICAL BOLD ITALIC {case} {letter.upper()}")


def _formula(node: nodes.Element, *, block: bool) -> str:
    try:
        return str(tex2mathml(readable(node.astext()), as_block=block))
    except MathError as error:
        LOG.warning("%s in the formula %s", error, node.astext(), location=node)
        return escape(node.astext())


def _inline(self: Any, node: nodes.Element) -> None:
    self.body.append(_formula(node, block=False))
    raise nodes.SkipNode


def _display(self: Any, node: nodes.Element) -> None:
    label = node.get("label")  # the number in the paper
    number = f"<span>({escape(label)})</span>" if label else ""
    style = "display: flex; align-items: center; gap: 1rem; overflow-x: auto"
    self.body.append(self.starttag(node, "div", CLASS="math", style=style))
    self.body.append(f'<div style="margin: 0 auto">{_formula(node, block=True)}</div>{number}</div>\n')
    raise nodes.SkipNode


def _left_over(app: Sphinx, doctree: nodes.document, name: str) -> None:
    """Warn of formulas that were read as text."""
    for text in doctree.findall(nodes.Text):
        inside = isinstance(text.parent, (nodes.literal, nodes.literal_block, nodes.math, nodes.math_block))
        if TEX.search(text) and not inside:
            LOG.warning("a formula that is shown as text: %s", text[:60], location=name)


def _offline(app: Sphinx, error: Exception | None) -> None:
    """Warn of all that a browser would load from the network."""
    for page in Path(app.outdir).glob("*.html"):
        for found in FROM_NETWORK.findall(page.read_text(encoding="utf-8")):
            LOG.warning("%s: loads from the network: %s", page.name, found)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer ``mathml``."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    app.connect("doctree-resolved", _left_over)
    app.connect("build-finished", _offline)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
