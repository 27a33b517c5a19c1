"""What must not change a calibration: order and numbers of rows, pixel units, zeros and senses of joints."""

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict
from projservo_cli.records import Observation
from tests.calibration.simulated_robot import around, random_robot, trials

SIGMA = 0.5
# The search ends when a step moves the images by 1e-7 of the residual; it converges faster than
# linearly, so that the optimum is nearer still.
SAME_PX = 1e-6


@pytest.fixture(scope="module")
def case():
    """Robot, noisy trials with a tenth of the sightings missing, poses to predict, calibration."""
    rng = np.random.default_rng(7)
    robot = random_robot("RRPRPR", rng, markers=7)
    observation = robot.observe(trials(robot, frames=6), SIGMA, rng)
    images = observation.images
    images[rng.random(images.shape[:3]) < 0.1] = np.nan
    q = around(robot, 40, rng)
    return robot, observation, q, calibrate(observation, robot.joint_types, source="recorded")


def same(values):
    return values


def shifted(s):
    return s + np.array([[[4000.0, -2500.0]], [[0.0, 0.0]]])


def small(s):
    return 0.01 * s + np.array([[[1.0, -2.0]], [[-3.0, 5.0]]])


def exchanged(s):
    return s[:, ::-1].copy()


def turned(q):
    sense = np.where(np.arange(q.shape[1]) % 2, -1.0, 1.0)
    return sense * q + np.linspace(-1.0, 1.0, q.shape[1])


# Other joints, other pixels that keep the noise equal in all directions, and how large a pixel is.
CHANGES = {
    "order of poses and markers": (same, same, 1.0),
    "left image shifted": (same, shifted, 1.0),
    "both images scaled down and shifted": (same, small, 0.01),
    "left and right exchanged": (same, exchanged, 1.0),
    "zeros and senses of the joints": (turned, same, 1.0),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_must_not_change_a_calibration(case, rng, name):
    """Poses and markers are shuffled in all cases."""
    robot, observation, q, calibration = case
    joints, pixels, scale = CHANGES[name]
    k, j = rng.permutation(len(observation.pose)), rng.permutation(len(observation.marker))
    images = pixels(observation.images[k][:, :, j])
    changed = Observation(observation.pose[k], observation.marker[j], joints(observation.q[k]), images)
    other = calibrate(changed, robot.joint_types, source="recorded")
    order = [list(other.marker).index(number) for number in calibration.marker]
    apart = predict(other, joints(q))[:, :, order] - pixels(predict(calibration, q))
    assert np.abs(apart).max() <= SAME_PX * scale
    assert other.dof == calibration.dof
    assert len(other.outlier) == len(calibration.outlier)
    assert other.rms_px == pytest.approx(scale * calibration.rms_px, rel=1e-6)
    assert other.sigma_px == pytest.approx(scale * calibration.sigma_px, rel=1e-5)
    assert other.chi2_per_dof == pytest.approx(calibration.chi2_per_dof, rel=1e-4)
