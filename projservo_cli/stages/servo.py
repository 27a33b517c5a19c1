"""Stage servo: one control law in closed loop with the simulated robot, to its verdict."""

import math
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.control import CODES
from projservo_cli.control.law import ERRORS, MOST_PARTS, Gains, new_state
from projservo_cli.geometry.normal import COORDINATES
from projservo_cli.loop.compiled import Log, new_log, path_deviation
from projservo_cli.loop.compiled import run as run_loop
from projservo_cli.loop.step import VERDICTS, Limits
from projservo_cli.plants.plant import Plant
from projservo_cli.records import METRIC_LAWS, POINT_LAWS, Calibration, FloatArray, Model, Plan, Trace
from projservo_cli.stages.sight import Sight, sight_of
from projservo_cli.stages.truth import (
    PIN_NOISE,
    SERVO_NOISE,
    Reach,
    Truth,
    generator,
    plant_of,
    reach_of,
    truth_of,
)
from projservo_cli.task.face import task_from_images
from projservo_cli.task.target import task_from_body

if TYPE_CHECKING:
    from projservo_cli.config import Config

DEPENDS_ON = (
    "seed",
    "robot",
    "rig",
    "markers",
    "noise.servo_px",
    "task",
    "trajectory.delta",
    "control",
    "plant",
    "stop",
)
# Points of a joint step at which the deviation between samples is measured.
SUBSAMPLES = 50


def gains_of(config: "Config") -> Gains:
    """Gains and limits of the laws."""
    c = config.control
    return Gains(
        c.gain_t,
        c.gain_r,
        c.gain_p,
        c.gain_s,
        c.ratio_rp,
        c.gain,
        c.period_s,
        config.trajectory.delta,
        speed_limits(config),
        c.substeps == "auto",
    )


def speed_limits(config: "Config") -> FloatArray:
    """Most joint motion per second (n,), rad/s or m/s; infinite for none."""
    c = config.control
    revolute = math.inf if c.joint_speed_limit_deg_s is None else math.radians(c.joint_speed_limit_deg_s)
    prismatic = math.inf if c.prismatic_speed_limit_m_s is None else c.prismatic_speed_limit_m_s
    types = config.robot.joint_types if config.robot is not None else ""
    return np.array([prismatic if kind == "P" else revolute for kind in types])


def limits_of(config: "Config") -> Limits:
    """When a run ends and what bounds its commands; noise widens the tolerance of the image error."""
    return Limits(
        speed_limits(config),
        config.stop.image_px + config.stop.noise_factor * config.noise.servo_px,
        config.stop.diverged_factor,
        config.stop.plateau_steps,
        config.stop.max_steps,
        config.plant.joint_limits == "stop",
        config.plant.image_border == "stop",
    )


def run(
    config: "Config", calibration: Calibration, plan: Plan, law: str, *, progress: object = None
) -> Trace:
    """Drive one law from the start of the task to its verdict.

    Raises
    ------
    InputError
        If the configuration lacks a part of the simulation.
    WorkFailed
        If the goal cannot be reached.
    """
    truth = truth_of(config)
    reach = reach_of(config, truth)
    model = truth.model if law in METRIC_LAWS else calibration.model()
    sight = None if law in POINT_LAWS else sight_of(config, calibration, truth, reach)
    noise = servo_noise(config, len(truth.face), 0 if sight is None else len(sight.pins))
    return drive(
        law,
        model,
        plant_of(config, truth, reach.q_start),
        truth,
        reach,
        gains_of(config),
        limits_of(config),
        noise,
        plan.rotation_sense(),
        sight,
    )


def servo_noise(config: "Config", m: int, pins: int = 0) -> FloatArray:
    """Pixel noise of m face markers and of pins at every instant, the same for every law, px."""
    parts = []
    for count, stream in ((m, SERVO_NOISE), (pins, PIN_NOISE)):
        shape = (config.stop.max_steps + 1, 2, count, 2)
        drawn = config.noise.servo_px > 0.0
        parts.append(generator(config, stream).standard_normal(shape) if drawn else np.zeros(shape))
    return config.noise.servo_px * np.concatenate(parts, axis=2)


def drive(
    law: str,
    model: Model,
    plant: Plant,
    truth: Truth,
    reach: Reach,
    gains: Gains,
    limits: Limits,
    noise: FloatArray,
    sense: FloatArray | None = None,
    sight: Sight | None = None,
) -> Trace:
    """Run one law with one model on the simulated robot.

    Parameters
    ----------
    law : name of the law.
    model : what the law believes.
    noise : (≥ max_steps + 1, 2, m, 2) px, with a sight m + p markers.
    sense : (2, n) joint motions of the planned rotations r and p, which decide the sense of a half turn.
    sight : the body to measure with; without it the face is measured point by point.
    """
    n, m, observed = len(reach.q_start), len(truth.face), len(truth.face)
    if sight is None:
        task = task_from_images(model, reach.s_start, reach.s_star, truth.center)
    else:
        task = task_from_body(model, sight.body, reach.q_start, sight.s_start, sight.s_star, truth.center, m)
        plant = plant._replace(pins=sight.pins)
        observed += len(sight.pins)
    state = new_state(n, m)
    if sense is not None:
        state.memory.rotation[:] = sense
    log = new_log(n, observed, limits.max_steps, len(ERRORS), MOST_PARTS if gains.substeps else 0)
    code, steps = run_loop(
        CODES[law], model, task, gains, limits, plant, noise, reach.q_start.copy(), state, log
    )
    return trace_of(
        law, VERDICTS[code], steps, plant, truth, reach, gains, limits, log, float(state.limited[0])
    )


def trace_of(
    law: str,
    verdict: str,
    steps: int,
    plant: Plant,
    truth: Truth,
    reach: Reach,
    gains: Gains,
    limits: Limits,
    log: Log,
    visibility_limited: float,
) -> Trace:
    """Record of a finished run, with its errors against the truth."""
    rows = steps + 1
    H = log.H[:rows]
    before, after, views = log.fit[:rows].T
    middle = plant.M.mean(axis=0) if plant.center < 0 else plant.M[plant.center]
    center = (H @ middle)[:, :3]
    pose = H @ truth.robot.base_tool
    position = rotation = between = at_samples = None
    if reach.goal_pose is not None:
        goal = reach.goal_pose @ np.linalg.solve(truth.robot.base_tool, middle)
        position = 1e3 * float(np.linalg.norm(center[-1] - goal[:3]))
        rotation = rotation_between(pose[-1], reach.goal_pose)
        start = np.append(center[0], 1.0)
        deviations = path_deviation(plant, log, steps, gains.period, start, goal, SUBSAMPLES)
        between, at_samples = 1e3 * deviations[0], 1e3 * deviations[1]
    errors = log.errors[:rows]
    hidden = log.hidden[:rows] > 0.5
    outside, beyond, joint = (int(x) for x in log.events[:3])
    return Trace(
        law=law,
        verdict=verdict,
        reason=reason_of(verdict, log, steps, limits, joint),
        steps=steps,
        period=gains.period,
        observation="points" if np.isnan(views).all() else "body",
        position_error_mm=position,
        rotation_error_deg=rotation,
        self_occluded_steps_left=int(hidden[:, 0].sum()),
        self_occluded_steps_right=int(hidden[:, 1].sum()),
        center_deviation_mm=between,
        center_deviation_at_samples_mm=at_samples,
        plateau_steps=longest_plateau(log.error[:rows], limits.plateau_steps),
        speed_limited_steps=int((log.factor[:steps] < 1.0).sum()),
        visibility_limited_steps=int(visibility_limited),
        first_outside_image=outside,
        first_beyond_limit=beyond,
        limit_joint=joint,
        q=log.q[:rows],
        s=np.ascontiguousarray(log.s[:rows, :, : len(truth.face)]),
        s_star=reach.s_star,
        image_error=log.error[:rows],
        tau=errors[:, 0],
        tau_affine=errors[:, 1],
        theta_r=errors[:, 2],
        theta_p=errors[:, 3],
        theta_s=errors[:, 4],
        prediction_px=rms(before, 2.0 * views),
        fit_px=rms(after, 2.0 * views - COORDINATES),
        views_used=views,
        q_dot=log.q_dot[:steps],
        speed_factor=log.factor[:steps],
        self_occluded=hidden,
        pose=pose,
        goal_pose=np.full((4, 4), np.nan) if reach.goal_pose is None else reach.goal_pose,
        center=center,
    )


def rms(squares: FloatArray, count: FloatArray) -> FloatArray:
    """Root of the mean of sums of squares; NaN where the count is not positive."""
    mean = np.full(squares.shape, math.nan)
    np.divide(squares, count, out=mean, where=count > 0.0)
    return np.asarray(np.sqrt(mean))


def rotation_between(pose: FloatArray, goal: FloatArray) -> float:
    """Angle between the rotations of two poses (4, 4), deg."""
    R = pose[:3, :3].T @ goal[:3, :3]
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return math.degrees(math.atan2(float(sine), float(np.trace(R)) - 1.0))


def longest_plateau(image_error: FloatArray, window: int) -> int:
    """Longest stretch, in steps, in which the image error falls by less than 1 % in ``window`` steps."""
    flat = image_error[window:] > 0.99 * image_error[:-window]
    longest = current = 0
    for value in flat:
        current = current + 1 if value else 0
        longest = max(longest, current)
    return longest + window - 1 if longest else 0


def reason_of(verdict: str, log: Log, steps: int, limits: Limits, joint: int) -> str:
    """Why a run ended, in a sentence."""
    error, first = float(log.error[steps]), float(log.error[0])
    return {
        "converged": f"image error {error:.3g} px is within {limits.image_px:.3g} px",
        "plateau": f"no step left; image error {error:.3g} px fell by less than 1 % in the last "
        f"{limits.plateau_steps} steps: a local minimum",
        "max steps": f"no step left; image error {error:.3g} px was still changing",
        "diverged": f"image error {error:.3g} px (at first {first:.3g}) or the distance of the face grew "
        f"{limits.diverged_factor:g}-fold",
        "left image": f"a face marker left an image at step {steps}",
        "behind camera": f"a face marker passed behind a camera at step {steps}",
        "markers lost": f"a face marker was not seen by both cameras at step {steps}",
        "joint limit": f"the command of step {steps} would take joint {joint + 1} beyond its limit",
        "singular": f"the joint motion was not unique at step {steps}: the robot is near a singularity",
    }[verdict]
