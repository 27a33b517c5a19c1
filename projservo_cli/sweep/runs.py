"""A part of a sweep: runs with consecutive numbers, each to one row of the table."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from projservo_cli.config import Config
from projservo_cli.config.sweep import Distribution
from projservo_cli.loop.step import VERDICTS
from projservo_cli.records import Calibration, Plan, Trace, WorkFailed
from projservo_cli.stages import plan as planning
from projservo_cli.stages.sense import Sense, rotation_sense
from projservo_cli.stages.servo import Simulated, record, scene_of, sense_is_enough, simulate
from projservo_cli.stages.traces import (
    effort_of,
    motion_of,
    path_between_mm,
    rotation_between,
)
from projservo_cli.sweep.design import Design, TaskSet, name_of_run

NOT_CALIBRATED, NOT_STARTED = "not calibrated", "not started"
ALL_VERDICTS = (*VERDICTS, NOT_CALIBRATED, NOT_STARTED)
NONE = -1  # in columns of counts, where a run did not begin

Columns = dict[str, npt.NDArray[Any]]


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


@dataclass(frozen=True, eq=False)
class Part:
    """Runs ``first`` to ``last`` - 1 and all they need.

    Attributes
    ----------
    calibrations : by their key; None where there could be none.
    tasks : random tasks of the bases, by the number of the base.
    """

    design: Design
    first: int
    last: int
    calibrations: Mapping[str, Calibration | None]
    tasks: Mapping[int, TaskSet]


@dataclass(frozen=True, eq=False)
class Made:
    """Rows of a part, the traces that are kept, and how long it took, s."""

    first: int
    last: int
    columns: Columns
    traces: dict[int, Trace] = field(default_factory=dict)
    seconds: float = 0.0


def run_part(part: Part) -> Made:
    """Make the runs of a part; the same on any machine of one kind, whatever ran before.

    Raises
    ------
    InputError
        If a drawn value is not one that its key takes.
    """
    began = time.perf_counter()
    design = _interned(part.design)
    columns = columns_of(design)
    rows: list[dict[str, Any]] = []
    traces: dict[int, Trace] = {}
    wanted = set(design.sweep.traces)
    with threadpool_limits(1):  # with more, sums may be taken in another order
        for run in range(part.first, part.last):
            row, trace = _run(design, run, part, keep=run in wanted)
            rows.append(row)
            if trace is not None:
                traces[run] = trace
    table = {column.name: _column(column, rows) for column in columns}
    return Made(part.first, part.last, table, traces, time.perf_counter() - began)


_designs: dict[str, Design] = {}


def _interned(design: Design) -> Design:
    """One object for every copy of a design, so that what it has worked out is kept from part to part."""
    if design.key not in _designs:
        _designs.clear()
        _designs[design.key] = design
    return _designs[design.key]


def _column(column: Column, rows: Sequence[dict[str, Any]]) -> npt.NDArray[Any]:
    missing = math.nan if column.dtype == "f8" else NONE
    values = [row.get(column.name, missing) for row in rows]
    if column.dtype.startswith("S"):
        values = [value.encode() for value in values]
    return np.array(values, dtype=column.dtype)


def _run(design: Design, run: int, part: Part, *, keep: bool) -> tuple[dict[str, Any], Trace | None]:
    at = design.numbers(run)
    config = design.config(run, part.tasks)
    row: dict[str, Any] = {
        "run": run,
        "cell": at.cell,
        "draw": at.draw,
        "calibration": at.calibration,
        "task": at.task,
        "seed": config.seed,
    }
    for name, value in (design.values(at.cell) | design.drawn(run)).items():
        row[name] = shown(value) if not isinstance(value, (int, float)) or isinstance(value, bool) else value
    calibration = part.calibrations[design.calibration_key(at.cell, at.calibration)]
    if calibration is None:
        return row | {"verdict": NOT_CALIBRATED, "usable": 0}, None
    row["usable"] = int(calibration.usable)
    try:
        made, plan = trial(config, calibration)
    except WorkFailed:
        return row | {"verdict": NOT_STARTED}, None
    row |= measures(config, made, between_samples=design.sweep.between_samples)
    return row, record(config, name_of_run(config), plan, made) if keep else None


class Trial(NamedTuple):
    """A run, and the plan it was made with or as much of it as it needs."""

    made: Simulated
    plan: Plan | Sense


def trial(config: Config, calibration: Calibration) -> Trial:
    """One run of the only law of a configuration.

    Raises
    ------
    WorkFailed
        If the task cannot be begun.
    """
    name = name_of_run(config)
    scene = scene_of(config, calibration)
    plan: Plan | Sense
    if sense_is_enough(config, name):
        plan = rotation_sense(config, calibration, scene.reach, scene.sight)
    else:
        plan = planning.run(config, calibration)
    return Trial(simulate(config, calibration, plan, name, scene), plan)


def measures(config: Config, made: Simulated, *, between_samples: bool) -> dict[str, Any]:
    """What is measured of a run, by column."""
    log, steps = made.outcome.log, made.outcome.steps
    hidden = (log.hidden[: steps + 1] > 0.5).sum(axis=0)
    found = {
        "verdict": made.outcome.verdict,
        "steps": steps,
        "image_error_px": float(log.error[steps]),
        "self_occluded_steps_left": int(hidden[0]),
        "self_occluded_steps_right": int(hidden[1]),
        "first_outside_image": int(log.events[0]),
        "first_beyond_limit": int(log.events[1]),
        "speed_limited_steps": int((log.factor[:steps] < 1.0).sum()),
        "visibility_limited_steps": int(made.outcome.limited),
        "effort": effort_of(log, steps, config.control.period_s),
    }
    motion = motion_of(made.outcome, made.plant, made.truth, made.reach)
    if motion is None or made.reach.goal_pose is None:
        return found
    found |= {
        "rotation_deg": rotation_between(log.H[0] @ made.truth.robot.base_tool, made.reach.goal_pose),
        "distance_mm": 1e3 * float(np.linalg.norm(motion.goal[:3] - motion.start[:3])),
        "position_error_mm": motion.position_mm,
        "rotation_error_deg": motion.rotation_deg,
        "path_length_mm": motion.path_mm,
        "center_deviation_at_samples_mm": motion.at_samples_mm,
    }
    if between_samples:
        found[BETWEEN.name] = path_between_mm(made.outcome, made.plant, motion, config.control.period_s)
    return found
