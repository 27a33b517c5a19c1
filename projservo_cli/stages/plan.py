"""Stage plan: the task's partition, where the face stays visible, and a motion that keeps it so."""

import math
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from projservo_cli.config import Config
from projservo_cli.config.models import LIMITS_MISSING, Trajectory
from projservo_cli.control.law import State
from projservo_cli.geometry.algebra import as_array, composed_angle, vec
from projservo_cli.geometry.kernels import COORDINATES, RANK_TOLERANCE
from projservo_cli.geometry.kinematics import forward, forward_kinematics, project
from projservo_cli.geometry.lens import straight_views
from projservo_cli.guidance.goals import Aim
from projservo_cli.guidance.keep_out import keep_out_of
from projservo_cli.guidance.timing import Pace, joints_at
from projservo_cli.guidance.validity import (
    NO_SPREAD,
    Asked,
    Constraints,
    Spread,
    constraints_of,
    spread_of,
)
from projservo_cli.guidance.way import Search, Way, find_way, first_within, within_region
from projservo_cli.loop.trial import begin
from projservo_cli.records import (
    PRISMATIC,
    Calibration,
    FloatArray,
    InputError,
    Model,
    Plan,
    WorkFailed,
    in_sense,
)
from projservo_cli.stages.scenario import Scenario, scenario_of
from projservo_cli.stages.world import face_numbers
from projservo_cli.task.body import SETTLED, fit_body
from projservo_cli.task.face import Task, center_of, face_plane
from projservo_cli.task.margins import (
    BEHIND,
    CONSTRAINTS,
    IMAGE,
    JOINTS,
    VISIBILITY,
    Along,
    Demands,
    Reaching,
    along,
    along_joints,
    limit_margin,
    within,
)
from projservo_cli.task.partition import Parts
from projservo_cli.task.planning import Path, least_time, plan_path
from projservo_cli.task.target import Shown
from projservo_cli.task.trajectory import profile_shares
from projservo_cli.task.visibility import (
    arc_minimum,
    margin_coefficients,
    visibility_angles,
    visibility_translation,
)

VIEWS = ("left", "right")


def _timed(shortest: FloatArray, sigma: FloatArray, trajectory: Trajectory) -> FloatArray:
    """Time (s,) of a motion: its shortest time, from rest to rest, stretched to the duration it is given.

    Where nothing limits the speed, the path parameter sigma (s,) passes evenly but for the ramps.
    """
    duration, ramp = trajectory.duration_s, trajectory.ramp_s
    eased = _from_rest(shortest, ramp)
    least = float(eased[-1])
    if duration is None:
        return eased
    _require_time(duration, least)
    if not least > 0.0:
        eased = _from_rest(sigma * duration, ramp)
    return np.asarray(eased * (duration / eased[-1]))


def _require_time(duration: float, least: float) -> None:
    if least > duration:
        raise WorkFailed(
            f"trajectory.duration_s {duration:g}: the joint-speed limit lets the motion take {least:.4g} s "
            "or more: give it longer, or null for as short as that"
        )


def _from_rest(time: FloatArray, ramp: float) -> FloatArray:
    """Times (s,) of a motion that comes up to its pace evenly in so many s, and so to rest again at its end.

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


def _verdict_of(path: Path) -> tuple[bool, str, str]:
    """Whether all constraints hold along a path, which is nearest to failing, and that in words.

    Nearest is the smallest share of the margin at the worse of both ends; where a constraint fails, words
    are of the first instant at which it does.
    """
    shares = path.shares()
    nearest = int(np.argmin(shares.min(axis=0)))
    margins = path.along.margins[:, nearest]
    name, holds = CONSTRAINTS[nearest], bool(margins.min() > 0.0)
    words = _words(path, nearest, int(np.argmin(shares[:, nearest]) if holds else np.argmax(margins <= 0.0)))
    if holds:
        return True, name, f"all constraints hold; nearest is {name}: {words}"
    return False, name, f"{name} fails first: {words}"


def _words(path: Path, constraint: int, instant: int) -> str:
    """What one constraint says at one instant, and where that is."""
    found, demands = path.along, path.reaching.demands
    at = "at mu_t {:.2f}, mu_r {:.2f}, mu_p {:.2f}".format(*path.mu[instant])
    if constraint == VISIBILITY:
        view = int(np.argmin(found.view.visibility[instant]))
        margin = found.view.visibility[instant, view]
        return f"visibility from the {VIEWS[view]} camera is {margin:.3f} of the start's {at}"
    if constraint == IMAGE:
        view = int(np.argmin(found.view.distance[instant]))
        return f"{_border_words(found.view.distance[instant, view], VIEWS[view], demands)} {at}"
    if math.isnan(found.condition[instant]):
        return f"the joints cannot follow: the operators become dependent {at}"
    if constraint == JOINTS:
        q = found.q[instant]
        i = int(np.argmin(limit_margin(q, demands)))
        limits = f"its limits are {demands.lower[i]:.4g} to {demands.upper[i]:.4g} (rad or m)"
        return f"joint {i + 1} is at {q[i]:.4g}, {limits}, {at}"
    return (
        f"the reciprocal condition of the image Jacobian is {found.condition[instant]:.2g} "
        f"({demands.conditioning:.2g} allowed) {at}"
    )


def _border_words(distance: float, view: str, demands: Demands) -> str:
    if distance <= BEHIND:
        return f"a marker of the face is behind the {view} camera"
    if distance < 0.0:
        return f"a marker of the face is {-distance:.1f} px outside the {view} image"
    return (
        f"a marker of the face is {distance:.1f} px from the border of the {view} image "
        f"({demands.border_px:g} px asked for)"
    )


def _least(path: Path) -> tuple[FloatArray, FloatArray]:
    """Smallest value (4,) of each constraint in its own unit, and the shares (4, 3) where it is."""
    found, view = path.along, path.along.view
    values = [view.visibility.min(axis=1), view.distance.min(axis=1), found.limit, found.condition]
    where = [0 if np.isnan(column).all() else int(np.nanargmin(column)) for column in values]
    return np.array([column[i] for column, i in zip(values, where, strict=True)]), path.mu[where]


class _Found(NamedTuple):
    """A motion that was found for a task."""

    judged: Path  # where the constraints were looked at
    motion: Path  # as it is stored, at the instants sigma
    time: FloatArray  # (s,) when it is there, s; NaN where nothing limits the speed
    feasible: bool
    reason: str  # feasible, reason: whether it may be followed, in words
    way: Way | None = None  # through joint space, where one was looked for


def _coupled(reaching: Reaching, trajectory: Trajectory) -> _Found:
    """Shares of translation and rotations that keep all constraints, [RH00] section 4.3."""
    sigma = np.linspace(0.0, 1.0, trajectory.samples)
    judged = plan_path(reaching)
    mu = judged.at(sigma)
    motion = Path(judged.reaching, mu, along(judged.reaching, mu))
    if judged.holds() and not motion.holds():  # between the places that were looked at
        judged = motion
    feasible, _, reason = _verdict_of(judged)
    reason = reason if feasible else f"no path was found that keeps all constraints; {reason}"
    return _Found(judged, motion, _timed(sigma * judged.duration(), sigma, trajectory), feasible, reason)


def _given(profile: str, reaching: Reaching, trajectory: Trajectory, pure_translation: float) -> _Found:
    """Shares of a profile of the paper; ``pure_translation`` of the translation at most before a rotation."""
    sigma = np.linspace(0.0, 1.0, trajectory.samples)
    mu = profile_shares(profile, sigma, pure_translation)
    motion, speed = Path(reaching, mu, along(reaching, mu)), reaching.demands.speed
    shortest = least_time(speed, motion.along.q) if np.isfinite(speed).any() else np.nan * sigma
    time = _timed(shortest, sigma, trajectory)
    return _Found(motion, motion, time, *_in_sight(profile, motion.along))


class JointSearch(NamedTuple):
    """What the profile ``joint`` takes beside model, images and demands."""

    acceleration: FloatArray  # (n,) most joint acceleration, rad/s² or m/s²
    q_shown: FloatArray  # (k, n) joints known to show the goal, rad or m
    sigma: float  # standard deviation of a coordinate of the images of the goal, px
    spread: Spread = NO_SPREAD  # how far predictions err
    closed: str = ""  # why no way can be looked for, in words


def _search_of(scenario: Scenario) -> JointSearch:
    """What a scenario tells of a search through joint space."""
    calibration, spread = scenario.calibration, NO_SPREAD
    if calibration is not None:
        numbers = scenario.numbers if len(scenario.ends.body.M) else scenario.numbers[: scenario.m]
        known, demands = calibration.marker.tolist(), scenario.demands
        spread = _spread(
            calibration,
            tuple(known.index(number) for number in numbers),
            scenario.m,
            (tuple(demands.lower), tuple(demands.upper), tuple(demands.image_size)),
            scenario.config.trajectory.search.seed,
        )
    sigma = scenario.noise_px / math.sqrt(scenario.config.noise.shown_frames)
    joints, closed = scenario.joints, ""
    if scenario.truth is None and not (np.isfinite(joints.lower) & np.isfinite(joints.upper)).all():
        closed = f"nothing tells the limits of all joints: {LIMITS_MISSING}"
    return JointSearch(joints.acceleration, scenario.q_shown, sigma, spread, closed)


@lru_cache(maxsize=64)
def _spread(
    calibration: Calibration,
    indices: tuple[int, ...],
    m: int,
    bounds: tuple[tuple[float, ...], ...],
    seed: int,
) -> Spread:
    """How far predictions of a calibration err, the same for every task; it takes 20 ms."""
    lower, upper, size = (np.array(bound) for bound in bounds)
    demands = within(lower, upper)._replace(image_size=size)
    return spread_of(calibration, np.array(indices), m, demands, seed)


def _body_at_start(model: Model, task: Task, shown: Shown, A: FloatArray) -> FloatArray:
    """Points (b, 4) of the body at the start, face first; the face A (m, 4) alone without a body."""
    if len(task.body.M) == 0:
        return A
    seen = straight_views(model.lens, shown.s_start)
    fit = fit_body(model.P, task.body, seen, forward(model, shown.q_start), SETTLED, np.zeros((6, 7)))
    return np.asarray(task.body.M @ as_array(fit.H).T)


# What is left of the images, px, where joints are interpolated between the places that are stored.
_INTERPOLATED_PX = 0.05


def _constraints(
    reaching: Reaching, A: FloatArray, task: Task, trajectory: Trajectory, spread: Spread
) -> Constraints:
    """What joints are held against, for a body at A (b, 4)."""
    margins = trajectory.joint_margin_m, math.radians(trajectory.joint_margin_deg)
    keep = np.where(reaching.model.joint_types == PRISMATIC, *margins).astype(np.float64)
    asked = Asked(reaching.demands, keep, trajectory.least_face_px)
    drawn = keep_out_of([(region.left, region.right, region.hides) for region in trajectory.keep_out])
    c = constraints_of(reaching.model, A, task, reaching.q_start, asked)
    return c._replace(spread=spread, keep_out=drawn)


def _entered(c: Constraints, q: FloatArray) -> str:
    """Which region the body enters along joints (s, n), in words; empty where it keeps out of all."""
    if not np.isfinite(q).all():
        return "no joints can follow the motion, so that it cannot be kept out of regions"
    for end, joints in (("start", q[0]), ("goal", q[-1])):
        if region := within_region(c, joints):
            return f"the {end} is within region {region} of trajectory.keep_out"
    last, region = first_within(c, q)
    at = f"at sigma {last / (len(q) - 1):.2f}"
    return f"the body enters region {region} of trajectory.keep_out {at}" if region else ""


def _through_joints(
    reaching: Reaching, A: FloatArray, task: Task, trajectory: Trajectory, search: JointSearch
) -> _Found:
    """A way through joint space for a body at A (b, 4); the linear motion where there is none."""
    model = reaching.model
    c = _constraints(reaching, A, task, trajectory, search.spread)
    aim = Aim(task.A_star, straight_views(model.lens, task.s_star), search.sigma)
    how = Search(trajectory.search.samples, trajectory.search.seed, trajectory.goals)
    way = find_way(c, aim, reaching.q_start, search.q_shown, how, search.acceleration)
    if way.pace is None:
        linear = _given("linear", reaching, trajectory.model_copy(update={"duration_s": None}), 1.0)
        q, unknown = np.full_like(linear.motion.along.q, np.nan), np.full(trajectory.samples, np.nan)
        still = linear.motion.along._replace(q=q, limit=unknown, condition=unknown)
        motion = linear.motion._replace(along=still)
        return _Found(linear.judged, motion, unknown, False, way.why_none(), way)
    found = _sampled(reaching, way.pace, trajectory.samples)
    least = float(way.pace.time[-1])
    duration = least if trajectory.duration_s is None else trajectory.duration_s
    _require_time(duration, least)
    motion = Path(reaching, np.full((len(found.q), 3), np.nan), found)
    time = np.linspace(0.0, duration, len(found.q))
    return _Found(motion, motion, time, True, _found_words(way), way)


def _sampled(reaching: Reaching, pace: Pace, samples: int) -> Along:
    """The motion at so many places even in time, or more where joints between them were too far off."""
    while True:
        q = joints_at(pace, np.linspace(0.0, float(pace.time[-1]), 2 * samples - 1))
        found, between = along_joints(reaching, q[::2]), 0.5 * (q[:-2:2] + q[2::2])
        off = along_joints(reaching, q[1::2]).view.s - along_joints(reaching, between).view.s
        if np.abs(off).max() <= _INTERPOLATED_PX:
            return found
        samples = 2 * samples - 1


def _found_words(way: Way) -> str:
    g = int(np.abs(way.goals - way.corners[-1]).max(axis=1).argmin())
    how = "a straight way" if way.straight else f"a way through {len(way.corners) - 2} corners"
    some = f"the {len(way.goals)} nearest of " if way.shown > len(way.goals) else ""
    return (
        f"{how} in joint space, after {way.draws} samples, leads to joints {g + 1} of {some}{way.shown} that "
        f"show the goal{f'; {way.barred} more are within a region' if way.barred else ''}"
    )


def _partitioned(
    model: Model, shown: Shown, profile: str, lower: FloatArray, upper: FloatArray
) -> tuple[State, Task, Parts, str]:
    """Measure and partition the task at its start; half turns are rehearsed within joint limits.

    Returns the state with face and joint motions, the task in the frame of the model, translation and
    rotations, a half turn in the sense that was rehearsed, and what to say of the rehearsal.
    """
    task, seen = shown.task(model), straight_views(model.lens, shown.s_start)
    bounds = (lower, upper) if rehearses(profile) else None
    state, parts, arrives = begin(model, task, seen, shown.q_start, bounds)
    return state, task, parts, "" if arrives else "; neither sense of the half turn arrived when rehearsed"


def rehearses(profile: str) -> bool:
    """Whether half turns are rehearsed; where shares are searched for both senses are compared."""
    return profile not in ("constrained", "auto")


def _joint_motions(state: State) -> FloatArray:
    """Joint motions t, r, p (3, n) of a partitioned task; zero where the joints are singular."""
    work = state.work
    if len(work.span.H_hat) == 0:
        return state.q_hat[:3].copy()
    J = work.span.dual @ work.H_hat.reshape(-1, 16).T
    q_hat, _, rank, _ = np.linalg.lstsq(J, state.q_hat[:3].T, rcond=RANK_TOLERANCE)
    return np.asarray(q_hat.T if rank == min(J.shape) else np.zeros_like(q_hat.T))


# What noise and calibration may leave of images that the joints can reach, px rms per marker and view.
LEFT_PX = 3.0
STAGES = 20


def _require_in_span(model: Model, A: FloatArray, q_start: FloatArray, images: FloatArray) -> None:
    """Refuse a task whose goal leaves more than ``LEFT_PX`` wherever the joints bring the face.

    The joints that bring the face A (m, 4) nearest to its planned images (s, 2, m, 2), in px, are carried
    along the plan from those at the start (n,).
    """
    M = A @ np.linalg.inv(forward_kinematics(model, q_start)).T
    q = q_start

    def miss(q: FloatArray, wanted: FloatArray) -> FloatArray:
        return (project(model.P, M @ forward_kinematics(model, q).T, model.lens) - wanted).ravel()

    for k in np.unique(np.linspace(0, len(images) - 1, STAGES).astype(int)):
        q = least_squares(miss, q, args=(images[k],), method="lm", xtol=1e-12).x
    left = float(np.sqrt(np.mean(np.sum(miss(q, images[-1]).reshape(-1, 2) ** 2, axis=1))))
    if not left <= LEFT_PX:
        raise WorkFailed(
            f"the task does not lie in what {len(q)} joints can do: the nearest they bring the face is "
            f"{left:.3g} px rms from its goal images, more than the {LEFT_PX:g} px that noise may leave; "
            "choose a goal by joint readings, or one that moves the face as these joints do"
        )


def run(config: Config, calibration: Calibration) -> Plan:
    """Partition the task and plan its motion, from the calibration and the images alone.

    Raises InputError if the configuration lacks the task or the face; WorkFailed if the task cannot be
    partitioned.
    """
    known = set(calibration.marker.tolist())
    missing = [number for number in face_numbers(config) if number not in known]
    if missing:
        raise WorkFailed(
            f"markers.face names marker {missing[0]}, which the calibration has not seen: "
            f"choose among {', '.join(map(str, sorted(known)))}"
        )
    return _plan_of(scenario_of(config, calibration))


def needs_covariance(trajectory: Trajectory) -> bool:
    """Whether a plan takes the covariance of the calibration: a search through joint space and regions do."""
    return trajectory.profile in ("joint", "auto") or bool(trajectory.keep_out)


def _plan_of(scenario: Scenario) -> Plan:
    trajectory = scenario.config.trajectory
    search = _search_of(scenario) if needs_covariance(trajectory) else None
    return plan_task(scenario.model, scenario.ends, trajectory, scenario.demands, search)


def plan_task(
    model: Model, shown: Shown, trajectory: Trajectory, demands: Demands, search: JointSearch | None = None
) -> Plan:
    """Plan from the images of the face at the start and at the goal, [RH00] section 4.

    trajectory : the motion that is asked for.
    demands : what the motion must keep to; profiles of the paper are only measured against it.
    search : what a search through joint space takes, for the profiles ``joint`` and ``auto``.
    Raises WorkFailed if a marker cannot be triangulated, a motion is not unique or the joints would be too
    fast; InputError for the profile ``joint`` where a joint has no speed limit.
    """
    if trajectory.profile != "auto":
        return _planned(model, shown, trajectory, demands, search)[0]
    before: list[str] = []
    closed = _closed(model, demands, search)
    for profile in ("linear", "constrained", "joint"):
        asked = trajectory.model_copy(update={"profile": profile})
        last = profile == "joint" or (profile == "constrained" and bool(closed))
        try:
            plan, fails = _planned(model, shown, asked, demands, search)
        except WorkFailed as error:
            if last:
                raise
            before.append(f"not {profile}: {error}")
            continue
        if not fails or last:
            after = [] if profile == "joint" or not fails else [f"not joint: {closed}"]
            return replace(plan, reason="; ".join([plan.reason, *before, *after]))
        before.append(f"not {profile}: {fails}")
    raise AssertionError(before)


def _closed(model: Model, demands: Demands, search: JointSearch | None) -> str:
    """Why no way through joint space can be looked for, or given a time; empty where it can."""
    if search is None or search.closed:
        return "no search was given" if search is None else search.closed
    for i in np.flatnonzero(~np.isfinite(demands.speed)):
        kind = "prismatic" if model.joint_types[i] == PRISMATIC else "joint"
        unit = "m_s" if kind == "prismatic" else "deg_s"
        return f"joint {i + 1} has no speed limit: set control.{kind}_speed_limit_{unit}"
    return ""


def _planned(
    model: Model, shown: Shown, trajectory: Trajectory, demands: Demands, search: JointSearch | None
) -> tuple[Plan, str]:
    """Plan of one profile, and what of its constraints fails, in words; empty where all hold."""
    profile, face = trajectory.profile, shown.by_points()
    state, task, parts, note = _partitioned(model, shown, profile, demands.lower, demands.upper)
    H_hat = np.array([as_array(H) for H in (parts.H_t, parts.H_r, parts.H_p)])
    a, amplitudes = np.array(parts.a), np.array([parts.tau, parts.theta_r, parts.theta_p])
    tau_0, theta_0 = _changes(a, H_hat, task)
    tau_limit = min((trajectory.delta * t for t in tau_0 if t > 0.0), default=math.inf)
    reaching = Reaching(model, demands, H_hat, amplitudes, state.A, a, task.O, shown.q_start)
    if profile == "joint":
        closed = _closed(model, demands, search)
        if search is None or closed:
            raise InputError(f"the profile joint: {closed}")
        A = _body_at_start(model, task, shown, state.A)
        found = _through_joints(reaching, A, task, trajectory, search)
    elif profile == "constrained":
        found = _coupled(reaching, trajectory)
    else:
        share = tau_limit / parts.tau if parts.tau > 0.0 else 1.0
        found = _given(profile, reaching, trajectory, share)
    entered = ""
    if profile != "joint" and trajectory.keep_out and found.feasible:
        A = _body_at_start(model, task, shown, state.A)
        spread = NO_SPREAD if search is None else search.spread
        entered = _entered(_constraints(reaching, A, task, trajectory, spread), found.motion.along.q)
        found = found._replace(feasible=not entered, reason=entered or found.reason)
    motion, time, way = found.motion, found.time, found.way
    tau, theta_r, theta_p = (float(x) for x in motion.reaching.amplitudes)
    view = motion.along.view
    if len(shown.q_start) < COORDINATES and way is None:
        _require_in_span(model, state.A, shown.q_start, view.s)
    sense, sense_margin = _senses(parts, task)
    holds, constraint, words = _verdict_of(found.judged)
    least, least_mu = _least(found.judged)
    plan = Plan(
        profile=profile,
        feasible=found.feasible,
        reason=found.reason + ("" if way else note),
        tau=tau,
        theta_r=theta_r,
        theta_p=theta_p,
        theta_s=composed_angle(theta_r, theta_p)[0],
        constraint=constraint,
        duration=float(time[-1]) if math.isfinite(time[-1]) else None,
        tau_limit=tau_limit,
        sigma=np.linspace(0.0, 1.0, len(time)),
        time=time,
        mu=motion.mu,
        H_d=view.H_d,
        s=view.s,
        margin=view.visibility,
        border_distance=view.distance,
        q=motion.along.q,
        joint_margin=motion.along.limit,
        condition=motion.along.condition,
        least=least,
        least_mu=least_mu,
        s_start=face.s_start,
        s_star=face.s_star,
        A=state.A,
        A_star=task.A_star,
        A_t=state.A_t,
        A_r=state.A_r,
        a=a,
        a_star=np.array(face_plane(task.A_star, task.order, center_of(task.A_star, shown.center))),
        a_t=np.array(parts.a_t),
        A_c=np.array(parts.A_c),
        A_c_star=np.array(center_of(task.A_star, shown.center)),
        q_start=shown.q_start,
        q_hat=_joint_motions(state),
        H_hat=H_hat,
        optical_center=task.O,
        tau_0=tau_0,
        theta_0=theta_0,
        sense=sense,
        sense_margin=sense_margin,
        goals=None if way is None else way.shown,
        samples=None if way is None else way.draws,
    )
    return plan, entered or ("" if holds or (way is not None and found.feasible) else words)


def _changes(a: FloatArray, H_hat: FloatArray, task: Task) -> tuple[FloatArray, FloatArray]:
    """τ_0 (2,) and θ_0± (2, 2) of both cameras; NaN where a motion never changes visibility."""
    tau_0 = [visibility_translation(a, H_hat[0], O) for O in task.O]
    theta_0 = [visibility_angles(a, H_hat[1], O) for O in task.O]
    return (
        np.array([math.nan if t is None else t for t in tau_0]),
        np.array([(math.nan, math.nan) if t is None else t for t in theta_0]),
    )


def _senses(parts: Parts, task: Task) -> tuple[FloatArray, FloatArray]:
    """Both senses of the rotation onto the plane, and each camera's least margin along them."""
    other = parts.theta_r - math.copysign(2.0 * math.pi, parts.theta_r)
    senses = np.array(sorted((parts.theta_r, other), key=abs))
    margins = np.zeros((2, 2))
    for view, O in enumerate(task.O):
        c = np.array(margin_coefficients(parts.a, parts.H_r, vec(O)))
        c_0, c_s, c_c = (c * (task.visible[view] / abs(c[0] + c[2]))).tolist()
        margins[:, view] = [arc_minimum(c_0, c_s, c_c, sense) for sense in senses.tolist()]
    return senses, margins


def _in_sight(profile: str, found: Along) -> tuple[bool, str]:
    """Whether both cameras see the face all along, and what says so."""
    margins = found.view.visibility
    sigma = np.linspace(0.0, 1.0, len(margins))
    worst = np.unravel_index(np.argmin(margins), margins.shape)
    if margins.min() > 0.0:
        return True, (
            f"both cameras see the face all along; least margin {margins.min():.3f} of the start's, "
            f"{VIEWS[worst[1]]} camera at sigma {sigma[worst[0]]:.2f}"
        )
    lost = [
        f"{VIEWS[view]} from sigma {sigma[np.argmax(margins[:, view] <= 0)]:.2f}"
        for view in range(2)
        if margins[:, view].min() <= 0.0
    ]
    return False, (
        f"the profile {profile} turns the face away from a camera ({', '.join(lost)}): "
        "choose another trajectory.profile"
    )


def rotation_sense(scenario: Scenario) -> FloatArray:
    """Joint motions (2, n) of both rotations in the sense of the plan; few profiles need all of that."""
    trajectory, joints = scenario.config.trajectory, scenario.joints
    if not rehearses(trajectory.profile):
        return _plan_of(scenario).rotation_sense()
    ends = scenario.model, scenario.ends
    state, _, parts, _ = _partitioned(*ends, trajectory.profile, joints.lower, joints.upper)
    return in_sense(parts.theta_r, parts.theta_p, _joint_motions(state)[1:3])
