"""The whole chain on arms of more and of fewer than six joints."""

from functools import cache

import numpy as np
import pytest

from projservo_cli import Experiment
from projservo_cli.config import load_config
from projservo_cli.geometry.kinematics import joint_operators
from projservo_cli.records import WorkFailed
from tests.configured import calibrate, plan, servo
from tests.conftest import ROOT

# Four joints: two vertical axes, a lift and a vertical axis again; it turns the face about one direction.
LIFT = """
robot:
  dh:
    joints:
      - {type: R, d_m: 0.6, a_m: 0.4, limits_deg: [-150, 150]}
      - {type: R, a_m: 0.35, limits_deg: [-150, 150]}
      - {type: P, limits_m: [-0.4, 0.4]}
      - {type: R, limits_deg: [-170, 170]}
    tool: [[0, 0, 1, 0.0], [0, 1, 0, 0], [-1, 0, 0, 0.03], [0, 0, 0, 1]]
calibration: {amplitude_deg: 20, reference: {joints: [20, -40, 0.0, 20], unit: deg}}
task:
  start: {joints: [30, -60, -0.05, 10], unit: deg}
  goal: {joints: {joints: [10, -30, 0.08, 35], unit: deg}}
"""
# The paper's arm without its last joint.
FIVE = """
robot:
  dh:
    joints:
      - {type: R, alpha_deg: 90, limits_deg: [-160, 160]}
      - {type: R, a_m: 0.4318, limits_deg: [-225, 45]}
      - {type: R, d_m: 0.15, a_m: 0.0203, alpha_deg: -90, limits_deg: [-45, 225]}
      - {type: R, d_m: 0.4318, alpha_deg: 90, limits_deg: [-110, 170]}
      - {type: R, alpha_deg: -90, limits_deg: [-100, 100]}
    tool: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]
calibration: {amplitude_deg: 20, reference: {joints: [15, 15, -25, 25, -65], unit: deg}}
task:
  start: {joints: [24, 30, -44, 42, -79], unit: deg}
  goal: {joints: {joints: [10, 10, -20, 10, -60], unit: deg}}
"""
ARMS = {"seven": "", "lift": LIFT, "five": FIVE}
# A turntable.
ONE = """
robot:
  dh:
    joints: [{type: R, d_m: 0.6, a_m: 0.4, limits_deg: [-150, 150]}]
    tool: [[0, 0, 1, 0.0], [0, 1, 0, 0], [-1, 0, 0, 0.03], [0, 0, 0, 1]]
task:
  start: {joints: [-10], unit: deg}
  goal: {joints: {joints: [10], unit: deg}}
"""


def watched(name, arm, *overrides):
    """Configuration of an arm that the paper's rig watches."""
    text = (ROOT / "configs" / "paper.yaml").read_text(encoding="utf-8")
    rig = text[text.index("\nrig:") : text.index("\ncalibration:")]
    return load_config(f"{name}.yaml", list(overrides), text=rig + arm)


@cache
def planned(name, *overrides):
    """Configuration, calibration from noisy images, and plan of an arm."""
    if name == "seven":
        config = load_config(ROOT / "configs" / "seven.yaml", list(overrides))
    else:
        config = watched(name, ARMS[name], *overrides)
    _, calibration, _ = calibrate.run(config)
    assert calibration.usable
    return config, calibration, plan.run(config, calibration)


@pytest.mark.volume
@pytest.mark.parametrize("law", ["exact", "direct_two", "stacked"])
@pytest.mark.parametrize("name", ARMS)
def test_the_task_is_done(name, law):
    config, calibration, found = planned(name)
    assert found.feasible
    assert np.isfinite(found.q).all()
    trace = servo.run(config, calibration, found, law)
    if (name, law) == ("seven", "stacked"):
        assert trace.verdict == "no progress"  # a local minimum on the way round, as with six joints
        return
    assert trace.verdict == "converged", trace.reason
    assert trace.position_error_mm < 0.05
    assert trace.rotation_error_deg < 0.05
    if law == "exact":
        # What the calibration is off; the other laws drift by up to tens of millimetres.
        assert trace.center_deviation_at_samples_mm < 1.0


@pytest.mark.volume
@pytest.mark.parametrize("points", ["points", "body"])
def test_the_redundant_arm_makes_the_least_motion(points):
    """No other joint motion moves the face alike and is shorter: none is spent on what moves nothing."""
    config, calibration, found = planned("seven", f"control.features={points}")
    trace = servo.run(config, calibration, found, "direct_two")
    assert (trace.verdict, trace.features) == ("converged", points)
    model = calibration.model()
    for k in range(0, trace.steps, 10):
        H_hat = joint_operators(model, trace.q[k]).reshape(7, 16)
        spent = np.linalg.svd(H_hat.T)[2][6] @ trace.q_dot[k]
        assert abs(spent) < 1e-6 * np.linalg.norm(trace.q_dot[k])


def test_one_joint_is_calibrated_and_has_a_page_and_reaches_no_pose(tmp_path):
    experiment = Experiment(watched("one", ONE), tmp_path).make("calibrate")
    assert experiment.calibration.usable
    assert np.isfinite(experiment.calibration.predict([0.1])).all()
    with pytest.raises(WorkFailed, match="one joint cannot reach a pose, which takes two or more"):
        experiment.make("servo")
    assert experiment.make("report").report.figures
    assert (tmp_path / "report.html").is_file()
