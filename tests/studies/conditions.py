"""Arms, tasks by seed, and when a run has arrived, in studies of robots as they are.

    python -m tests.studies.conditions

draws the tasks anew and writes tasks.csv beside this file, which the studies read.
"""

import math
from pathlib import Path

import numpy as np

from projservo_cli.simulation.random_tasks import STRATA, random_tasks
from tests.configured import truth_of
from tests.known import configured, with_task
from tests.studies.common import row_of, tasks_in, write_rows

TASKS = Path(__file__).with_name("tasks.csv")
SEEDS, ARMS = range(1, 31), ("ur5", "hobby")
# What arrived means: converged, and no farther off in truth than this.
NEAR_MM, NEAR_DEG = 3.0, 1.0


def task_config(config, arm, seed):
    """A configuration with the task of a seed."""
    return with_task(config, tasks_in(TASKS, arm=arm)[seed], seed=seed)


def errors(pose, goal, truth):
    """How far the middle of the face is from where it belongs, mm, and how far it is turned, degrees."""
    back = np.linalg.inv(truth.robot.base_tool)
    middle = truth.M_face.mean(axis=0)
    way = (pose @ back - goal @ back) @ middle
    turn = np.clip(0.5 * (np.trace(pose[:3, :3].T @ goal[:3, :3]) - 1.0), -1.0, 1.0)
    return 1e3 * float(np.linalg.norm(way[:3])), math.degrees(math.acos(turn))


def drawn(arm):
    """Tasks of all seeds, those of each sixth of half a turn in turn."""
    config = configured(arm)
    truth, front = truth_of(config), np.array(config.task.start.values(config.joint_types))
    for seed in SEEDS:
        tasks = random_tasks(truth, front, STRATA, np.random.default_rng(seed))
        yield {"arm": arm, "seed": seed} | row_of([ends[(seed - 1) % STRATA] for ends in tasks])


if __name__ == "__main__":
    write_rows(TASKS, [row for arm in ARMS for row in drawn(arm)])
