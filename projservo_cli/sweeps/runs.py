"""A part of a sweep: runs with consecutive numbers, each to one row of the table."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from projservo_cli.config.inputs import servo_inputs
from projservo_cli.geometry.null_space import COORDINATES
from projservo_cli.laws import CODES
from projservo_cli.loop.batch import NUMBERS, VERDICT, Batch, Setting
from projservo_cli.loop.compiled_loop import Course
from projservo_cli.loop.verdicts import INTERRUPTED, RUNNING, VERDICT_NAMES
from projservo_cli.messages import sentence_and_remedy
from projservo_cli.messages.verdict_causes import VERDICTS
from projservo_cli.records import (
    VIEWS,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    Plan,
    Trace,
    WorkFailed,
)
from projservo_cli.result_hashes import key_of
from projservo_cli.stages import plan as planning
from projservo_cli.stages.plan import rotation_sense
from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.scenario import RunScenario, run_scenario
from projservo_cli.stages.servo import drive, sense_is_enough
from projservo_cli.stages.stage_inputs import PlanInputs, ServoInputs
from projservo_cli.store.sweep_table import Failure, Heading, merge_failures
from projservo_cli.sweeps.design import RUNS, Design, name_of_run

_NOT_CALIBRATED, _NOT_STARTED = "not calibrated", "not started"
# Reason of a compiled run that did not start.
_UNMEASURED = "its images of start and goal do not show the task"
_LONGEST = 300  # characters of a reason that is kept
_NONE = -1  # value of counts, if a run did not begin


def _text(name: str, values: Sequence[str], about: str) -> Heading:
    """A column of texts, as wide as the longest of the possible ones."""
    return Heading(name, f"S{max(len(value.encode()) for value in values)}", "1", about)


NUMBERED = (
    Heading("run", "i8", "1", "number of the run"),
    Heading("cell", "i8", "1", "number of its cell of the grid"),
    Heading("draw", "i8", "1", "number of the run in its cell; runs of one number share task and noise"),
    Heading("calibration", "i8", "1", "number of the calibration in the cell"),
    Heading("task", "i8", "1", "number of the random task, -1 for the task of the base"),
    Heading("seed", "i8", "1", "seed of the run"),
)


def _self_occluded(view: Sequence[str]) -> list[str]:
    """Columns of the times at which each camera is behind the face."""
    return [f"self_occluded_steps_{name}" for name in view]


def measured_columns(view: Sequence[str] = VIEWS) -> tuple[Heading, ...]:
    """Columns of the values that are measured of each run, of a rig with some views."""
    about = (f"times at which the {name} camera is behind the face" for name in view)
    hidden = (Heading(name, "i8", "1", text) for name, text in zip(_self_occluded(view), about, strict=True))
    return (
        _text("verdict", VERDICT_NAMES, "verdict of the run"),
        Heading(
            "success",
            "u1",
            "1",
            "1 if it converged and at every time, in truth, no joint was past a limit, no camera behind "
            "the face and every marker of the face in both images",
        ),
        Heading("usable", "i1", "1", "whether its calibration is usable"),
        Heading("steps", "i8", "1", "commands sent, -1 if the run did not begin"),
        Heading("rotation_deg", "f8", "deg", "true rotation from start to goal"),
        Heading("distance_mm", "f8", "mm", "true distance of the centre from start to goal"),
        Heading("position_error_mm", "f8", "mm", "true centre to true goal at the end"),
        Heading("rotation_error_deg", "f8", "deg", "true rotation to the goal at the end"),
        Heading("image_error_px", "f8", "px", "image error at the end, rms over markers and views"),
        *hidden,
        Heading(
            "first_outside_image", "i8", "1", "first time index with a marker outside an image, -1 for never"
        ),
        Heading("first_beyond_limit", "i8", "1", "first time index beyond a joint limit, -1 for never"),
        Heading("speed_limited_steps", "i8", "1", "commands scaled to the joint-speed limit"),
        Heading(
            "visibility_limited_steps",
            "i8",
            "1",
            "commands whose translation was limited to visibility_fraction·tau_0",
        ),
        Heading("path_length_mm", "f8", "mm", "length of the path of the centre, from sample to sample"),
        Heading("center_deviation_at_samples_mm", "f8", "mm", "maximum distance of the centre from the line"),
        Heading("effort", "f8", "rad²/s or m²/s", "integral of the squared joint velocities"),
    )


BETWEEN = Heading("center_deviation_mm", "f8", "mm", "maximum distance of the centre, between samples too")


def columns_of(design: Design) -> tuple[Heading, ...]:
    """All columns of the table of a sweep: numbers, inputs, measured values.

    Raises InputError for an axis that has the name of another column.
    """
    axes = [_input(axis.name, axis.values, "value of the grid") for axis in design.axes]
    random = design.sweep.random.items()
    drawn = [_input(key, given.choice or (0.0,), "value drawn for the run") for key, given in random]
    measured = (*measured_columns(design.view), *([BETWEEN] if design.sweep.between_samples else []))
    taken = {column.name for column in (*NUMBERED, *measured)}
    for name in taken.intersection(axis.name for axis in (*axes, *drawn)):
        raise InputError(
            f"grid.{name}: the table has another column of this name: call the axis otherwise, such as "
            f"my_{name}: {{keys: [{name}], values: [...]}}"
        )
    return (*NUMBERED, *axes, *drawn, *measured)


def _input(name: str, values: Sequence[Any], about: str) -> Heading:
    """A column of values that are given: of numbers if all are, otherwise of texts."""
    displayed = [_displayed(value) for value in values]
    if any(isinstance(value, str) for value in displayed):
        return _text(name, [str(value) for value in displayed], about)
    return Heading(name, "f8", "1", about)


def _displayed(value: Any) -> Any:
    """Numbers and texts as they are, other values as text."""
    return value if type(value) in (int, float, str) else json.dumps(value)


_Columns = dict[str, npt.NDArray[Any]]
# Text of a verdict of the kernel in the table.
_SAID = {code: name.encode() for code, name in enumerate(VERDICT_NAMES)}


class Part(NamedTuple):
    """Runs ``first`` to ``last`` - 1 and all they need."""

    design: Design
    first: int
    last: int
    calibrations: Mapping[str, Calibration | None]  # calibrations by key; None if there could be none


class _Made(NamedTuple):
    """Rows of a part, the traces that are kept, and why runs failed or did not start."""

    columns: _Columns
    traces: dict[int, Trace]
    failures: dict[str, Failure]  # failures by the name of the law


def run_part(part: Part) -> _Made:
    """Make the runs of a part; the same on any machine of one kind, after any other runs."""
    design = _interned(part.design)
    runs = np.arange(part.first, part.last)
    table = _numbered(design, runs)
    traces: dict[int, Trace] = {}
    failures: dict[str, Failure] = {}
    wanted = set(design.sweep.traces)
    with threadpool_limits(1):  # more threads may change the order of sums
        for these in _alike(design, runs):
            rows = these - part.first
            first = int(these[0])
            cell, _, number, _ = design.numbers(first)
            calibration = part.calibrations[design.calibration_key(cell, number)]
            inputs = design.values(cell) | design.drawn(first)
            _put(table, rows, {name: _displayed(value) for name, value in inputs.items()})
            if calibration is None:
                _put(table, rows, {"verdict": _NOT_CALIBRATED, "usable": 0})
                continue
            _put(table, rows, {"usable": int(calibration.usable)})
            config = design.config(first)
            given, name = servo_inputs(config), name_of_run(config)
            reasons: dict[int, str] = {}
            if is_compiled(design, given, name):
                measured, why = _measured(given, name, calibration, table["seed"][rows])
                _put(table, rows, measured)
                reasons = dict(zip(these.tolist(), why, strict=True))
                these = np.array([run for run in these if run in wanted], dtype=np.int64)
            for run in these.tolist():
                row, trace, reasons[run] = _run(design, run, calibration, keep=run in wanted)
                _put(table, np.array([run - part.first]), row)
                if trace is not None:
                    traces[run] = trace
            failed = (Failure(1, run, reason[:_LONGEST]) for run, reason in reasons.items() if reason)
            merge_failures(failures, ((name, one) for one in failed))
    return _Made(table, traces, failures)


def _alike(design: Design, runs: IntArray) -> Iterator[IntArray]:
    """Runs in groups that differ in their seeds alone."""
    at = design.placed(runs)
    drawn = at.draw if design.sweep.random else np.zeros_like(runs)
    keys = np.stack([at.cell, at.calibration, at.task, drawn])
    _, group = np.unique(keys, axis=1, return_inverse=True)
    order = np.argsort(group, kind="stable")
    yield from (runs[these] for these in np.split(order, np.flatnonzero(np.diff(group[order])) + 1))


def is_compiled(design: Design, given: ServoInputs, name: str) -> bool:
    """Whether a run is made by the kernel of whole runs, which needs no plan and leaves no trace."""
    six = len(given.plan.joints.types) == COORDINATES
    kernel = six and sense_is_enough(given, name) and given.plan.trajectory.rehearses
    return kernel and not design.sweep.between_samples


def _numbered(design: Design, runs: IntArray) -> _Columns:
    """Rows of runs that are not made yet, with their numbers and seeds."""
    missing = {"f8": math.nan, "i8": _NONE, "i1": _NONE, "u1": 0}
    table = {
        column.name: np.full(len(runs), missing.get(column.dtype, b""), dtype=column.dtype)
        for column in columns_of(design)
    }
    at = design.placed(runs)
    for name, number in at._asdict().items():
        table[name][:] = number
    table["seed"][:] = [design.seed(RUNS, number) for number in at.draw.tolist()]
    return table


def _put(table: _Columns, rows: IntArray, values: Mapping[str, Any]) -> None:
    """Write values of columns, texts as bytes, one for all rows or one each."""
    for name, value in values.items():
        table[name][rows] = value.encode() if isinstance(value, str) else value


def _measured(
    given: ServoInputs, name: str, calibration: Calibration, seeds: IntArray
) -> tuple[dict[str, Any], Sequence[str]]:
    """Return the measured values of compiled runs, by column, and why each did not start, if so."""
    try:
        scenario = run_scenario(given, calibration)
        numbers = _numbers_of(scenario, name, seeds.tolist())
    except WorkFailed as error:
        return {"verdict": _NOT_STARTED}, [str(error)] * len(seeds)
    names = (*NUMBERS, *_self_occluded(scenario.world.view))
    found: dict[str, Any] = dict(zip(names, numbers.T, strict=True))
    for column in measured_columns(scenario.world.view):
        if column.dtype == "i8":
            found[column.name] = np.where(numbers[:, VERDICT] < 0, _NONE, found[column.name])
    found["success"] = found["success"] == 1.0
    found["verdict"] = [_SAID.get(int(code), _NOT_STARTED.encode()) for code in numbers[:, VERDICT]]
    return found, ["" if code in _SAID else _UNMEASURED for code in numbers[:, VERDICT].tolist()]


# Noise is drawn for this number of steps, and for this multiple if a run is longer.
_INSTANTS, _FURTHER = 192, 4
# Runs that compiled code makes in one call: their noise is a few hundred kilobytes.
_TOGETHER = 16


def _numbers_of(scenario: RunScenario, law: str, seeds: Sequence[int]) -> FloatArray:
    """Numbers (k, ``NUMBERS`` + V) of the runs of seeds (k), each a function of its seed alone."""
    setting = Setting(
        code=CODES[law],
        model=scenario.world.model,
        believed=scenario.believed_by(law),
        body=scenario.exact.body,
        shares_task=scenario.measures_body(law),
        rehearse=scenario.world.inputs.trajectory.rehearses,
        gains=scenario.gains,
        course=Course(scenario.plant_of(law), scenario.termination, scenario.exact.q_start),
        ends=scenario.true_ends,
        pair=scenario.exact.pair,
        q_near=scenario.exact.q_near,
    )
    batch = Batch(setting, len(scenario.world.numbers))
    found = np.empty((len(seeds), len(NUMBERS) + len(scenario.world.view)))
    for first in range(0, len(seeds), _TOGETHER):
        running, instants = list(range(first, min(first + _TOGETHER, len(seeds)))), _INSTANTS
        while running:  # those that outlast their noise are repeated with more
            drawn = min(instants, scenario.termination.max_steps + 1)
            displayed = [scenario.images_at(seeds[i]) for i in running]
            images = np.array([(ends.s_start, ends.s_star) for ends in displayed])
            noise = np.array(
                [scenario.simulated.noise(scenario.numbers_of(law), seeds[i], drawn) for i in running]
            )
            found[running] = batch.numbers(images, noise)
            running = [i for i in running if found[i, VERDICT] == RUNNING]
            instants *= _FURTHER
    return found


_designs: dict[str, Design] = {}


def _interned(design: Design) -> Design:
    """One object for every copy of a design, so that its derived results are kept from part to part."""
    if design.key not in _designs:
        _designs.clear()
        _designs[design.key] = design
    return _designs[design.key]


_plans: dict[str, Plan] = {}
_PLANS = 128  # that are kept


def _plan(given: PlanInputs, calibration: Calibration, calibration_key: str) -> Plan:
    """Plan of a run; laws on the same images share one."""
    key = key_of(given, before=calibration_key)
    if key not in _plans:
        made = planning.run(given, calibration)
        if len(_plans) >= _PLANS:
            del _plans[next(iter(_plans))]
        _plans[key] = made
    return _plans[key]


def _run(
    design: Design, run: int, calibration: Calibration, *, keep: bool
) -> tuple[dict[str, Any], Trace | None, str]:
    """Return the measured values of one run, by column, its trace if it is kept, and why it failed, if so."""
    config = design.config(run)
    given, name, (cell, _, number, _) = servo_inputs(config), name_of_run(config), design.numbers(run)
    try:
        scenario = run_scenario(given, calibration)
        if sense_is_enough(given, name) and given.plan.trajectory.rehearses:
            made = drive(scenario, rotation_sense(scenario), name)
        else:
            made = drive(scenario, _plan(given.plan, calibration, design.calibration_key(cell, number)), name)
    except WorkFailed as error:
        return {"verdict": _NOT_STARTED}, None, str(error)
    if made.verdict == VERDICT_NAMES[INTERRUPTED]:
        raise KeyboardInterrupt
    row = {"verdict": made.verdict, "steps": made.steps, **made.summary._asdict()}
    row |= zip(_self_occluded(scenario.world.view), made.self_occluded_steps, strict=True)
    if design.sweep.between_samples:
        row[BETWEEN.name] = made.deviation_mm()
    return (
        row,
        trace_of(made) if keep else None,
        ""
        if made.why is None or not VERDICTS[made.verdict].retried
        else sentence_and_remedy(made.why, made.setup),
    )
