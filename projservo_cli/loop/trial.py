"""Whole runs from their images to their numbers, in arrays that one run leaves to the next."""

import math
from typing import NamedTuple

import numpy as np
from numba import literal_unroll

from projservo_cli.control import CODES
from projservo_cli.control.law import ERRORS, MOST_PARTS, Gains, State, measure, new_state, reset
from projservo_cli.geometry.algebra import as_array
from projservo_cli.geometry.jit import composed, njit
from projservo_cli.geometry.kinematics import backward
from projservo_cli.geometry.lens import straight
from projservo_cli.geometry.mechanisms import OWN, Span
from projservo_cli.loop.compiled import run
from projservo_cli.loop.step import CONVERGED, RUNNING, Limits, Log, new_log
from projservo_cli.loop.summary import Ends, Summary, summary
from projservo_cli.records import FloatArray, Model
from projservo_cli.robots.simulated import Plant
from projservo_cli.task.body import NO_BODY, Body
from projservo_cli.task.face import (
    FOUND,
    MIDPOINT,
    NOT_MEASURED,
    NOT_UNIQUE,
    Task,
    center_of,
    new_task,
    put_task,
)
from projservo_cli.task.partition import Parts, no_parts, partition, partition_now
from projservo_cli.task.target import Bench, new_bench, put_body_task

# Closer than this to half a turn, rad, calibration noise alone decides the sign of the angle.
HALF_TURN_BAND = math.radians(2.0)
REHEARSAL_STEPS = 300
REHEARSAL_PX = 1.0
REHEARSAL_STEP = math.radians(5.0)
REHEARSAL = Gains(0.1, 0.1, 0.1, 0.1, 1.0, 0.1, 1.0, 0.9)
DIRECT_TWO = CODES["direct_two"]


class _Stage(NamedTuple):
    """Where half turns are rehearsed: a robot that is as the model says, without noise."""

    limits: Limits  # at most 5° a step
    plant: Plant  # with the limits of the true joints; its model and face are those of the task
    noise: FloatArray  # (k, 2, m, 2) none
    state: State
    log: Log  # state, log: of the law and its run


def new_stage(model: Model, m: int, lower: FloatArray, upper: FloatArray, span: Span = OWN) -> _Stage:
    """Stage for a face of m markers and joint limits (n,), rad or m; an arm of n ≠ 6 joints has a span."""
    n, endless = len(lower), np.full(2, np.inf)
    no_face = (np.zeros((m, 4)), np.zeros(m, dtype=np.int64), MIDPOINT, np.zeros((2, 4)), np.zeros(2))
    return _Stage(
        Limits(np.full(n, REHEARSAL_STEP), REHEARSAL_PX, math.inf, 20, REHEARSAL_STEPS, False, False),
        Plant(model, *no_face, endless, lower, upper, False),
        np.zeros((REHEARSAL_STEPS + 1, 2, m, 2)),
        new_state(n, m, span=span),
        new_log(n, m, REHEARSAL_STEPS, len(ERRORS)),
    )


def begin(
    model: Model, task: Task, s: FloatArray, q_start: FloatArray, rehearse: bool, state: State, stage: _Stage
) -> tuple[int, Parts, bool]:
    """Measure and partition the task at its start.

    model : calibrated.
    task : in its frame.
    s : (2, b, 2) straight pixels at the start.
    q_start : (n,) joints there, rad or m.
    rehearse : whether a half turn is made in the sense that is better when rehearsed.
    state : fresh; on return with the face and the joint motions.
    Returns what is wrong, ``FOUND`` for nothing; the parts; False where neither sense of a half turn arrived.
    """
    status, parts = _first_parts(model, task, s, q_start, state)
    if status == FOUND and rehearse and _is_half_turn(parts.theta_p):
        parts, arrives = _in_better_sense(model, task, q_start, state, stage)
        return FOUND if parts.found else NOT_UNIQUE, parts, arrives
    return status, parts, True


@njit
def _first_parts(
    model: Model, task: Task, s: FloatArray, q_start: FloatArray, state: State
) -> tuple[int, Parts]:
    """Measure and partition the task in the sense that the angles have; what is wrong, and the parts."""
    if not measure(model, task, s, q_start, state):
        return NOT_MEASURED, no_parts()
    parts = partition(state.work, task, state.A, state.A_t, state.A_r, state.q_hat, state.memory)
    return FOUND if parts.found else NOT_UNIQUE, parts


@composed
def _is_half_turn(theta_p: float) -> bool:
    """Whether the rotation within the plane is so near to half a turn that its sense must be chosen."""
    return math.pi - abs(theta_p) < HALF_TURN_BAND


def _in_better_sense(
    model: Model, task: Task, q_start: FloatArray, state: State, stage: _Stage
) -> tuple[Parts, bool]:
    """The parts of a task that was partitioned, with its half turn in the better sense, and if it arrives."""
    sense, arrives = _half_turn_sense(model, task, state.A, q_start, state.q_hat[2], stage)
    state.memory.rotation[1] = sense * state.q_hat[2]
    parts = partition_now(state.work, task, state.A, state.A_t, state.A_r, state.q_hat, state.memory)
    return parts, arrives


def _half_turn_sense(
    model: Model, task: Task, A: FloatArray, q_start: FloatArray, q_hat_p: FloatArray, stage: _Stage
) -> tuple[float, bool]:
    """Sense of a half turn within the plane, 1 for that of the motion q̂_p or −1, and whether it arrives.

    Either sense reaches the goal, but they take the joints elsewhere. Both are rehearsed on the
    calibrated model itself, at a tenth of the error and at most 5° a step; the sense that arrives
    without passing a joint limit is taken, between equals the one that arrives in fewer steps.

    A : (m, 4) face at the start; q_hat_p : (n,) joint motion, or (6,) coordinates in the span.
    """
    # Cameras have no sign of their own; the plant tells front from back by positive depths.
    depth = model.P[:, 2] @ np.array(center_of(A, MIDPOINT))
    seen = model._replace(P=model.P * np.sign(depth)[:, None, None])
    plant = stage.plant._replace(
        model=seen,
        M=np.ascontiguousarray(A @ as_array(backward(model, q_start)).T),
        order=task.order,
        center=task.center,
        O=task.O,
        visible=task.visible,
    )
    task = task._replace(body=NO_BODY)

    def rehearsed(sense: float, most: int) -> tuple[bool, bool, int]:
        """Whether a sense arrives, whether it keeps within joint limits, and in how many steps."""
        state, log = stage.state, stage.log
        reset(state)
        state.memory.rotation[1] = sense * q_hat_p
        limits = stage.limits._replace(max_steps=most)
        verdict, steps = run(
            DIRECT_TWO, seen, task, REHEARSAL, limits, plant, stage.noise, q_start, state, log
        )
        return verdict == CONVERGED, bool(log.events[1] < 0.0), steps

    arrived, inside, steps = rehearsed(1.0, REHEARSAL_STEPS)
    # Where the first sense does well, the other one is better only if it arrives before.
    most = max(0, steps - 1) if arrived and inside else REHEARSAL_STEPS
    other_arrived, other_inside, other_steps = rehearsed(-1.0, most)
    better = (not other_arrived, not other_inside, other_steps) < (not arrived, not inside, steps)
    return (-1.0 if better else 1.0), arrived or other_arrived


# A run that could not be begun; other verdicts as of ``step``.
NOT_STARTED = -2
# Columns of the numbers of a run: verdict, steps, then those of its summary.
VERDICT, STEPS = range(2)
NUMBERS = ("verdict", "steps", *Summary._fields)


class Setting(NamedTuple):
    """All that runs share which differ in their images alone; of a robot with six joints."""

    code: int  # of the law
    model: Model  # calibrated, by which the task is partitioned
    believed: Model  # what the law believes, the same or the metric one
    body: Body  # with which the task is measured; none for point by point
    shares_task: bool  # whether the law measures the task in the same way; it else does point by point
    rehearse: bool  # whether half turns are rehearsed
    gains: Gains
    limits: Limits  # gains, limits: of the law
    plant: Plant  # true robot as the law observes it
    lower: FloatArray
    upper: FloatArray  # lower, upper: (n,) limits of the joints, rad or m
    q_start: FloatArray  # (n,) joints at the start, rad or m
    ends: Ends  # true poses of the tool


class _Measuring(NamedTuple):
    """Workspace in which the task of a run is measured, and the run driven."""

    start: FloatArray
    goal: FloatArray  # start, goal: (2, b, 2) straight pixels of the images there
    bench: Bench  # in which the task is measured
    task: Task
    own_task: Task  # task, own_task: as it is partitioned, and as a law sees it that measures in another way
    state: State
    own_state: State  # state, own_state: of the partition and of the law
    log: Log  # of the run


class _Opened(NamedTuple):
    """A task that was measured and partitioned: what is wrong, ``FOUND`` for nothing, and its angles, rad."""

    status: int
    theta_r: float
    theta_p: float


class _Desk(NamedTuple):
    """Workspace for the runs of a setting, one after the other."""

    measuring: _Measuring  # of the task and the run
    stage: _Stage  # for half turns


def new_desk(setting: Setting, shown: int) -> _Desk:
    """Workspace for a setting in which so many markers are shown at the start and at the goal.

    Raises WorkFailed if the face has fewer than three markers.
    """
    n, m = len(setting.q_start), len(setting.plant.M)
    observed = m + len(setting.plant.pins)
    s_star = np.zeros((2, m, 2))
    body = setting.body._replace(shown=np.zeros((2, len(setting.body.M)), dtype=np.bool_))
    center, parts = setting.plant.center, MOST_PARTS if setting.gains.substeps else 0
    measuring = _Measuring(
        np.zeros((2, shown, 2)),
        np.zeros((2, shown, 2)),
        new_bench(n, m),
        new_task(setting.model, s_star, center)._replace(body=body),
        new_task(setting.believed, s_star, center),
        new_state(n, m, shown),
        new_state(n, m, observed),
        new_log(n, observed, setting.limits.max_steps, len(ERRORS), parts),
    )
    return _Desk(measuring, new_stage(setting.model, m, setting.lower, setting.upper))


@composed
def _put_measured(model: Model, q_start: FloatArray, shown: FloatArray, desk: _Measuring, task: Task) -> int:
    """Measure a task from images (2, 2, b, 2) at its start and goal, px; what is wrong."""
    for view in range(2):
        for k in range(task.s_star.shape[1]):
            for i in range(2):
                task.s_star[view, k, i] = shown[1, view, k, i]
    straight(model.lens, shown[0], desk.start)
    straight(model.lens, shown[1], desk.goal)
    status, _ = put_task(model.P, model.a_inf, desk.start, desk.goal, desk.bench.A, desk.bench.angle, task)
    if status == FOUND and task.body.M.shape[0] > 0:
        status, _ = put_body_task(model, q_start, desk.start, desk.goal, desk.bench, task)
    return status


@njit
def _open(setting: Setting, shown: FloatArray, desk: _Measuring) -> _Opened:
    """Measure and partition a task, and measure it as the law will.

    shown : (2, 2, b, 2) images at the start and at the goal, the face first, px.
    desk : on return with tasks and states.
    """
    reset(desk.own_state)
    if not setting.shares_task:
        status = _put_measured(setting.believed, setting.q_start, shown, desk, desk.own_task)
        if status != FOUND:
            return _Opened(status, 0.0, 0.0)
    status = _put_measured(setting.model, setting.q_start, shown, desk, desk.task)
    if status != FOUND:
        return _Opened(status, 0.0, 0.0)
    reset(desk.state)
    status, parts = _first_parts(setting.model, desk.task, desk.start, setting.q_start, desk.state)
    return _Opened(status, parts.theta_r, parts.theta_p)


def trials(setting: Setting, shown: FloatArray, noise: FloatArray, desk: _Desk, numbers: FloatArray) -> None:
    """Runs, one after the other: measure the task, partition it, drive the law to its verdict, and sum up.

    shown : (r, 2, 2, b, 2) images of each run at the start and at the goal, the face first, px.
    noise : (r, k, 2, m + p, 2) of the images of the loop, px; ``RUNNING`` is the verdict where it is too
        short.
    desk : workspace.
    numbers : (r, ``NUMBERS``) on return the numbers of the runs.
    """
    made = 0
    while made < len(shown):
        made = _without_rehearsal(setting, shown, noise, desk.measuring, made, numbers)
        if made < len(shown):
            at = desk.measuring
            parts, _ = _in_better_sense(setting.model, at.task, setting.q_start, at.state, desk.stage)
            opened = _Opened(FOUND if parts.found else NOT_UNIQUE, parts.theta_r, parts.theta_p)
            _drive(setting, opened, noise[made], at, numbers[made])
            made += 1


@njit
def _without_rehearsal(
    setting: Setting, shown: FloatArray, noise: FloatArray, desk: _Measuring, first: int, numbers: FloatArray
) -> int:
    """Runs from the first on, up to one whose half turn is to be rehearsed; that one is opened.

    A call takes as long as a tenth of a run to hand its arguments over, and all of it with the lock of the
    interpreter held: hence many runs a call.
    """
    runs = len(shown)
    for made in range(first, runs):
        opened = _open(setting, shown[made], desk)
        if opened.status == FOUND and setting.rehearse and _is_half_turn(opened.theta_p):
            return made
        _drive(setting, opened, noise[made], desk, numbers[made])
    return runs


@njit
def _drive(
    setting: Setting, opened: _Opened, noise: FloatArray, desk: _Measuring, numbers: FloatArray
) -> None:
    """Drive the law of a run that was opened; its numbers."""
    for i in range(numbers.shape[0]):
        numbers[i] = math.nan
    numbers[VERDICT] = NOT_STARTED
    if opened.status != FOUND:
        return
    state, q_hat = desk.own_state, desk.state.q_hat
    for i in range(state.memory.rotation.shape[1]):
        state.memory.rotation[0, i] = q_hat[1, i] if opened.theta_r >= 0.0 else -q_hat[1, i]
        state.memory.rotation[1, i] = q_hat[2, i] if opened.theta_p >= 0.0 else -q_hat[2, i]
    verdict, steps = run(
        setting.code,
        setting.believed,
        desk.task if setting.shares_task else desk.own_task,
        setting.gains,
        setting.limits,
        setting.plant,
        noise,
        setting.q_start,
        state,
        desk.log,
    )
    numbers[VERDICT] = verdict
    numbers[STEPS] = steps
    if verdict != RUNNING:
        found = summary(setting.plant, desk.log, steps, state.limited[0], setting.gains.period, setting.ends)
        column = 2
        for value in literal_unroll(found):
            numbers[column] = value
            column += 1
