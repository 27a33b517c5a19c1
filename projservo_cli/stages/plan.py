"""Stage plan: the task's partition, where the face stays visible, and a motion that keeps it so."""

import math
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.geometry.algebra import vec
from projservo_cli.geometry.composition import composed_angle
from projservo_cli.geometry.displacement import as_array, as_mat
from projservo_cli.geometry.kinematics import project
from projservo_cli.geometry.mechanisms import COORDINATES
from projservo_cli.records import Calibration, FloatArray, Model, Plan, WorkFailed
from projservo_cli.stages.beginning import joint_motions, partitioned_at_start
from projservo_cli.stages.constrained import (
    CONSTRAINED,
    VIEWS,
    constrained_verdict,
    demands_of,
    motion_of,
)
from projservo_cli.stages.pace import AS_FAST_AS_ALLOWED, Pace
from projservo_cli.stages.reach import reach_for, sight_for
from projservo_cli.stages.reachable import require_in_span
from projservo_cli.stages.sight import Sight
from projservo_cli.stages.truth import center_index, face_numbers
from projservo_cli.task.face import Task, center_of, face_plane
from projservo_cli.task.margins import CONSTRAINTS, Demands, Reaching
from projservo_cli.task.partition import Parts
from projservo_cli.task.trajectory import trajectory_displacement
from projservo_cli.task.visibility import (
    arc_minimum,
    margin,
    margin_coefficients,
    visibility_angles,
    visibility_translation,
)

if TYPE_CHECKING:
    from projservo_cli.config import Config

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
    reach = reach_for(config, calibration)
    return plan_task(
        calibration.model(),
        reach.q_start,
        reach.s_start,
        reach.s_star,
        center_index(config),
        config.trajectory.profile,
        config.trajectory.delta,
        config.trajectory.samples,
        demands_of(config, calibration.joint_types),
        sight_for(config, calibration, reach),
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
