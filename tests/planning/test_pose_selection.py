"""Suggested poses: the promised variance is the one found, less than by chance, within the region."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, prediction_variance
from projservo_cli.planning.pose_selection import suggest
from projservo_cli.planning.prediction_covariance import Region
from projservo_cli.records import WorkFailed, changed
from tests.calibration.simulated_robot import IMAGE_SIZE, around, random_robot, trials

SIGMA = 0.5
COUNT = 4
IMAGE = np.array([[[0.0, 0.0], IMAGE_SIZE]] * 2)
REACH = np.array([0.5, 0.15, 0.5, 0.5])


@pytest.fixture(scope="module")
def robot():
    return random_robot("RPRR", np.random.default_rng(3), markers=6)


@pytest.fixture(scope="module")
def region(robot):
    return Region(robot.q_reference - REACH, robot.q_reference + REACH, IMAGE)


def observed(robot, q, seed):
    """Images of the markers that lie within them, with noise."""
    found = robot.observe(q, SIGMA, np.random.default_rng(seed))
    found.images[~((found.images >= 0.0) & (found.images <= IMAGE_SIZE)).all(axis=-1)] = np.nan
    return found


def calibrated(robot, q, seed):
    return calibrate(observed(robot, q, seed), robot.joint_types, sigma_px=SIGMA)


@pytest.fixture(scope="module")
def few(robot):
    """Short trial motions: ±10° and 5 cm."""
    return trials(robot, 4, np.radians(10.0), 0.05)


@pytest.fixture(scope="module")
def suggested(robot, few, region):
    observation = observed(robot, few, 0)
    calibration = calibrate(observation, robot.joint_types, sigma_px=SIGMA)
    return suggest(calibration, observation, region, region, COUNT, np.random.default_rng(5))


def visible(robot, q):
    images = robot.images(q)
    inside = ((images >= 0.0) & (images <= IMAGE_SIZE)).all(axis=-1)
    return q[inside.all(axis=1).sum(axis=1) >= 3]


def test_what_is_promised_is_what_the_covariance_with_the_poses_says(robot, few, suggested):
    """An oracle that knows nothing of designs: calibrate with the poses added, look at the variance."""
    targets = visible(robot, around(robot, 150, np.random.default_rng(8)))
    before = np.mean([prediction_variance(calibrated(robot, few, seed), targets).mean() for seed in range(2)])
    q = np.vstack([few, [one.q for one in suggested]])
    after = np.mean([prediction_variance(calibrated(robot, q, seed), targets).mean() for seed in range(2)])
    promised = suggested[0].variance_before / suggested[-1].variance_after
    # Other targets, another estimate, markers counted that the noise moves over the border.
    assert before / after == pytest.approx(promised, rel=0.35)
    assert before / after > 3.0


def test_the_choice_does_not_depend_on_the_frame_nor_on_the_unit_of_pixels(robot, few, suggested):
    observation = observed(robot, few, 0)
    scaled = dataclasses.replace(observation, images=3.0 * observation.images + 50.0)
    calibration = calibrate(scaled, robot.joint_types, sigma_px=3.0 * SIGMA)
    image = 3.0 * IMAGE + 50.0
    region = Region(robot.q_reference - REACH, robot.q_reference + REACH, image)
    found = suggest(calibration, scaled, region, region, COUNT, np.random.default_rng(5))
    for one, other in zip(found, suggested, strict=True):
        np.testing.assert_array_equal(one.q, other.q)
        assert one.variance_after == pytest.approx(9.0 * other.variance_after, rel=1e-3)


def test_what_cannot_be_suggested_says_why(robot, few, region):
    observation = observed(robot, few, 0)
    calibration = calibrate(observation, robot.joint_types, sigma_px=SIGMA)
    nowhere = dataclasses.replace(region, image=IMAGE + 1e5)
    with pytest.raises(WorkFailed, match="no further pose to suggest"):
        suggest(calibration, observation, nowhere, region, 1, np.random.default_rng(0))
    off = calibration.errors.scaled(1e4)
    vague = changed(calibration, sqrt_cov_shared=off.shared, sqrt_cov_marker=off.marker, sqrt_cov_own=off.own)
    with pytest.raises(WorkFailed, match="by this calibration"):
        suggest(vague, observation, region, region, 1, np.random.default_rng(0))
