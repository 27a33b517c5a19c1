"""A misfit that one joint is to blame for names that joint; one that is not names none."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate
from projservo_cli.records import WorkFailed
from tests.calibration.simulated_robot import around, random_robot, trials

SEEDS = {"RRRRRR": 1, "RRPRRR": 5, "RPRP": 3}
TYPES = tuple(SEEDS)


def robot_of(types):
    return random_robot(types, np.random.default_rng(SEEDS[types]), markers=6)


def poses(robot, motions):
    return trials(robot) if motions == "trials" else around(robot, 40, np.random.default_rng(1))


def seen(robot, q, sigma=0.5):
    return robot.observe(q, sigma, np.random.default_rng(2))


def refusal(observation, types):
    with pytest.raises(WorkFailed) as caught:
        calibrate(observation, types, source="recorded")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def flipped(types, i):
    return types[:i] + {"R": "P", "P": "R"}[types[i]] + types[i + 1 :]


@pytest.mark.parametrize(("types", "joint", "motions"), [("RRPRRR", 2, "trials"), ("RPRP", 0, "all at once")])
def test_a_joint_of_the_wrong_type(types, joint, motions):
    robot = robot_of(types)
    message = refusal(seen(robot, poses(robot, motions)), flipped(types, joint))
    right, wrong = ("revolute", "prismatic") if types[joint] == "R" else ("prismatic", "revolute")
    assert message.startswith(
        f"by the images joint {joint + 1} is {right}, not {wrong}: check the types of joints"
    )


@pytest.mark.parametrize(("types", "joint", "motions"), [("RRRRRR", 3, "trials"), ("RPRP", 1, "all at once")])
def test_a_joint_that_stands_still_while_its_readings_move(types, joint, motions):
    robot = robot_of(types)
    q = poses(robot, motions)
    true = q.copy()
    true[:, joint] = robot.q_reference[joint]
    message = refusal(dataclasses.replace(seen(robot, true), q=q), types)
    assert f"joint {joint + 1} stands still" in message
    assert "its readings" in message


@pytest.mark.parametrize("spoiled", ["shuffled", "geared"])
def test_what_no_single_joint_explains_names_none(spoiled):
    robot = robot_of("RPRP")
    q = poses(robot, "all at once")
    readings, types = q.copy(), "RPRP"
    if spoiled == "shuffled":
        readings = np.random.default_rng(0).permutation(q)
    if spoiled == "geared":
        readings[:, 0] = q[0, 0] + 1.3 * (q[:, 0] - q[0, 0])
    message = refusal(dataclasses.replace(seen(robot, q), q=readings), types)
    assert "by the images" not in message
    assert "does not describe the data" in message or "contradict the joint readings" in message
