"""Images at rest: ``validate`` tells what changed as ``doctor`` does, by one posture and by several."""

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict
from projservo_cli.findings import LIMITS, REFUSES
from projservo_cli.monitoring.fault_at_rest import fault_at_rest
from projservo_cli.records import Observation
from projservo_cli.stages.validate import compared
from tests.calibration.simulated_robot import around, random_robot, trials

NOISE_PX, FRAMES = 0.3, 20


@pytest.fixture(scope="module")
def rig():
    """A robot before two cameras, and its calibration."""
    rng = np.random.default_rng(5)
    robot = random_robot("RRRRRR", rng, 12, 2)
    seen = robot.observe(np.concatenate([trials(robot), around(robot, 12, rng)]), NOISE_PX, rng)
    return robot, calibrate(seen, robot.joint_types)


def images(rig, q, off=0.0):
    """Noisy images at joints (K, n), of which those of the right camera are off."""
    calibration, rng = rig[1], np.random.default_rng(6)
    s = predict(calibration, q)
    s = s + NOISE_PX * rng.standard_normal(s.shape)
    s[:, 1] += off
    return Observation(np.arange(len(q)), calibration.marker, q, s)


def codes(one):
    """Codes of the causes of a fault."""
    return {cause.code for cause in one.others}


@pytest.mark.parametrize("off", [0.0, 1.5])
def test_frames_of_one_posture_are_judged_as_doctor_judges_them(rig, off):
    shown = images(rig, np.repeat(rig[0].q_reference[None], FRAMES, axis=0), np.array([off, 0.0]))
    fault, value = fault_at_rest(rig[1], shown), compared(rig[1], shown)
    findings = value["findings"]
    assert {one["limit_px"] for one in value["views"]} == {None}
    assert (fault is not None) == bool(off)
    assert [one.code for one in findings] == ([fault.code] if fault else [])
    if fault:
        assert "displaced_camera" in codes(fault)
        assert codes(fault) == codes(findings[0])


def test_of_several_postures_medians_decide_and_what_changed_is_told_beside_them(rig):
    q = around(rig[0], 20, np.random.default_rng(7))
    assert compared(rig[1], images(rig, q))["findings"] == []
    value = compared(rig[1], images(rig, q, np.array([6.0, 0.0])))
    contradicted, changed = value["findings"]
    assert (contradicted.code, contradicted.severity) == ("contradicted_in_part", REFUSES)
    assert (changed.code, changed.severity) == ("images_off", LIMITS)
    assert "displaced_camera" in codes(changed)
    assert "right camera was moved" in value["advice"][-1]
