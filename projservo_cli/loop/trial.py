"""Whole runs from their images to their numbers, in arrays that one run leaves to the next."""

import math
from typing import NamedTuple

import numpy as np
from numba import literal_unroll

from projservo_cli.control.law import ERRORS, MOST_PARTS, Gains, State, new_state, reset
from projservo_cli.geometry.jit import composed, njit
from projservo_cli.geometry.lens import straight
from projservo_cli.loop.beginning import Stage, first_parts, in_better_sense, is_half_turn, new_stage
from projservo_cli.loop.compiled import Log, new_log, run
from projservo_cli.loop.step import RUNNING, Limits
from projservo_cli.loop.summary import Ends, Summary, summary
from projservo_cli.plants.plant import Plant
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.body import Body
from projservo_cli.task.face import FOUND, NOT_UNIQUE, Task, new_task, put_task
from projservo_cli.task.target import Bench, new_bench, put_body_task

# A run that could not be begun; other verdicts as of ``step``.
NOT_STARTED = -2
# Columns of the numbers of a run: verdict, steps, then those of its summary.
VERDICT, STEPS = range(2)
NUMBERS = ("verdict", "steps", *Summary._fields)


class Setting(NamedTuple):
    """All that runs share which differ in their images alone; of a robot with six joints.

    Attributes
    ----------
    code : of the law.
    model : calibrated, by which the task is partitioned.
    believed : what the law believes, the same or the metric one.
    body : with which the task is measured; none for point by point.
    shares_task : whether the law measures the task in the same way; it else does point by point.
    rehearse : whether half turns are rehearsed.
    gains, limits : of the law.
    plant : true robot as the law observes it.
    lower, upper : (n,) limits of the joints, rad or m.
    q_start : (n,) joints at the start, rad or m.
    ends : true poses of the tool.
    """

    code: int
    model: Model
    believed: Model
    body: Body
    shares_task: bool
    rehearse: bool
    gains: Gains
    limits: Limits
    plant: Plant
    lower: FloatArray
    upper: FloatArray
    q_start: FloatArray
    ends: Ends


class Measuring(NamedTuple):
    """Workspace in which the task of a run is measured.

    Attributes
    ----------
    start, goal : (2, b, 2) straight pixels of the images there.
    bench : in which the task is measured.
    task, own_task : as it is partitioned, and as a law sees it that measures in another way.
    state, own_state : of the partition and of the law.
    """

    start: FloatArray
    goal: FloatArray
    bench: Bench
    task: Task
    own_task: Task
    state: State
    own_state: State


class Desk(NamedTuple):
    """Workspace for the runs of a setting, one after the other.

    Attributes
    ----------
    measuring : of the task.
    stage : for half turns.
    log : of the run.
    """

    measuring: Measuring
    stage: Stage
    log: Log


def new_desk(setting: Setting, shown: int) -> Desk:
    """Workspace for a setting in which so many markers are shown at the start and at the goal.

    Raises
    ------
    WorkFailed
        If the face has fewer than three markers.
    """
    n, m = len(setting.q_start), len(setting.plant.M)
    observed = m + len(setting.plant.pins)
    s_star = np.zeros((2, m, 2))
    body = setting.body._replace(shown=np.zeros((2, len(setting.body.M)), dtype=np.bool_))
    center, parts = setting.plant.center, MOST_PARTS if setting.gains.substeps else 0
    measuring = Measuring(
        np.zeros((2, shown, 2)),
        np.zeros((2, shown, 2)),
        new_bench(n, m),
        new_task(setting.model, s_star, center)._replace(body=body),
        new_task(setting.believed, s_star, center),
        new_state(n, m, shown),
        new_state(n, m, observed),
    )
    return Desk(
        measuring,
        new_stage(setting.model, m, setting.lower, setting.upper),
        new_log(n, observed, setting.limits.max_steps, len(ERRORS), parts),
    )


@composed
def put_measured(model: Model, q_start: FloatArray, shown: FloatArray, desk: Measuring, task: Task) -> int:
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
def opened(
    model: Model,
    believed: Model,
    shares_task: bool,
    q_start: FloatArray,
    shown: FloatArray,
    desk: Measuring,
) -> tuple[int, float, float]:
    """Measure and partition a task, and measure it as the law will.

    Parameters
    ----------
    model, believed, shares_task, q_start : of the setting.
    shown : (2, 2, b, 2) images at the start and at the goal, the face first, px.
    desk : on return with tasks and states.

    Returns
    -------
    What is wrong, ``FOUND`` for nothing; the angles onto and within the plane, rad.
    """
    reset(desk.own_state)
    if not shares_task:
        status = put_measured(believed, q_start, shown, desk, desk.own_task)
        if status != FOUND:
            return status, 0.0, 0.0
    status = put_measured(model, q_start, shown, desk, desk.task)
    if status != FOUND:
        return status, 0.0, 0.0
    reset(desk.state)
    status, parts = first_parts(model, desk.task, desk.start, q_start, desk.state)
    return status, parts.theta_r, parts.theta_p


def trials(setting: Setting, shown: FloatArray, noise: FloatArray, desk: Desk, numbers: FloatArray) -> None:
    """Runs, one after the other: measure the task, partition it, drive the law to its verdict, and sum up.

    Parameters
    ----------
    shown : (r, 2, 2, b, 2) images of each run at the start and at the goal, the face first, px.
    noise : (r, k, 2, m + p, 2) of the images of the loop, px; ``RUNNING`` is the verdict where it is too
        short.
    desk : workspace.
    numbers : (r, ``NUMBERS``) on return the numbers of the runs.
    """
    made = 0
    while made < len(shown):
        made = without_rehearsal(setting, shown, noise, desk.measuring, desk.log, made, numbers)
        if made < len(shown):
            rehearsed(setting, noise[made], desk, numbers[made])
            made += 1


@njit
def without_rehearsal(
    setting: Setting,
    shown: FloatArray,
    noise: FloatArray,
    desk: Measuring,
    log: Log,
    first: int,
    numbers: FloatArray,
) -> int:
    """Runs from the first on, up to one whose half turn is to be rehearsed; that one is opened.

    A call takes as long as a tenth of a run to hand its arguments over, and all of it with the lock of the
    interpreter held: hence many runs a call.
    """
    runs = len(shown)
    for made in range(first, runs):
        status, theta_r, theta_p = opened(
            setting.model, setting.believed, setting.shares_task, setting.q_start, shown[made], desk
        )
        if status == FOUND and setting.rehearse and is_half_turn(theta_p):
            return made
        driven(setting, status, theta_r, theta_p, noise[made], desk, log, numbers[made])
    return runs


def rehearsed(setting: Setting, noise: FloatArray, desk: Desk, numbers: FloatArray) -> None:
    """One run that was opened, its half turn in the better sense."""
    at = desk.measuring
    parts, _ = in_better_sense(setting.model, at.task, setting.q_start, at.state, desk.stage)
    status = FOUND if parts.found else NOT_UNIQUE
    driven(setting, status, parts.theta_r, parts.theta_p, noise, at, desk.log, numbers)


@njit
def driven(
    setting: Setting,
    status: int,
    theta_r: float,
    theta_p: float,
    noise: FloatArray,
    desk: Measuring,
    log: Log,
    numbers: FloatArray,
) -> None:
    """Drive the law of a run that was opened, with what is wrong and its angles, rad; its numbers."""
    for i in range(numbers.shape[0]):
        numbers[i] = math.nan
    numbers[VERDICT] = NOT_STARTED
    if status != FOUND:
        return
    state = desk.own_state
    for i in range(state.memory.rotation.shape[1]):
        state.memory.rotation[0, i] = desk.state.q_hat[1, i] if theta_r >= 0.0 else -desk.state.q_hat[1, i]
        state.memory.rotation[1, i] = desk.state.q_hat[2, i] if theta_p >= 0.0 else -desk.state.q_hat[2, i]
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
        log,
    )
    numbers[VERDICT] = verdict
    numbers[STEPS] = steps
    if verdict != RUNNING:
        found = summary(setting.plant, log, steps, state.limited[0], setting.gains.period, setting.ends)
        column = 2
        for value in literal_unroll(found):
            numbers[column] = value
            column += 1
