"""The task as all markers of the body show it: teaching by showing."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Mat4, mul, translation
from projservo_cli.geometry.jit import composed
from projservo_cli.geometry.kinematics import forward, operators_at
from projservo_cli.geometry.lens import straight_views
from projservo_cli.geometry.mechanisms import OWN, Span, Work, span_of, workspace
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.body import Body, Until, carry, fit_body, new_normal
from projservo_cli.task.face import (
    FOUND,
    MISFIT_GOAL,
    MISFIT_START,
    NOT_UNIQUE,
    UNSEEN_GOAL,
    UNSEEN_START,
    Task,
    new_task,
    put_task,
    require_found,
)
from projservo_cli.task.partition import Memory, partition_now
from projservo_cli.task.trajectory import turned

# A fit ends where a step moves the images by less than this, px rms a coordinate.
SETTLED_SIGHT_PX = 1e-6
MOST_SIGHT_STEPS = 30
SETTLED, TOO_FEW, UNSETTLED = range(3)  # how it ended


class Bench(NamedTuple):
    """Workspace in which a task is measured."""

    work: Work  # arrays of the kernels
    # A, A_t, A_r: (m, 4) the face at the start, the target without translation, and without both
    A: FloatArray
    A_t: FloatArray
    A_r: FloatArray
    q_hat: FloatArray  # (3, k) joint motions t, r, p, or coordinates in the span
    memory: Memory  # of the partition
    normal: FloatArray  # (6, 7) of the fit of the body
    angle: FloatArray  # (m,) of the order of the markers


def new_bench(n: int, m: int, span: Span = OWN) -> Bench:
    """Workspace for n joints and m markers of the face; an arm of n ≠ 6 joints has a span."""
    work = workspace(n, 4 * m, span)
    k = len(work.basis)
    A, A_t, A_r = np.zeros((3, m, 4))
    return Bench(work, A, A_t, A_r, np.zeros((3, k)), Memory(np.zeros((2, k))), new_normal(), np.zeros(m))


def task_from_body(
    model: Model,
    body: Body,
    q_start: FloatArray,
    s_start: FloatArray,
    s_star: FloatArray,
    center: int,
    m: int,
) -> Task:
    """What the laws know of a task, from images of the whole body.

    model, body : calibrated.
    q_start : (n,) joints at the start, rad or m.
    s_start, s_star : (2, b, 2) pixels of the body at the start and at the goal, the m of the face first,
        which both cameras must see; of the others NaN where unseen.
    center : index of the centre marker, or ``MIDPOINT``.
    m : markers of the face.
    Raises WorkFailed if the face cannot be triangulated, a motion is not unique or the markers do not agree
    on a place of the body.
    """
    shown = np.zeros(s_star.shape[:2], dtype=np.bool_)
    task = new_task(model, s_star[:, :m], center)._replace(body=body._replace(shown=shown))
    start, goal = straight_views(model.lens, s_start), straight_views(model.lens, s_star)
    bench = new_bench(len(q_start), m)
    require_found(*put_task(model.P, model.a_inf, start, goal, bench.A, bench.angle, task))
    bench = new_bench(len(q_start), m, span_of(model, task.A_star))
    require_found(*put_body_task(model, q_start, start, goal, bench, task))
    return task


@composed
def put_body_task(
    model: Model, q_start: FloatArray, start: FloatArray, goal: FloatArray, bench: Bench, task: Task
) -> tuple[int, int]:
    """Points of a task at the goal by the whole body instead of the face alone.

    The goal is found from the start by the partition of the task, which the triangulated face
    determines, and fitted to all markers seen there.

    start, goal : (2, b, 2) straight pixels of the body, NaN where unseen.
    bench : on return with the face at the start.
    task : as ``put_task`` leaves it, with the body; on return with its points and the views that were shown.
    Returns what is wrong, ``FOUND`` for nothing, and how many markers were seen, counted once a view.
    """
    ended, views, H_start = settled(model.P, task.body, start, forward(model, q_start), bench.normal)
    if ended != SETTLED:
        return UNSEEN_START if ended == TOO_FEW else MISFIT_START, views
    operators_at(model, q_start, bench.work.H_hat)
    carry(task.body, H_start, bench.A)
    bench.memory.rotation[:] = 0.0
    parts = partition_now(bench.work, task, bench.A, bench.A_t, bench.A_r, bench.q_hat, bench.memory)
    if not parts.found:
        return NOT_UNIQUE, 0
    turn = turned(parts.H_r, parts.H_p, parts.theta_r, parts.theta_p)
    H_guess = mul(mul(translation(parts.H_t, parts.tau), turn), H_start)
    ended, views, H_star = settled(model.P, task.body, goal, H_guess, bench.normal)
    if ended != SETTLED:
        return UNSEEN_GOAL if ended == TOO_FEW else MISFIT_GOAL, views
    carry(task.body, H_star, task.A_star)
    for view in range(2):
        for k in range(goal.shape[1]):
            task.body.shown[view, k] = math.isfinite(goal[view, k, 0]) and math.isfinite(goal[view, k, 1])
    return FOUND, views


@composed
def settled(P: FloatArray, body: Body, s: FloatArray, H: Mat4, normal: FloatArray) -> tuple[int, int, Mat4]:
    """Displacement of least reprojection error, from a predicted one.

    P : (2, 3, 4) cameras.
    s : (2, b, 2) straight pixels, NaN where unseen.
    H : prediction.
    normal : (6, 7) workspace.
    Returns ``SETTLED``, ``TOO_FEW`` markers seen, or ``UNSETTLED`` after the most steps; markers seen,
    counted once a; view; the displacement.
    """
    views = 0
    for _ in range(MOST_SIGHT_STEPS):
        fit = fit_body(P, body, s, H, Until(False, SETTLED_SIGHT_PX, 1), normal)
        views = fit.views
        if not fit.found:
            return TOO_FEW, views, H
        H = fit.H
        if fit.before - fit.after <= SETTLED_SIGHT_PX * SETTLED_SIGHT_PX * (2 * views):
            return SETTLED, views, H
    return UNSETTLED, views, H
