"""The columns of the table of a sweep."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from projservo_cli.config.sweep import Distribution
from projservo_cli.loop.step import VERDICTS
from projservo_cli.sweep.design import Design

NOT_CALIBRATED, NOT_STARTED = "not calibrated", "not started"
ALL_VERDICTS = (*VERDICTS, NOT_CALIBRATED, NOT_STARTED)
NONE = -1  # in columns of counts, where a run did not begin


@dataclass(frozen=True)
class Column:
    """One column of the table: its name, NumPy type, unit and what it holds."""

    name: str
    dtype: str
    units: str
    about: str


def text(name: str, values: Sequence[str], about: str) -> Column:
    """A column of texts, as wide as the longest of the possible ones."""
    return Column(name, f"S{max(len(value.encode()) for value in values)}", "1", about)


NUMBERS = (
    Column("run", "i8", "1", "number of the run"),
    Column("cell", "i8", "1", "number of its cell of the grid"),
    Column("draw", "i8", "1", "number of the run in its cell; runs of one number share task and noise"),
    Column("calibration", "i8", "1", "number of the calibration in the cell"),
    Column("task", "i8", "1", "number of the random task, -1 for that of the base"),
    Column("seed", "i8", "1", "seed of the run"),
)
MEASURED = (
    text("verdict", ALL_VERDICTS, "how the run ended"),
    Column("usable", "i1", "1", "whether its calibration is usable"),
    Column("steps", "i8", "1", "commands sent, -1 where the run did not begin"),
    Column("rotation_deg", "f8", "deg", "true rotation from start to goal"),
    Column("distance_mm", "f8", "mm", "true distance of the centre from start to goal"),
    Column("position_error_mm", "f8", "mm", "true centre to true goal at the end"),
    Column("rotation_error_deg", "f8", "deg", "true rotation to the goal at the end"),
    Column("image_error_px", "f8", "px", "image error at the end, rms over markers and views"),
    Column("self_occluded_steps_left", "i8", "1", "instants at which the left camera is behind the face"),
    Column("self_occluded_steps_right", "i8", "1", "instants at which the right camera is behind the face"),
    Column("first_outside_image", "i8", "1", "first instant with a marker outside an image, -1 for never"),
    Column("first_beyond_limit", "i8", "1", "first instant beyond a joint limit, -1 for never"),
    Column("speed_limited_steps", "i8", "1", "commands scaled to the joint-speed limit"),
    Column("visibility_limited_steps", "i8", "1", "commands whose translation was kept within delta·tau_0"),
    Column("path_length_mm", "f8", "mm", "length of the path of the centre, from sample to sample"),
    Column("center_deviation_at_samples_mm", "f8", "mm", "largest distance of the centre from the line"),
    Column("effort", "f8", "rad²/s or m²/s", "integral of the squared joint velocities"),
)
BETWEEN = Column("center_deviation_mm", "f8", "mm", "largest distance of the centre, between samples too")


def columns_of(design: Design) -> tuple[Column, ...]:
    """All columns of the table of a sweep: numbers, inputs, what was measured."""
    about = "value of the grid"
    axes = [_input(axis.name, axis.values, about) for axis in design.axes]
    drawn = [_drawn(key, distribution) for key, distribution in design.sweep.random.items()]
    between = (BETWEEN,) if design.sweep.between_samples else ()
    return (*NUMBERS, *axes, *drawn, *MEASURED, *between)


def _drawn(key: str, distribution: Distribution) -> Column:
    if distribution.choice is not None:
        return _input(key, distribution.choice, "value drawn for the run")
    return Column(key, "f8", "1", "value drawn for the run")


def _input(name: str, values: Sequence[Any], about: str) -> Column:
    if all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values):
        return Column(name, "f8", "1", about)
    return text(name, [shown(value) for value in values], about)


def shown(value: Any) -> str:
    """A value as text, texts as they are."""
    return value if isinstance(value, str) else json.dumps(value)
