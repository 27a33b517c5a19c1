"""Calibration as a whole, on robots simulated with scipy's matrix exponential."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict, residual_statistics
from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.detections import Detections
from projservo_cli.calibration.prediction import Parameters, dense_pixel_changes
from projservo_cli.calibration.projective import Projective
from projservo_cli.calibration.robust_fit import Solution
from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.records import Observation
from tests.calibration.simulated_robot import IMAGE_SIZE, around, random_robot, trials


def noisy(types="RRPRRR", seed=5, sigma=0.5, poses=trials):
    robot = random_robot(types, np.random.default_rng(seed))
    return robot, robot.observe(poses(robot), sigma, np.random.default_rng(seed + 1))


@pytest.fixture(scope="module")
def known():
    """A robot, its observation, and its calibration."""
    robot, observation = noisy("RRR")
    return robot, observation, calibrate(observation, "RRR", sigma_px=0.5)


@pytest.mark.parametrize("types", ["RRPR", "PRP", "R"])
def test_noise_free_images_are_predicted_exactly(types):
    robot, observation = noisy(types, sigma=0.0)
    calibration = calibrate(observation, types, source="recorded")
    q = around(robot, 60, np.random.default_rng(99))
    assert np.abs(predict(calibration, q) - robot.images(q)).max() < 1e-5
    assert calibration.usable
    assert calibration.rms_px < 1e-6


def test_record_follows_the_conventions():
    robot, observation = noisy()
    calibration = calibrate(observation, "rrprrr", sigma_px=0.5, image_size=IMAGE_SIZE)
    assert calibration.joint_types == "RRPRRR"
    assert np.array_equal(calibration.marker, observation.marker)
    assert np.array_equal(calibration.q_reference, robot.q_reference)
    # Both cameras see positive depths.
    assert np.all(np.einsum("vc,mc->vm", calibration.P[:, 2], calibration.M) > 0.0)
    assert calibration.poses_used == 49
    assert calibration.markers_used == 10
    assert len(calibration.outlier) == len(calibration.suspect) == len(calibration.id_switches) == 0
    assert np.allclose(calibration.excitation, np.ptp(observation.q, axis=0))


def test_frame_is_projective_and_isotropic(known):
    _, observation, calibration = known
    moved = [calibration.M @ forward_kinematics(calibration.model(), q).T for q in observation.q]
    points = np.concatenate(moved)
    assert np.abs(points.T @ points / len(points) - np.eye(4)).max() < 1e-9
    # The guessed metric frame of the search does not show: twists would have a last row of zeros.
    assert np.abs(calibration.H_hat_0[:, 3]).max() > 1e-3
    assert np.linalg.norm(calibration.a_inf) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("noise", "markers", "lens_terms"), [(None, 5, 0), (None, 5, 4), (0.01, 5, 2), (0.01, 30, 0)]
)
def test_covariance_is_that_of_the_parameters(noise, markers, lens_terms):
    """Predictions err as by the dense information matrix, of every marker that is eliminated or kept."""
    robot = random_robot("RPR", np.random.default_rng(2), markers=markers)
    q = trials(robot, frames=4)
    readings = readings_at(robot, q)
    tau = None if noise is None else noise * np.array([1.0, 0.3, 2.0])
    problem = LeastSquares.of(readings, robot.q_reference, lens_terms).with_noise(tau)
    bent = np.array([[320.0, 240.0, 300.0, -0.1, 0.02]] * 2) if lens_terms else None
    scene = Parameters(
        robot.cameras, robot.twists, readings.prismatic, robot.markers, bent, lens_terms=lens_terms
    )
    used = readings.seen & (np.random.default_rng(3).random(readings.seen.shape) > 0.3)
    solution = Solution(problem, scene, problem.residual(scene), used, 10**12)
    ahead = problem.dense(problem.derivative(scene), readings.seen)
    J = ahead * np.repeat(used.ravel(), 2)[:, None]
    if tau is not None:  # offsets of all joints as parameters of their own, held by their noise
        G = (problem.joint_derivative(scene) * tau)[..., None, :] * used[..., None, None, None]
        at_pose = (readings.pose_of[:, None] == np.arange(len(q)))[None, :, None, :, None]
        offsets = (G * at_pose).reshape(len(J), -1)
        held = np.hstack([np.zeros((offsets.shape[1], problem.size)), np.eye(offsets.shape[1])])
        J = np.vstack([np.hstack([J, offsets]), held])
    scale = np.linalg.norm(J, axis=0)
    root = np.linalg.pinv(J / scale, rcond=1e-11)[: problem.size] / scale[: problem.size, None]
    expected = (ahead @ root) @ (ahead @ root).T
    errors = solution.errors()
    factor = ahead @ errors.dense()
    np.testing.assert_allclose(factor @ factor.T, expected, atol=1e-9 * np.abs(expected).max())
    parts = problem.predicted(scene, errors)
    variance = sum((part**2).sum(axis=-1) for part in parts)
    np.testing.assert_allclose(variance.ravel(), np.diag(expected), rtol=1e-9)
    # The record tells them of another frame.
    result = Projective.of(solution)
    found = dense_pixel_changes(result.params, result.errors(solution, errors), problem.q)
    found = found[readings.pose_of, :, readings.marker_of].swapaxes(0, 1).reshape(len(expected), -1)
    np.testing.assert_allclose(found @ found.T, expected, atol=1e-9 * np.abs(expected).max())


def test_residual_statistics_count_what_they_skip(known):
    """Every count and percentile against a loop over single sightings."""
    robot, observation, calibration = known
    q = around(robot, 6, np.random.default_rng(9))
    images = robot.observe(q, 3.0, np.random.default_rng(10)).images
    images[1, 0, 2] = np.nan
    images[3, :, 1] = np.nan
    images[4, 1, 4, 0] = np.nan  # half a pixel is no pixel
    fresh = Observation(np.arange(6), np.append(observation.marker[:-1], 999), q, images)
    found = residual_statistics(calibration, fresh)
    difference = (predict(calibration, q) - images)[:, :, :-1].reshape(-1, 2)
    distances = [(du * du + dv * dv) ** 0.5 for du, dv in difference if not np.isnan(du + dv)]
    assert found["count"] == len(distances) == 6 * 2 * 9 - 4
    assert found["rms_px"] == pytest.approx(np.sqrt(np.mean(np.square(distances))))
    assert found["median_px"] == pytest.approx(np.median(distances))
    assert found["p95_px"] == pytest.approx(np.quantile(distances, 0.95))
    assert found["skipped"] == {"unknown_marker": 12, "behind_camera": 0, "missing": 4}
    nothing = residual_statistics(
        calibration, dataclasses.replace(fresh, images=np.full_like(images, np.nan))
    )
    assert nothing["count"] == 0
    assert nothing["rms_px"] is nothing["limit_px"] is None


def test_limit_of_held_out_images_takes_their_own_noise(known):
    """Four times the noise of the calibration is no contradiction; a gear that changed since is one."""
    robot, _, calibration = known
    q = around(robot, 30, np.random.default_rng(9))
    for noise in (0.0, 0.5, 2.0):
        fresh = robot.observe(q, noise, np.random.default_rng(10))
        found = residual_statistics(calibration, fresh)
        assert found["noise_px"] == pytest.approx(np.sqrt(2.0) * noise, rel=0.2, abs=1e-6)
        assert found["median_px"] < 0.5 * found["limit_px"]
        assert found["limit_px"] == pytest.approx(3.0 * np.hypot(found["stated_px"], found["noise_px"]))
        geared = dataclasses.replace(fresh, q=(1.0 + 0.2 * noise + 0.05) * q)
        contradicted = residual_statistics(calibration, geared)
        assert contradicted["median_px"] > contradicted["limit_px"]


@pytest.mark.parametrize("missed", [0.0, 0.8])
def test_a_camera_that_turned_passes_the_limit_of_its_own_view(known, missed):
    """The pooled median hides it: by rows that it lacks, or by the noise that it is smaller than."""
    robot, _, calibration = known
    rng = np.random.default_rng(11)
    fresh = robot.observe(around(robot, 40, rng), 0.3, rng)
    fresh.images[rng.random(40) < missed, 1] = np.nan
    sound = residual_statistics(calibration, fresh)
    for one in sound["views"]:
        assert one["median_px"] < one["limit_px"]
    assert sum(one["count"] for one in sound["views"]) == sound["count"]
    fresh.images[:, 1] += [8.0 * sound["stated_px"], 6.0 * sound["stated_px"]]
    left, right = residual_statistics(calibration, fresh)["views"]
    assert left == sound["views"][0]
    assert right["median_px"] > right["limit_px"]


def readings_at(robot, q):
    return Detections.of(robot.observe(q, 0.0, np.random.default_rng(0)), robot.joint_types)


def test_reference_is_the_pose_all_trials_share():
    robot = random_robot("RRR", np.random.default_rng(3))
    q = trials(robot, frames=4)
    shuffled = q[np.random.default_rng(0).permutation(len(q))]
    assert np.array_equal(readings_at(robot, shuffled).reference(), robot.q_reference)
    assert readings_at(robot, around(robot, 20, np.random.default_rng(1))).home() is None
