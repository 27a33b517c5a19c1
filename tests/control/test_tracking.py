"""Following the plan of the paper's task, a half turn, with noise: a calibrated robot."""

import numpy as np
import pytest

from tests.configured import calibrate, plan, servo, truth_of
from tests.known import configured

pytestmark = pytest.mark.volume
NOISE = ["noise.calibration_px=0.5", "noise.servo_px=0.5"]


@pytest.mark.parametrize(("seed", "frames"), [(1, 16), (5, 1)])
def test_the_centre_keeps_to_its_line_and_arrives_in_time(seed, frames):
    """At 0.5 px in the trials and in the loop; one image tells the goal to 0.96 mm, sixteen to a quarter."""
    config = configured("paper", *NOISE, f"seed={seed}", f"noise.averaged_frames={frames}")
    _, calibration, _ = calibrate.run(config)
    trace = servo.run(config, calibration, plan.run(config, calibration), "exact_track")
    assert trace.verdict == "converged"
    assert not trace.self_occluded.any()
    assert trace.center_deviation_mm <= 3.0
    body = np.linalg.solve(truth_of(config).robot.base_tool, truth_of(config).M_face.mean(axis=0))
    off_mm = 1e3 * np.linalg.norm(trace.center - (trace.goal_pose @ body)[:3], axis=1)
    due = int(trace.planned_s / trace.period) + 1
    assert trace.steps <= due + 1
    assert off_mm[min(trace.steps, due)] <= (1.0 if frames > 1 else 3.0)
