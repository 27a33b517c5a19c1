"""Closed forms (4), (5) and the linear multi-frame method beside the refinement."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict
from projservo_cli.calibration.closed_form import homography
from projservo_cli.records import WorkFailed
from tests.calibration.simulated_robot import around, random_robot, trials


def error_of(method, sigma, types="RRPRRR", **given):
    robot = random_robot(types, np.random.default_rng(12))
    observation = robot.observe(trials(robot), sigma, np.random.default_rng(1))
    calibration = calibrate(observation, types, method=method, source="recorded", **given)
    q = around(robot, 40, np.random.default_rng(2))
    return calibration, np.sqrt(2.0 * np.mean((predict(calibration, q) - robot.images(q)) ** 2))


@pytest.mark.parametrize("method", ["closed_form", "linear"])
def test_exact_images_give_exact_operators(method):
    calibration, error = error_of(method, 0.0)
    assert error < 1e-4
    assert calibration.usable
    assert calibration.method == method
    assert calibration.operator_defect[[0, 1, 3, 4, 5]].max() < 1e-6
    assert calibration.plane_defect.max() < 1e-6
    assert np.allclose(calibration.M @ calibration.a_inf, 1.0, atol=1e-9)
    assert np.all(np.isnan(calibration.covariance))


@pytest.mark.parametrize("method", ["closed_form", "linear"])
def test_noise_hurts_them_more_than_the_refinement_and_they_say_so(method):
    calibration, error = error_of(method, 0.5)
    _, refined = error_of("refined", 0.5)
    assert error > 3.0 * refined
    assert not calibration.usable
    assert "use refined" in calibration.reason


def test_homography_of_exact_points():
    rng = np.random.default_rng(3)
    H, A = rng.standard_normal((4, 4)), rng.standard_normal((7, 4))
    B = A @ H.T
    found = homography(A / np.linalg.norm(A, axis=1)[:, None], B / np.linalg.norm(B, axis=1)[:, None])
    found *= H[0, 0] / found[0, 0]
    assert np.abs(found - H).max() < 1e-10


@pytest.mark.parametrize("method", ["closed_form", "linear"])
def test_motions_of_several_joints_are_refused(method):
    robot = random_robot("RRR", np.random.default_rng(4))
    observation = robot.observe(around(robot, 30, np.random.default_rng(5)), 0.5, np.random.default_rng(6))
    with pytest.raises(WorkFailed, match="single-joint trials"):
        calibrate(observation, "RRR", method=method)


def test_half_turns_leave_the_closed_form_undefined():
    robot = random_robot("RRR", np.random.default_rng(4))
    q = trials(robot, frames=2, angle=np.pi)
    observation = robot.observe(q, 0.1, np.random.default_rng(6))
    with pytest.raises(WorkFailed, match=r"joint 1 .* 180° leaves equation \(4\) undefined"):
        calibrate(observation, "RRR", method="closed_form")


@pytest.mark.parametrize("kind", ["coplanar", "four"])
def test_bodies_the_closed_form_cannot_use_are_refined(kind):
    robot = random_robot("RRPRRR", np.random.default_rng(12))
    markers = robot.markers[:6].copy() if kind == "coplanar" else robot.markers[:4]
    if kind == "coplanar":
        markers[:, 2] = 0.3 * markers[:, 0]
    robot = dataclasses.replace(robot, markers=markers)
    observation = robot.observe(trials(robot), 0.5, np.random.default_rng(1))
    message = "one plane" if kind == "coplanar" else "5 markers"
    with pytest.raises(WorkFailed, match=message):
        calibrate(observation, "RRPRRR", method="closed_form")
    calibration = calibrate(observation, "RRPRRR", sigma_px=0.5)
    q = around(robot, 40, np.random.default_rng(2))
    assert np.sqrt(2.0 * np.mean((predict(calibration, q) - robot.images(q)) ** 2)) < 1.0
