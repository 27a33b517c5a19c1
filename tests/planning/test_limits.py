"""Joint limits of a robot that nobody describes: from a list, or from what recorded data cover."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.records import InputError
from projservo_cli.store.observation_tables import read_table
from tests.configured import calibrate, plan, record, scenario_of

ROOT = Path(__file__).parents[2]
# The arm's trials turn each joint by 30° to both sides of this reference.
REFERENCE = np.array([3.6575, -1.6783, -1.8493, 0.2776, 1.1568, 3.5344])
NEAR = "{joints: [3.5, -1.6, -1.75, 0.15, 1.25, 3.4], unit: rad}"
FAR = "{joints: [3.8, -1.75, -1.95, 0.4, 1.05, 3.7], unit: rad}"
MINE = f"""\
plant: {{use: "tests.robots.robots:Sound", options: {{config: {ROOT / "configs/ur5.yaml"}}}}}
data: {{table: trials.csv, joints: RRRRRR, joint_order: stated}}
markers: {{numbers: [0, 1, 2, 3, 4, 5, 6, 7, 8, 9], face: [0, 1, 2, 3]}}
task: {{start: {NEAR}, goal: {{joints: {FAR}}}}}
control: {{laws: [exact], mode: track}}
"""


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """A file that describes a recorded robot, and how it is read with overrides."""
    folder = tmp_path_factory.mktemp("mine")
    simulated = load_config(ROOT / "configs/ur5.yaml")
    record.record(simulated, record.new_recording(simulated, folder / "trials.csv"))
    (folder / "mine.yaml").write_text(MINE, encoding="utf-8")

    @lru_cache
    def calibration():
        return calibrate.run(load_config(folder / "mine.yaml"))[1]

    def read(*overrides):
        return load_config(folder / "mine.yaml", overrides), calibration()

    return read


def test_limits_from_data_are_what_they_cover_widened_by_a_share_of_it(mine):
    config, calibration = mine("robot.limits.from_data=0.1")
    low, high = REFERENCE - np.radians(30.0), REFERENCE + np.radians(30.0)
    scenario = scenario_of(config, calibration)
    np.testing.assert_allclose(scenario.world.joints.limits.lower, low - np.radians(6.0), atol=1e-6)
    np.testing.assert_allclose(scenario.world.joints.limits.upper, high + np.radians(6.0), atol=1e-6)
    # Laws never pass them.
    np.testing.assert_array_equal(scenario.gains.limits.lower, scenario.world.joints.limits.lower)
    np.testing.assert_array_equal(
        read_table(config.data.table, "RRRRRR", "rad").q.min(axis=0), calibration.joint_min
    )
    through_joints = config.trajectory.model_copy(update={"profile": "joint_space"})
    found = plan.run(config.model_copy(update={"trajectory": through_joints}), calibration)
    assert found.feasible, found.reason
    assert (
        (found.q > scenario.world.joints.limits.lower) & (found.q < scenario.world.joints.limits.upper)
    ).all()


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        ("{}", "robot.limits: give exactly one of joints and from_data"),
        ("{from_data: 0.1, unit: rad}", "robot.limits.unit: applies to joints"),
        ("{joints: [[0, 1], [2, 1]], unit: rad}", "robot.limits.joints.1: the lower limit 2 must be below"),
        ("{joints: [[0, 1]], unit: rad}", "robot.limits.joints: 1 pairs for 6 joints (RRRRRR)"),
        ("{from_data: -1}", "robot.limits.from_data: must be at least 0"),
    ],
)
def test_limits_that_make_no_sense_are_refused(mine, limits, told):
    with pytest.raises(InputError) as caught:
        mine(f"robot.limits={limits}")
    assert told in str(caught.value)
