"""Cameras as streams: newest frames, lost cables, other sizes, and what is wrong with a picture."""

import os
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("cv2")

from projservo_cli.detection import TagFinder
from projservo_cli.hardware import cameras
from projservo_cli.hardware.camera_robot import CameraRobot, exposure_of
from projservo_cli.hardware.cameras import Camera
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
        opened.append(Camera("left", Source(source=source, **settings), max_age_s, reconnect_s))
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


def test_a_camera_that_comes_back_in_time_is_waited_for(stream, camera):
    source = stream(lambda: SEEN)
    shown = camera(source.url, reconnect_s=4.0)
    source.paused.set()
    time.sleep(0.5)
    source.paused.clear()
    before = shown.newest().serial
    assert shown.newest().serial >= before
    assert shown.reconnections == 1
    assert time.monotonic() - shown.newest().t < 0.3


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


def test_a_closed_camera_is_read_no_more(stream, camera):
    shown = camera(stream(lambda: SEEN, 2.0).url)
    shown.close()
    assert not shown._grabbing.is_alive()


def test_frames_of_another_size_are_refused(stream, camera):
    with pytest.raises(
        WorkFailed, match=r"gives frames of 320 x 240 px, not the 640 x 480 of cameras.left.size"
    ):
        camera(stream(lambda: SEEN).url, size_px=(640, 480))
    sizes = [(320, 240)]
    source = stream(lambda: picture(size=sizes[0]))
    shown = camera(source.url, reconnect_s=5.0)
    sizes[0] = (640, 480)
    source.paused.set()  # it comes back with another one
    time.sleep(0.4)
    source.paused.clear()
    with pytest.raises(WorkFailed, match=r"changed its frames from 320 x 240 px to 640 x 480"):
        _ = [shown.newest() for _ in range(10**9)]


def test_what_cannot_be_opened_is_named():
    with pytest.raises(WorkFailed, match=r"the right camera .*no-such-film.*: cannot be opened"):
        Camera("right", Source(source="no-such-film.mp4"), 0.3, 1.0).open()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="device nodes of Linux")
def test_a_missing_or_forbidden_or_metadata_device_is_named_with_the_right_one(monkeypatch, tmp_path):
    with pytest.raises(WorkFailed, match=r"there is no /dev/video77; devices: "):
        Camera("left", Source(source=77), 0.3, 1.0).open()
    nodes = [tmp_path / "video0", tmp_path / "video1"]
    for node in nodes:
        node.touch()

    def ioctl(number, request, answer):
        assert request == 0x80685600
        path = os.readlink(f"/proc/self/fd/{number}")
        struct.pack_into("=II", answer, 84, 0x84A00001, 0x04200001 if path.endswith("video0") else 0x04A00000)
        answer[48:60] = b"usb-0000:1.2"

    monkeypatch.setattr("fcntl.ioctl", ioctl)
    monkeypatch.setattr(cameras, "_nodes", lambda: nodes)
    assert cameras._wrong_device(nodes[0]) == ""
    assert cameras._wrong_device(nodes[1]) == (
        f"{nodes[1]} gives no pictures: it is the second node of a webcam, for metadata: take {nodes[0]}"
    )
    monkeypatch.setattr("os.access", lambda *_: False)
    assert "sudo usermod -aG video $USER" in cameras._wrong_device(nodes[0])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc tells who has it")
def test_a_camera_that_another_program_has_is_named_with_that_program(tmp_path):
    device = tmp_path / "video0"
    device.touch()
    assert cameras._holder(device) == ""
    code = f"import time; f = open({str(device)!r}); print('open', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout.readline()
        told = cameras._holder(device)
        other.kill()
    assert told.startswith(f"{device} is in use by python")
    assert f"(process {other.pid}): close that" in told


class _Driver:
    """A device of which the driver has autofocus that it does not switch off."""

    def __init__(self, deaf):
        self.deaf, self.told = deaf, {}

    def getBackendName(self):
        return "V4L2"

    def set(self, key, value):
        self.told[key] = value
        return key not in self.deaf

    def get(self, key):
        return 1.0 if key in self.deaf else self.told.get(key, -1.0)


def test_autofocus_and_exposure_that_a_driver_does_not_fix_are_said():
    cv = cameras._cv()
    settings = Source(source=0, size_px=(640, 480), rate_hz=30.0, exposure_ms=8.0, focus=20.0)
    sound = _Driver(set())
    assert list(cameras._set_up(sound, settings)) == []
    assert sound.told[cv.CAP_PROP_EXPOSURE] == 80.0  # V4L2 counts 100 µs
    assert (sound.told[cv.CAP_PROP_AUTO_EXPOSURE], sound.told[cv.CAP_PROP_AUTOFOCUS]) == (1, 0)
    assert sound.told[cv.CAP_PROP_FOURCC] == cv.VideoWriter.fourcc(*"MJPG")
    deaf = _Driver({cv.CAP_PROP_AUTOFOCUS, cv.CAP_PROP_FOCUS, cv.CAP_PROP_EXPOSURE})
    autofocus, focus, exposure = cameras._set_up(deaf, settings)
    assert "autofocus is on" in autofocus
    assert "does not set the focus to 20" in focus
    assert "does not fix the exposure at 8 ms" in exposure
    (automatic,) = cameras._set_up(sound, Source(source=0))
    assert "its exposure is automatic" in automatic


class _Ignoring(_Driver):
    """A device of which the driver takes all settings, and keeps its own."""

    def __init__(self, **kept):
        super().__init__(set())
        self.kept = {getattr(cameras._cv(), f"CAP_PROP_{name}"): value for name, value in kept.items()}

    def get(self, key):
        return self.kept.get(key, super().get(key))


def test_settings_that_a_driver_takes_and_ignores_are_said():
    yuyv = float(cameras._cv().VideoWriter.fourcc(*"YUYV"))
    settings = Source(source=0, exposure_ms=8.0, focus=30.0)
    ignoring = _Ignoring(FOURCC=yuyv, AUTOFOCUS=1.0, FOCUS=100.0, EXPOSURE=156.0)
    assert list(cameras._set_up(ignoring, settings)) == [
        "sends YUYV, not the MJPG of fourcc: set fourcc: YUYV, or take another camera",
        "autofocus is on, and its driver does not switch it off: a camera that refocuses is another one",
        "its driver does not set the focus to 30, it has 100",
        "its driver does not fix the exposure at 8 ms, it has 15.6 ms: set an exposure_ms that it takes",
    ]
    (automatic,) = cameras._set_up(_Ignoring(AUTO_EXPOSURE=3.0), settings)
    assert "its exposure stays automatic" in automatic
    # What is rounded, or not known, is no difference.
    assert list(cameras._set_up(_Ignoring(FOCUS=32.0, EXPOSURE=78.0), settings)) == []
    unknown = dict.fromkeys(("FOURCC", "AUTOFOCUS", "FOCUS", "AUTO_EXPOSURE", "EXPOSURE"), -1.0)
    assert list(cameras._set_up(_Ignoring(**unknown), settings)) == []


def test_black_dark_saturated_and_blurred_images_are_said():
    assert exposure_of(SEEN).faults() == []
    assert "is black" in exposure_of(np.full_like(SEEN, 3)).faults()[0]
    assert "is dark" in exposure_of(picture(light=0.1)).faults()[0]
    assert "is saturated: 9" in exposure_of(picture(light=1.8)).faults()[0]
    (blurred,) = exposure_of(picture(blur=4.0)).faults()
    assert "is blurred by 3" in blurred


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
