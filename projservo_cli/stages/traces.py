"""From the log of a run to its record: errors where the truth is known, the verdict in words."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.control.law import TAU_AFFINE, THETA_S, Gains
from projservo_cli.geometry.displacement import as_mat
from projservo_cli.geometry.kernels import COORDINATES
from projservo_cli.loop.compiled import Log
from projservo_cli.loop.step import Limits, plateau_stretch, tolerance
from projservo_cli.loop.summary import MM, Ends, Summary, angle_between, effort, path_deviation, summary
from projservo_cli.records import REPLAN, FloatArray, Trace
from projservo_cli.robots.simulated import Plant
from projservo_cli.stages.scenario import Reach, Truth
from projservo_cli.task.face import center_of

# Points of a joint step at which the deviation between samples is measured.
SUBSAMPLES = 50

# Share of the translation and rotation, deg, that are left; None where they are not measured.
Remaining = tuple[float | None, float | None]


class Outcome(NamedTuple):
    """How a run of the Python loop ended.

    Attributes
    ----------
    verdict, disturbance : the verdict, and why the images no longer agree where that is it.
    steps : commands sent.
    log : what was recorded.
    limited : how often visibility limited the translation.
    """

    verdict: str
    disturbance: str
    steps: int
    log: Log
    limited: float


class Known(NamedTuple):
    """What is known of the truth of a run, by instant; NaN or None where nothing is.

    Attributes
    ----------
    pose, goal_pose : (k, 4, 4), (4, 4) true pose of the tool, m.
    center : (k, 3) true centre of the face, m.
    position_mm, rotation_deg : errors at the end.
    between_mm, at_samples_mm : largest distance of the centre from its line.
    path_mm : length of the centre's path, from sample to sample.
    """

    pose: FloatArray
    goal_pose: FloatArray
    center: FloatArray
    position_mm: float | None = None
    rotation_deg: float | None = None
    between_mm: float | None = None
    at_samples_mm: float | None = None
    path_mm: float | None = None


def unknown(instants: int) -> Known:
    """What is known of a robot that is not simulated."""
    return Known(np.full((instants, 4, 4), np.nan), np.full((4, 4), np.nan), np.full((instants, 3), np.nan))


def ends_of(plant: Plant, truth: Truth, goal_pose: FloatArray | None) -> Ends:
    """Where the true robot holds the tool at its reference and at the goal."""
    base_tool, unknown_pose = truth.robot.base_tool, np.full((4, 4), np.nan)
    if goal_pose is None:
        return Ends(base_tool, unknown_pose, unknown_pose[0])
    return Ends(base_tool, goal_pose, goal_pose @ np.linalg.solve(base_tool, middle_of(plant)))


def summary_of(outcome: Outcome, plant: Plant, ends: Ends, period: float) -> Summary:
    """Numbers of a run of the simulated robot."""
    return summary(plant, outcome.log, outcome.steps, outcome.limited, period, ends)


def path_between_mm(outcome: Outcome, plant: Plant, ends: Ends, period: float, found: Summary) -> float:
    """Largest distance of the centre from its line, between the samples too, mm."""
    log, steps = outcome.log, outcome.steps
    start = log.H[0] @ middle_of(plant)
    between = MM * path_deviation(plant, log, steps, period, start, ends.goal, SUBSAMPLES)
    return max(between, found.center_deviation_at_samples_mm)


def middle_of(plant: Plant) -> FloatArray:
    """Centre (4,) of the face at the reference, m."""
    return np.array(center_of(plant.M, plant.center))


def known(outcome: Outcome, plant: Plant, truth: Truth, reach: Reach, gains: Gains) -> Known:
    """What is known of the simulated robot."""
    H = outcome.log.H[: outcome.steps + 1]
    center = (H @ middle_of(plant))[:, :3]
    pose = H @ truth.robot.base_tool
    ends = ends_of(plant, truth, reach.goal_pose)
    if reach.goal_pose is None:
        return Known(pose, ends.goal_pose, center)
    found = summary_of(outcome, plant, ends, gains.period)
    return Known(
        pose,
        reach.goal_pose,
        center,
        found.position_error_mm,
        found.rotation_error_deg,
        path_between_mm(outcome, plant, ends, gains.period, found),
        found.center_deviation_at_samples_mm,
        found.path_length_mm,
    )


def record_of(
    law: str,
    outcome: Outcome,
    reach: Reach,
    gains: Gains,
    limits: Limits,
    truth: Known,
    mode: str = REPLAN,
    planned_s: float | None = None,
) -> Trace:
    """Record of a finished run."""
    verdict, steps, log = outcome.verdict, outcome.steps, outcome.log
    rows = steps + 1
    before, after, views = log.fit[:rows].T
    errors = log.errors[:rows]
    hidden = log.hidden[:rows] > 0.5
    outside, beyond, joint = (int(x) for x in log.events[:3])
    # A law that follows a plan measures what is left to where the plan is, not to the goal.
    stretch = plateau_stretch(log.judged[:rows], limits.plateau_steps)
    remaining = left(log, steps) if mode == REPLAN else (None, None)
    return Trace(
        law=law,
        mode=mode,
        planned_s=planned_s,
        verdict=verdict,
        reason=outcome.disturbance or reason_of(verdict, log, steps, limits, joint, remaining),
        steps=steps,
        period=gains.period,
        observation="points" if np.isnan(views).all() else "body",
        position_error_mm=truth.position_mm,
        rotation_error_deg=truth.rotation_deg,
        translation_left=remaining[0],
        rotation_left_deg=remaining[1],
        self_occluded_steps_left=int(hidden[:, 0].sum()),
        self_occluded_steps_right=int(hidden[:, 1].sum()),
        center_deviation_mm=truth.between_mm,
        center_deviation_at_samples_mm=truth.at_samples_mm,
        path_length_mm=truth.path_mm,
        effort=effort(log, steps, gains.period),
        plateau_steps=0 if stretch is None else stretch[1] - stretch[0],
        speed_limited_steps=int((log.factor[:steps] < 1.0).sum()),
        visibility_limited_steps=int(outcome.limited),
        first_outside_image=outside,
        first_beyond_limit=beyond,
        limit_joint=joint,
        q=log.q[:rows],
        q_read=None if np.array_equal(log.read[:rows], log.q[:rows]) else log.read[:rows],
        s=np.ascontiguousarray(log.s[:rows, :, : reach.s_star.shape[1]]),
        s_star=reach.s_star,
        image_error=log.error[:rows],
        stop_error=log.judged[:rows],
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
        pose=truth.pose,
        goal_pose=truth.goal_pose,
        center=truth.center,
    )


def left(log: Log, steps: int) -> Remaining:
    """Share of the translation and rotation, deg, that were left; None where the law measures neither."""
    first, last = (float(log.errors[k, TAU_AFFINE]) for k in (0, steps))
    turn = float(log.errors[steps, THETA_S])
    share = last / first if first > 0.0 and math.isfinite(last) else None
    return share, math.degrees(turn) if math.isfinite(turn) else None


def words_left(log: Log, steps: int, remaining: Remaining) -> str:
    """What was left, in words."""
    share, turn = remaining
    parts = [] if share is None else [f"{share:.1%} of the translation"]
    parts += [] if turn is None else [f"{turn:.3g} deg of rotation"]
    return f"{' and '.join([*parts, f'an image error of {float(log.judged[steps]):.3g} px'])} are left"


def rms(squares: FloatArray, count: FloatArray) -> FloatArray:
    """Root of the mean of sums of squares; NaN where the count is not positive."""
    mean = np.full(squares.shape, math.nan)
    np.divide(squares, count, out=mean, where=count > 0.0)
    return np.asarray(np.sqrt(mean))


def rotation_between(pose: FloatArray, goal: FloatArray) -> float:
    """Angle between the rotations of two poses (4, 4), deg."""
    return math.degrees(angle_between(as_mat(pose), as_mat(goal)))


def reason_of(verdict: str, log: Log, steps: int, limits: Limits, joint: int, remaining: Remaining) -> str:
    """Why a run ended, in a sentence."""
    error, first = float(log.judged[steps]), float(log.judged[0])
    within = tolerance(limits, float(log.fit[steps, 2]))
    return {
        "converged": f"image error {error:.3g} px is within {within:.3g} px",
        "plateau": f"no step left; image error {error:.3g} px fell by less than 1 % in the last "
        f"{limits.plateau_steps} steps: a local minimum",
        "max steps": f"no step left; image error {error:.3g} px was still changing",
        "diverged": f"image error {error:.3g} px (at first {first:.3g}) or the distance of the face grew "
        f"{limits.diverged_factor:g}-fold",
        "left image": f"a face marker left an image at step {steps}",
        "behind camera": f"a face marker passed behind a camera at step {steps}",
        "markers lost": f"the law could not measure the face at step {steps}: a marker was not seen"
        + (f", {limits.lost_steps} periods after the last that was" if limits.lost_steps else ""),
        "joint limit": f"joint {joint + 1} stands at its limit, {float(log.read[steps, joint]):.6g} (rad or "
        f"m), and the task would take it beyond; {words_left(log, steps, remaining)}",
        "singular": f"the joint motion was not unique at step {steps}: the robot is near a singularity",
    }[verdict]
