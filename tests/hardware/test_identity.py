"""What a recording holds for: the registers that give readings of an arm their meaning."""

from types import SimpleNamespace

import numpy as np
import pytest

from projservo_cli.records import JointLimits, Observation, WorkFailed
from projservo_cli.robots.contract import Bounds, PluginRobot, at_rest_after
from projservo_cli.store.tables import identity_in, recording_of, write_table


def robot_with(**methods):
    quiet = dict.fromkeys(("open", "read", "command", "stop", "close"), lambda *_: None)
    limits = JointLimits(*np.array([[-1.0], [1.0], [1.0], [1.0]]))
    bounds = Bounds(limits, np.ones(1), 0.04, 0.1, np.zeros(1))
    return PluginRobot(SimpleNamespace(**quiet | methods), "arm", 4, bounds, 1.0, 1.0)


def test_an_arm_that_was_homed_since_is_named_by_what_changed():
    robot = robot_with(identity=lambda: "1:0/4095/12/0/0;2:0/4095/12/-85/0")
    with at_rest_after(robot):
        robot.require_identity("")  # a recording that tells none
        robot.require_identity("1:0/4095/12/0/0;2:0/4095/12/-85/0")
        with pytest.raises(WorkFailed, match=r"nothing was moved.*2:0/4095/12/7/0 is now 2:0/4095/12/-85/0"):
            robot.require_identity("1:0/4095/12/0/0;2:0/4095/12/7/0")


@pytest.mark.parametrize("identity", ["", "1:0/4095/12/0/0;2:0/4095/12/-85/0"])
def test_a_table_keeps_recording_and_identity(tmp_path, identity):
    seen = Observation(np.arange(2), np.arange(3), np.zeros((2, 1)), np.ones((2, 2, 3, 2)))
    write_table(seen, tmp_path / "t.csv", recording="my:Robot 0123", identity=identity)
    assert recording_of(tmp_path / "t.csv") == "my:Robot 0123"
    assert identity_in(tmp_path / "t.csv") == identity
