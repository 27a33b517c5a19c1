"""Lens distortion estimated with all the rest: its derivative, its size, its uncertainty, its refusals."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict, prediction_variance
from projservo_cli.records import WorkFailed
from tests.calibration.simulated_robot import IMAGE_SIZE, around, random_robot

SIGMA = 0.5
LENS = np.array([[640.0, 512.0, 640.0, -0.06, 0.01], [640.0, 512.0, 640.0, 0.03, -0.01]])


def lensed(straight, lens):
    """Pixels (..., 2, m, 2) through a radial lens in both views, written out anew."""
    offset = straight - lens[:, None, :2]
    square = (offset**2).sum(axis=-1, keepdims=True) / lens[:, None, 2:3] ** 2
    return lens[:, None, :2] + offset * (1.0 + lens[:, None, 3:4] * square + lens[:, None, 4:] * square**2)


@pytest.fixture(scope="module")
def robot():
    return random_robot("RRPR", np.random.default_rng(30))


@pytest.fixture(scope="module")
def poses(robot):
    """Poses whose markers reach over most of the images."""
    rng = np.random.default_rng(3)
    return around(robot, 70, rng, angle=0.8, length=0.3)


def observed(robot, q, lens, seed=1):
    observation = robot.observe(q, SIGMA, np.random.default_rng(seed))
    noise = observation.images - robot.images(q)
    images = lensed(robot.images(q), lens) + noise
    inside = ((images >= 0.0) & (images <= np.array(IMAGE_SIZE))).all(axis=-1)
    return dataclasses.replace(observation, images=np.where(inside[..., None], images, np.nan))


def calibrated(robot, observation, **given):
    given = {"source": "recorded", "image_size": IMAGE_SIZE} | given
    return calibrate(observation, robot.joint_types, **given)


def test_known_distortion_is_recovered_within_its_uncertainty(robot, poses):
    fitted = calibrated(robot, observed(robot, poses, LENS), sigma_px=SIGMA, lens=True)
    off = (fitted.lens[:, 3:] - LENS[:, 3:]).ravel()
    spread = fitted.sqrt_cov_shared[-4:] @ fitted.sqrt_cov_shared[-4:].T
    assert np.array_equal(fitted.lens[:, :3], LENS[:, :3])
    # χ² of four degrees of freedom: beyond 18.5 once in a thousand draws.
    assert off @ np.linalg.solve(spread, off) < 18.5
    # … and the uncertainty is small beside what is found.
    assert np.sqrt(np.diag(spread))[[0, 2]].max() < 0.005
    # 2000 readings: χ² per degree of freedom to 3.5 %, four of that.
    assert fitted.chi2_per_dof == pytest.approx(1.0, abs=0.14)
    assert fitted.outlier.size == 0


@pytest.mark.parametrize("size", [IMAGE_SIZE, None])
def test_a_centre_of_the_lens_elsewhere_is_found(robot, poses, size):
    """Off the middle of the image by far more than it is uncertain, the centre is estimated too."""
    lens = LENS + np.array([[80.0, -60.0, 0.0, 0.0, 0.0], [-70.0, 90.0, 0.0, 0.0, 0.0]])
    found = calibrated(robot, observed(robot, poses, lens), image_size=size, lens=True)
    assert found.lens_terms == 4
    off = (found.lens[:, :2] - lens[:, :2]).ravel()
    centers = found.sqrt_cov_shared[-8:].reshape(2, 4, -1)[:, 2:].reshape(4, -1)
    assert off @ np.linalg.solve(centers @ centers.T, off) < 18.5  # χ² of four, once in a thousand draws
    q = around(robot, 60, np.random.default_rng(8), angle=0.6, length=0.2)
    true = lensed(robot.images(q), lens)
    inside = ((true >= 0.0) & (true <= np.array(IMAGE_SIZE))).all(axis=-1)
    error = np.sqrt(np.mean((predict(found, q) - true)[inside] ** 2))
    assert error == pytest.approx(np.sqrt(prediction_variance(found, q)[inside].mean()), rel=0.5)


def test_without_the_lens_the_fit_says_what_would_explain_it(robot, poses):
    weak = LENS * [1.0, 1.0, 1.0, 0.3, 0.3]
    calibration = calibrated(robot, observed(robot, poses, weak))
    assert any("try --lens" in text for text in calibration.advice)
    assert "limited by lens" in calibration.reason
    assert calibration.lens is None


def test_a_fit_that_a_lens_spoils_is_refused_with_the_remedy(robot, poses):
    strong = observed(robot, poses[:15], LENS * [1.0, 1.0, 1.0, 3.0, 3.0])
    with pytest.raises(WorkFailed, match="try --lens"):
        calibrated(robot, strong)


def test_straight_images_show_no_lens_and_lose_little(robot, poses):
    straight = observed(robot, poses, LENS * [1.0, 1.0, 1.0, 0.0, 0.0])
    without, with_lens = (
        calibrated(robot, straight, sigma_px=SIGMA, source="simulated", lens=lens) for lens in (False, True)
    )
    k = with_lens.lens[:, 3:].ravel()
    assert k @ np.linalg.solve(with_lens.sqrt_cov_shared[-4:] @ with_lens.sqrt_cov_shared[-4:].T, k) < 18.5
    assert any("omit --lens" in text for text in with_lens.advice)
    assert not any("lens" in text for text in without.advice)
    q = around(robot, 60, np.random.default_rng(8), angle=0.6, length=0.2)
    for calibration in (without, with_lens):
        off = predict(calibration, q) - robot.images(q)
        variance = prediction_variance(calibration, q)
        assert np.sqrt(np.mean(off**2) / np.mean(variance)) < 1.4
    # Four parameters more cost certainty, by the Cramér–Rao bound, and never add any.
    assert (prediction_variance(with_lens, q) >= 0.999 * prediction_variance(without, q)).mean() > 0.99
