"""Figures after those of [RH00]: named arrays from a run, and a drawing of them.

A figure is a pair of functions ``data(material) -> arrays`` and ``draw(data, figure)`` in a file of its own,
which registers it; to add one, write the file and name it here.
"""

from projservo_cli.report.figures import (  # noqa: F401
    calibration,
    drift,
    errors,
    images,
    joints,
    overview,
    partition,
    path,
    planned,
    scene,
    visibility,
)
from projservo_cli.report.material import REGISTER

FIGURES = tuple(REGISTER[name] for name in sorted(REGISTER))
