"""The motion of a plan by its profile, its time, and paths to the goal for a run that is under way."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.findings import REFUSES, Finding, Subject, usable
from projservo_cli.geometry.algebra import as_array
from projservo_cli.geometry.kinematics import forward, forward_kinematics, project
from projservo_cli.geometry.lens import undistort
from projservo_cli.planning.goal_configurations import GoalFeatures
from projservo_cli.planning.joint_constraints import Constraints, constraints_of
from projservo_cli.planning.keep_out import keep_out_of
from projservo_cli.planning.motion_margins import (
    CLEAR,
    IMAGE,
    Demands,
    Motion,
    Reaching,
    along_joints,
    along_shares,
    column,
    columns_of_kind,
)
from projservo_cli.planning.prediction_covariance import spread_of
from projservo_cli.planning.product_space import duration, evenly, plan_path
from projservo_cli.planning.rrt_connect import (
    JointPath,
    SearchLimits,
    find_path,
    first_within,
    margins_at,
    within_region,
)
from projservo_cli.planning.time_parameterization import TimedPath, joints_at, minimum_time
from projservo_cli.records import NO_SPREAD, FloatArray, Model, Plan, Spread, WorkFailed, changed
from projservo_cli.settings.task import Trajectory
from projservo_cli.stages.plan_summary import sight_of, verdict_of
from projservo_cli.stages.scenario import Scenario
from projservo_cli.task.body_pose import SETTLED, fit_body
from projservo_cli.task.face import Task
from projservo_cli.task.target import TaskImages
from projservo_cli.task.trajectory import profile_shares


class Found(NamedTuple):
    """A motion that was found for a task."""

    judged: Motion  # where the constraints were looked at
    motion: Motion  # as it is stored, at the instants sigma
    time: FloatArray  # (s,) when it is there, s; NaN if nothing limits the speed
    findings: tuple[Finding, ...]  # whether it may be followed; a path has its own
    path: JointPath | None = None  # through joint space, if one was searched
    entered: Finding | None = None  # the region that it enters and is to keep out of


def coupled(reaching: Reaching, trajectory: Trajectory) -> Found:
    """Shares of translation and rotations that keep all constraints, [RH00] section 4.3."""
    sigma = np.linspace(0.0, 1.0, trajectory.n_samples)
    judged = plan_path(reaching)
    motion = along_shares(judged.reaching, evenly(judged, sigma))
    if judged.holds() and not motion.holds():  # between the places that were looked at
        judged = motion
    _, nearest = verdict_of(judged)
    found = (nearest,) if usable([nearest]) else (Finding("no_coupled_path", REFUSES), nearest)
    return Found(judged, motion, _timed(sigma * duration(judged), sigma, trajectory), found)


def by_profile(
    profile: str, reaching: Reaching, trajectory: Trajectory, pure: tuple[float, float] = (1.0, 1.0)
) -> Found:
    """Shares of a profile of the paper; ``pure`` of translation and rotation at most before the other."""
    sigma = np.linspace(0.0, 1.0, trajectory.n_samples)
    motion = along_shares(reaching, profile_shares(profile, sigma, pure))
    speed = reaching.demands.limits.speed
    shortest = minimum_time(speed, motion.along.q) if np.isfinite(speed).any() else np.nan * sigma
    time = _timed(shortest, sigma, trajectory)
    return Found(motion, motion, time, (sight_of(profile, motion),))


class JointSearch(NamedTuple):
    """Inputs of the profile ``joint_space``, except model, images and demands."""

    goal_joints: FloatArray  # (k, n) joints known to show the goal, rad or m
    sigma: float  # standard deviation of a coordinate of the images of the goal, px
    spread: Spread = NO_SPREAD  # how far predictions err
    closed: Finding | None = None  # why no path can be searched


def search_of(scenario: Scenario) -> JointSearch:
    """Return the inputs of a search through joint space."""
    world, demands = scenario.world, scenario.demands
    numbers = world.numbers if len(scenario.ends.body.M) else world.numbers[: world.m]
    spread = spread_of(
        world.calibration,
        tuple(world.calibration.indices_of(numbers)),
        world.m,
        (tuple(demands.limits.lower), tuple(demands.limits.upper), tuple(map(tuple, demands.image_size))),
        world.inputs.trajectory.search.seed,
        scenario.world.min_views,
    )
    closed = None if world.knows_limits else Finding("unknown_limits", REFUSES)
    return JointSearch(scenario.joints_at_goal, scenario.goal_sigma_px, spread, closed)


def why_closed(model: Model, demands: Demands, search: JointSearch | None) -> Finding | None:
    """Return the reason why no path through joint space can be searched or timed; None if it can."""
    for i in np.flatnonzero(~np.isfinite(demands.limits.speed)):
        unit = "m" if model.prismatic[i] else "rad"
        return Finding("no_speed_limit", REFUSES, Subject(joints=(int(i) + 1,)), unit=unit)
    return Finding("no_search", REFUSES) if search is None else search.closed


def _timed(shortest: FloatArray, sigma: FloatArray, trajectory: Trajectory) -> FloatArray:
    """Time (s,) of a motion: its shortest time, from rest to rest, stretched to the duration it is given.

    If nothing limits the speed, the path parameter sigma (s,) passes evenly but for the ramps.
    """
    duration, ramp = trajectory.duration_s, trajectory.acceleration_time_s
    eased = _from_rest(shortest, ramp)
    min_duration = float(eased[-1])
    if duration is None:
        return eased
    _require_time(duration, min_duration)
    if not min_duration > 0.0:
        eased = _from_rest(sigma * duration, ramp)
    return np.asarray(eased * (duration / eased[-1]))


def _require_time(duration: float, min_duration: float) -> None:
    if min_duration > duration:
        raise WorkFailed(
            f"a duration of {duration:g} s: the minimum within the joint-speed limit is "
            f"{min_duration:.4g} s: set trajectory.duration_s, or that of the step, to a longer one, or to "
            "null for the minimum"
        )


def _from_rest(time: FloatArray, ramp: float) -> FloatArray:
    """Times (s,) of a motion that accelerates evenly for a time, s, and decelerates likewise.

    The pace, seconds of ``time`` a second, is a trapezoid, of a short motion a triangle of the same slope:
    the motion never is faster, and takes longer by the ramp.
    """
    total = float(time[-1])
    if not (ramp > 0.0 and total > 0.0):
        return time
    half = 0.5 * min(total, ramp)
    end = total + ramp if total >= ramp else 2.0 * math.sqrt(total * ramp)
    before = np.sqrt(2.0 * ramp * np.maximum(time, 0.0))
    after = end - np.sqrt(2.0 * ramp * np.maximum(total - time, 0.0))
    return np.select([time <= half, time >= total - half], [before, after], time + 0.5 * ramp)


def body_at_start(model: Model, task: Task, images: TaskImages, A: FloatArray) -> FloatArray:
    """Points (b, 4) of the body at the start, face first; the face A (m, 4) alone without a body."""
    if len(task.body.M) == 0:
        return A
    seen = undistort(model.lens, images.s_start)
    fit = fit_body(model.P, task.body, seen, forward(model, images.q_start), SETTLED, np.zeros((6, 7)))
    return np.asarray(task.body.M @ as_array(fit.H).T)


# Tolerance of the images, px, of joints interpolated between stored samples.
_INTERPOLATED_PX = 0.05


def _joint_constraints(reaching: Reaching, task: Task, trajectory: Trajectory, spread: Spread) -> Constraints:
    """Return the constraints of the joints."""
    view = reaching.demands.view
    drawn = keep_out_of([(one.polygons(view), one.occludes) for one in trajectory.keep_out])
    c = constraints_of(reaching.model, reaching.body, task, reaching.q_start, reaching.demands, drawn)
    return c._replace(spread=spread)


def _entered(c: Constraints, q: FloatArray) -> Finding | None:
    """Return the region that the body enters along joints (s, n); None if it keeps out of all."""
    if not np.isfinite(q).all():
        return Finding("not_followed", REFUSES)
    for end, joints in (("start", q[0]), ("goal", q[-1])):
        if region := within_region(c, joints):
            return Finding("within_region", REFUSES, Subject(name=end), region)
    last, region = first_within(c, q)
    at = (Finding("share", amount=last / (len(q) - 1)),)
    return Finding("enters_region", REFUSES, amount=region, others=at) if region else None


def kept_out(found: Found, task: Task, trajectory: Trajectory, spread: Spread) -> Found:
    """Return the motion, infeasible if it enters a keep-out region of the body."""
    c = _joint_constraints(found.motion.reaching, task, trajectory, spread)
    entered = _entered(c, found.motion.along.q)
    return found if entered is None else found._replace(findings=(entered,), entered=entered)


def joint_path(reaching: Reaching, task: Task, trajectory: Trajectory, search: JointSearch) -> Found:
    """A path through joint space; the linear motion if there is none."""
    c = _joint_constraints(reaching, task, trajectory, search.spread)
    target = GoalFeatures(task.A_star, undistort(reaching.model.lens, task.s_star), search.sigma)
    how = SearchLimits(
        trajectory.search.max_samples, trajectory.search.seed, trajectory.max_goal_configurations
    )
    path = find_path(c, target, reaching.q_start, search.goal_joints, how)
    if path.timing is None:
        linear = by_profile("linear", reaching, trajectory.model_copy(update={"duration_s": None}))
        q, unknown = np.full_like(linear.motion.along.q, np.nan), np.full(trajectory.n_samples, np.nan)
        still = linear.motion.along._replace(q=q, limit=unknown, condition=unknown)
        motion = linear.motion._replace(along=still)
        return Found(linear.judged, motion, unknown, (), path)
    motion = _sampled_path(reaching, path.timing, trajectory.n_samples)
    min_duration = float(path.timing.time[-1])
    asked = min_duration if trajectory.duration_s is None else trajectory.duration_s
    _require_time(asked, min_duration)
    time = np.linspace(0.0, asked, len(motion.mu))
    return Found(motion, motion, time, (), path)


def _sampled_path(reaching: Reaching, timed: TimedPath, samples: int) -> Motion:
    """The motion at places evenly spaced in time, with more where joints between them err too much."""
    while True:
        q = joints_at(timed, np.linspace(0.0, float(timed.time[-1]), 2 * samples - 1))
        found, between = along_joints(reaching, q[::2]), 0.5 * (q[:-2:2] + q[2::2])
        off = along_joints(reaching, q[1::2]).along.s - along_joints(reaching, between).along.s
        if np.abs(off).max() <= _INTERPOLATED_PX:
            return found
        samples = 2 * samples - 1


class PathReplanner:
    """Paths to the goal of a scenario, of which a plan was made."""

    def __init__(self, scenario: Scenario, plan: Plan) -> None:
        model, images, self._trajectory = (
            scenario.world.model,
            scenario.ends,
            scenario.world.inputs.trajectory,
        )
        task, amplitudes = images.task(model), np.array([plan.tau, plan.theta_r, plan.theta_p])
        self._plan, self._search, self._made = plan, search_of(scenario), 0
        parts = plan.H_hat, amplitudes, plan.A, plan.a
        body = body_at_start(model, task, images, plan.A)
        self._reaching = Reaching(model, scenario.demands, *parts, task.O, task.visible, images.q_start, body)
        self._c = _joint_constraints(self._reaching, task, self._trajectory, self._search.spread)
        self._goal = GoalFeatures(task.A_star, undistort(model.lens, task.s_star), self._search.sigma)

    def predicted(self, q: FloatArray) -> FloatArray:
        """Pixels (V, b, 2) of the body at joints (n,), by the calibration, the face first."""
        model = self._c.model
        return project(model.P, self._c.M @ forward_kinematics(model, q).T, model.lens)

    def leaves(self, q: FloatArray, off: FloatArray) -> bool:
        """Whether a path of joints (s, n) leaves an image, if images err by (s, V, 2), px."""
        for joints, px in zip(q, off, strict=True):
            P = self._c.model.P.copy()
            P[:, :2] += px[:, :, None] * P[:, 2:]
            c = self._c._replace(spread=NO_SPREAD, model=self._c.model._replace(P=P))
            if margins_at(c, joints)[0][column(IMAGE, len(P)) :].min() < 0.0:
                return True
        return False

    def replan(self, q: FloatArray, excluded: FloatArray, off: FloatArray) -> Plan | None:
        """Plan of a path from joints (n,), with image errors (V, 2), px, to goals not excluded (k, n).

        It keeps that much farther from borders and regions. Each search has its own seed.
        """
        self._made += 1
        plan, asked, full = self._plan, self._trajectory, self._c.full.copy()
        V = len(off)
        full[columns_of_kind(IMAGE, V)] += np.abs(off).max(axis=1)
        full[columns_of_kind(CLEAR, V)] += np.abs(off).max()
        c = self._c._replace(full=full)
        how = SearchLimits(
            asked.search.max_samples, asked.search.seed + self._made, asked.max_goal_configurations, excluded
        )
        start = np.clip(q, c.limits.lower, c.limits.upper)
        path = find_path(c, self._goal, start, self._search.goal_joints, how)
        if path.timing is None:
            return None
        found = _sampled_path(self._reaching, path.timing, asked.n_samples)
        H, H_start = (forward_kinematics(self._reaching.model, q) for q in (start, plan.q_start))
        sigma, duration = np.linspace(0.0, 1.0, len(found.mu)), float(path.timing.time[-1])
        return changed(
            plan,
            q_start=start,
            A=plan.A @ (H @ np.linalg.inv(H_start)).T,
            q=found.along.q,
            mu=found.mu,
            path_parameter=sigma,
            time=duration * sigma,
            duration=duration,
        )
