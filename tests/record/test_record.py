"""Recording the simulated robot: the table, interruptions, limits, refusals."""

from pathlib import Path

import numpy as np
import pytest

from projservo_cli import files
from projservo_cli.config import load_config
from projservo_cli.records import WorkFailed
from projservo_cli.stages import record as stage
from projservo_cli.stages.calibrate import simulate
from projservo_cli.stages.own_robot import drive_to
from projservo_cli.stages.world import joints_of, truth_of
from projservo_cli.store import load
from projservo_cli.tables import read_joint_list, read_table

CONFIGS = Path(__file__).parents[2] / "configs"
UR5, STANFORD = CONFIGS / "ur5.yaml", CONFIGS / "stanford.yaml"
FEW = ["--set", "calibration.frames_per_joint=2"]


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(files, "_synchronise", lambda path: None)  # the disk may take its time


def same(table, observation):
    for name in ("pose", "marker", "q", "images"):
        np.testing.assert_array_equal(getattr(table, name), getattr(observation, name), err_msg=name)


@pytest.mark.parametrize("config", [UR5, STANFORD])
def test_the_table_is_what_calibrate_simulates_to_the_bit(projservo, config):
    answer = projservo("record", "-c", config, "--output", "new/t.csv", "--json")
    assert answer.code == 0, answer.err
    assert (answer.json["poses"], answer.json["recorded"], answer.json["pending"]) == (49, 49, 0)
    settings = load_config(config)
    same(read_table("new/t.csv"), simulate(settings, truth_of(settings)))


def test_markers_that_leave_an_image_are_counted(projservo):
    wide = ["--set", "calibration.amplitude_deg=60", "--set", "rig.image_size_px=[800, 600]"]
    answer = projservo("record", "-c", UR5, *wide, "-o", "t.csv", "--json")
    images = read_table("t.csv").images
    assert 0 < answer.json["unseen"] == np.isnan(images[..., 0]).sum()


def test_recording_then_calibrating_is_calibrating(projservo):
    assert projservo("record", "-c", UR5, "-o", "t.csv", "-q").code == 0
    assert projservo("calibrate", "-c", UR5, "-o", "one", "-q").code == 0
    recorded = ["--data", "t.csv", "--noise-px", "0.5"]
    assert projservo("calibrate", "-c", UR5, *recorded, "-o", "two", "-q").code == 0
    one, two = load("one").calibration, load("two").calibration
    assert (one.source, two.source) == ("simulated", "recorded")
    for name in ("P", "H_hat_0", "M", "a_inf", "q_reference", "covariance"):
        np.testing.assert_array_equal(getattr(two, name), getattr(one, name), err_msg=name)


class Interrupting(stage.SimulatedRobot):
    """A robot whose user loses patience."""

    left = 5

    def observe(self):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        return super().observe()


@pytest.mark.parametrize("gone", [0, 2])
def test_an_interrupted_recording_goes_on_where_it_was(projservo, monkeypatch, gone):
    assert projservo("record", "-c", UR5, *FEW, "-o", "whole.csv", "-q").code == 0
    with monkeypatch.context() as patch:
        patch.setattr(stage, "SimulatedRobot", Interrupting)
        answer = projservo("record", "-c", UR5, *FEW, "-o", "t.csv")
    assert answer.code == 130
    assert "t.csv: 5 of 13 poses; run again to continue" in answer.err
    assert read_table("t.csv").pose.tolist() == [0, 1, 2, 3, 4]
    lines = Path("t.csv").read_text().splitlines(keepends=True)
    del lines[1 : 1 + 10 * gone]  # poses that were lost are recorded again
    Path("t.csv").write_text("".join(lines))
    assert projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "-n", "--json").json["pending"] == 8 + gone
    answer = projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "--json")
    assert (answer.code, answer.json["found"], answer.json["recorded"]) == (0, 5 - gone, 8 + gone)
    assert Path("t.csv").read_bytes() == Path("whole.csv").read_bytes()
    again = projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "--json").json
    assert (again["recorded"], again["commands"]) == (0, 0)


def test_the_table_grows_while_the_robot_moves(monkeypatch):
    monkeypatch.setattr(stage, "SAVE_EVERY", 0.0)
    config = load_config(UR5, ["calibration.frames_per_joint=2"])
    path, sizes = Path("t.csv"), []
    recording = stage.new_recording(config, path)
    monkeypatch.setattr(recording, "save", lambda: sizes.append(len(recording.q)))
    stage.record(config, recording)
    assert sizes[0] < 13
    assert sizes == sorted(set(sizes))
    assert sizes[-1] == 13


def test_a_table_of_another_configuration_is_refused_unless_forced(projservo):
    assert projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "-q").code == 0
    before = Path("t.csv").read_bytes()
    others = {
        "seed=2": "was not recorded with this configuration",
        "noise.calibration_px=0.1": "was not recorded with this configuration",
        "calibration.amplitude_deg=20": "pose 1 is none of those to be recorded",
        "calibration.frames_per_joint=1": "pose 2 is none of those to be recorded",
    }
    for change, message in others.items():
        answer = projservo("record", "-c", UR5, *FEW, "--set", change, "-o", "t.csv", "-q")
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        assert message in answer.err
        assert "--force" in answer.err
    assert Path("t.csv").read_bytes() == before
    lines = before.decode().splitlines(keepends=True)
    for text, message in (
        ("".join(lines).replace(",recording", ",note"), "was not recorded with this configuration"),
        ("".join(line for line in lines if line.split(",")[1] != "9"), "other markers"),
    ):
        Path("t.csv").write_text(text)
        answer = projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "-q")
        assert (answer.code, message in answer.err) == (2, True)
    assert projservo("record", "-c", UR5, *FEW, "--set", "seed=2", "-o", "t.csv", "-q", "--force").code == 0
    assert Path("t.csv").read_bytes() != before
    again = projservo("record", "-c", UR5, *FEW, "--set", "seed=2", "-o", "t.csv", "--json")
    assert again.json["found"] == 13


def test_what_does_not_change_the_pixels_does_not_matter(projservo):
    assert projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "-q").code == 0
    for change in ("calibration.method=closed_form", "control.period_s=0.02", "markers.face=[0, 1, 2]"):
        answer = projservo("record", "-c", UR5, *FEW, "--set", change, "-o", "t.csv", "--json")
        assert (answer.code, answer.json["recorded"]) == (0, 0), change


def test_further_motions_follow_the_trials_and_continue_their_table(projservo):
    assert projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "-q").code == 0
    trials = read_table("t.csv")
    degrees = np.degrees(trials.q[0]) + np.array([[10, 0, -10, 5, 0, 20], [-10, 5, 0, 0, 15, 0]])
    rows = [",".join(map(repr, row)) for row in degrees.tolist()]
    Path("more.csv").write_text("\n".join(["q1,q2,q3,q4,q5,q6", *rows]))
    more = ["--motions", "more.csv", "--joint-unit", "deg"]
    answer = projservo("record", "-c", UR5, *FEW, *more, "-o", "t.csv", "--json")
    assert (answer.json["found"], answer.json["recorded"]) == (13, 2)
    table = read_table("t.csv")
    assert table.pose.tolist() == list(range(15))
    np.testing.assert_array_equal(table.images[:13], trials.images)
    np.testing.assert_array_equal(table.q[13:], read_joint_list("more.csv", "RRRRRR", "deg").q)
    truth = truth_of(load_config(UR5))
    clean = np.stack([truth.images(q, truth.M) for q in table.q])
    assert 0.3 < np.std(table.images[13:] - clean[13:]) < 0.7  # 80 draws of sigma 0.5: ± 5 standard errors
    assert projservo("record", "-c", UR5, *FEW, "-o", "t.csv").code == 2  # poses that are not asked for
    Path("far.csv").write_text("pose,q1,q2,q3,q4,q5,q6\n8,0,0,0,0,0,7\n")
    refused = projservo("record", "-c", UR5, *FEW, "--motions", "far.csv", "-o", "u.csv")
    assert refused.code == 2
    assert "pose 8: joint 6 would be at 7, beyond its limits" in refused.err
    assert not Path("u.csv").exists()


class Watched(stage.SimulatedRobot):
    """Keeps what it was told."""

    steps, stopped = None, False

    def command(self, step, period):
        self.steps = [*(self.steps or []), step]
        super().command(step, period)

    def stop(self):
        self.stopped = True


def test_every_step_keeps_the_speed_limit_and_the_joint_limits():
    config = load_config(STANFORD)
    recording = stage.new_recording(config, Path("t.csv"))
    noise = np.zeros((49, 2, 10, 2))
    robot = Watched(truth_of(config), recording.targets[0], noise)
    stage.record(config, recording, robot)
    steps = np.array(robot.steps)
    limit = np.array([125 * np.pi / 180 * 0.04] * 6)
    limit[2] = 0.5 * 0.04
    assert (np.abs(steps) <= limit * (1 + 1e-12)).all()
    assert recording.commands == len(steps)
    path = recording.targets[0] + np.cumsum(steps, axis=0)
    truth = truth_of(config).robot
    assert ((path >= truth.lower - 1e-9) & (path <= truth.upper + 1e-9)).all()
    # each leg takes the least number of commands, and up to two for rounding
    legs = np.ceil(np.abs(np.diff(recording.targets, axis=0)) / limit - 1e-9).max(axis=1)
    assert legs.sum() <= recording.commands <= legs.sum() + 2 * len(legs)
    assert robot.stopped


class Stuck(Watched):
    """A robot whose first joint does not go beyond a place."""

    def command(self, step, period):
        super().command(step, period)
        self._q[0] = min(self._q[0], 3.7)


def test_a_robot_that_does_not_arrive_is_reported_and_the_rest_kept():
    config = load_config(UR5)
    recording = stage.new_recording(config, Path("t.csv"))
    robot = Stuck(truth_of(config), recording.targets[0], np.zeros((49, 2, 10, 2)))
    with pytest.raises(WorkFailed, match=r"joint 1 was sent to 3.73.* and stands at 3.7 "):
        stage.record(config, recording, robot)
    assert robot.stopped
    assert read_table("t.csv").pose.tolist() == list(range(len(recording.q)))
    assert recording.pending


def test_a_recorded_configuration_without_robot_says_which_key_to_set(projservo):
    Path("mine.yaml").write_text("data: {table: t.csv}\n")
    answer = projservo("record", "-c", "mine.yaml", "-o", "u.csv")
    assert answer.code == 2
    assert "set robot.dh or robot.screws" in answer.err


def test_no_limit_is_one_step():
    config = load_config(UR5, ["control.joint_speed_limit_deg_s=null"])
    joints = joints_of(config)
    assert np.isinf(joints.speed).all()
    robot = Watched(truth_of(config), np.zeros(6), np.zeros((1, 2, 10, 2)))
    target = np.array([1.0, -2.0, 0.1, 1e-9, 0.0, 3.0])
    assert drive_to(robot, target, config, joints, "record") <= 2
    np.testing.assert_array_equal(robot.joints(), target)
