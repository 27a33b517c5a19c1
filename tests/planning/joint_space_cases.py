"""Random tasks of shipped robots, with the true model in place of a calibrated one."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from projservo_cli.planning.goal_configurations import GoalFeatures
from projservo_cli.planning.joint_constraints import Constraints
from projservo_cli.planning.motion_margins import Demands
from projservo_cli.simulation.random_tasks import random_tasks
from tests.configured import joints_of, truth_of
from tests.known import configured, true_search

COUNT = 12


class Case(NamedTuple):
    """One task."""

    truth: object
    q_start: object
    q_goal: object
    c: Constraints
    aim: GoalFeatures


@lru_cache(maxsize=8)
def _drawn(name):
    config = configured(name)
    truth, joints = truth_of(config), joints_of(config)
    front = np.array(config.task.start.values(config.joint_types))
    return truth, joints, random_tasks(truth, front, COUNT, np.random.default_rng(3))


def case(name, k):
    """Random task k of a configuration."""
    truth, joints, tasks = _drawn(name)
    ends = tasks[0][k], tasks[1][k]
    speed = np.where(np.isfinite(joints.limits.speed), joints.limits.speed, 1.0)
    keep = np.array([0.002 if kind == "P" else np.radians(1.0) for kind in joints.types])
    limits = joints.limits._replace(speed=speed)
    demands = Demands(limits, truth.image_size, 5.0, 0.0, keep, 8.0)
    return Case(truth, *ends, *true_search(truth, ends, demands))
