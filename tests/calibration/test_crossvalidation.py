"""Cross-validation: held-out poses do not enter their fit, fits are converged, errors are as predicted."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, cross_validate, predict
from projservo_cli.records import InputError
from tests.calibration.simulated_robot import around, random_robot, trials

SIGMA = 0.5
FOLDS = 4


def solved(observation, joint_types, **settings):
    """The solution behind a calibration, and its noise."""
    kept = []
    calibrate(observation, joint_types, sigma_px=SIGMA, fitted=lambda *found: kept.append(found), **settings)
    return kept[0]


@pytest.fixture(scope="module")
def robot():
    return random_robot("RRP", np.random.default_rng(3), markers=6)


@pytest.fixture(scope="module")
def observation(robot):
    rng = np.random.default_rng(4)
    return robot.observe(np.vstack([trials(robot, 6), around(robot, 12, rng)]), SIGMA, rng)


@pytest.fixture(scope="module")
def solution(observation):
    return solved(observation, "RRP")


@pytest.fixture(scope="module")
def held_out(solution):
    return cross_validate(*solution, FOLDS, seed=1)


def test_held_out_poses_do_not_enter_the_fit_that_predicts_them(solution, held_out):
    found, noise = solution
    readings = found.problem.detections
    away = held_out.fold[readings.pose_of] == 2
    pixels = readings.pixels + np.where(away[:, None], 300.0, 0.0)
    problem = dataclasses.replace(found.problem, detections=dataclasses.replace(readings, pixels=pixels))
    again = cross_validate(dataclasses.replace(found, problem=problem), noise, FOLDS, seed=1)
    fold = held_out.fold == 2
    # Seen has moved by 300 px, predicted not by a bit; 300 px cost some digits of the difference.
    np.testing.assert_allclose(again.residual[fold] - 300.0, held_out.residual[fold], atol=1e-12)
    np.testing.assert_array_equal(again.predicted[fold], held_out.predicted[fold])
    other = ~fold & (held_out.fold >= 0)
    assert np.nanmax(np.abs(again.residual[other] - held_out.residual[other])) > 0.0


def test_each_fit_is_that_of_a_calibration_from_its_poses_alone(observation, held_out):
    for fold in range(FOLDS):
        test = held_out.fold == fold
        rest = dataclasses.replace(
            observation, **{name: getattr(observation, name)[~test] for name in ("pose", "q", "images")}
        )
        alone = calibrate(rest, "RRP", sigma_px=SIGMA)
        residual = observation.images[test] - predict(alone, observation.q[test])
        # Both searches end when a step moves the images by 1e-7 of the residual.
        np.testing.assert_allclose(held_out.residual[test], residual, atol=2e-6)


def test_every_pose_is_predicted_once_and_the_statistics_are_of_its_residuals(observation, held_out):
    assert held_out.failed == ()
    assert held_out.unit == "poses"  # single-joint trials hang together as a whole
    np.testing.assert_array_equal(held_out.pose, observation.pose)
    np.testing.assert_array_equal(held_out.marker, observation.marker)
    assert np.ptp(np.bincount(held_out.fold)) <= 1
    distance = np.linalg.norm(held_out.residual, axis=3)
    assert held_out.count == distance.size == np.isfinite(distance).sum()
    assert held_out.rms_px == pytest.approx(np.sqrt(np.mean(distance**2)))
    assert held_out.median_px == pytest.approx(np.median(distance))
    assert held_out.p95_px == pytest.approx(np.percentile(distance, 95))


def test_errors_are_as_the_covariance_of_each_fit_predicts(held_out):
    score = held_out.residual / held_out.predicted
    assert (held_out.predicted > SIGMA).all()
    # Some 740 coordinates, the errors of a prediction shared: three standard errors of independent ones.
    assert np.mean(score**2) == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / score.size))
    assert held_out.rms_px == pytest.approx(held_out.predicted_rms_px, rel=0.1)
    assert "as much as the covariance predicts" in held_out.reason


def test_the_division_follows_from_its_seed_alone(solution, held_out):
    again, other = (cross_validate(*solution, FOLDS, seed=seed) for seed in (1, 2))
    np.testing.assert_array_equal(again.residual, held_out.residual)
    assert (other.fold != held_out.fold).any()


def test_wrong_markers_and_poses_without_a_reading_do_not_count(observation):
    images = observation.images.copy()
    images[5, 0, 2] += 80.0
    images[3] = np.nan
    found = cross_validate(*solved(dataclasses.replace(observation, images=images), "RRP"), 5, seed=0)
    assert np.isnan(found.residual[5, 0, 2]).all()
    assert found.count == np.isfinite(images[..., 0]).sum() - 1
    assert found.rms_px < 1.0
    assert found.fold[3] == -1
    assert set(found.fold) == {-1, 0, 1, 2, 3, 4}


def spun(robot, configurations, spins, rng):
    """Poses that share all readings but the last in groups, with the jitter of real encoders."""
    q = np.repeat(around(robot, configurations, rng), spins, axis=0)
    q[:, -1] += np.tile(np.linspace(-0.1, 0.1, spins), configurations)
    return q + 1e-4 * rng.uniform(-1.0, 1.0, q.shape)


def test_poses_that_differ_in_one_joint_stay_together(robot):
    rng = np.random.default_rng(6)
    found = cross_validate(*solved(robot.observe(spun(robot, 9, 4, rng), SIGMA, rng), "RRP"), 3, seed=0)
    assert found.unit == "configurations"
    assert (found.fold.reshape(9, 4) == found.fold[::4, None]).all()
    np.testing.assert_array_equal(np.bincount(found.fold), [12, 12, 12])


@pytest.mark.parametrize("folds", [1, 32])
def test_parts_without_poses_are_refused(solution, folds):
    with pytest.raises(InputError, match="there are 31 poses; choose 2 to 31 parts"):
        cross_validate(*solution, folds, seed=0)


def test_a_part_that_alone_moves_a_joint_is_named_not_predicted():
    rng = np.random.default_rng(7)
    robot = random_robot("RR", rng, markers=6)
    # The second joint moves in one pose only: without it nothing is known of that joint.
    q = np.vstack([robot.q_reference + np.outer(np.linspace(-0.5, 0.5, 9), [1.0, 0.0]), robot.q_reference])
    q[9, 1] += 0.5
    found = cross_validate(*solved(robot.observe(q, SIGMA, rng), "RR"), 5, seed=0)
    assert [int(text[5]) - 1 for text in found.failed] == [found.fold[9]]
    assert np.isnan(found.residual[found.fold == found.fold[9]]).all()
    assert "1 parts could not be predicted" in found.reason


def test_poses_that_disagree_err_more_than_noise_predicts(robot):
    rng = np.random.default_rng(8)
    observation = robot.observe(around(robot, 30, rng), SIGMA, rng)
    lagging = observation.q + 2e-3 * rng.standard_normal(observation.q.shape)
    kept = []
    recorded = dataclasses.replace(observation, q=lagging)
    calibrate(recorded, "RRP", source="recorded", fitted=lambda *found: kept.append(found))
    found = cross_validate(kept[0][0], SIGMA, FOLDS, seed=0)
    assert found.rms_px > 1.2 * found.predicted_rms_px
    assert "joint readings or a lens" in found.reason
