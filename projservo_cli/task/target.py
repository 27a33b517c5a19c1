"""Target of a law: its task by the face, by all markers of the body, and with a plan to follow."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import as_array, mat_into, mul
from projservo_cli.geometry.displacements import translation
from projservo_cli.geometry.jit import inline
from projservo_cli.geometry.kinematics import forward, forward_kinematics, operators_at, project
from projservo_cli.geometry.lens import undistort
from projservo_cli.geometry.mechanisms import make_span, rows_of, workspace
from projservo_cli.geometry.null_space import COORDINATES
from projservo_cli.records import VIEWS, FloatArray, InputError, IntArray, Model, Plan, WorkFailed
from projservo_cli.task.body_pose import NO_BODY, SETTLED, Body, carry, fit_body
from projservo_cli.task.face import (
    MISFIT_GOAL,
    MISFIT_START,
    NOT_UNIQUE,
    ONE_LINE,
    UNSEEN_GOAL,
    UNSEEN_START,
    Task,
    center_of,
    face_plane,
    new_task,
    order_into,
    require_found,
    sides_into,
    task_into,
)
from projservo_cli.task.incidences import (
    Incidence,
    Incidences,
    image_velocities,
    incidences_of,
    nearest_goal,
    points_of,
    weighted,
)
from projservo_cli.task.partition import Split, partition
from projservo_cli.task.trajectory import Reference, both_rotations, trajectory_displacement

# Maximum correction of a revolute joint off a joint-space path, rad: images mislead near a singularity.
_ROOM_RAD = math.radians(1.0)
# Maximum correction of a prismatic joint off a joint-space path, m; the path keeps as much from limits.
_ROOM_M = 0.002
# Last period, in periods, below which it is round-off.
_ROUND_OFF = 1e-9
# Share of a period for differences of image velocities: curvature errs by 1e-6 px, far above round-off.
_DIFFERENCE = 1e-4


def is_stereo(view: Sequence[str]) -> bool:
    """Tell whether there are two views, from which points are measured one by one."""
    return len(view) == len(VIEWS)


class Place(NamedTuple):
    """Pose of the body that was taught, where its carrier, the scene or an object, has it now."""

    s: FloatArray  # (V, b, 2) px of the body
    # (k, 4) markers of the object in the frame of the body, NaN where unseen; none of the scene
    M: FloatArray = np.zeros((0, 4))


class TargetGoal(NamedTuple):
    """Goal of a task: incidences, each at its carrier, or the whole pose."""

    locations: tuple[Place, ...]  # places of the scene, then of observed objects
    s: FloatArray  # (V, b, 2) px at the pose to drive to: of incidences the one that was chosen
    incidences: tuple[Incidence, ...] = ()  # incidences by positions in the body; none for the whole pose

    @classmethod
    def at(cls, s: FloatArray) -> "TargetGoal":
        """Return the whole pose that images (V, b, 2) show, and nothing carries."""
        return cls((Place(s),), s)

    @property
    def carriers(self) -> tuple[int, ...]:
        """Places of the carriers of its incidences, each once; of a whole pose the last one."""
        return tuple(sorted({one.carrier for one in self.incidences})) or (len(self.locations) - 1,)

    def place(self, carrier: int) -> Place:
        """Place of a carrier; of an object that was not looked at where the goal was taught."""
        return self.locations[carrier if carrier < len(self.locations) else 0]

    def carried_to(self, objects: Sequence[Place]) -> "TargetGoal":
        """Return the goal with its objects where they are now; all of it goes along, unless that tears it."""
        found = self._replace(locations=(self.locations[0], *objects))
        return found if len(found.carriers) > 1 else found._replace(s=found.place(*found.carriers).s)

    def to(self, s: FloatArray) -> "TargetGoal":
        """Return the goal where images (V, b, 2) show it, for any carrier."""
        return self._replace(locations=tuple(place._replace(s=s) for place in self.locations), s=s)


class TaskImages(NamedTuple):
    """Images at start and goal of a task: teaching by showing."""

    q_start: FloatArray  # (n,) joint readings at the start, rad or m, with the offset if there is one
    s_start: FloatArray  # (V, b, 2) px of the face, then of its pins, at the start; NaN if unknown
    goal: TargetGoal
    center: int  # index of the centre marker within the face, or ``MIDPOINT``
    pins: int = 0  # number of markers that are not on the face
    body: Body = NO_BODY  # body of all markers, to measure with; none to measure point by point
    view: tuple[str, ...] = VIEWS  # names of the views
    min_views: int = 0  # number of views that are to see the face, 0 for all
    # (n,) joints near the goal joints, rad or m, which predict its pose if no pair of views shows it
    q_near: FloatArray = np.zeros(0)

    @property
    def s_star(self) -> FloatArray:
        """Images (V, b, 2) at the pose to drive to, px."""
        return self.goal.s

    def to(self, s: FloatArray) -> "TaskImages":
        """Return the task to where images (V, b, 2) show the goal."""
        return self._replace(goal=self.goal.to(s))

    def asking(self, incidences: tuple[Incidence, ...]) -> "TaskImages":
        """Return the task with other incidences; without any for the whole pose."""
        return self._replace(goal=self.goal._replace(incidences=incidences))

    @property
    def pair(self) -> IntArray:
        """Views (2,) that show the whole face at start and goal, the first ones; none without two."""
        m = self.s_start.shape[1] - self.pins
        enough = np.isfinite([self.s_start[:, :m], self.s_star[:, :m]]).all(axis=(0, 2, 3))
        if is_stereo(self.view):
            return np.arange(len(self.view))
        return np.flatnonzero(enough)[:2] if enough.sum() > 1 else np.arange(0)

    def by_points(self) -> "TaskImages":
        """Select the markers of the face, to measure it point by point; incidences need the body."""
        m = self.s_start.shape[1] - self.pins
        s_start, s_star = (np.ascontiguousarray(s[:, :m]) for s in (self.s_start, self.s_star))
        return self._replace(s_start=s_start, goal=TargetGoal.at(s_star), pins=0, body=NO_BODY)

    def task(self, model: Model) -> Task:
        """Task of laws with a model, calibrated or metric.

        Raises WorkFailed if a marker of the face cannot be triangulated, the face is degenerate or edge-on in
        a view; with a body, if a motion is not unique or the markers do not fit a pose of the body.
        """
        task, H_star = self._measured(model)
        return task._replace(incidences=self._rows(model, task, H_star)) if self.goal.incidences else task

    def displacement_at_goal(self, model: Model) -> FloatArray:
        """Displacement (4, 4) of the body at the pose to drive to; raises as ``task``."""
        return self._measured(model)[1]

    def displacements_taught(self, model: Model, H_star: FloatArray | None = None) -> FloatArray:
        """Displacements (g, 4, 4) of the body where each incidence was taught; raises as ``task``.

        H_star : (4, 4) displacement at the pose to drive to, if it is known.
        """
        goal, found = self.goal, dict[int, FloatArray]()
        for carrier in goal.carriers:
            s = goal.place(carrier).s
            known = H_star if s is goal.s else None
            found[carrier] = self.to(s).displacement_at_goal(model) if known is None else known
        return np.array([found[one.carrier] for one in goal.incidences])

    def scenes(self, H_taught: FloatArray) -> list[FloatArray]:
        """Points (…, 4) that span the feature of the scene of each incidence, by displacements (g, 4, 4).

        Raises WorkFailed for one of the markers of an object that has not been looked at.
        """
        found = list[FloatArray]()
        for one, H in zip(self.goal.incidences, H_taught, strict=True):
            M = np.concatenate([self.body.M, self.goal.place(one.carrier).M])
            if not one.visible_by(range(len(M))):
                raise WorkFailed(f"incidence {one.name}: its object was not located: plan first")
            found.append(points_of(M, one.scene) @ H.T)
        return found

    def displacement_at_start(self, model: Model) -> FloatArray:
        """Displacement (4, 4) of the body at the start; raises WorkFailed where images do not show it."""
        unseen = np.zeros((len(model.P), len(self.body.M)), dtype=np.bool_)
        body, normal = self.body._replace(in_goal=unseen), np.zeros((COORDINATES, COORDINATES + 1))
        start = forward(model, self.q_start)
        fit = fit_body(model.P, body, undistort(model.lens, self.s_start), start, SETTLED, normal)
        if not fit.settled:
            require_found(MISFIT_START if fit.found else UNSEEN_START, fit.views, self.view)
        return as_array(fit.H)

    def _measured(self, model: Model) -> tuple[Task, FloatArray]:
        """Task without incidences, and the displacement (4, 4) of the body at its goal."""
        m, n, H_star = self.s_start.shape[1] - self.pins, len(self.q_start), np.eye(4)
        images = np.array([undistort(model.lens, s) for s in (self.s_start, self.s_star)])
        unseen = np.zeros((len(model.P), len(self.body.M)), dtype=np.bool_)
        task = new_task(model, self.s_star[:, :m], self.center, self.pair, self.min_views)._replace(
            body=self.body._replace(in_goal=unseen)
        )
        require_found(*task_into(model, images, task, np.zeros((m, 4)), np.zeros(m)), self.view)
        if len(self.body.M) > 0:
            work = workspace(n, rows_of(len(model.P), m), make_span(model, task.A_star))
            k = len(work.basis)
            A, A_t, A_r = np.zeros((3, m, 4))
            split = Split(work=work, A=A, A_t=A_t, A_r=A_r, q_hat=np.zeros((3, k)), driven=np.zeros((2, k)))
            normal = np.zeros((COORDINATES, COORDINATES + 1))
            ends = self.q_start, self.q_near
            require_found(*body_task_into(model, ends, images, task, split, normal, H_star), self.view)
        return task, H_star

    def _rows(self, model: Model, task: Task, H_star: FloatArray) -> Incidences:
        """Rows of the incidences by a task to the goal (4, 4)."""
        scenes = self.scenes(self.displacements_taught(model, H_star))
        rows = incidences_of(model, task.body, scenes, self.goal.incidences)
        A = np.ascontiguousarray(task.body.M[: len(task.A_star)])
        face = np.array(face_plane(A, task.order, center_of(A, task.center)))
        shows = task.body.in_goal
        goal = nearest_goal(rows, task.body, H_star, image_velocities(model, shows))
        return weighted(rows, model, task.body, goal, shows, face)


@inline
def body_task_into(
    model: Model,
    ends: tuple[FloatArray, FloatArray],
    images: FloatArray,
    task: Task,
    split: Split,
    normal: FloatArray,
    H_star: FloatArray,
) -> tuple[int, int]:
    """Complete the target points of a task by the whole body instead of the face alone.

    The partition of the task by the triangulated face predicts the pose at the goal, or the joints near it
    if there is no pair of views; it is then fitted to all markers seen there.

    ends : joints (n,) at the start, rad or m, and near the goal, (0,) with a pair of views.
    images : (2, V, b, 2) undistorted pixels of the body at the start and at the goal, NaN if unseen.
    task : as of ``task_into``, with the body; on return with its points and its views at the goal.
    split : on return with the face at the start.
    normal : (6, 7) workspace of the fit of the body.
    H_star : (4, 4) on return the displacement of the body at the goal.
    Returns the code of a problem, ``FOUND`` if there is none, and the number of markers seen, once a view.
    """
    goal, q_start = images[1], ends[0]
    there = fit_body(model.P, task.body, images[0], forward(model, q_start), SETTLED, normal)
    if not there.settled:
        return MISFIT_START if there.found else UNSEEN_START, there.views
    operators_at(model, q_start, split.work.H_hat)
    carry(task.body, there.H, split.A)
    if task.pair.shape[0] > 0:
        split.driven[:] = 0.0
        parts = partition(task, split)
        if not parts.found:
            return NOT_UNIQUE, 0
        turn = both_rotations(parts.H_r, parts.H_p, parts.theta_r, parts.theta_p)
        guess = mul(mul(translation(parts.H_t, parts.tau), turn), there.H)
    else:
        guess = forward(model, ends[1])
    fit = fit_body(model.P, task.body, goal, guess, SETTLED, normal)
    if not fit.settled:
        return MISFIT_GOAL if fit.found else UNSEEN_GOAL, fit.views
    carry(task.body, fit.H, task.A_star)
    mat_into(H_star, fit.H)
    if task.pair.shape[0] == 0 and not order_into(task.A_star, task.order, split.work.system.rhs):
        return ONE_LINE, 0
    for view in range(goal.shape[0]):
        for k in range(goal.shape[1]):
            task.body.in_goal[view, k] = math.isfinite(goal[view, k, 0]) and math.isfinite(goal[view, k, 1])
    return sides_into(task, split.A, images[0])


def followed(model: Model, task: Task, plan: Plan, period: float, rate: float) -> Task:
    """Add a plan to follow to a task, [RH00] section 4.

    model : calibrated model of the plan; period : of the control, s; rate : factor of every command.
    Raises InputError if the plan has no duration; WorkFailed if the joints cannot follow it.
    """
    times = _period_times(plan, period)
    mu, q, A, s = _followed_at(model, task, plan, times)
    until_next = np.append(np.diff(times), 0.0)
    _, _, _, s_next = _followed_at(model, task, plan, times + _DIFFERENCE * until_next)
    amplitudes = np.array([plan.tau, plan.theta_r, plan.theta_p])
    room = np.zeros(0) if len(mu) else np.where(model.prismatic, _ROOM_M, _ROOM_RAD)
    A, s, ahead = (np.ascontiguousarray(x) for x in (A, s, (s_next - s) / _DIFFERENCE))
    return task._replace(
        reference=Reference(
            H_hat=plan.H_hat, amplitudes=amplitudes, mu=mu, q=q, A=A, s=s, s_ahead=ahead, rate=rate, room=room
        )
    )


def _period_times(plan: Plan, period: float) -> FloatArray:
    """Times (k,), k ≥ 2, one control period apart, until the arrival of the plan, s."""
    if not np.isfinite(plan.q).all():
        raise WorkFailed(
            "the joints cannot follow the planned motion to its end: choose another trajectory.profile, or "
            "set control.on_plan_failure=regulate to drive without a plan"
        )
    if plan.duration is None:
        raise InputError(
            "the plan has no duration, as no joint that it moves has a speed limit: set trajectory.duration_s"
        )
    count = max(1, math.ceil(plan.duration / period - _ROUND_OFF))
    return np.asarray(np.minimum(np.arange(count + 1) * period, plan.duration))


def _followed_at(
    model: Model, task: Task, plan: Plan, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Shares (k, 3), joints (k, n), points (k, m, 4) and undistorted pixels (k, V, m, 2) at times (k,), s.

    A joint-space path has no shares; its displacements follow from the joints.

    The planned displacement carries the points to where the face should be. The error of the plan at the
    goal is corrected along the path, for points measured one by one and for images by the residual of the
    calibration there, so that both arrive at the taught goal.
    """
    sigma = np.interp(times, plan.time, plan.path_parameter) if plan.time[-1] > 0.0 else np.ones(len(times))
    mu, q = (
        np.stack([np.interp(sigma, plan.path_parameter, row) for row in rows.T], axis=1)
        for rows in (plan.mu, plan.q)
    )
    if np.isnan(mu).any():
        mu, back = np.empty((0, 3)), np.linalg.inv(forward_kinematics(model, plan.q[0]))
        H_d = np.array([forward_kinematics(model, row) for row in (*q, plan.q[-1])]) @ back
    else:
        amplitudes = plan.tau, plan.theta_r, plan.theta_p
        H_d = trajectory_displacement(plan.H_hat, amplitudes, np.append(mu, np.ones((1, 3)), axis=0))
    H_d, H_goal = np.swapaxes(H_d[:-1], 1, 2), H_d[-1].T
    A = plan.A @ H_d + sigma[:, None, None] * (task.A_star - plan.A @ H_goal)
    off = undistort(model.lens, task.s_star) - project(model.P, task.A_star)
    s = np.moveaxis(project(model.P, A), 0, 1) + sigma[:, None, None, None] * off
    return mu, q, A @ np.linalg.inv(H_d), s
