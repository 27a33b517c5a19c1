"""A plan as what a law follows: joints, points and images once a control period, [RH00] section 4."""

import math

import numpy as np

from projservo_cli.geometry.kinematics import project
from projservo_cli.geometry.lens import straight_views
from projservo_cli.records import FloatArray, InputError, Model, Plan, WorkFailed
from projservo_cli.task.face import Task
from projservo_cli.task.trajectory import Reference, trajectory_displacement

# A last period that is shorter than this share of one is none.
ROUND_OFF = 1e-9
# Share of a period over which image velocities are differences: what it leaves is the curvature of the
# image paths in so much of a period, a millionth of a pixel, far above round-off.
DIFFERENCE = 1e-4


def followed(model: Model, task: Task, plan: Plan, period: float, rate: float) -> Task:
    """The task with the plan to follow, [RH00] section 4.

    model : calibrated model, in whose frame the plan was made.
    period : control period, s.
    rate : factor of every command.
    Raises InputError if the plan has no time; WorkFailed if the joints cannot follow it.
    """
    times = _instants(plan, period)
    mu, q, A, s = _followed_at(model, task, plan, times)
    until_next = np.append(np.diff(times), 0.0)
    _, _, _, s_next = _followed_at(model, task, plan, times + DIFFERENCE * until_next)
    reference = Reference(
        plan.H_hat,
        np.array([plan.tau, plan.theta_r, plan.theta_p]),
        mu,
        q,
        np.ascontiguousarray(A),
        np.ascontiguousarray(s),
        np.ascontiguousarray((s_next - s) / DIFFERENCE),
        rate,
    )
    return task._replace(reference=reference)


def _instants(plan: Plan, period: float) -> FloatArray:
    """Times (k,), k ≥ 2, one control period apart, the last that at which the plan arrives, s.

    Raises InputError, WorkFailed as of ``followed``.
    """
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
    count = max(1, math.ceil(plan.duration / period - ROUND_OFF))
    return np.asarray(np.minimum(np.arange(count + 1) * period, plan.duration))


def _followed_at(
    model: Model, task: Task, plan: Plan, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Shares (k, 3), joints (k, n), points (k, m, 4) and straight pixels (k, 2, m, 2) at times (k,), s.

    The points are those that the planned displacement carries to where the face should be. What the plan
    is off at the goal is taken back along the path: points where they were measured one by one, and
    images by what the calibration is off there, so that both arrive where the goal was shown.
    """
    sigma = np.interp(times, plan.time, plan.sigma) if plan.time[-1] > 0.0 else np.ones(len(times))
    mu, q = (
        np.stack([np.interp(sigma, plan.sigma, row) for row in rows.T], axis=1) for rows in (plan.mu, plan.q)
    )
    H_d = np.array(
        [
            trajectory_displacement(plan.H_hat, (plan.tau, plan.theta_r, plan.theta_p), share)
            for share in (*mu, np.ones(3))
        ]
    )
    H_d, H_goal = np.swapaxes(H_d[:-1], 1, 2), H_d[-1].T
    A = plan.A @ H_d + sigma[:, None, None] * (task.A_star - plan.A @ H_goal)
    off = straight_views(model.lens, task.s_star) - project(model.P, task.A_star)
    s = np.moveaxis(project(model.P, A), 0, 1) + sigma[:, None, None, None] * off
    return mu, q, A @ np.linalg.inv(H_d), s
