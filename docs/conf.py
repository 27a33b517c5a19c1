"""How the documentation is built: `python -m sphinx -W -n docs build/docs`."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from projservo_cli.provenance import __version__  # noqa: E402

project = "projservo"
release = version = __version__
extensions = ["myst_parser", "extensions.mathml"]
exclude_patterns = ["extensions", "generate"]
nitpicky = True

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
myst_dmath_double_inline = True

html_theme = "furo"
html_title = f"projservo {release}"
html_math_renderer = "mathml"
html_copy_source = False
html_show_copyright = False
