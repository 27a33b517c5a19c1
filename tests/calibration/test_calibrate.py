"""Calibration as a whole, on robots simulated with scipy's matrix exponential."""

import dataclasses
import inspect

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict, prediction_variance, residual_statistics
from projservo_cli.calibration.adjustment import Scene, derivative, gauge
from projservo_cli.calibration.frame import isotropic, output_derivative, output_gauge, spread_factor
from projservo_cli.calibration.optimization import prepare
from projservo_cli.calibration.prediction import prediction_derivative
from projservo_cli.calibration.readings import gather
from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.records import FloatArray, InputError, Model, Observation
from tests.calibration.simulated_robot import IMAGE_SIZE, Robot, around, random_robot, trials

DRAWS = 12


def noisy(types="RRPRRR", seed=5, sigma=0.5, poses=trials):
    robot = random_robot(types, np.random.default_rng(seed))
    return robot, robot.observe(poses(robot), sigma, np.random.default_rng(seed + 1))


def held_out(robot, calibration, count=60):
    q = around(robot, count, np.random.default_rng(99))
    return predict(calibration, q) - robot.images(q), q


def bound(robot: Robot, q: FloatArray, q_new: FloatArray) -> float:
    """Cramér–Rao bound of the rms Euclidean prediction error at unit noise, from the true parameters."""
    readings = gather(robot.observe(q, 0.0, np.random.default_rng(0)), robot.joint_types)
    problem = prepare(readings, robot.q_reference)
    scene = Scene(robot.cameras, robot.twists, robot.markers)
    _, J = derivative(scene, readings, problem.q)
    factor = spread_factor(problem.dense(J, np.ones(J.shape[:2])), gauge(scene, readings, problem.place))
    target = gather(robot.observe(q_new, 0.0, np.random.default_rng(0)), robot.joint_types)
    ahead = prepare(target, robot.q_reference)
    _, J = derivative(scene, target, ahead.q)
    spread = ahead.dense(J, np.ones(J.shape[:2])) @ factor
    return float(np.sqrt(2.0 * (spread**2).sum(axis=1).mean()))


def test_it_sees_pixels_and_joint_readings_only():
    """Anything else, as a start (``init``), is left out by default."""
    parameters = inspect.signature(calibrate).parameters
    assert set(parameters) == {
        "observation", "joint_types", "method", "sigma_px", "source", "image_size", "seed",
        "lens", "init", "fitted", "tell",
    }  # fmt: skip
    assert parameters["init"].default is None


@pytest.mark.parametrize("types", ["RRPRRR", "RRRRRR", "PRP", "R"])
def test_noise_free_images_are_predicted_exactly(types):
    robot, observation = noisy(types, sigma=0.0)
    calibration = calibrate(observation, types, source="recorded")
    error, _ = held_out(robot, calibration)
    assert np.abs(error).max() < 1e-5
    assert calibration.usable
    assert calibration.rms_px < 1e-6


def test_record_follows_the_conventions():
    robot, observation = noisy()
    calibration = calibrate(observation, "rrprrr", sigma_px=0.5, image_size=IMAGE_SIZE)
    n, m = 6, len(robot.markers)
    assert calibration.joint_types == "RRPRRR"
    assert np.array_equal(calibration.marker, observation.marker)
    assert np.array_equal(calibration.q_reference, robot.q_reference)
    # Operators obey (4) and (5) to round-off, whatever the noise.
    H_hat = calibration.H_hat_0
    assert calibration.operator_defect[[0, 1, 3, 4, 5]].max() < 1e-11
    assert np.abs(H_hat[2] @ H_hat[2]).max() < 1e-11 * np.abs(H_hat[2]).max() ** 2
    assert calibration.trace_defect.max() < 1e-12
    assert calibration.plane_defect.max() < 1e-12
    # Signs: the plane at infinity is one on the markers, both cameras see positive depths.
    assert np.allclose(calibration.M @ calibration.a_inf, 1.0, atol=1e-12)
    assert np.all(np.einsum("vc,mc->vm", calibration.P[:, 2], calibration.M) > 0.0)
    assert calibration.covariance.shape == (24 + 16 * n + 4 * m,) * 2
    assert np.linalg.eigvalsh(calibration.covariance)[0] > -1e-12 * np.trace(calibration.covariance)
    assert calibration.dof == 2 * 2 * 49 * 10 - (24 + 5 * 4 + 2 + 3 * 10 - 8)
    assert calibration.merged_poses == 49
    assert calibration.merged_markers == 10
    assert len(calibration.outlier) == len(calibration.suspect) == len(calibration.swapped) == 0
    assert np.allclose(calibration.excitation, np.ptp(observation.q, axis=0))


def test_frame_is_projective_and_isotropic():
    _, observation = noisy("RRR")
    calibration = calibrate(observation, "RRR", sigma_px=0.5)
    moved = []
    for q, seen in zip(observation.q, np.isfinite(observation.images[:, 0, :, 0]), strict=True):
        moved.append(calibration.M[seen] @ forward_kinematics(calibration.model(), q).T)
    points = np.concatenate(moved)
    assert np.abs(points.T @ points / len(points) - np.eye(4)).max() < 1e-9
    # The guessed metric frame of the search does not show: twists would have a last row of zeros.
    assert np.abs(calibration.H_hat_0[:, 3]).max() > 1e-3
    assert np.linalg.norm(calibration.a_inf) == pytest.approx(1.0, abs=1e-9)


def test_frame_does_not_depend_on_the_frame_it_comes_from():
    robot = random_robot("RPR", np.random.default_rng(2))
    a_inf = np.array([0.0, 0.0, 0.0, 1.0])
    rng = np.random.default_rng(3)
    points = np.hstack([rng.uniform(-0.2, 0.2, (50, 3)), np.ones((50, 1))])
    first = isotropic(robot.cameras, robot.twists, robot.markers, a_inf, points)
    Z = np.eye(4) + 0.3 * rng.standard_normal((4, 4))
    back = np.linalg.inv(Z)
    second = isotropic(
        -3.0 * robot.cameras @ back, Z @ robot.twists @ back, robot.markers @ Z.T, a_inf @ back, points @ Z.T
    )
    for one, other in ((first.P, second.P), (first.H_hat_0, second.H_hat_0), (first.M, second.M)):
        assert np.allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(one).max())


def test_same_seed_same_numbers_and_other_seeds_agree():
    robot, observation = noisy("RRRRRR", poses=lambda r: around(r, 40, np.random.default_rng(1)))
    first, again, other = (calibrate(observation, "RRRRRR", sigma_px=0.5, seed=s) for s in (0, 0, 7))
    for field in dataclasses.fields(first):
        if field.name != "seconds":
            assert np.array_equal(getattr(first, field.name), getattr(again, field.name)), field.name
    _, q = held_out(robot, first)
    assert np.abs(predict(first, q) - predict(other, q)).max() < 1e-5


@pytest.mark.parametrize("poses", [trials, lambda robot: around(robot, 45, np.random.default_rng(4))])
def test_predictions_do_not_depend_on_order_numbers_or_image_coordinates(poses):
    robot, observation = noisy("RPRRRR", poses=poses)
    first = calibrate(observation, "RPRRRR", source="recorded")
    _, q = held_out(robot, first)
    expected = predict(first, q)
    rng = np.random.default_rng(8)
    rows, columns = rng.permutation(len(observation.pose)), rng.permutation(len(observation.marker))
    shuffled = Observation(
        observation.pose[rows],
        100 - observation.marker[columns],
        observation.q[rows],
        observation.images[rows][:, :, columns],
    )
    found = predict(calibrate(shuffled, "RPRRRR", source="recorded", seed=3), q)
    order = [list(100 - observation.marker[columns]).index(100 - number) for number in observation.marker]
    assert np.abs(found[:, :, order] - expected).max() < 1e-5
    # One affine change of coordinates with a turn for each camera: a rotation keeps the noise isotropic.
    c, s = np.cos(0.7), np.sin(0.7)
    linear = 0.5 * np.array([[c, -s], [s, c]])
    changed = dataclasses.replace(
        observation, images=observation.images @ linear.T + np.array([300.0, -900.0])
    )
    calibration = calibrate(changed, "RPRRRR", source="recorded")
    assert (
        np.abs(
            (predict(calibration, q) - np.array([300.0, -900.0])) @ np.linalg.inv(linear).T - expected
        ).max()
        < 1e-5
    )
    assert calibration.chi2_per_dof == pytest.approx(first.chi2_per_dof, rel=1e-3)


def test_markers_may_come_and_go():
    robot, observation = noisy("RRRRRR", poses=lambda r: around(r, 60, np.random.default_rng(3)))
    rng = np.random.default_rng(0)
    observation.images[rng.random((60, 2, 10)) < 0.3] = np.nan  # each view loses its own
    calibration = calibrate(observation, "RRRRRR", sigma_px=0.5)
    error, q = held_out(robot, calibration)
    assert np.sqrt(2.0 * np.mean(error**2)) < 1.5 * 0.5 * bound(robot, observation.q, q) / np.sqrt(0.5)


def test_covariance_is_that_of_the_parameters():
    """Variances of predictions from the record equal those of the adjustment, and its gauge is free."""
    robot = random_robot("RPR", np.random.default_rng(2), markers=5)
    q = trials(robot, frames=4)
    readings = gather(robot.observe(q, 0.0, np.random.default_rng(0)), "RPR")
    problem = prepare(readings, robot.q_reference)
    scene = Scene(robot.cameras, robot.twists, robot.markers)
    _, J = derivative(scene, readings, problem.q)
    factor = spread_factor(problem.dense(J, np.ones(J.shape[:2])), gauge(scene, readings, problem.place))
    result = isotropic(scene.P, scene.H_hat, scene.M, np.array([0.0, 0.0, 0.0, 1.0]), scene.M)
    model = Model(result.P, result.H_hat_0, np.array([0, 1, 0]), robot.q_reference, result.a_inf)
    outward = output_derivative(scene, readings, problem.place, result)
    predicted = prediction_derivative(model, result.M, q)
    direct = problem.dense(J, np.ones(J.shape[:2])) @ factor
    chained = (predicted @ (outward @ factor))[readings.pose_of, :, readings.marker_of]
    chained = chained.transpose(1, 0, 2, 3).reshape(direct.shape)
    assert np.abs(chained - direct).max() < 1e-9 * np.abs(direct).max()
    assert np.abs(predicted @ output_gauge(result)).max() < 1e-9 * np.abs(predicted).max()


def test_prediction_derivative_agrees_with_central_differences():
    robot, observation = noisy("RPR")
    calibration = calibrate(observation, "RPR", sigma_px=0.5)
    model, q = calibration.model(), around(robot, 2, np.random.default_rng(1))
    analytic = prediction_derivative(model, calibration.M, q)
    blocks = (model.P, model.H_hat_0, calibration.M)
    values = np.concatenate([b.ravel() for b in blocks])
    edges = np.cumsum([b.size for b in blocks])[:-1]

    def pixels(x):
        P, H_hat, M = (part.reshape(b.shape) for part, b in zip(np.split(x, edges), blocks, strict=True))
        return predict(dataclasses.replace(calibration, P=P, H_hat_0=H_hat, M=M), q)

    for k in range(0, values.size, 5):
        step = 1e-6 * max(1.0, abs(values[k]))
        ahead, behind = values.copy(), values.copy()
        ahead[k] += step
        behind[k] -= step
        numeric = (pixels(ahead) - pixels(behind)) / (2.0 * step)
        assert np.allclose(numeric, analytic[..., k], rtol=1e-4, atol=1e-4 * np.abs(analytic[..., k]).max())


def test_residual_statistics_count_what_they_skip():
    robot, observation = noisy("RRR")
    calibration = calibrate(observation, "RRR", sigma_px=0.5)
    q = np.concatenate([around(robot, 4, np.random.default_rng(2)), robot.q_reference[None]])
    images = robot.images(q)
    images[0, 0, 3] = np.nan
    fresh = Observation(np.arange(5), np.append(observation.marker[:-1], 999), q, images)
    found = residual_statistics(calibration, fresh)
    assert found["count"] == 5 * 2 * 9 - 1
    assert found["skipped"] == {"unknown_marker": 10, "behind_camera": 0, "missing": 1}
    distance = np.linalg.norm(predict(calibration, q) - images, axis=3)[:, :, :-1]
    distance = distance[np.isfinite(distance)]
    assert found["rms_px"] == pytest.approx(np.sqrt(np.mean(distance**2)))
    assert found["median_px"] == pytest.approx(np.median(distance))
    assert found["p95_px"] == pytest.approx(np.percentile(distance, 95))
    nothing = residual_statistics(
        calibration, dataclasses.replace(fresh, images=np.full_like(images, np.nan))
    )
    assert nothing["count"] == 0
    assert nothing["rms_px"] is None
    with pytest.raises(InputError, match="expected one row of 3"):
        predict(calibration, q[:, :2])


@pytest.mark.volume
def test_fit_is_as_good_as_the_cramer_rao_bound_over_noise_draws():
    robot = random_robot("RRPRR", np.random.default_rng(21))
    q = trials(robot)
    q_new = around(robot, 40, np.random.default_rng(5))
    truth = robot.images(q_new)
    squares, chi2, predicted = [], [], []
    for draw in range(DRAWS):
        calibration = calibrate(robot.observe(q, 0.5, np.random.default_rng(draw)), "RRPRR", sigma_px=0.5)
        squares.append(2.0 * np.mean((predict(calibration, q_new) - truth) ** 2))
        chi2.append(calibration.chi2_per_dof)
        predicted.append(2.0 * prediction_variance(calibration, q_new).mean())
    squares = np.array(squares)
    limit = 0.5 * bound(robot, q, q_new)
    ratio = np.sqrt(squares.mean()) / limit
    # Standard error of the ratio from the scatter of the draws.
    error = 0.5 * squares.std() / np.sqrt(len(squares)) / squares.mean()
    assert ratio < 1.10 + 2.0 * error
    assert ratio > 0.90 - 2.0 * error
    assert np.sqrt(np.mean(predicted)) == pytest.approx(limit, rel=0.05)
    # χ² per degree of freedom: mean one, variance 2 / dof.
    spread = np.sqrt(2.0 / calibration.dof)
    assert np.mean(chi2) == pytest.approx(1.0, abs=4.0 * spread / np.sqrt(len(chi2)))
    assert np.std(chi2) == pytest.approx(spread, rel=0.5)
