"""Figures after those of [RH00]: named arrays from a run, and a drawing of them.

A figure is a pair of functions ``data(material) -> arrays`` and ``draw(data, figure)``, which registers it
in a file with those of its topic; to add one, write both, and name the file here if it is new.
"""

from projservo_cli.report.figures import (  # noqa: F401
    calibration,
    drift,
    errors,
    frames,
    guided,
    images,
    parts,
    planned,
    scene,
)
from projservo_cli.report.material import REGISTER

FIGURES = tuple(REGISTER[name] for name in sorted(REGISTER))
