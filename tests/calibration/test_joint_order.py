"""Which order of joints along the arm the poses show."""

import dataclasses
import itertools

import numpy as np
import pytest

from projservo_cli import Observations, calibrate
from projservo_cli.messages import order_advice
from tests.calibration.simulated_robot import around, random_robot, trials


def pairs(types):
    """All pairs of joints whose order matters: two that slide commute."""
    numbers = itertools.combinations(range(1, len(types) + 1), 2)
    return [[i, j] for i, j in numbers if types[i - 1] + types[j - 1] != "PP"]


def seen(robot, q, sigma=0.3):
    record = robot.observe(q, sigma, np.random.default_rng(2))
    return Observations.of(record, joint_types=robot.joint_types)


def undecided(observations):
    found = calibrate(observations, progress=False)
    assert found.usable
    told = [one.subject.joints for one in found.findings if one.code == "undecided_order"]
    assert told == ([tuple(np.unique(found.undecided_order))] if found.undecided_order.size else [])
    return found.undecided_order.tolist(), found


@pytest.mark.parametrize("types", ["RRR", "RPRP"])
def test_single_joint_trials_show_no_order_and_combined_poses_all_of_it(types):
    robot = random_robot(types, np.random.default_rng(4), markers=8)
    single, several = trials(robot, 8), around(robot, 4, np.random.default_rng(5))
    none, found = undecided(seen(robot, single))
    assert none == pairs(types)
    assert order_advice(found).startswith("these poses cannot confirm the order of joints 1, 2")
    assert undecided(seen(robot, np.vstack([single, several])))[0] == []
    # A true arm with its columns in another order fits as well, and its order is as open.
    record = robot.observe(single, 0.3, np.random.default_rng(2))
    exchanged = dataclasses.replace(record, q=record.q[:, ::-1])
    assert len(undecided(Observations.of(exchanged, joint_types=types[::-1]))[0]) == len(pairs(types))


def test_a_stated_order_and_that_of_a_simulation_need_no_poses():
    robot = random_robot("RRR", np.random.default_rng(4), markers=8)
    observations = seen(robot, trials(robot, 8))
    for known in ({"order_stated": True}, {"source": "simulated"}):
        found = calibrate(dataclasses.replace(observations, **known), progress=False)
        assert found.undecided_order is None
        assert not order_advice(found)
