"""How the documentation is built: `python -m sphinx -W -n docs build/docs`."""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
os.environ["NUMBA_DISABLE_JIT"] = "1"  # docstrings are read, nothing is computed

from projservo_cli.provenance import __version__  # noqa: E402

project = "projservo"
release = version = __version__
OWN = ("docstrings", "mathml", "reference")
extensions = ["myst_parser", "sphinx.ext.autodoc", *(f"extensions.{name}" for name in OWN)]
exclude_patterns = ["extensions"]
nitpicky = True

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
myst_dmath_double_inline = True

autodoc_typehints = "none"  # docstrings give shapes and units, which types do not
autodoc_member_order = "bysource"

html_theme = "furo"
html_title = f"projservo {release}"
html_math_renderer = "mathml"
html_copy_source = False
html_show_copyright = False
