"""What a run did, from its log to numbers and to its record."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.control.law import TAU_AFFINE, THETA_S
from projservo_cli.geometry.kernels import COORDINATES
from projservo_cli.loop.step import Limits, Log, plateau_stretch, tolerance
from projservo_cli.loop.summary import MM, Summary, path_deviation, summary
from projservo_cli.records import REPLAN, FloatArray, Trace
from projservo_cli.robots.simulated import Plant
from projservo_cli.stages.own_robot import untested
from projservo_cli.stages.scenario import Scenario
from projservo_cli.task.face import center_of

SUBSAMPLES = 50  # points of a joint step at which the deviation between samples is measured


class Run(NamedTuple):
    """A run as it ended."""

    verdict: str
    disturbance: str  # verdict, disturbance: the verdict, and why the images no longer agree where that is it
    steps: int  # commands sent
    log: Log  # what was recorded
    limited: float  # how often visibility limited the translation
    plant: Plant  # that was driven; of a robot that is not simulated what the calibration takes it for
    law: str = ""
    mode: str = REPLAN  # law, mode: what it is a run of
    planned_s: float | None = None  # when the plan that it followed arrives, s
    unplanned: str = ""  # why it went without the plan that it was to follow


def summary_of(scenario: Scenario, run: Run) -> Summary:
    """Numbers of a run; NaN where they need a truth that nobody knows."""
    return summary(run.plant, run.log, run.steps, run.limited, scenario.gains.period, scenario.true_ends)


def deviation_between_samples_mm(scenario: Scenario, run: Run, found: Summary) -> float:
    """Largest distance of the true centre from its line, between the samples too, mm."""
    start = run.log.H[0] @ np.array(center_of(run.plant.M, run.plant.center))
    goal, period = scenario.true_ends.goal, scenario.gains.period
    between = path_deviation(run.plant, run.log, run.steps, period, start, goal, SUBSAMPLES)
    return max(MM * between, found.center_deviation_at_samples_mm)


def trace_of(scenario: Scenario, run: Run) -> Trace:
    """Record of a run."""
    log, steps, limits = run.log, run.steps, scenario.limits
    rows = steps + 1
    found = summary_of(scenario, run)
    ends = scenario.true_ends
    known = bool(np.isfinite(ends.goal).all())
    between = deviation_between_samples_mm(scenario, run, found) if known else math.nan
    before, after, views = log.fit[:rows].T
    errors, H = log.errors[:rows], log.H[:rows]
    # A law that follows a plan measures what is left to where the plan is, not to the goal.
    remaining = _left(log, steps) if run.mode == REPLAN else (None, None)
    outside, beyond, joint = (int(x) for x in log.events[:3])
    simulated = scenario.truth is not None
    stretch = plateau_stretch(log.judged[:rows], limits.plateau_steps)
    s_star = scenario.ends.by_points().s_star
    return Trace(
        law=run.law,
        mode=run.mode,
        planned_s=run.planned_s,
        verdict=run.verdict,
        reason=run.disturbance or _reason(run, limits, joint, remaining),
        steps=steps,
        period=scenario.gains.period,
        observation="points" if np.isnan(views).all() else "body",
        position_error_mm=_number(found.position_error_mm),
        rotation_error_deg=_number(found.rotation_error_deg),
        translation_left=remaining[0],
        rotation_left_deg=remaining[1],
        self_occluded_steps_left=found.self_occluded_steps_left,
        self_occluded_steps_right=found.self_occluded_steps_right,
        center_deviation_mm=_number(between),
        center_deviation_at_samples_mm=_number(found.center_deviation_at_samples_mm),
        path_length_mm=_number(found.path_length_mm),
        effort=found.effort,
        plateau_steps=0 if stretch is None else stretch[1] - stretch[0],
        speed_limited_steps=found.speed_limited_steps,
        visibility_limited_steps=found.visibility_limited_steps,
        first_outside_image=outside,
        first_beyond_limit=beyond,
        limit_joint=joint,
        q=log.q[:rows],
        q_read=None if np.array_equal(log.read[:rows], log.q[:rows]) else log.read[:rows],
        s=np.ascontiguousarray(log.s[:rows, :, : s_star.shape[1]]),
        s_star=s_star,
        image_error=log.error[:rows],
        stop_error=log.judged[:rows],
        tau=errors[:, 0],
        tau_affine=errors[:, 1],
        theta_r=errors[:, 2],
        theta_p=errors[:, 3],
        theta_s=errors[:, 4],
        prediction_px=_rms(before, 2.0 * views),
        fit_px=_rms(after, 2.0 * views - COORDINATES),
        views_used=views,
        q_dot=log.q_dot[:steps],
        speed_factor=log.factor[:steps],
        self_occluded=log.hidden[:rows] > 0.5,
        pose=H @ ends.base_tool,
        goal_pose=ends.goal_pose,
        center=_centers(run) if simulated else np.full((rows, 3), np.nan),
        unplanned=run.unplanned,
        untested="" if simulated else untested(scenario),
    )


def _centers(run: Run) -> FloatArray:
    """True centre (k, 3) of the face at each instant, m."""
    H = run.log.H[: run.steps + 1]
    return np.asarray((H @ np.array(center_of(run.plant.M, run.plant.center)))[:, :3])


def _number(value: float) -> float | None:
    """A number, or None where it is not known."""
    return None if math.isnan(value) else value


def _left(log: Log, steps: int) -> tuple[float | None, float | None]:
    """Share of the translation and rotation, deg, that were left; None where the law measures neither."""
    first, last = (float(log.errors[k, TAU_AFFINE]) for k in (0, steps))
    turn = float(log.errors[steps, THETA_S])
    share = last / first if first > 0.0 and math.isfinite(last) else None
    return share, math.degrees(turn) if math.isfinite(turn) else None


def _rms(squares: FloatArray, count: FloatArray) -> FloatArray:
    """Root of the mean of sums of squares; NaN where the count is not positive."""
    mean = np.full(squares.shape, math.nan)
    np.divide(squares, count, out=mean, where=count > 0.0)
    return np.asarray(np.sqrt(mean))


def _reason(run: Run, limits: Limits, joint: int, remaining: tuple[float | None, float | None]) -> str:
    """Why a run ended, in a sentence."""
    log, steps = run.log, run.steps
    error, first = float(log.judged[steps]), float(log.judged[0])
    within = tolerance(limits, float(log.fit[steps, 2]))
    share, turn = remaining
    left = [
        *([] if share is None else [f"{share:.1%} of the translation"]),
        *([] if turn is None else [f"{turn:.3g} deg of rotation"]),
        f"an image error of {error:.3g} px",
    ]
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
        f"m), and the task would take it beyond; {' and '.join(left)} are left",
        "singular": f"the joint motion was not unique at step {steps}: the robot is near a singularity",
    }[run.verdict]
