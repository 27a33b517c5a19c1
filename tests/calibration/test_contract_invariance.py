"""What must not change a calibration: order and numbers of rows, pixel units, zeros and senses of joints."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict
from projservo_cli.records import Observation
from tests.calibration.simulated_robot import around, random_robot, trials

SIGMA = 0.5
# The search ends when a step moves the images by 1e-7 of the residual; it converges faster than
# linearly, so that the optimum is nearer still.
SAME_PX = 1e-6


@pytest.fixture(scope="module", params=["RRRRRR", "RRPRPR"])
def case(request):
    """Robot, noisy trials with a tenth of the sightings missing, poses to predict, calibration."""
    rng = np.random.default_rng(7)
    robot = random_robot(request.param, rng, markers=7)
    observation = robot.observe(trials(robot, frames=6), SIGMA, rng)
    images = observation.images
    images[rng.random(images.shape[:3]) < 0.1] = np.nan
    q = around(robot, 40, rng)
    return robot, observation, q, calibrate(observation, robot.joint_types, source="recorded")


def calibrated(observation, robot):
    return calibrate(observation, robot.joint_types, source="recorded")


def test_order_of_poses_and_markers(case, rng):
    robot, observation, q, calibration = case
    k, j = rng.permutation(len(observation.pose)), rng.permutation(len(observation.marker))
    shuffled = Observation(
        observation.pose[k], observation.marker[j], observation.q[k], observation.images[k][:, :, j]
    )
    other = calibrated(shuffled, robot)
    order = [list(other.marker).index(number) for number in calibration.marker]
    assert np.abs(predict(other, q)[:, :, order] - predict(calibration, q)).max() <= SAME_PX
    assert other.dof == calibration.dof
    assert other.rms_px == pytest.approx(calibration.rms_px, rel=1e-9)
    np.testing.assert_array_equal(other.outlier, calibration.outlier)


# Homographies of the pixels of left and right camera that keep the noise equal in all directions.
IMAGES = {
    "left image shifted": ((1.0, (4000.0, -2500.0)), (1.0, (0.0, 0.0))),
    "both scaled down and shifted": ((0.01, (1.0, -2.0)), (0.01, (-3.0, 5.0))),
}


def scaled(images, changes):
    """Images (K, 2, m, 2) in other coordinates of each camera."""
    return np.stack([s * images[:, v] + np.array(t) for v, (s, t) in enumerate(changes)], axis=1)


@pytest.mark.parametrize("name", IMAGES)
def test_scale_and_origin_of_the_pixels(case, name):
    robot, observation, q, calibration = case
    changed = dataclasses.replace(observation, images=scaled(observation.images, IMAGES[name]))
    other = calibrated(changed, robot)
    scale = IMAGES[name][0][0]
    apart = predict(other, q) - scaled(predict(calibration, q), IMAGES[name])
    assert np.abs(apart).max() <= SAME_PX * scale
    assert other.sigma_px == pytest.approx(scale * calibration.sigma_px, rel=1e-5)
    assert other.chi2_per_dof == pytest.approx(calibration.chi2_per_dof, rel=1e-4)


def test_left_and_right_exchanged(case):
    robot, observation, q, calibration = case
    other = calibrated(dataclasses.replace(observation, images=observation.images[:, ::-1].copy()), robot)
    assert np.abs(predict(other, q)[:, ::-1] - predict(calibration, q)).max() <= SAME_PX


def test_zeros_and_senses_of_the_joints(case, rng):
    robot, observation, q, calibration = case
    sense = np.where(np.arange(q.shape[1]) % 2, -1.0, 1.0)
    zero = rng.uniform(-1.0, 1.0, q.shape[1])
    other = calibrated(dataclasses.replace(observation, q=sense * observation.q + zero), robot)
    assert np.abs(predict(other, sense * q + zero) - predict(calibration, q)).max() <= SAME_PX
