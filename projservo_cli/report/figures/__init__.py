"""Figures after those of [RH00]: named arrays from a run, and a drawing of them.

A figure is a pair of functions ``data(material) -> arrays`` and ``draw(data, figure)``, which registers it
in a file with those of its topic; to add one, write both, and name the file here if it is new.
"""

from projservo_cli.report.figures import (
    calibration as calibration,
)
from projservo_cli.report.figures import (
    errors as errors,
)
from projservo_cli.report.figures import (
    frames as frames,
)
from projservo_cli.report.figures import (
    images as images,
)
from projservo_cli.report.figures import (
    joint_space as joint_space,
)
from projservo_cli.report.figures import (
    metric as metric,
)
from projservo_cli.report.figures import (
    parts as parts,
)
from projservo_cli.report.figures import (
    path_deviation as path_deviation,
)
from projservo_cli.report.figures import (
    planned as planned,
)
from projservo_cli.report.figures import (
    scene as scene,
)
from projservo_cli.report.report_data import REGISTER

FIGURES = tuple(REGISTER[name] for name in sorted(REGISTER))
