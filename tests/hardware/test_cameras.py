"""Cameras as streams: newest frames, lost cables, other sizes, and what is wrong with a picture."""

import os
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("cv2")

from projservo_cli.detection.finders import TagFinder
from projservo_cli.findings import Subject
from projservo_cli.hardware import video_cameras
from projservo_cli.hardware.camera_robot import CameraRobot
from projservo_cli.hardware.video_cameras import VideoCamera
from projservo_cli.messages import sentence_and_remedy
from projservo_cli.records import WorkFailed
from projservo_cli.settings.cameras import Cameras as Stereo
from projservo_cli.settings.cameras import Source
from tests.hardware.streams import Stream, picture

SEEN = picture()


@pytest.fixture
def stream():
    made = []

    def make(*given, **named):
        made.append(Stream(*given, **named))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.fixture
def camera():
    opened = []

    def make(source, max_age_s=0.3, reconnect_s=1.0, **settings):
        opened.append(VideoCamera("left", Source(source=source, **settings), max_age_s, reconnect_s))
        opened[-1].open()
        return opened[-1]

    yield make
    for one in opened:
        one.close()


def test_the_newest_frame_is_never_older_than_a_period_of_the_camera(stream, camera):
    source = stream(lambda: SEEN, 30.0)
    shown = camera(source.url)
    time.sleep(1.0)
    ages, behind = [], []
    for _ in range(20):
        time.sleep(0.05)  # a loop that looks less often than frames come
        served, frame = source.served, shown.newest()
        ages.append(time.monotonic() - frame.t)
        behind.append(served - frame.serial)
    # Half a period and one frame, but other programs share the machine.
    assert np.median(ages) < 3.0 / 30.0
    assert np.ptp(behind) <= 6  # none queues
    assert 5.0 < shown.rate_hz < 35.0


def test_a_camera_that_is_lost_is_named_within_two_seconds(stream, camera):
    source = stream(lambda: SEEN)
    shown = camera(source.url, reconnect_s=1.5)
    source.paused.set()
    begun = time.monotonic()
    time.sleep(0.4)
    with pytest.raises(
        WorkFailed, match=r"the left camera .*: no frame for [12][.0-9]* s .*look at its cable"
    ):
        shown.newest()
    assert time.monotonic() - begun < 2.5  # 1.9 s, but other programs share the machine


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="device nodes of Linux")
def test_a_missing_or_forbidden_or_metadata_device_is_named_with_the_right_one(monkeypatch, tmp_path):
    with pytest.raises(WorkFailed, match=r"there is no /dev/video77; devices: "):
        VideoCamera("left", Source(source=77), 0.3, 1.0).open()
    nodes = [tmp_path / "video0", tmp_path / "video1"]
    for node in nodes:
        node.touch()

    def ioctl(number, request, answer):
        assert request == 0x80685600
        path = os.readlink(f"/proc/self/fd/{number}")
        struct.pack_into("=II", answer, 84, 0x84A00001, 0x04200001 if path.endswith("video0") else 0x04A00000)
        answer[48:60] = b"usb-0000:1.2"

    monkeypatch.setattr("fcntl.ioctl", ioctl)
    monkeypatch.setattr(video_cameras, "_nodes", lambda: nodes)
    left = Subject(views=("left",))
    assert video_cameras._wrong_device(nodes[0], left) is None
    second = video_cameras._wrong_device(nodes[1], left)
    assert second.code == "second_node"
    assert sentence_and_remedy(second).endswith(f"; take {nodes[0]}")
    monkeypatch.setattr("os.access", lambda *_: False)
    assert video_cameras._wrong_device(nodes[0], left).code == "unreadable_device"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc tells who has it")
def test_a_camera_that_another_program_has_is_named_with_that_program(tmp_path):
    device = tmp_path / "video0"
    device.touch()
    assert video_cameras._holder(device, Subject()) is None
    code = f"import time; f = open({str(device)!r}); print('open', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout.readline()
        told = video_cameras._holder(device, Subject())
        other.kill()
    (process,) = told.others
    assert (told.code, told.subject.name, process.amount) == ("held_device", str(device), other.pid)
    assert process.subject.name.startswith("python")


class Arm:
    """An arm that reads joints alone."""

    def __init__(self):
        self.calls = []

    def open(self):
        self.calls.append("open")

    def joints(self):
        return np.array([0.1, 0.2]), 5.0

    def command(self, target, speed, due):
        self.calls.append("command")

    def stop(self):
        self.calls.append("stop")

    def close(self):
        self.calls.append("close")


def test_an_arm_without_pixels_becomes_a_robot_that_sees_tags(stream):
    left, right = stream(lambda: SEEN), stream(lambda: picture(at=(120.0, 90.0), numbers=(0, 1)))
    arm = Arm()
    stereo = Stereo(left=Source(source=left.url), right=Source(source=right.url))
    robot = CameraRobot(arm, stereo, TagFinder("4X4_50"), range(8))
    robot.open()
    q, pixels, t_q, t_left, t_right, sigma = robot.read()
    robot.stop()
    robot.close()
    assert arm.calls == ["open", "stop", "close"]
    assert q.tolist() == [0.1, 0.2]
    assert (t_q, abs(t_left - t_right) < 0.2) == (5.0, True)
    square = np.array([(0, 0), (60, 0), (60, 60), (0, 60)])
    assert pixels[0, :4] == pytest.approx(square + np.array([200, 150]), abs=0.1)
    assert pixels[1] == pytest.approx(
        np.r_[square + np.array([120, 90]), square + np.array([210, 90])], abs=0.1
    )
    assert np.isnan(pixels[0, 4:]).all()
    assert (np.isfinite(sigma) == np.isfinite(pixels[..., 0])).all()
    assert robot.frames.shape == (2, 240, 320)
    assert robot.remarks() == []


def test_a_run_goes_on_with_the_cameras_that_are_left_and_a_lost_one_comes_back(stream, capsys):
    streams = [stream(lambda: SEEN) for _ in range(3)]
    sources = dict(zip(("left", "right", "top"), ({"source": one.url} for one in streams), strict=True))
    rig = Stereo.model_validate(sources | {"max_age_s": 0.4, "reconnect_s": 0.8})
    robot = CameraRobot(Arm(), rig, TagFinder("4X4_50"), range(4), whole=False)

    def seen():
        return np.isfinite(robot.read()[1]).all(axis=(1, 2)).tolist()

    robot.open()
    try:
        assert (robot.view, seen()) == (("left", "right", "top"), [True] * 3)
        streams[1].paused.set()
        time.sleep(0.5)
        assert seen() == [True, False, True]
        begun = time.monotonic()
        assert seen() == [True, False, True]
        assert time.monotonic() - begun < 0.5  # it is waited for once
        assert "the right camera" in (told := capsys.readouterr().err)
        assert told.count("\n") == 1
        streams[1].paused.clear()
        until = time.monotonic() + 10.0
        while seen() != [True] * 3:
            assert time.monotonic() < until
        for one in streams:
            one.paused.set()
        with pytest.raises(WorkFailed, match=r"camera .*no frame for"):
            time.sleep(1.0) or seen()
    finally:
        robot.stop()
        robot.close()
