"""Progress of a recording: a note after each pose, and a page with both images of the last one."""

from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from projservo_cli.records import VIEWS, JointLimits, Observation, WorkFailed
from projservo_cli.robots.contract import Bounds, PluginRobot, at_rest_after
from projservo_cli.store.observation_tables import identity_in, read_table, recording_of, write_table
from tests.hardware.still import Quiet
from tests.hardware.streams import Stream, picture
from tests.hardware.test_doctor import CONFIGURATION


class Walking(Quiet):
    """Two joints that stand where they are sent, but for a tenth of a degree of the second one."""

    def __init__(self):
        self.q, self.time = np.zeros(2), 0.0

    def now(self):
        return self.time

    def joints(self):
        return self.q + np.radians([0.0, -0.1]), self.time

    def command(self, target, speed, due):
        self.q, self.time = target.copy(), due


@pytest.fixture(params=[("left", "right"), ("top",)])
def recording(request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    images = picture(at=(60.0, 80.0)), picture(at=(80.0, 90.0))
    streams = [Stream(lambda image=image: image) for image in images]
    text = CONFIGURATION.format(left=streams[0].url, right=streams[1].url, rate=30, options="")
    config = yaml.safe_load(text)
    config["plant"] = "tests.hardware.test_recording:Walking"
    config["data"]["joints"] = "RR"
    config["markers"] = {"numbers": [0, 1, 2, 3], "face": [0, 1, 2, 3]}
    config["robot"]["limits"]["joints"] = [[-90, 90]] * 2
    config["calibration"] = {
        "reference": {"joints": [0, 0], "unit": "deg"},
        "frames_per_joint": 2,
        "random_poses": 1,
    }
    sources = {name: config["cameras"].pop(side) for name, side in zip(request.param, VIEWS, strict=False)}
    config["cameras"] = {"max_age_s": 10.0, "reconnect_s": 10.0} | sources  # its clock is none of the wall
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    yield tmp_path
    for stream in streams:
        stream.close()


def test_a_recording_notes_its_worst_joint_and_shows_the_last_images(projservo, recording, monkeypatch):
    view = tuple(yaml.safe_load((recording / "arm.yaml").read_text(encoding="utf-8"))["cameras"])[2:]
    seen, notes = "|".join(["4"] * len(view)), []
    monkeypatch.setattr(
        "projservo_cli.cli.output.Console.progress",
        lambda self, what, done, total, note="": notes.append((what, done, total, note)),
    )
    answer = projservo("record", "-c", "arm.yaml", "-o", "arm.csv", "--json")
    assert answer.code == 0, answer.err
    assert [note[:3] for note in notes] == [("record", k, 6) for k in range(1, 7)]
    assert notes[-1][3] == f"markers {seen}, joint 2 0.1° off"
    assert read_table("arm.csv").view == view
    page = (recording / "arm.html").read_text(encoding="utf-8")
    assert f"6 of 6 poses; markers {seen}, joint 2 0.1° off" in page
    assert page.count("data:image/jpeg;base64,") == len(view)
    assert 'http-equiv="refresh"' not in page


def test_poses_of_a_robot_that_has_limits_alone_are_recorded_as_doctor_asks(projservo, recording):
    (recording / "refit_poses.csv").write_text("q1,q2\n0.1,-0.1\n0.15,0.05\n", encoding="utf-8")
    alone = ("--set", "calibration.frames_per_joint=0", "--set", "calibration.random_poses=0")
    poses = ("--motions", "refit_poses.csv", "--output", "refit.csv", "--json")
    answer = projservo("record", "-c", "arm.yaml", *alone, *poses)
    assert answer.code == 0, answer.err
    assert answer.json["recorded"] == 3  # the start, and both
    assert read_table("refit.csv").q[1:] == pytest.approx(np.array([[0.1, -0.1], [0.15, 0.05]]), abs=2e-3)


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
