"""The start: the marker body from partial views, axes and places in a metric frame."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from projservo_cli.calibration.adjustment import prepare
from projservo_cli.calibration.epipolar import Guess
from projservo_cli.calibration.readings import gather
from projservo_cli.calibration.start import merged, placed
from projservo_cli.records import Observation
from tests.calibration.simulated_robot import around, random_robot, trials


def guessed(points):
    return Guess(np.zeros((2, 3, 4)), points, 0.0, 1.0)


def cloud(seen_share, wrong_share, rng):
    """Poses of one body with some sightings missing and some wrong: body, rotations, guess, readings."""
    true = rng.uniform(-0.1, 0.1, (8, 3))
    R = Rotation.random(30, random_state=1).as_matrix()
    points = true @ np.swapaxes(R, 1, 2) + rng.uniform(-1.0, 1.0, (30, 1, 3))
    seen = rng.random((30, 8)) < seen_share
    wrong = rng.random((30, 8)) < wrong_share
    points[wrong] += rng.uniform(-0.5, 0.5, (int(wrong.sum()), 3))
    images = np.where(seen[:, None, :, None], np.zeros((30, 2, 8, 2)), np.nan)
    readings = gather(Observation(np.arange(30), np.arange(8), np.zeros((30, 1)), images), "R")
    return true, R, guessed(points[readings.pose_of, readings.marker_of]), readings


@pytest.mark.parametrize(("seen_share", "wrong_share"), [(1.0, 0.0), (0.6, 0.0), (0.9, 0.08)])
def test_body_is_merged_from_partial_views(seen_share, wrong_share):
    true, R, guess, readings = cloud(seen_share, wrong_share, np.random.default_rng(2))
    found = merged(guess, readings)
    assert np.isfinite(found.body).all()
    assert found.merged.sum() >= 0.9 * len(R)
    # The body is the true one up to a rigid motion: distances agree.
    distance = np.linalg.norm(true[:, None] - true, axis=2)
    assert np.abs(np.linalg.norm(found.body[:, None] - found.body, axis=2) - distance).max() < 1e-3
    # All poses agree on the rotation between both body frames, R_k = R_true B.
    between = np.swapaxes(R[found.merged], 1, 2) @ found.R[found.merged]
    assert np.median(np.abs(between - np.median(between, axis=0))) < 1e-3


@pytest.mark.parametrize("types", ["RRRRRR", "RPRRPR", "PRR"])
@pytest.mark.parametrize("poses", [trials, lambda robot: around(robot, 40, np.random.default_rng(6))])
def test_screws_are_recovered_from_exact_points(types, poses):
    robot = random_robot(types, np.random.default_rng(5))
    q = poses(robot)
    readings = gather(robot.observe(q, 0.0, np.random.default_rng(0)), types)
    true = np.array([_moved(robot, row) for row in q])
    guess = guessed(true[readings.pose_of, readings.marker_of])
    problem = prepare(readings, robot.q_reference)
    scenes = placed(problem, readings, guess, merged(guess, readings), np.random.default_rng(1))
    # The ridge pulls axes towards the body by at most its square over the number of equations.
    assert min(np.abs(scene.H_hat - robot.twists).max() for scene in scenes) < 5e-3


def _moved(robot, row):
    T = np.eye(4)
    for twist, amount in zip(robot.twists, row - robot.q_reference, strict=True):
        T = T @ expm(twist * amount)
    return (T @ robot.markers.T).T[:, :3]
