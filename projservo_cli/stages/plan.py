"""Stage plan: the task's partition, where the face stays visible, and a motion that keeps it so."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from projservo_cli.control.law import State, new_state
from projservo_cli.geometry.algebra import vec
from projservo_cli.geometry.displacement import as_array, as_mat, composed_angle
from projservo_cli.geometry.kinematics import forward_kinematics, project
from projservo_cli.geometry.lens import straight_views
from projservo_cli.geometry.mechanisms import COORDINATES, joint_motion, span_of
from projservo_cli.loop.trial import begin, new_stage
from projservo_cli.records import BoolArray, Calibration, FloatArray, Model, Plan, WorkFailed, signed
from projservo_cli.stages.calibrate import image_size_of
from projservo_cli.stages.scenario import Scenario, Sight, measured_task, scenario_of, sight_of
from projservo_cli.stages.world import center_index, face_numbers, joints_of
from projservo_cli.task.along import Along, along
from projservo_cli.task.face import Task, center_of, face_plane, require_found
from projservo_cli.task.margins import CONSTRAINTS, IMAGE, JOINTS, VISIBILITY, Demands, Reaching, limit_margin
from projservo_cli.task.partition import Parts
from projservo_cli.task.planning import plan_path
from projservo_cli.task.trajectory import profile_shares, trajectory_displacement
from projservo_cli.task.visibility import (
    arc_minimum,
    margin,
    margin_coefficients,
    visibility_angles,
    visibility_translation,
)

if TYPE_CHECKING:
    from projservo_cli.config import Config


class Pace(NamedTuple):
    """How fast a planned motion is to be.

    Attributes
    ----------
    duration : time it is given, s; None for as little as the joint-speed limit lets it take.
    ramp : time in which it comes up to its pace, and to rest again at its end, s.
    """

    duration: float | None = None
    ramp: float = 0.0


AS_FAST_AS_ALLOWED = Pace()


def least_time(q: FloatArray, speed: FloatArray) -> FloatArray:
    """Time (s,) at which joints q (s, n) are reached where one is always at its speed limit (n,), s.

    NaN throughout where no joint has a limit.
    """
    if not np.isfinite(speed).any():
        return np.full(len(q), math.nan)
    steps = (np.abs(np.diff(q, axis=0)) / speed).max(axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def timed(shortest: FloatArray, sigma: FloatArray, pace: Pace) -> FloatArray:
    """Time (s,) of a motion: its shortest time, from rest to rest, stretched to the duration it is given.

    Where nothing limits the speed, the path parameter sigma (s,) passes evenly but for the ramps.

    Raises
    ------
    WorkFailed
        If the joints would be too fast.
    """
    duration = pace.duration
    eased = from_rest(shortest, pace.ramp)
    least = float(eased[-1])
    if duration is None:
        return eased
    if least > duration:
        raise WorkFailed(
            f"trajectory.duration_s {duration:g}: the joint-speed limit lets the motion take {least:.4g} s "
            "or more: give it longer, or null for as short as that"
        )
    if not least > 0.0:
        eased = from_rest(sigma * duration, pace.ramp)
    return np.asarray(eased * (duration / eased[-1]))


def from_rest(time: FloatArray, ramp: float) -> FloatArray:
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


CONSTRAINED = "constrained"
VIEWS = ("left", "right")


@dataclass(frozen=True, eq=False)
class Motion:
    """Shares of a plan at equal steps of σ, with their margins.

    Attributes
    ----------
    reaching : the task in the senses that were chosen, with the demands that the motion keeps to.
    asked : the demands that it was to keep to.
    mu : (s, 3) shares.
    along : margins at the shares.
    checked, checked_mu : margins and shares (k, 3) by which the motion is judged.
    time : (s,) when each is reached, s; NaN without a limit or where the joints cannot follow.
    """

    reaching: Reaching
    asked: Demands
    mu: FloatArray
    along: Along
    checked: Along
    checked_mu: FloatArray
    time: FloatArray

    @property
    def duration(self) -> float | None:
        """When it arrives, s; None where there is no time."""
        return float(self.time[-1]) if math.isfinite(self.time[-1]) else None

    def least(self) -> tuple[FloatArray, FloatArray]:
        """Smallest value (4,) of each constraint in its own unit, and the shares (4, 3) where it is."""
        columns = self._values()
        where = [_argmin(column) for column in columns]
        values = [column[i] for column, i in zip(columns, where, strict=True)]
        return np.array(values), self.checked_mu[where]

    def _values(self) -> list[FloatArray]:
        found = self.checked
        return [found.visibility.min(axis=1), found.distance.min(axis=1), found.limit, found.condition]

    def nearest(self) -> tuple[int, float, int]:
        """Constraint that is nearest to failing, its smallest margin, and the instant.

        Nearest is the smallest share of the margin at the worse of both ends; where the constraint fails,
        the instant is the first at which it does.
        """
        margins = self.checked.margins(self.reaching)
        scale = np.minimum(margins[0], margins[-1])
        shares = margins / np.where(scale > 0.0, scale, 1.0)
        constraint = int(np.argmin(shares.min(axis=0)))
        column = margins[:, constraint]
        least = float(column.min())
        instant = int(np.argmax(column <= 0.0)) if least <= 0.0 else int(np.argmin(shares[:, constraint]))
        return constraint, least, instant

    def given_up(self, found: Along) -> BoolArray:
        """Where (s,) along the motion something asked for was given up, so that the joints can follow."""
        if self.reaching.demands.miss_px == 0.0:
            return np.zeros(len(found.miss), dtype=np.bool_)
        return np.asarray((found.condition <= self.asked.conditioning) | (found.miss > 0.0))

    def relaxed(self) -> str:
        """What was given up, in words; empty where nothing was."""
        where = np.flatnonzero(self.given_up(self.checked))
        if not len(where):
            return ""
        first, last = ("{:.2f}, {:.2f}, {:.2f}".format(*self.checked_mu[i]) for i in where[[0, -1]])
        condition, miss = self.checked.condition.min(), self.checked.miss.max()
        said = []
        if condition <= self.asked.conditioning:
            said += [f"with conditioning below its bound ({condition:.2g} of {self.asked.conditioning:.2g})"]
        if miss > 0.0:
            allowed = self.asked.miss_px
            said += [f"with joints up to {miss:.2g} px behind the planned images ({allowed:g} px allowed)"]
        return f"{' and '.join(said)}, from mu_t, mu_r, mu_p {first} to {last}"

    def words(self, constraint: int, instant: int) -> str:
        """What one constraint says at one instant, and where that is."""
        found, demands = self.checked, self.reaching.demands
        at = "at mu_t {:.2f}, mu_r {:.2f}, mu_p {:.2f}".format(*self.checked_mu[instant])
        if constraint == VISIBILITY:
            view = int(np.argmin(found.visibility[instant]))
            margin = found.visibility[instant, view]
            return f"visibility from the {VIEWS[view]} camera is {margin:.3f} of the start's {at}"
        if constraint == IMAGE:
            view = int(np.argmin(found.distance[instant]))
            return f"{_border_words(found.distance[instant, view], VIEWS[view], demands)} {at}"
        if math.isnan(found.condition[instant]):
            return f"the joints cannot follow: the operators become dependent {at}"
        if constraint == JOINTS:
            return f"{_joint_words(found.q[instant], demands)} {at}"
        return (
            f"the reciprocal condition of the image Jacobian is {found.condition[instant]:.2g} "
            f"({demands.conditioning:.2g} allowed) {at}"
        )


def _argmin(column: FloatArray) -> int:
    return 0 if np.isnan(column).all() else int(np.nanargmin(column))


def _border_words(distance: float, view: str, demands: Demands) -> str:
    if distance <= -1e9:
        return f"a marker of the face is behind the {view} camera"
    if distance < 0.0:
        return f"a marker of the face is {-distance:.1f} px outside the {view} image"
    return (
        f"a marker of the face is {distance:.1f} px from the border of the {view} image "
        f"({demands.border_px:g} px asked for)"
    )


def _joint_words(q: FloatArray, demands: Demands) -> str:
    each = [
        limit_margin(
            q[i : i + 1], demands._replace(lower=demands.lower[i : i + 1], upper=demands.upper[i : i + 1])
        )
        for i in range(len(q))
    ]
    i = int(np.argmin(each))
    return (
        f"joint {i + 1} is at {q[i]:.4g}, its limits are {demands.lower[i]:.4g} to {demands.upper[i]:.4g} "
        "(rad or m),"
    )


def demands_of(config: "Config", joint_types: str = "") -> Demands:
    """What the planned motion must keep to, as configured.

    Parameters
    ----------
    joint_types : one letter a joint, where the configuration does not tell.
    """
    joints = joints_of(config, joint_types)
    return Demands(
        joints.lower,
        joints.upper,
        joints.speed,
        np.array(image_size_of(config) or (math.inf, math.inf), dtype=np.float64),
        config.trajectory.border_px,
        config.trajectory.least_condition,
        config.trajectory.most_miss_px,
    )


def motion_of(
    profile: str,
    reaching: Reaching,
    sigma: FloatArray,
    pure_translation: float,
    pace: Pace = AS_FAST_AS_ALLOWED,
) -> Motion:
    """Motion of a profile: one of the paper's, or planned under constraints.

    Parameters
    ----------
    sigma : (s,) path parameter in [0, 1]; of a planned motion the part of its duration.
    pure_translation : most share of the translation before any rotation, δ τ_0 / τ.
    pace : time it is given.

    Raises
    ------
    WorkFailed
        If the joints would be too fast.
    """
    if profile == CONSTRAINED:
        path = plan_path(reaching)
        mu = path.at(sigma)
        time = timed(sigma * path.duration, sigma, pace)
        found = along(path.reaching, mu)
        return Motion(path.reaching, reaching.demands, mu, found, path.along, path.mu, time)
    mu = profile_shares(profile, sigma, pure_translation)
    demands = reaching.demands._replace(miss_px=0.0)
    reaching = reaching._replace(demands=demands)
    found = along(reaching, mu)
    shortest = least_time(found.q, reaching.demands.speed)
    return Motion(reaching, demands, mu, found, found, mu, timed(shortest, sigma, pace))


def constrained_verdict(motion: Motion) -> tuple[bool, str]:
    """Whether all constraints hold along a motion, and which is nearest to failing, in words."""
    constraint, least, instant = motion.nearest()
    words = motion.words(constraint, instant)
    relaxed = motion.relaxed()
    if least > 0.0 and relaxed:
        return True, f"no path was found that keeps all constraints; planned {relaxed}; all else holds"
    if least > 0.0:
        return True, f"all constraints hold; nearest is {CONSTRAINTS[constraint]}: {words}"
    return (
        False,
        f"no path was found that keeps all constraints; {CONSTRAINTS[constraint]} fails first: {words}",
    )


def partitioned_at_start(
    model: Model,
    q_start: FloatArray,
    s_start: FloatArray,
    s_star: FloatArray,
    center: int,
    profile: str,
    bounds: tuple[FloatArray, FloatArray],
    sight: Sight | None,
) -> tuple[State, Task, Parts, str]:
    """Measure and partition the task at its start; the arguments are those of ``plan_task``.

    Returns
    -------
    state : with the face and the joint motions.
    task : in the frame of the model.
    parts : translation and rotations, a half turn in the sense that was rehearsed.
    note : what to say of the rehearsal.

    Raises
    ------
    WorkFailed
        If a marker cannot be triangulated or a motion is not unique.
    """
    n, m = len(q_start), s_start.shape[1]
    task = measured_task(model, q_start, s_start, s_star, center, sight)
    seen = straight_views(model.lens, s_start if sight is None else sight.s_start)
    span = span_of(model, task.A_star)
    state, stage = new_state(n, m, span=span), new_stage(model, m, *bounds, span)
    status, parts, arrives = begin(model, task, seen, q_start, rehearses(profile), state, stage)
    require_found(status, 0)
    return state, task, parts, "" if arrives else "; neither sense of the half turn arrived when rehearsed"


def rehearses(profile: str) -> bool:
    """Whether half turns are rehearsed; the profile constrained compares both senses by itself."""
    return profile != CONSTRAINED


def joint_motions(state: State) -> FloatArray:
    """Joint motions t, r, p (3, n) of a partitioned task; zero for one that the joints cannot make."""
    q_hat = np.zeros((3, len(state.q_dot)))
    if len(state.work.span.H_hat) == 0:
        q_hat[:] = state.q_hat[:3]
        return q_hat
    for row in range(3):
        if not joint_motion(state.work, state.q_hat[row], q_hat[row]):
            q_hat[row] = 0.0
    return q_hat


# What noise and calibration may leave of images that the joints can reach, px rms per marker and view.
LEFT_PX = 3.0
STAGES = 20


def require_in_span(model: Model, A: FloatArray, q_start: FloatArray, images: FloatArray) -> None:
    """Refuse a task whose goal the joints cannot bring the face to.

    The joints that bring the face nearest to its planned images, in px, are carried along the plan.

    Parameters
    ----------
    model : calibrated model.
    A : (m, 4) face at the start.
    q_start : (n,) joints there, rad or m.
    images : (s, 2, m, 2) planned pixels of the face.

    Raises
    ------
    WorkFailed
        If more than ``LEFT_PX`` of image error are left at the goal.
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


DEPENDS_ON = (
    "seed",
    "robot",
    "rig",
    "markers",
    "noise.servo_px",
    "noise.shown_frames",
    "task",
    "trajectory",
    "control.observation",
    "plant.use",
    "control.joint_speed_limit_deg_s",
    "control.prismatic_speed_limit_m_s",
)


def run(config: "Config", calibration: Calibration) -> Plan:
    """Partition the task and plan its motion, from the calibration and the images alone.

    Raises
    ------
    InputError
        If the configuration lacks the task or the face.
    WorkFailed
        If the task cannot be partitioned.
    """
    known = set(calibration.marker.tolist())
    missing = [number for number in face_numbers(config) if number not in known]
    if missing:
        raise WorkFailed(
            f"markers.face names marker {missing[0]}, which the calibration has not seen: "
            f"choose among {', '.join(map(str, sorted(known)))}"
        )
    scenario = scenario_of(config, calibration)
    return plan_task(
        calibration.model(),
        scenario.ends.q_start,
        *scenario.ends.first(scenario.watched.face),
        center_index(config),
        config.trajectory.profile,
        config.trajectory.delta,
        config.trajectory.samples,
        demands_of(config, calibration.joint_types),
        sight_of(scenario),
        Pace(config.trajectory.duration_s, config.trajectory.ramp_s),
    )


def plan_task(
    model: Model,
    q_start: FloatArray,
    s_start: FloatArray,
    s_star: FloatArray,
    center: int,
    profile: str,
    delta: float,
    samples: int,
    demands: Demands,
    sight: Sight | None = None,
    pace: Pace = AS_FAST_AS_ALLOWED,
) -> Plan:
    """Plan from the images of the face at the start and at the goal, [RH00] section 4.

    Parameters
    ----------
    model : calibrated model.
    q_start : (n,) joint readings at the start, rad or m.
    s_start, s_star : (2, m, 2) pixels of the face.
    center : index of the centre marker, or ``MIDPOINT``.
    profile, delta, samples : which part is driven when, share of τ_0, points of the path.
    demands : what the motion must keep to; profiles of the paper are only measured against it.
    sight : the body to measure with; without it the face is measured point by point.
    pace : time the motion is given.

    Raises
    ------
    WorkFailed
        If a marker cannot be triangulated, a motion is not unique or the joints would be too fast.
    """
    state, task, parts, note = partitioned_at_start(
        model, q_start, s_start, s_star, center, profile, (demands.lower, demands.upper), sight
    )
    H_hat = np.array([as_array(H) for H in (parts.H_t, parts.H_r, parts.H_p)])
    q_hat = joint_motions(state)
    sigma = np.linspace(0.0, 1.0, samples)
    tau_0, theta_0 = _changes(np.array(parts.a), H_hat, task)
    tau_limit = min((delta * t for t in tau_0 if t > 0.0), default=math.inf)
    reaching = Reaching(
        model,
        demands,
        H_hat,
        np.array([parts.tau, parts.theta_r, parts.theta_p]),
        state.A,
        np.array(parts.a),
        task.O,
        q_start,
        np.ones(4),
    )
    pure_translation = tau_limit / parts.tau if parts.tau > 0.0 else 1.0
    motion = motion_of(profile, reaching, sigma, pure_translation, pace)
    tau, theta_r, theta_p = (float(x) for x in motion.reaching.amplitudes)
    H_d = np.array([trajectory_displacement(H_hat, (tau, theta_r, theta_p), row) for row in motion.mu])
    images = np.moveaxis(project(model.P, state.A @ np.swapaxes(H_d, 1, 2), model.lens), 0, 1)
    if len(q_start) < COORDINATES:
        require_in_span(model, state.A, q_start, images)
    a = np.array(parts.a)
    carried = np.linalg.solve(np.swapaxes(H_d, 1, 2), a[:, None])[..., 0]
    margins = margin(carried, task.O, task.visible)
    margins = margins / margins[0]
    sense, sense_margin = _senses(parts, task)
    if profile == CONSTRAINED:
        feasible, reason = constrained_verdict(motion)
    else:
        feasible, reason = _verdict(profile, sigma, margins)
    least, least_mu = motion.least()
    return Plan(
        profile=profile,
        feasible=feasible,
        reason=reason + note,
        relaxed=motion.relaxed(),
        tau=tau,
        theta_r=theta_r,
        theta_p=theta_p,
        theta_s=composed_angle(theta_r, theta_p)[0],
        constraint=CONSTRAINTS[motion.nearest()[0]],
        duration=motion.duration,
        tau_limit=tau_limit,
        sigma=sigma,
        time=motion.time,
        mu=motion.mu,
        H_d=H_d,
        s=images,
        margin=margins,
        border_distance=motion.along.distance,
        q=motion.along.q,
        joint_margin=motion.along.limit,
        condition=motion.along.condition,
        miss=motion.along.miss,
        given_up=motion.given_up(motion.along),
        least=least,
        least_mu=least_mu,
        s_start=s_start,
        s_star=s_star,
        A=state.A,
        A_star=task.A_star,
        A_t=state.A_t,
        A_r=state.A_r,
        a=a,
        a_star=np.array(face_plane(task.A_star, task.order, center_of(task.A_star, center))),
        a_t=np.array(parts.a_t),
        A_c=np.array(parts.A_c),
        A_c_star=np.array(center_of(task.A_star, center)),
        q_start=q_start,
        q_hat=q_hat,
        H_hat=H_hat,
        optical_center=task.O,
        tau_0=tau_0,
        theta_0=theta_0,
        sense=sense,
        sense_margin=sense_margin,
    )


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
    for view in range(2):
        c_0, c_s, c_c = margin_coefficients(parts.a, as_mat(as_array(parts.H_r)), vec(task.O[view]))
        sign = task.visible[view] / abs(c_0 + c_c)
        for i in range(2):
            margins[i, view] = arc_minimum(sign * c_0, sign * c_s, sign * c_c, senses[i])
    return senses, margins


def _verdict(profile: str, sigma: FloatArray, margins: FloatArray) -> tuple[bool, str]:
    """Whether both cameras see the face all along, and what says so."""
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


class Sense(NamedTuple):
    """All of a plan that a law needs that plans anew in each step: which way to turn.

    Attributes
    ----------
    motions : (2, n) joint motions of the rotations r and p in the sense they are planned.
    task : measured as the plan is; None where the whole plan was made.
    """

    motions: FloatArray
    task: Task | None

    def rotation_sense(self) -> FloatArray:
        """Joint motions (2, n) of the rotations r and p in the sense they are planned."""
        return self.motions


def rotation_sense(scenario: Scenario) -> Sense:
    """The sense that the plan of a task takes; only the profile constrained needs the whole plan for it.

    Raises
    ------
    WorkFailed
        If the task cannot be partitioned.
    """
    config, calibration = scenario.config, scenario.calibration
    profile = config.trajectory.profile
    if profile == CONSTRAINED:
        return Sense(run(config, calibration).rotation_sense(), None)
    joints = joints_of(config, calibration.joint_types)
    state, task, parts, _ = partitioned_at_start(
        calibration.model(),
        scenario.ends.q_start,
        *scenario.ends.first(scenario.watched.face),
        center_index(config),
        profile,
        (joints.lower, joints.upper),
        sight_of(scenario),
    )
    return Sense(signed(parts.theta_r, parts.theta_p, joint_motions(state)[1:3]), task)
