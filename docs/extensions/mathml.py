"""Formulas as MathML, which browsers show by themselves: no script, no network."""

from html import escape
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

LOG = logging.getLogger(__name__)


def _formula(node: nodes.Element, *, block: bool) -> str:
    try:
        return str(tex2mathml(node.astext(), as_block=block))
    except MathError as error:
        LOG.warning("%s in the formula %s", error, node.astext(), location=node)
        return escape(node.astext())


def _inline(self: Any, node: nodes.Element) -> None:
    self.body.append(_formula(node, block=False))
    raise nodes.SkipNode


def _display(self: Any, node: nodes.Element) -> None:
    label = node.get("label")  # the number in the paper
    number = f'<span style="float: right">({escape(label)})</span>' if label else ""
    self.body.append(self.starttag(node, "div", CLASS="math", style="overflow-x: auto"))
    self.body.append(f"{number}{_formula(node, block=True)}</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer ``mathml``."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
