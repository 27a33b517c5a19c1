"""One contract for all robots: those of the documentation, and simulated ones with faults."""

import importlib
import sys
import threading

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.robots.contract import PluginRobot, at_rest_after
from projservo_cli.robots.pacing import Steered
from projservo_cli.stages.worlds.external_robot import path_to
from tests.configured import bounds_of, joints_of, robot_by_itself, truth_of
from tests.documentation.blocks import PAGES, ROOT, blocks_of
from tests.documentation.test_pages import put_truth
from tests.robots.robots import Sound

CONFIG = ROOT / "configs" / "ur5.yaml"
PERIOD = 0.04
OFF = 0.02  # rad that an arm of the documentation may be off its target, once at rest
DOCUMENTED = {"my_robot": "UR5", "position": "Position", "velocity": "Velocity", "trajectory": "Trajectory"}


def faulty():
    """An arm that is late, lags, sags and plays, with coarse encoders."""
    wrong = (
        "camera_latency_s=0.12",
        "encoder_counts_per_turn=4096",
        "servo_time_constant_s=0.05",
        "gravity_sag_deg=0.5",
        "backlash_deg=0.5",
    )
    config = load_config(CONFIG, [*(f"disturbance.{key}" for key in wrong), "disturbance.frame_rate_hz=30"])
    start = np.array([3.66, -1.68, -1.85, 0.28, 1.16, 3.53])
    return robot_by_itself(config, truth_of(config), start, 0.5, 1, 0)


@pytest.fixture(params=[*DOCUMENTED, "sound", "faulty"])
def robot(request, tmp_path, monkeypatch):
    """A robot of the contract, made as its user would."""
    if request.param not in DOCUMENTED:
        return Sound(CONFIG) if request.param == "sound" else faulty()
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    put_truth(tmp_path)
    for block in blocks_of(PAGES["robot-class"]):
        if block.file:
            (tmp_path / block.file).write_text(block.text)
    for module in ("drives", *DOCUMENTED):
        monkeypatch.delitem(sys.modules, module, raising=False)
    made = getattr(importlib.import_module(request.param), DOCUMENTED[request.param])
    return made("truth.json")


@pytest.fixture
def steered(robot):
    """The same, opened and read once."""
    threads = {}

    def noted(name):
        method = getattr(robot, name)

        def call(*arguments):
            threads.setdefault(name, set()).add(threading.current_thread())
            return method(*arguments)

        setattr(robot, name, call)

    for name in ("open", "read", "command", "stop", "close"):
        noted(name)
    config = load_config(CONFIG, ["plant.max_steady_state_error_deg=1.5"])
    joints = joints_of(config)
    foreign = PluginRobot(robot, "robot", 10, bounds_of(config, joints), 5.0, 5.0)
    with at_rest_after(foreign):
        steered = Steered(foreign)
        steered.observe()
        yield steered
    assert {*threads} == {"open", "read", "command", "stop", "close"}
    assert len(set.union(*threads.values())) == 1
    assert threading.current_thread() not in threads["open"]


def to(steered, target):
    for _ in path_to(steered, target, 0.5, "test"):
        pass
    return steered.reading.q


def where(robot):
    """Its joints, without a look."""
    return robot.q if hasattr(robot, "q") else robot.truth()


def hold(robot, seconds):
    """No command comes any more: where time passes in commands alone, only what they say is to be done."""
    if hasattr(robot, "run"):
        robot.run(robot.now() + seconds)


def test_it_goes_where_it_is_sent_and_adds_nothing_up(robot, steered):
    start = steered.reading.q
    target = start + np.array([0.3, -0.2, 0.1, 0.0, -0.3, 0.2])
    np.testing.assert_allclose(to(steered, target), target, atol=OFF)
    for _ in range(20):
        steered.command(np.zeros(6), PERIOD)
        steered.observe()
    np.testing.assert_allclose(steered.reading.q, target, atol=OFF)
    np.testing.assert_allclose(to(steered, start), start, atol=OFF)
    assert steered.overruns == 0


def test_time_passes_in_commands_alone_and_the_last_one_expires(robot, steered):
    before = steered.robot.now()
    steered.observe()
    assert steered.robot.now() == before
    steered.command(np.zeros(6), PERIOD)
    assert steered.robot.now() == pytest.approx(before + PERIOD, abs=1e-6)
    for _ in range(10):
        steered.command(np.full(6, 0.02), PERIOD)  # 0.5 rad/s
        last = steered.observe().q
    hold(robot, 1.0)
    gone = where(robot)
    # Until it was due and two periods on, and what its servo lags behind: 0.1 s and 50 ms of 0.5 rad/s.
    assert (np.abs(gone - last) <= 0.5 * (2.0 * PERIOD + 0.05) + OFF).all()
    hold(robot, 1.0)
    np.testing.assert_allclose(where(robot), gone, atol=1e-6)
