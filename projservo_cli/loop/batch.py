"""Whole runs from their images to their numbers, in arrays that one run leaves to the next."""

import math
from typing import NamedTuple

import numpy as np
from numba import literal_unroll

from projservo_cli.control.law import (
    ERRORS,
    MAX_PARTS,
    Gains,
    Law,
    State,
    make_split,
    measure,
    new_state,
    reset,
)
from projservo_cli.geometry.algebra import as_array
from projservo_cli.geometry.jit import inline, merged, njit
from projservo_cli.geometry.kinematics import backward
from projservo_cli.geometry.lens import undistort_into
from projservo_cli.geometry.mechanisms import OWN, Span, make_span
from projservo_cli.laws import CODES
from projservo_cli.loop.compiled import Course, run_compiled
from projservo_cli.loop.run_metrics import Ended, Summary, summarize
from projservo_cli.loop.verdicts import CONVERGED, RUNNING, Limits, Log, new_log
from projservo_cli.records import FloatArray, JointLimits, Model
from projservo_cli.simulation.analytic_plant import Ends, Plant
from projservo_cli.task.body import NO_BODY, Body
from projservo_cli.task.face import (
    FOUND,
    MIDPOINT,
    NOT_MEASURED,
    NOT_UNIQUE,
    Task,
    center_of,
    new_task,
    require_found,
    task_into,
)
from projservo_cli.task.partition import NO_PARTS, Parts, partition
from projservo_cli.task.target import body_task_into

# Closer than this to half a turn, rad, calibration noise alone decides the sign of the angle.
_HALF_TURN_BAND = math.radians(2.0)
_REHEARSAL_STEPS = 300
_REHEARSAL_PX = 1.0
_REHEARSAL_STEP = math.radians(5.0)
_REHEARSAL = Gains(
    gain_t=0.1,
    gain_r=0.1,
    gain_p=0.1,
    gain_s=0.1,
    ratio_rp=1.0,
    gain=0.1,
    period=1.0,
    visibility_fraction=0.9,
)
_DIRECT_TWO = CODES["direct_two"]


class _Rehearsal:
    """Both senses of a half turn, tried on a robot that is as the model says, without noise.

    Either sense reaches the goal, but they take the joints elsewhere. Both are rehearsed at a tenth of the
    error and at most 5° a step; the sense that arrives without passing a joint limit is taken, between equals
    the one that arrives in fewer steps.

    model : calibrated; q_start : (n,) first joints, rad or m; m : markers of the face; bounds : of
        the joints; span : of an arm of n ≠ 6 joints.
    """

    def __init__(
        self, model: Model, q_start: FloatArray, m: int, bounds: JointLimits, span: Span = OWN
    ) -> None:
        self.model, self.q_start, self.bounds, n = model, q_start, bounds, len(q_start)
        self.noise, self.state = np.zeros((_REHEARSAL_STEPS + 1, 2, m, 2)), new_state(n, m, span=span)
        self.log = new_log(n, m, _REHEARSAL_STEPS, len(ERRORS))

    def better(self, task: Task, state: State) -> tuple[int, Parts, bool]:
        """A partitioned task in the better sense: its verdict, its parts, and whether it arrives."""
        model = self.model
        # Cameras have no sign of their own; the plant distinguishes front and back by positive depths.
        depth = model.P[:, 2] @ np.array(center_of(state.A, MIDPOINT))
        oriented = model._replace(P=model.P * np.sign(depth)[:, None, None])
        M = np.ascontiguousarray(state.A @ as_array(backward(model, self.q_start)).T)
        endless = np.full((2, 2), np.inf)
        plant = Plant(oriented, M, task.order, task.center, task.O, task.visible, endless, self.bounds, False)
        law = Law(_DIRECT_TWO, oriented, task._replace(body=NO_BODY), _REHEARSAL)
        step = np.full(len(self.q_start), _REHEARSAL_STEP)
        q_hat_p = state.q_hat[2].copy()

        def simulated(sense: float, max_steps: int) -> tuple[bool, bool, int]:
            """Whether a sense fails to arrive, whether it passes a joint limit, and in how many steps."""
            reset(self.state)
            self.state.driven[1] = sense * q_hat_p
            limits = Limits(
                speed=step,
                image_error_px=_REHEARSAL_PX,
                diverged_factor=math.inf,
                stall_periods=20,
                max_steps=max_steps,
                stop_at_joint_limit=False,
                stop_at_border=False,
            )
            course = Course(plant, limits, self.q_start)
            verdict, steps = run_compiled(law, course, self.noise, self.state, self.log)
            return verdict != CONVERGED, bool(self.log.events[1] >= 0.0), steps

        first = simulated(1.0, _REHEARSAL_STEPS)
        # Where the first sense does well, the other one is better only if it arrives before.
        other = simulated(-1.0, _REHEARSAL_STEPS if any(first[:2]) else max(0, first[2] - 1))
        state.driven[1] = (-1.0 if other < first else 1.0) * q_hat_p
        parts = partition(task, make_split(state))
        return FOUND if parts.found else NOT_UNIQUE, parts, not (first[0] and other[0])


def begin(
    model: Model, task: Task, s: FloatArray, q_start: FloatArray, bounds: JointLimits | None
) -> tuple[State, Parts, bool]:
    """Measure and partition the task at its start.

    model : calibrated; task : in its frame.
    s : (2, b, 2) straight pixels at the start; q_start : (n,) joints there, rad or m.
    bounds : limits of the joints, where a half turn is to be made in the sense
        that is better when rehearsed.
    Returns the state with the face and the joint motions; the parts; False where neither sense of a half turn
    arrived. Raises WorkFailed if the face is not seen, or a motion not unique.
    """
    m, span, arrives = len(task.A_star), make_span(model, task.A_star), True
    state = new_state(len(q_start), m, span=span)
    status, parts = _first_parts(model, task, s, q_start, state)
    if status == FOUND and bounds is not None and _is_half_turn(parts.theta_p):
        status, parts, arrives = _Rehearsal(model, q_start, m, bounds, span).better(task, state)
    require_found(status, 0)
    return state, parts, arrives


@inline
def _first_parts(
    model: Model, task: Task, s: FloatArray, q_start: FloatArray, state: State
) -> tuple[int, Parts]:
    """Measure and partition the task in the sense of the angles; return the verdict and the parts."""
    if not measure(model, task, s, q_start, state):
        return NOT_MEASURED, NO_PARTS
    parts = partition(task, make_split(state))
    return FOUND if parts.found else NOT_UNIQUE, parts


@inline
def _is_half_turn(theta_p: float) -> bool:
    """Whether the rotation within the plane is so near to half a turn that its sense must be chosen."""
    return math.pi - abs(theta_p) < _HALF_TURN_BAND


# A run that could not be begun; other verdicts as of ``step``.
NOT_STARTED = -2
# Columns of the numbers of a run: verdict, steps, then those of its summary.
VERDICT, STEPS = range(2)
NUMBERS = ("verdict", "steps", *Summary._fields)
_NOT_OPENED = -1


class Setting(NamedTuple):
    """All that runs share which differ in their images alone; of a robot with six joints."""

    code: int  # of the law
    model: Model  # calibrated, by which the task is partitioned
    believed: Model  # model of the law, the same or the metric one
    body: Body  # with which the task is measured; none for point by point
    shares_task: bool  # whether the law measures the task in the same way; it else does point by point
    rehearse: bool  # whether half turns are rehearsed
    gains: Gains  # of the law
    course: Course  # true robot as the law observes it, from its first joints
    ends: Ends  # true poses of the tool


class _Scratch(NamedTuple):
    """Workspace in which the task of a run is measured, and the run driven."""

    images: FloatArray  # (2, 2, b, 2) straight pixels of the images at the start and at the goal
    task: Task
    own_task: Task  # task, own_task: as partitioned, and as a law with other features sees it
    state: State
    own_state: State  # state, own_state: of the partition and of the law
    log: Log  # of the run


class BatchRuns:
    """Runs of a setting, one after the other, in arrays that one run leaves to the next.

    images : number of markers whose images are given at the start and at the goal.
    Raises WorkFailed if the face has fewer than three markers.
    """

    def __init__(self, setting: Setting, images: int) -> None:
        plant, limits, q_start = setting.course
        n, m = len(q_start), len(plant.M)
        observed, s_star = m + len(plant.pins), np.zeros((2, m, 2))
        body = setting.body._replace(in_goal=np.zeros((2, len(setting.body.M)), dtype=np.bool_))
        self.setting = setting
        self.scratch = _Scratch(
            images=np.zeros((2, 2, images, 2)),
            task=new_task(setting.model, s_star, plant.center)._replace(body=body),
            own_task=new_task(setting.believed, s_star, plant.center),
            state=new_state(n, m, images),
            own_state=new_state(n, m, observed),
            log=new_log(
                n, observed, limits.max_steps, len(ERRORS), MAX_PARTS if setting.gains.substeps else 0
            ),
        )
        self.rehearsal = _Rehearsal(setting.model, q_start, m, plant.limits)

    def numbers(self, images: FloatArray, noise: FloatArray) -> FloatArray:
        """Measure the task, partition it, drive the law to its verdict and sum up: (r, ``NUMBERS``).

        images : (r, 2, 2, b, 2) of each run at the start and at the goal, the face first, px.
        noise : (r, k, 2, m + p, 2) of the images of the loop, px; ``RUNNING`` is the verdict where it is too
            short.
        """
        numbers = np.full((len(images), len(NUMBERS)), math.nan)
        at, made, opened = self.scratch, 0, _NOT_OPENED
        while made < len(images):
            made += _until_rehearsal(self.setting, images[made:], noise[made:], at, opened, numbers[made:])
            if made < len(images):
                opened, _, _ = self.rehearsal.better(at.task, at.state)
        return numbers


@njit
def _until_rehearsal(
    setting: Setting,
    images: FloatArray,
    noise: FloatArray,
    scratch: _Scratch,
    opened: int,
    numbers: FloatArray,
) -> int:
    """Runs up to one whose half turn is to be rehearsed, and how many; that one is opened.

    A call takes as long as a tenth of a run to hand its arguments over, and all of it with the lock of the
    interpreter held: hence many runs a call.

    opened : verdict of the first run, which was opened; else ``_NOT_OPENED``.
    """
    for made in range(len(images)):
        status = opened
        if made > 0 or opened == _NOT_OPENED:
            status, theta_p = _open(setting, images[made], scratch)
            if status == FOUND and setting.rehearse and _is_half_turn(theta_p):
                return made
        _drive(setting, status, noise[made], scratch, numbers[made])
    return len(images)


@merged
def _open(setting: Setting, images: FloatArray, scratch: _Scratch) -> tuple[int, float]:
    """Measure and partition a task, also as the law measures it; the verdict and the angle θ_p, rad."""
    reset(scratch.own_state)
    if not setting.shares_task:
        status = _measured_into(setting, setting.believed, images, scratch, scratch.own_task)
        if status != FOUND:
            return status, 0.0
    status = _measured_into(setting, setting.model, images, scratch, scratch.task)
    if status != FOUND:
        return status, 0.0
    reset(scratch.state)
    status, parts = _first_parts(
        setting.model, scratch.task, scratch.images[0], setting.course.q_start, scratch.state
    )
    return status, parts.theta_p


@inline
def _measured_into(setting: Setting, model: Model, images: FloatArray, scratch: _Scratch, task: Task) -> int:
    """Measure a task from images (2, 2, b, 2) at its start and goal, px; return the verdict."""
    for view in range(2):
        for k in range(task.s_star.shape[1]):
            for i in range(2):
                task.s_star[view, k, i] = images[1, view, k, i]
    undistort_into(model.lens, images[0], scratch.images[0])
    undistort_into(model.lens, images[1], scratch.images[1])
    state = scratch.state
    status, _ = task_into(model, scratch.images, task, state.A, state.work.system.rhs)
    if status == FOUND and task.body.M.shape[0] > 0:
        q_start = setting.course.q_start
        status, _ = body_task_into(model, q_start, scratch.images, task, make_split(state), state.normal)
    return status


@merged
def _drive(setting: Setting, status: int, noise: FloatArray, scratch: _Scratch, numbers: FloatArray) -> None:
    """Drive the law of a run that was opened; its numbers."""
    numbers[VERDICT] = NOT_STARTED
    if status != FOUND:
        return
    state = scratch.own_state
    for part in range(2):
        for i in range(state.driven.shape[1]):
            state.driven[part, i] = scratch.state.driven[part, i]
    task = scratch.task if setting.shares_task else scratch.own_task
    law = Law(setting.code, setting.believed, task, setting.gains)
    verdict, steps = run_compiled(law, setting.course, noise, state, scratch.log)
    numbers[VERDICT] = verdict
    numbers[STEPS] = steps
    if verdict != RUNNING:
        ended, period = Ended(verdict, steps, state.limited[0]), setting.gains.period
        summary = summarize(setting.course.plant, scratch.log, ended, period, setting.ends)
        column = 2
        for value in literal_unroll(summary):
            numbers[column] = value
            column += 1
