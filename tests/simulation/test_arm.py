"""True robots and cameras: DH tables, look-at cameras, the roll axis, goals that the robot is turned to."""

import math

import numpy as np
import pytest

from projservo_cli.simulation.arm import roll_axis
from projservo_cli.simulation.ground_truth import turned
from tests.configured import truth_of
from tests.known import configured
from tests.samples import displacement

# θ, α (deg), d, a (m) of six joints, the third prismatic.
TABLE = [
    ("R", 6.0, 90.0, 0.3, 0.05),
    ("R", -11.0, 17.0, 0.1, 0.4),
    ("P", 29.0, -90.0, 0.2, 0.0),
    ("R", 0.0, 90.0, 0.35, -0.02),
    ("R", 23.0, -63.0, 0.0, 0.1),
    ("R", 0.0, 0.0, 0.07, 0.0),
]
TOOL = displacement([0.3, -0.2, 0.5], [0.01, 0.02, 0.1])


def dh_robot(convention):
    """Robot of the table, in front of the rig of the paper."""
    joints = [
        f"{{type: {kind}, theta_deg: {theta}, alpha_deg: {alpha}, d_m: {d}, a_m: {a}, "
        f"limits_{'m' if kind == 'P' else 'deg'}: [-3, 3]}}"
        for kind, theta, alpha, d, a in TABLE
    ]
    tool = TOOL.tolist()
    dh = f"{{convention: {convention}, joints: [{', '.join(joints)}], tool: {tool}}}"
    start = f"{{joints: {[0] * 6}, unit: deg}}"
    settings = f"robot={{dh: {dh}}}", f"task.start={start}", f"calibration.reference={start}"
    return truth_of(configured("paper", *settings)).robot


def camera(position, target, focal=(1200, 1100)):
    """Left camera of the paper's rig, looking from a position at a target."""
    told = f"{{focal_px: {list(focal)}, principal_point_px: [640, 500], "
    told += f"position_m: {list(map(float, position))}, target_m: {list(map(float, target))}}}"
    return truth_of(configured("paper", f"rig.left={told}")).P[0]


def rot(axis, angle):
    return displacement(angle * np.eye(3)[axis], np.zeros(3))


def shift(axis, length):
    return displacement(np.zeros(3), length * np.eye(3)[axis])


def chain(q, modified):
    """Pose of a DH table by the products of its textbook definition."""
    T = np.eye(4)
    for amount, (kind, theta, alpha, d, a) in zip(q, TABLE, strict=True):
        turn, slide = (0, amount) if kind == "P" else (amount, 0)
        joint = rot(2, math.radians(theta) + turn) @ shift(2, d + slide)
        link = rot(0, math.radians(alpha)) @ shift(0, a)
        T = T @ link @ joint if modified else T @ joint @ link
    return T @ TOOL


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_dh_tables_of_both_conventions(convention, rng):
    robot = dh_robot(convention)
    for q in (np.zeros(6), *rng.uniform(-2, 2, (5, 6))):
        assert robot.pose(q) == pytest.approx(chain(q, convention == "modified"), abs=1e-13)
    assert robot.prismatic.tolist() == [0, 0, 1, 0, 0, 0]
    assert robot.limits.lower == pytest.approx([*np.radians([-3, -3]), -3, *np.radians([-3, -3, -3])])


@pytest.mark.parametrize("roll_deg", [10, 165, 180])
def test_the_joints_of_a_goal_hold_the_tool_there(roll_deg):
    """Within the limits, and no farther away than the joints the paper's robot starts at, turned there."""
    config = configured("paper_perturbed", f"task.goal.roll_deg={roll_deg}")
    truth, goal = truth_of(config), config.task.goal
    q_start = np.array(config.task.start.values(config.joint_types))
    q = turned(goal, truth.robot, truth.P, q_start)
    around, direction = roll_axis(truth.P)
    turn = displacement(math.radians(roll_deg) * direction, np.zeros(3))
    turn[:3, 3] = around - turn[:3, :3] @ around
    nudge = displacement(np.array(goal.perturbation.rotation_rad), goal.perturbation.translation_m)
    assert truth.robot.pose(q) == pytest.approx(turn @ truth.robot.pose(q_start) @ nudge, abs=1e-9)
    assert (truth.robot.limits.lower <= q).all()
    assert (q <= truth.robot.limits.upper).all()
