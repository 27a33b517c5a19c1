"""Whole runs from their images to their numbers, in arrays that one run leaves to the next."""

import math
from typing import NamedTuple

import numpy as np
from numba import literal_unroll

from projservo_cli.control import address_of
from projservo_cli.control.law import (
    ERRORS,
    MAX_PARTS,
    Gains,
    Law,
    State,
    make_split,
    new_state,
    reset,
)
from projservo_cli.geometry.jit import inline, merged, njit
from projservo_cli.geometry.lens import undistort_into
from projservo_cli.loop.compiled_loop import Course, run_compiled
from projservo_cli.loop.run_metrics import Ended, Summary, summarize
from projservo_cli.loop.task_start import Rehearsal, first_parts, is_half_turn
from projservo_cli.loop.verdicts import RUNNING, Log, new_log
from projservo_cli.records import FloatArray, IntArray, Model
from projservo_cli.simulation.analytic_plant import Ends
from projservo_cli.task.body_pose import Body
from projservo_cli.task.face import (
    FOUND,
    Task,
    new_task,
    task_into,
)
from projservo_cli.task.target import body_task_into

# A run that could not be begun; other verdicts as of ``step``.
NOT_STARTED = -2
# Columns of the numbers of a run: verdict, steps, the numbers of its summary, and then, for each view, the
# times at which its camera is behind the face.
VERDICT, STEPS = range(2)
NUMBERS = ("verdict", "steps", *Summary._fields)
_NOT_OPENED = -1


class Setting(NamedTuple):
    """All that runs share which differ in their images alone; of a robot with six joints."""

    code: int  # code of the law
    model: Model  # calibrated, by which the task is partitioned
    believed: Model  # model of the law, the same or the metric one
    body: Body  # body that measures the task; none for point by point
    shares_task: bool  # whether the law measures the task in the same way; it else does point by point
    rehearse: bool  # whether half turns are rehearsed
    gains: Gains  # gains of the law
    course: Course  # true robot as the law observes it, from its first joints
    ends: Ends  # true poses of the tool
    pair: IntArray  # (2,) views from which the face is triangulated; none of one view
    q_near: FloatArray  # (n,) joints near the goal joints, rad or m


class _Scratch(NamedTuple):
    """Workspace in which the task of a run is measured, and the run driven."""

    images: FloatArray  # (2, V, b, 2) straight pixels of the images at the start and at the goal
    task: Task
    own_task: Task  # task, own_task: as partitioned, and as a law with other features sees it
    state: State
    own_state: State  # state, own_state: of the partition and of the law
    log: Log  # log of the run
    address: int  # address of the compiled law


class Batch:
    """Runs of a setting, one after the other, in arrays that one run leaves to the next.

    images : number of markers whose images are given at the start and at the goal.
    Raises WorkFailed if the face has fewer than three markers.
    """

    def __init__(self, setting: Setting, images: int) -> None:
        plant, limits, q_start = setting.course
        n, m = len(q_start), len(plant.M)
        V, pair, least = len(plant.O), setting.pair, plant.min_views
        observed, s_star = m + len(plant.pins), np.zeros((V, m, 2))
        body = setting.body._replace(in_goal=np.zeros((V, len(setting.body.M)), dtype=np.bool_))
        self.setting = setting
        self.scratch = _Scratch(
            images=np.zeros((2, V, images, 2)),
            task=new_task(setting.model, s_star, plant.center, pair, least)._replace(body=body),
            own_task=new_task(setting.believed, s_star, plant.center, pair, least),
            state=new_state(n, m, images, views=V),
            own_state=new_state(n, m, observed, views=V),
            log=new_log(
                n, observed, limits.max_steps, len(ERRORS), MAX_PARTS if setting.gains.substeps else 0, V
            ),
            address=address_of(setting.code),
        )
        self.rehearsal = Rehearsal(setting.model, q_start, m, plant.limits)

    def numbers(self, images: FloatArray, noise: FloatArray) -> FloatArray:
        """Measure the task, partition it, drive the law to its verdict and sum up: (r, ``NUMBERS`` + V).

        images : (r, 2, V, b, 2) of each run at the start and at the goal, the face first, px.
        noise : (r, k, V, m + p, 2) of the images of the loop, px; ``RUNNING`` is the verdict if it is too
            short.
        """
        numbers = np.full((len(images), len(NUMBERS) + images.shape[2]), math.nan)
        at, made, opened = self.scratch, 0, _NOT_OPENED
        while made < len(images):
            made += until_rehearsal(self.setting, images[made:], noise[made:], at, opened, numbers[made:])
            if made < len(images):
                opened, _, _ = self.rehearsal.better(at.task, at.state)
        return numbers


@njit
def until_rehearsal(
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

    opened : verdict of the first run, which was opened; otherwise ``_NOT_OPENED``.
    """
    for made in range(len(images)):
        status = opened
        if made > 0 or opened == _NOT_OPENED:
            status, theta_p = _open(setting, images[made], scratch)
            if status == FOUND and setting.rehearse and is_half_turn(theta_p):
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
    status, parts = first_parts(
        setting.model, scratch.task, scratch.images[0], setting.course.q_start, scratch.state
    )
    return status, parts.theta_p


@inline
def _measured_into(setting: Setting, model: Model, images: FloatArray, scratch: _Scratch, task: Task) -> int:
    """Measure a task from images (2, V, b, 2) at its start and goal, px; return the verdict."""
    for view in range(task.s_star.shape[0]):
        for k in range(task.s_star.shape[1]):
            for i in range(2):
                task.s_star[view, k, i] = images[1, view, k, i]
    undistort_into(model.lens, images[0], scratch.images[0])
    undistort_into(model.lens, images[1], scratch.images[1])
    state = scratch.state
    status, _ = task_into(model, scratch.images, task, state.A, state.work.system.rhs)
    if status == FOUND and task.body.M.shape[0] > 0:
        ends = setting.course.q_start, setting.q_near
        status, _ = body_task_into(
            model, ends, scratch.images, task, make_split(state), state.normal, state.pose
        )
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
    law = Law(setting.code, scratch.address, setting.believed, task, setting.gains)
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
        for view in range(scratch.log.hidden.shape[1]):
            numbers[column + view] = 0.0
            for k in range(steps + 1):
                numbers[column + view] += scratch.log.hidden[k, view]
