"""The extensions that the documentation is built with, as modules."""

import sys

import pytest

from tests.documentation.blocks import DOCS

pytest.importorskip("sphinx", reason="Sphinx is not installed: pip install 'projservo[docs]'")
sys.path.insert(0, str(DOCS / "extensions"))
try:
    import docstrings
    import links
    import reference
finally:
    sys.path.remove(str(DOCS / "extensions"))

__all__ = ["docstrings", "links", "reference"]
