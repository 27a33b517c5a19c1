"""Epipolar geometry: exact data, noise, gross errors, refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projservo_cli.calibration import epipolar
from projservo_cli.calibration.reconstruction import canonical_pair, reconstruct
from projservo_cli.geometry.stereo import fundamental_matrix
from projservo_cli.records import WorkFailed
from tests.calibration.simulated_robot import rig


def sightings(count, sigma, rng):
    points = np.hstack([rng.uniform(-0.4, 0.4, (count, 3)), np.ones((count, 1))])
    m = rig() @ points.T
    pixels = np.swapaxes(m[:, :2] / m[:, 2:], 1, 2)
    return pixels + sigma * rng.standard_normal(pixels.shape)


def same_up_to_sign(F, G):
    return min(np.abs(F - G).max(), np.abs(F + G).max())


def test_exact_correspondences_give_the_rig():
    left, right = sightings(40, 0.0, np.random.default_rng(0))
    found = epipolar.estimate(left, right, np.random.default_rng(1))
    # The relative accuracy of a double times the conditioning of normalised points.
    assert same_up_to_sign(found.F, fundamental_matrix(rig())) < 1e-9
    assert found.sigma_px < 1e-8


@pytest.mark.parametrize("share", [0.0, 0.15, 0.3])
def test_noise_is_estimated_in_spite_of_gross_errors(share):
    rng = np.random.default_rng(2)
    left, right = sightings(600, 0.5, rng)
    wrong = rng.random(600) < share
    right[wrong] += rng.uniform(20.0, 50.0, (int(wrong.sum()), 2)) * rng.choice(
        [-1.0, 1.0], (int(wrong.sum()), 2)
    )
    found = epipolar.estimate(left, right, np.random.default_rng(3))
    # 593 degrees of freedom leave 3 % of spread; errors along the epipolar line go unnoticed and add.
    assert found.sigma_px == pytest.approx(0.5, rel=0.12)
    true = epipolar.sampson(
        fundamental_matrix(rig()), epipolar.homogeneous(left), epipolar.homogeneous(right)
    )
    far = np.abs(true) > 5.0
    assert not found.inlier[far].any()
    assert found.inlier[~wrong].mean() > 0.995


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6))
def test_gradient_of_the_sampson_distance(seed):
    rng = np.random.default_rng(seed)
    F = rng.standard_normal((3, 3))
    a, b = (np.hstack([rng.standard_normal((6, 2)), np.ones((6, 1))]) for _ in range(2))
    analytic = epipolar._sampson_gradient(F, a, b)
    h = 1e-6
    for i in range(3):
        for j in range(3):
            step = np.zeros((3, 3))
            step[i, j] = h
            numeric = (epipolar.sampson(F + step, a, b) - epipolar.sampson(F - step, a, b)) / (2.0 * h)
            assert np.allclose(numeric, analytic[:, i, j], rtol=1e-5, atol=1e-6)


def test_too_few_and_flat_sightings_are_refused():
    left, right = sightings(7, 0.0, np.random.default_rng(4))
    with pytest.raises(WorkFailed, match="7 sightings of a marker by both"):
        epipolar.estimate(left, right, np.random.default_rng(0))
    left, _ = sightings(50, 0.3, np.random.default_rng(5))
    again = left + 0.3 * np.random.default_rng(6).standard_normal(left.shape)
    with pytest.raises(WorkFailed, match="without a baseline"):
        epipolar.estimate(left, again, np.random.default_rng(0))


def test_reconstruction_is_isotropic_and_projects_back():
    left, right = sightings(60, 0.0, np.random.default_rng(7))
    view = reconstruct(fundamental_matrix(rig()), left, right)
    m = view.P @ view.points.T
    assert np.all(m[:, 2] > 0.0)
    for camera, image in zip(m, (left, right), strict=True):
        assert np.abs((camera[:2] / camera[2]).T - image).max() < 1e-7
    moments = 4.0 * view.points.T @ view.points / len(view.points)
    assert np.abs(moments - np.eye(4)).max() < 1e-3


def test_canonical_pair_has_its_fundamental_matrix():
    F = fundamental_matrix(rig())
    assert same_up_to_sign(fundamental_matrix(canonical_pair(F)), F) < 1e-12
