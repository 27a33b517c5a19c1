"""Following a plan with a calibrated, noisy robot: how near the line, and when it arrives."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.displacement import as_mat
from projservo_cli.loop.summary import angle_between
from projservo_cli.stages import calibrate, plan, servo
from projservo_cli.stages.scenario import idealized, scenario_of
from projservo_cli.stages.world import truth_of
from tests.known import configured, driven

NOISE = ["noise.calibration_px=0.5", "noise.servo_px=0.5"]
# Within this of the goal, mm and deg, a run has arrived; it has until one period after the planned time.
ARRIVED_MM, ARRIVED_DEG = 1.0, 0.5


class Kept(NamedTuple):
    """How a run kept to the plan.

    Attributes
    ----------
    most_mm, rms_mm : distance of the true centre from its line, between the samples and at them.
    planned : time of arrival that was planned, in periods.
    arrived : first instant at the goal that was shown; infinite for never.
    position_mm, rotation_deg : errors to it one period after the planned time, or where the run ended
        before.
    true_mm, true_deg : errors to the true goal then, which the noise of the images at the goal adds to.
    occluded : instants at which a camera did not see the face.
    """

    verdict: str
    most_mm: float
    rms_mm: float
    planned: float
    arrived: float
    position_mm: float
    rotation_deg: float
    true_mm: float
    true_deg: float
    occluded: int

    @property
    def on_the_line(self) -> bool:
        return self.most_mm <= 3.0 and self.rms_mm <= 1.5

    @property
    def at_true_goal(self) -> bool:
        return self.true_mm <= ARRIVED_MM and self.true_deg <= ARRIVED_DEG

    @property
    def in_time(self) -> bool:
        at_goal = self.position_mm <= ARRIVED_MM and self.rotation_deg <= ARRIVED_DEG
        return at_goal and abs(self.arrived - self.planned) <= 1.0


def off_the_line(trace, goal):
    """Distance (k,) of the true centre from its line at every instant, mm."""
    way = (goal - trace.center[0]) / np.linalg.norm(goal - trace.center[0])
    off = trace.center - trace.center[0]
    return 1e3 * np.linalg.norm(off - np.outer(off @ way, way), axis=1)


def goal_shown(config, calibration, planned):
    """Pose (4, 4) in which the loop comes to rest without noise: the goal as its images show it."""
    scenario = scenario_of(config, calibration)
    scenario = replace(scenario, config=idealized(config), exact=scenario.ends)
    trace = driven(scenario, planned, "exact_track", None, image_px=1e-3, noise_px=0.0, max_steps=400)
    assert trace.verdict == "converged"
    return trace.pose[-1]


def errors_to(trace, truth, goal_pose):
    """Distance of the centre, mm, and rotation, deg, to a goal at every instant."""
    body = np.linalg.solve(truth.robot.base_tool, truth.M_face.mean(axis=0))
    position = 1e3 * np.linalg.norm(trace.center - (goal_pose @ body)[:3], axis=1)
    return position, np.array(
        [math.degrees(angle_between(as_mat(pose), as_mat(goal_pose))) for pose in trace.pose]
    )


def kept(trace, truth, shown):
    """What a trace says of its plan, whose goal was shown in a pose (4, 4)."""
    body = np.linalg.solve(truth.robot.base_tool, truth.M_face.mean(axis=0))
    goal = (trace.goal_pose @ body)[:3]
    position, rotation = errors_to(trace, truth, shown)
    true_position, true_rotation = errors_to(trace, truth, trace.goal_pose)
    there = np.flatnonzero((position <= ARRIVED_MM) & (rotation <= ARRIVED_DEG))
    planned = trace.planned_s / trace.period
    last = min(trace.steps, int(planned) + 1)
    return Kept(
        trace.verdict,
        trace.center_deviation_mm,
        float(np.sqrt(np.mean(off_the_line(trace, goal) ** 2))),
        planned,
        float(there[0]) if len(there) else np.inf,
        float(position[last]),
        float(rotation[last]),
        float(true_position[last]),
        float(true_rotation[last]),
        int(trace.self_occluded.sum()),
    )


def run_of(seed, *overrides):
    """The law ``exact`` on the plan, calibrated and observed with noise of one seed, gain 0.1 a step."""
    config = configured("paper", *NOISE, f"seed={seed}", *overrides)
    _, calibration, _ = calibrate.run(config)
    planned = plan.run(config, calibration)
    shown = goal_shown(config, calibration, planned)
    return kept(servo.run(config, calibration, planned, "exact_track"), truth_of(config), shown)
