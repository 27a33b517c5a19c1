"""The start: rotations, the marker body, axes and places in a metric frame."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from projservo_cli.calibration import start
from projservo_cli.calibration.epipolar import Guess
from projservo_cli.calibration.readings import gather
from tests.calibration.simulated_robot import around, random_robot, trials


def cloud(seen_share, wrong_share, rng):
    """Poses of one body with some sightings missing and some wrong."""
    true = rng.uniform(-0.1, 0.1, (8, 3))
    R = Rotation.random(30, random_state=1).as_matrix()
    t = rng.uniform(-1.0, 1.0, (30, 3))
    points = true @ np.swapaxes(R, 1, 2) + t[:, None]
    seen = rng.random((30, 8)) < seen_share
    wrong = rng.random((30, 8)) < wrong_share
    points[wrong] += rng.uniform(-0.5, 0.5, (int(wrong.sum()), 3))
    return true, R, t, points, seen


@pytest.mark.parametrize(("seen_share", "wrong_share"), [(1.0, 0.0), (0.6, 0.0), (0.9, 0.08)])
def test_body_is_merged_from_partial_views(seen_share, wrong_share):
    true, R, _, points, seen = cloud(seen_share, wrong_share, np.random.default_rng(2))
    found = start.merge(points, seen)
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
    dq = readings.q - robot.q_reference
    true = np.array([_moved(robot, row) for row in q])
    points = true[readings.pose_of, readings.marker_of]
    alignment = start.merge(true, np.ones(true.shape[:2], dtype=bool))
    candidates = start.rotation_axes(alignment, dq, readings.prismatic, np.random.default_rng(1), 3)
    best = min(np.abs(_screws(w, points, readings, dq) - robot.twists).max() for w in candidates)
    # The ridge pulls axes towards the body by at most its square over the number of equations.
    assert best < 5e-3


def _moved(robot, row):
    T = np.eye(4)
    for twist, amount in zip(robot.twists, row - robot.q_reference, strict=True):
        T = T @ expm(twist * amount)
    return (T @ robot.markers.T).T[:, :3]


def _screws(w, points, readings, dq):
    return start.place(w, Guess(np.zeros((2, 3, 4)), points, 0.0, 1.0), readings, dq).H_hat
