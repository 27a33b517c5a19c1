"""Cross-validation: held-out poses do not enter their fit, fits are converged, errors are as predicted."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, cross_validate, predict
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
