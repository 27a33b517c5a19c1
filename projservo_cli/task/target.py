"""Target of a law: its task by the face, by all markers of the body, and with a plan to follow."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import mul, translation
from projservo_cli.geometry.jit import composed
from projservo_cli.geometry.kernels import COORDINATES
from projservo_cli.geometry.kinematics import forward, forward_kinematics, operators_at, project
from projservo_cli.geometry.lens import straight_views
from projservo_cli.geometry.mechanisms import span_of, workspace
from projservo_cli.records import PRISMATIC, FloatArray, InputError, Model, Plan, WorkFailed
from projservo_cli.task.body import NO_BODY, SETTLED, Body, carry, fit_body
from projservo_cli.task.face import (
    MISFIT_GOAL,
    MISFIT_START,
    NOT_UNIQUE,
    UNSEEN_GOAL,
    UNSEEN_START,
    Task,
    new_task,
    put_sides,
    put_task,
    require_found,
)
from projservo_cli.task.partition import Split, partition
from projservo_cli.task.trajectory import Reference, both_rotations, trajectory_displacement

# How far images may take the joints from a way through joint space: near a singularity they would lead them
# astray, and the way keeps as much from the joint limits.
_ROOM_RAD, _ROOM_M = math.radians(1.0), 0.002
# A last period that is shorter than this share of one is none.
_ROUND_OFF = 1e-9
# Share of a period over which image velocities are differences: what it leaves is the curvature of the
# image paths in so much of a period, a millionth of a pixel, far above round-off.
_DIFFERENCE = 1e-4


class Shown(NamedTuple):
    """Start and goal of a task as images show them: teaching by showing."""

    q_start: FloatArray  # (n,) joint readings at the start, rad or m, with the offset if there is one
    s_start: FloatArray
    s_star: FloatArray  # s_start, s_star: (2, b, 2) px of the face, then of its pins; NaN where unknown
    center: int  # position of the centre marker within the face, or ``MIDPOINT``
    pins: int = 0  # how many of the markers are not on the face
    body: Body = NO_BODY  # of all of them, to measure with; none to measure point by point

    def by_points(self) -> "Shown":
        """What they show of the face alone, to be measured point by point."""
        m = self.s_start.shape[1] - self.pins
        s_start, s_star = (np.ascontiguousarray(s[:, :m]) for s in (self.s_start, self.s_star))
        return Shown(self.q_start, s_start, s_star, self.center)

    def task(self, model: Model) -> Task:
        """What laws with a model, calibrated or metric, know of the task.

        Raises WorkFailed if a marker of the face cannot be triangulated, the face is degenerate or a camera
        looks along it; with a body, if a motion is not unique or the markers do not agree on a place of it.
        """
        m, n = self.s_start.shape[1] - self.pins, len(self.q_start)
        shown = np.array([straight_views(model.lens, s) for s in (self.s_start, self.s_star)])
        unseen = np.zeros((2, len(self.body.M)), dtype=np.bool_)
        task = new_task(model, self.s_star[:, :m], self.center)._replace(
            body=self.body._replace(shown=unseen)
        )
        require_found(*put_task(model, shown, task, np.zeros((m, 4)), np.zeros(m)))
        if len(self.body.M) > 0:
            work = workspace(n, 4 * m, span_of(model, task.A_star))
            k = len(work.basis)
            A, A_t, A_r = np.zeros((3, m, 4))
            split = Split(work=work, A=A, A_t=A_t, A_r=A_r, q_hat=np.zeros((3, k)), driven=np.zeros((2, k)))
            normal = np.zeros((COORDINATES, COORDINATES + 1))
            require_found(*put_body_task(model, self.q_start, shown, task, split, normal))
        return task


@composed
def put_body_task(
    model: Model, q_start: FloatArray, shown: FloatArray, task: Task, split: Split, normal: FloatArray
) -> tuple[int, int]:
    """Points of a task at the goal by the whole body instead of the face alone.

    The goal is found from the start by the partition of the task, which the triangulated face
    determines, and fitted to all markers seen there.

    shown : (2, 2, b, 2) straight pixels of the body at the start and at the goal, NaN where unseen.
    task : as ``put_task`` leaves it, with the body; on return with its points and the views that were shown.
    split : on return with the face at the start.
    normal : (6, 7) workspace of the fit of the body.
    Returns what is wrong, ``FOUND`` for nothing, and how many markers were seen, counted once a view.
    """
    goal = shown[1]
    there = fit_body(model.P, task.body, shown[0], forward(model, q_start), SETTLED, normal)
    if not there.settled:
        return MISFIT_START if there.found else UNSEEN_START, there.views
    operators_at(model, q_start, split.work.H_hat)
    carry(task.body, there.H, split.A)
    split.driven[:] = 0.0
    parts = partition(task, split)
    if not parts.found:
        return NOT_UNIQUE, 0
    turn = both_rotations(parts.H_r, parts.H_p, parts.theta_r, parts.theta_p)
    guess = mul(mul(translation(parts.H_t, parts.tau), turn), there.H)
    fit = fit_body(model.P, task.body, goal, guess, SETTLED, normal)
    if not fit.settled:
        return MISFIT_GOAL if fit.found else UNSEEN_GOAL, fit.views
    carry(task.body, fit.H, task.A_star)
    for view in range(2):
        for k in range(goal.shape[1]):
            task.body.shown[view, k] = math.isfinite(goal[view, k, 0]) and math.isfinite(goal[view, k, 1])
    return put_sides(task, split.A), fit.views


def followed(model: Model, task: Task, plan: Plan, period: float, rate: float) -> Task:
    """The task with the plan to follow, [RH00] section 4.

    model : calibrated, in whose frame the plan was made; period : of the control, s; rate : factor of every
        command.
    Raises InputError if the plan has no time; WorkFailed if the joints cannot follow it.
    """
    times = _instants(plan, period)
    mu, q, A, s = _followed_at(model, task, plan, times)
    until_next = np.append(np.diff(times), 0.0)
    _, _, _, s_next = _followed_at(model, task, plan, times + _DIFFERENCE * until_next)
    amplitudes = np.array([plan.tau, plan.theta_r, plan.theta_p])
    room = np.zeros(0) if len(mu) else np.where(model.joint_types == PRISMATIC, _ROOM_M, _ROOM_RAD)
    A, s, ahead = (np.ascontiguousarray(x) for x in (A, s, (s_next - s) / _DIFFERENCE))
    return task._replace(
        reference=Reference(
            H_hat=plan.H_hat, amplitudes=amplitudes, mu=mu, q=q, A=A, s=s, s_ahead=ahead, rate=rate, room=room
        )
    )


def _instants(plan: Plan, period: float) -> FloatArray:
    """Times (k,), k ≥ 2, one control period apart, the last that at which the plan arrives, s."""
    if not np.isfinite(plan.q).all():
        raise WorkFailed(
            "the joints cannot follow the planned motion to its end, so that there is nothing to track: "
            "choose another trajectory.profile, or control.without_plan replan to drive without a plan"
        )
    if plan.duration is None:
        raise InputError(
            "no joint that the plan moves has a speed limit that gives it a time in which to follow it: set "
            "trajectory.duration_s"
        )
    count = max(1, math.ceil(plan.duration / period - _ROUND_OFF))
    return np.asarray(np.minimum(np.arange(count + 1) * period, plan.duration))


def _followed_at(
    model: Model, task: Task, plan: Plan, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Shares (k, 3), joints (k, n), points (k, m, 4) and straight pixels (k, 2, m, 2) at times (k,), s.

    Of a way through joint space there are no shares, and displacements are those of the joints.

    The points are those that the planned displacement carries to where the face should be. What the plan
    is off at the goal is taken back along the path: points where they were measured one by one, and
    images by what the calibration is off there, so that both arrive where the goal was shown.
    """
    sigma = np.interp(times, plan.time, plan.sigma) if plan.time[-1] > 0.0 else np.ones(len(times))
    mu, q = (
        np.stack([np.interp(sigma, plan.sigma, row) for row in rows.T], axis=1) for rows in (plan.mu, plan.q)
    )
    if np.isnan(mu).any():
        mu, back = np.empty((0, 3)), np.linalg.inv(forward_kinematics(model, plan.q[0]))
        H_d = np.array([forward_kinematics(model, row) for row in (*q, plan.q[-1])]) @ back
    else:
        amplitudes = plan.tau, plan.theta_r, plan.theta_p
        H_d = trajectory_displacement(plan.H_hat, amplitudes, np.append(mu, np.ones((1, 3)), axis=0))
    H_d, H_goal = np.swapaxes(H_d[:-1], 1, 2), H_d[-1].T
    A = plan.A @ H_d + sigma[:, None, None] * (task.A_star - plan.A @ H_goal)
    off = straight_views(model.lens, task.s_star) - project(model.P, task.A_star)
    s = np.moveaxis(project(model.P, A), 0, 1) + sigma[:, None, None, None] * off
    return mu, q, A @ np.linalg.inv(H_d), s
