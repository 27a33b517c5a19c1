"""Following a plan with a calibrated, noisy robot: how near the line, and when it arrives.

Run as ``python -m tests.control.tracking [SEEDS] [NAME …] [KEY=VALUE …]`` for the whole study: one row
a seed.
"""

import math
import sys
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.geometry.displacement import as_mat
from projservo_cli.loop.summary import angle_between
from projservo_cli.records import REPLAN, law_and_mode
from projservo_cli.stages import calibrate, plan, servo
from projservo_cli.stages.scenario import idealized, scenario_of
from projservo_cli.stages.world import truth_of
from tests.conftest import ROOT
from tests.known import driven

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
    steps: int
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


def goal_shown(config, calibration, planned, name):
    """Pose (4, 4) in which the loop comes to rest without noise: the goal as its images show it."""
    scenario = scenario_of(config, calibration)
    scenario = replace(scenario, config=idealized(config), exact=scenario.ends)
    plan = planned.rotation_sense() if law_and_mode(name)[1] == REPLAN else planned
    trace = driven(scenario, plan, name, None, image_px=1e-3, noise_px=0.0, max_steps=400)
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
    planned = trace.planned_s / trace.period if trace.planned_s is not None else np.nan
    last = trace.steps if np.isnan(planned) else min(trace.steps, int(planned) + 1)
    return Kept(
        trace.verdict,
        trace.steps,
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


def runs(seed, names, overrides=(), arm="paper"):
    """Runs by name, calibrated and observed with noise of one seed, gain 0.1 a step."""
    config = load_config(ROOT / "configs" / f"{arm}.yaml", [*NOISE, f"seed={seed}", *overrides])
    _, calibration, _ = calibrate.run(config)
    planned = plan.run(config, calibration)
    truth = truth_of(config)
    found = {}
    for name in names:
        shown = goal_shown(config, calibration, planned, name)
        found[name] = kept(servo.run(config, calibration, planned, name), truth, shown)
    return found


def study(seeds=100, names=("exact_track",), overrides=()):
    """Print every run, then how many kept to the line and to the time."""
    found = {name: [] for name in names}
    for seed in range(1, seeds + 1):
        for name, run in runs(seed, names, overrides).items():
            found[name].append(run)
            print(name, seed, *(f"{value:.4g}" if isinstance(value, float) else value for value in run))
    for name, rows in found.items():
        rms = [row.rms_mm for row in rows]
        print(
            f"{name}, {len(rows)} runs: on the line {sum(row.on_the_line for row in rows)}, in time "
            f"{sum(row.in_time for row in rows)}, converged "
            f"{sum(row.verdict == 'converged' for row in rows)}, without occlusion "
            f"{sum(row.occluded == 0 for row in rows)}; most {max(row.most_mm for row in rows):.3g} mm, rms "
            f"{max(rms):.3g} mm, of all {np.sqrt(np.mean(np.square(rms))):.3g} mm; at the true goal "
            f"{sum(row.at_true_goal for row in rows)}"
        )


if __name__ == "__main__":
    seeds, *rest = sys.argv[1:] or ["100"]
    names = tuple(word for word in rest if "=" not in word) or ("exact_track",)
    study(int(seeds), names, tuple(word for word in rest if "=" in word))
