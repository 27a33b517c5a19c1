"""Too few poses: refused with their number and that of the poses to record."""

import numpy as np
import pytest

from projservo_cli.calibration import calibrate
from projservo_cli.records import WorkFailed
from tests.calibration.simulated_robot import around, random_robot


def seen(types, count, sigma=0.5, seed=3, copies=1):
    robot = random_robot(types, np.random.default_rng(seed), markers=10)
    q = np.repeat(around(robot, count, np.random.default_rng(seed)), copies, axis=0)
    return robot.observe(q, sigma, np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("types", "count", "enough"), [("RRRRRR", 5, 6), ("RRPRRR", 5, 6), ("RRRR", 4, 5), ("RRR", 3, 4)]
)
def test_as_few_numbers_as_the_joints_have_are_refused(types, count, enough):
    with pytest.raises(WorkFailed, match=rf"^{count} poses show .* record {enough} or more"):
        calibrate(seen(types, count), types, source="recorded")
    with pytest.raises(WorkFailed, match=rf"^{count} poses show"):  # copies show nothing more
        calibrate(seen(types, count, copies=4), types, source="recorded")
    calibrate(seen(types, enough + 2), types, source="recorded")


def test_one_trial_of_each_joint_is_enough():
    for types in ("RP", "RRR", "RRRRRR"):
        robot = random_robot(types, np.random.default_rng(3), markers=10)
        q = np.vstack([robot.q_reference, robot.q_reference + 0.4 * np.eye(len(types))])
        observation = robot.observe(q, 0.1, np.random.default_rng(3))
        assert calibrate(observation, types, source="recorded").usable
