"""True robots and cameras: DH tables, look-at cameras, the roll axis, inverse kinematics."""

import math

import numpy as np
import pytest

from projservo_cli.records import InputError, WorkFailed
from projservo_cli.robots.simulated import (
    camera_center,
    dh_robot,
    inverse_kinematics,
    look_at_camera,
    rigid,
    roll_axis,
    rotation_about_axis,
    twist,
)
from tests.samples import displacement, hat, pixels

# θ, d, a, α of six joints, the third prismatic; lengths in m.
TABLE = [
    (False, 0.1, 0.3, 0.05, math.pi / 2),
    (False, -0.2, 0.1, 0.4, 0.3),
    (True, 0.5, 0.2, 0.0, -math.pi / 2),
    (False, 0.0, 0.35, -0.02, math.pi / 2),
    (False, 0.4, 0.0, 0.1, -1.1),
    (False, 0.0, 0.07, 0.0, 0.0),
]
TOOL = displacement([0.3, -0.2, 0.5], [0.01, 0.02, 0.1])
LIMITS = [(-3.0, 3.0)] * 6


def rot(axis, angle):
    return displacement(angle * np.eye(3)[axis], np.zeros(3))


def shift(axis, length):
    return displacement(np.zeros(3), length * np.eye(3)[axis])


def chain(q, modified):
    """Pose of a DH table by the products of its textbook definition."""
    T = np.eye(4)
    for amount, (prismatic, theta, d, a, alpha) in zip(q, TABLE, strict=True):
        joint = rot(2, theta + (0 if prismatic else amount)) @ shift(2, d + (amount if prismatic else 0))
        link = rot(0, alpha) @ shift(0, a)
        T = T @ link @ joint if modified else T @ joint @ link
    return T @ TOOL


@pytest.mark.parametrize("modified", [False, True])
def test_dh_tables_of_both_conventions(modified, rng):
    robot = dh_robot(TABLE, modified, TOOL, LIMITS)
    for q in (np.zeros(6), *rng.uniform(-2, 2, (5, 6))):
        assert robot.pose(q) == pytest.approx(chain(q, modified), abs=1e-13)
    assert robot.joint_types.tolist() == [0, 0, 1, 0, 0, 0]
    assert robot.lower.tolist() == [-3.0] * 6


def test_puma_at_its_ready_pose():
    """Corke's toolbox: joints (0, 90, −90, 0, 0, 0)° stretch the arm up; the wrist is at a3, −d3, a2 + d4."""
    rows = [
        (False, 0, 0.0, 0.0, math.pi / 2),
        (False, 0, 0.0, 0.4318, 0.0),
        (False, 0, 0.15005, 0.0203, -math.pi / 2),
        (False, 0, 0.4318, 0.0, math.pi / 2),
        (False, 0, 0.0, 0.0, -math.pi / 2),
        (False, 0, 0.0, 0.0, 0.0),
    ]
    robot = dh_robot(rows, False, np.eye(4), LIMITS)
    pose = robot.pose(np.radians([0, 90, -90, 0, 0, 0]))
    assert pose[:3, 3] == pytest.approx([0.0203, -0.15005, 0.8636], abs=1e-12)
    assert pose[:3, :3] == pytest.approx(np.eye(3), abs=1e-12)


def test_twists_and_rigid_displacements(rng):
    w, v, t = rng.normal(size=(3, 3))
    assert twist(w, v) == pytest.approx(hat(w, v), abs=0)
    assert rigid(np.eye(3), t) @ [0, 0, 0, 1] == pytest.approx([*t, 1])
    T = rotation_about_axis(t, 3.0 * w, 0.7)
    assert T @ [*(t + 0.4 * w), 1] == pytest.approx([*(t + 0.4 * w), 1], abs=1e-13)
    assert np.trace(T[:3, :3]) == pytest.approx(1 + 2 * math.cos(0.7))
    sense = [T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]] @ w
    assert sense > 0


def test_a_camera_looks_at_its_target():
    position, target = np.array([2.0, -0.3, 0.8]), np.array([0.5, 0.1, 0.6])
    P = look_at_camera([1200, 1100], [640, 500], position, target, [0, 0, 1])

    def seen(point):
        return pixels(np.array([P, P]), np.append(point, 1.0)[None])[0, 0]

    assert seen(target) == pytest.approx([640, 500], abs=1e-9)
    assert seen(target + np.array([0, 0, 0.1]))[1] < 500  # up is towards smaller v
    left = np.cross([0, 0, 1.0], target - position)
    assert seen(target + 0.1 * left)[0] < 640
    assert P[2] @ [*target, 1] == pytest.approx(np.linalg.norm(target - position))
    assert camera_center(P) == pytest.approx(position, abs=1e-12)
    for cameras in (np.stack([P, P]), np.stack([P, -3 * P])):
        point, direction = roll_axis(cameras)
        assert point == pytest.approx(position)
        assert direction == pytest.approx((target - position) / np.linalg.norm(target - position))
    # One metre across at the target's distance is the focal length over that distance, in both axes.
    distance = np.linalg.norm(target - position)
    across = seen(target + 1e-3 * left / np.linalg.norm(left)) - [640, 500]
    assert across == pytest.approx([-1.2 / distance, 0], abs=1e-9)


@pytest.mark.parametrize("target", [[1, 1, 1], [1, 1, 5]])
def test_a_camera_without_a_view_is_refused(target):
    with pytest.raises(InputError, match="camera"):
        look_at_camera([1000, 1000], [640, 512], [1, 1, 1], target, [0, 0, 1])


def test_roll_axis_lies_between_the_cameras():
    P = np.array(
        [look_at_camera([1000, 1000], [640, 512], [2, y, 0.5], [0.5, 0, 0.5], [0, 0, 1]) for y in (-0.2, 0.2)]
    )
    point, direction = roll_axis(P)
    assert point == pytest.approx([2, 0, 0.5], abs=1e-12)
    assert direction == pytest.approx([-1, 0, 0], abs=1e-12)


def test_inverse_kinematics_finds_reachable_poses(rng):
    robot = dh_robot(TABLE, False, TOOL, LIMITS)
    for _ in range(3):
        q_start, q_goal = rng.uniform(-1, 1, (2, 6))
        q = inverse_kinematics(robot, robot.pose(q_goal), q_start)
        assert robot.pose(q) == pytest.approx(robot.pose(q_goal), abs=1e-9)
        assert (robot.lower <= q).all()
        assert (q <= robot.upper).all()
        assert np.linalg.norm(q - q_start) <= np.linalg.norm(q_goal - q_start) + 1e-9


def test_inverse_kinematics_refuses_what_cannot_be_reached():
    robot = dh_robot(TABLE, False, TOOL, LIMITS)
    with pytest.raises(WorkFailed, match=r"cannot put its tool at \(9\.000"):
        inverse_kinematics(robot, displacement([0, 0, 0], [9, 0, 0]), np.zeros(6))
