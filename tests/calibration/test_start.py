"""The start: rotations, the marker body, axes and places in a metric frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from projservo_cli.calibration import body, rotations, start
from projservo_cli.calibration.readings import gather, reference_joints, reference_pose
from projservo_cli.records import InputError, Observation
from tests.calibration.simulated_robot import around, random_robot, trials


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 1e-12, 1e-7, 1e-3, 1.0, 3.0, np.pi - 1e-6, np.pi - 1e-9]))
def test_rotation_vectors_agree_with_scipy(seed, angle):
    axis = np.random.default_rng(seed).standard_normal(3)
    vector = angle * axis / np.linalg.norm(axis)
    R = rotations.rotation_exponential(vector[None])[0]
    assert np.abs(R - Rotation.from_rotvec(vector).as_matrix()).max() < 1e-14
    assert np.abs(rotations.rotation_vector(R[None])[0] - vector).max() < 1e-8


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
    found = body.merge(points, seen)
    assert np.isfinite(found.body).all()
    assert found.merged.sum() >= 0.9 * len(R)
    # The body is the true one up to a rigid motion: distances agree.
    distance = np.linalg.norm(true[:, None] - true, axis=2)
    assert np.abs(np.linalg.norm(found.body[:, None] - found.body, axis=2) - distance).max() < 1e-3
    relative = found.R[found.merged] @ np.swapaxes(R[found.merged], 1, 2)
    # All poses agree on the rotation between both body frames, R_k = R_true B.
    between = np.swapaxes(R[found.merged], 1, 2) @ found.R[found.merged]
    assert relative.shape == between.shape
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
    alignment = body.merge(true, np.ones(true.shape[:2], dtype=bool))
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
    return start.place(w, points, readings, dq).H_hat


def test_reference_is_the_pose_all_trials_share():
    robot = random_robot("RRR", np.random.default_rng(3))
    q = trials(robot, frames=4)
    shuffled = q[np.random.default_rng(0).permutation(len(q))]
    assert np.array_equal(reference_joints(shuffled), robot.q_reference)
    assert reference_pose(around(robot, 20, np.random.default_rng(1))) is None


@pytest.mark.parametrize("letters", ["RR", "RRRR", "RXR", ""])
def test_joint_letters_must_fit(letters):
    observation = Observation(np.arange(2), np.arange(3), np.zeros((2, 3)), np.zeros((2, 2, 3, 2)))
    with pytest.raises(InputError, match="letters"):
        gather(observation, letters)


def test_values_that_are_no_numbers_are_refused():
    q, images = np.zeros((2, 3)), np.zeros((2, 2, 3, 2))
    q[1, 2] = np.nan
    with pytest.raises(InputError, match="finite"):
        gather(Observation(np.arange(2), np.arange(3), q, images), "RRR")
    images[0, 0, 0, 0] = np.inf
    with pytest.raises(InputError, match="finite"):
        gather(Observation(np.arange(2), np.arange(3), np.zeros((2, 3)), images), "RRR")
