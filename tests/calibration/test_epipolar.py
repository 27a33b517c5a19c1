"""Epipolar geometry: exact data, noise, gross errors, refusals."""

import numpy as np
import pytest

from projservo_cli.calibration.detections import Detections
from projservo_cli.calibration.initial.epipolar import (
    Epipolar,
    ImageFrame,
    log_distances,
    marker_pairs,
    metric_guesses,
)
from projservo_cli.geometry.stereo import fundamental_matrix
from projservo_cli.records import Observation, WorkFailed
from tests.calibration.simulated_robot import IMAGE_SIZE, around, random_robot, rig


def sightings(count, sigma, rng):
    points = np.hstack([rng.uniform(-0.4, 0.4, (count, 3)), np.ones((count, 1))])
    m = rig() @ points.T
    pixels = np.swapaxes(m[:, :2] / m[:, 2:], 1, 2)
    return pixels + sigma * rng.standard_normal(pixels.shape)


def geometry(left, right, seed):
    """Of a marker seen at as many poses."""
    images = np.stack([left, right], axis=1)[:, :, None]
    seen = Observation(np.arange(len(left)), np.array([0]), np.zeros((len(left), 1)), images)
    return Epipolar.of(Detections.of(seen, "R"), np.random.default_rng(seed))


def same_up_to_sign(F, G):
    return min(np.abs(F - G).max(), np.abs(F + G).max())


def test_exact_correspondences_give_the_rig():
    left, right = sightings(40, 0.0, np.random.default_rng(0))
    found = geometry(left, right, 1)
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
    found = geometry(left, right, 3)
    # 593 degrees of freedom leave 3 % of spread; errors along the epipolar line go unnoticed and add.
    assert found.sigma_px == pytest.approx(0.5, rel=0.12)
    # What lies 20 px off in a direction of no account may pass; what is far from its epipolar line does not.
    line = np.c_[left, np.ones(600)] @ fundamental_matrix(rig()).T
    far = np.abs((line * np.c_[right, np.ones(600)]).sum(axis=1)) > 5.0 * np.linalg.norm(line[:, :2], axis=1)
    assert not found.inlier[far].any()
    assert found.inlier[~wrong].mean() > 0.995


def test_too_few_and_flat_sightings_are_refused():
    left, right = sightings(7, 0.0, np.random.default_rng(4))
    with pytest.raises(WorkFailed, match="7 observations of a marker by both"):
        geometry(left, right, 0)
    left, _ = sightings(50, 0.3, np.random.default_rng(5))
    again = left + 0.3 * np.random.default_rng(6).standard_normal(left.shape)
    with pytest.raises(WorkFailed, match="without a baseline"):
        geometry(left, again, 0)


@pytest.mark.parametrize("seed", range(3))
def test_the_first_guess_is_a_rigid_body_before_cameras_of_the_true_focal_length(seed):
    """Of exact images of a body at random poses, whose principal points are the middles of the images."""
    rng = np.random.default_rng(seed)
    robot = random_robot("RRR", rng, markers=8)
    seen = Detections.of(robot.observe(around(robot, 12, rng), 0.0, rng), robot.joint_types)
    frame = ImageFrame.of(seen, IMAGE_SIZE)
    (P, points), *_ = metric_guesses(Epipolar.of(seen, rng), seen, frame, 1.0)
    deviation, twice = log_distances(points, marker_pairs(seen.pose_of[seen.both], seen.marker_of[seen.both]))
    assert twice.all()
    assert deviation.max() < 1e-3
    M = np.c_[points, np.ones(len(points))]
    assert (M @ P[:, 2].T > 0.0).all()
    assert np.median(M @ P[0, 2]) == pytest.approx(1.0, rel=1e-6)
    assert P[0, 0, 0] / P[0, 2, 2] == pytest.approx(1200.0, rel=1e-2)
