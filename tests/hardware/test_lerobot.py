"""The class for LeRobot in the documentation, around a stand-in of its shape."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from projservo_cli import plugins
from tests.documentation.blocks import PAGES, blocks_of

NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


class StandIn:
    """As SO101Follower: degrees in and out, no stamps; connect and disconnect drop the torque."""

    def __init__(self, **config):
        given = {"use_degrees": True, "disable_torque_on_disconnect": False} | config
        self.config, self.q, self.on, self.calibrates = SimpleNamespace(**given), np.zeros(6), True, True
        self.bus = SimpleNamespace(
            disable_torque=lambda: self.switch(False), enable_torque=lambda: self.switch(True)
        )

    def switch(self, on):
        self.on = on

    def connect(self, calibrate=True):
        self.on, self.calibrates = False, calibrate

    def get_observation(self):
        return {f"{name}.pos": float(x) for name, x in zip((*NAMES, "gripper"), self.q, strict=True)}

    def send_action(self, action):
        for name, x in action.items():
            self.q[(*NAMES, "gripper").index(name.removesuffix(".pos"))] = x
        self.on = True
        return action

    def disconnect(self):
        self.on = self.on and not self.config.disable_torque_on_disconnect


@pytest.fixture
def made(tmp_path, monkeypatch):
    """A function that makes the class of the page around a stand-in; and its lines."""
    (text,) = (block.text for block in blocks_of(PAGES["robot-class"]) if block.file == "lerobot_arm.py")
    (tmp_path / "lerobot_arm.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lerobot_arm", raising=False)

    def make(**config):
        robot = StandIn(**config)
        monkeypatch.setitem(sys.modules, "my_arm", SimpleNamespace(make_robot=lambda: robot))
        return robot, plugins.make("plant", "lerobot_arm:LeRobotArm", (), {"make": "my_arm:make_robot"})

    make.lines = [line for line in text[text.index("class") :].splitlines() if line.strip()]
    return make


def test_a_robot_of_lerobot_is_driven_in_radians(made):
    robot, arm = made()
    arm.open()
    assert robot.calibrates is False
    assert not robot.on  # connect dropped it
    target = np.radians([10.0, -20, 30, -40, 50])
    arm.command(target, np.zeros(5), 0.0)
    np.testing.assert_allclose(arm.joints()[0], target)
    assert robot.q[5] == 0.0  # the gripper stays
    arm.stop()
    np.testing.assert_allclose(arm.joints()[0], target)
    arm.close()
    assert robot.on
    arm.release()
    assert not robot.on
    arm.hold()
    assert robot.on
    assert len(made.lines) <= 20
