"""Cameras of people: the newest frame of each, with its stamp.

OpenCV's ``VideoCapture`` reads devices, files and streams. A thread a camera always grabs: drivers queue
frames, so whoever asks now and then would get old ones.
"""

import contextlib
import math
import os
import re
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli import messages
from projservo_cli.detection.images import opencv, unfit
from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.passwords import masked
from projservo_cli.records import ByteArray, InputError, WorkFailed
from projservo_cli.settings.cameras import Source, device_of


class Frame(NamedTuple):
    """A frame of a camera."""

    grey: ByteArray  # (height, width)
    t: float  # s, when it was taken: the stamp of its driver, otherwise the arrival
    serial: int  # how many frames came up to it


# Number of stamps from which the rate is computed.
_TIMED = 30
# Pause between attempts to open a lost camera, s.
_RETRY_S = 0.2
# Time that a stream may take to open, and to give a frame, ms.
_OPEN_MS, _READ_MS = 5000, 1000
# Time within which the first frame must come: webcams settle their exposure, s.
_FIRST_S = 8.0
# Maximum wait for a closed camera, s: in a read, and in an attempt to open.
_CLOSE_S = 3.0
# Value of OpenCV for a property that a driver does not have.
_UNKNOWN = -1.0
# Focus that common webcams round to, and half the steps of exposures that DirectShow has, powers of two.
_FOCUS_STEP, _EXPOSURE_STEP = 5.0, 0.51
# Automatic exposures of V4L2: of time and iris, and of time alone (V4L2_CID_EXPOSURE_AUTO).
_V4L_AUTOMATIC = (0, 3)
# Codes of VIDIOC_QUERYCAP and offsets in its struct v4l2_capability (videodev2.h).
_QUERYCAP, _SIZE_OF, _BUS, _CAPS = 0x80685600, 104, slice(48, 80), 88
# Capability of nodes that give pictures (V4L2_CAP_VIDEO_CAPTURE, and of several planes).
_GIVES_PICTURES = 0x1 | 0x1000


class VideoCamera:
    """A camera that is always grabbed.

    name : of it, such as ``left``. now : clock of the stamps, s.
    ``remarks``: settings that its driver refused.
    """

    def __init__(
        self,
        name: str,
        settings: Source,
        max_age_s: float,
        reconnect_s: float,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name, self.settings, self._now = name, settings, now
        self._max_age_s, self._reconnect_s = max_age_s, reconnect_s
        self.remarks: list[Finding] = []
        self.reconnections = 0
        self.stamped = False  # whether frames carry stamps of the driver
        self._stamps: deque[float] = deque(maxlen=_TIMED)
        self._frame: Frame | None = None
        self._where = Subject(views=(name,))
        self._why = Finding("frameless", REFUSES, self._where)
        self._refused: Finding | None = None  # why no frame of it will do
        self._came = threading.Condition()
        self._closing = threading.Event()
        self._grabbing: threading.Thread | None = None

    @property
    def where(self) -> str:
        """Name and source, for messages."""
        return f"the {self.name} camera (cameras.{self.name}.source: {self.settings.source})"

    def _failed(self, why: Finding) -> WorkFailed:
        return messages.failed([why], stage=self.where)

    def open(self) -> None:
        """Connect, and wait for the first frame; WorkFailed if there is none."""
        capture = self._connected()
        # A daemon: a read that never returns must not keep the process alive.
        self._grabbing = threading.Thread(
            target=self._grab_always, args=(capture,), daemon=True, name=self.name
        )
        self._grabbing.start()
        with self._came:
            self._came.wait_for(
                lambda: self._frame is not None or self._refused or self._closing.is_set(), _FIRST_S
            )
        if self._refused or self._frame is None:
            self.close()
            device = device_of(self.settings.source)
            holder = None if device is None else _holder(device, self._where)
            no_frame = Finding("no_frame", REFUSES, self._where, _FIRST_S, unit="s")
            raise self._failed(self._refused or holder or no_frame)

    def newest(self) -> Frame:
        """Newest frame, waited for while the camera reconnects; WorkFailed if that takes too long."""
        while True:
            frame = self._frame
            assert frame is not None
            age = self._now() - frame.t
            if self._refused:
                raise self._failed(self._refused)
            if age <= self._max_age_s:
                return frame
            if age > self._reconnect_s:
                most, why = self._reconnect_s, (self._why,)
                raise self._failed(
                    Finding("lost_camera", REFUSES, self._where, age, limit=most, unit="s", others=why)
                )
            with self._came:
                self._came.wait(0.01)

    @property
    def runs(self) -> bool:
        """Whether its newest frame is new enough."""
        frame = self._frame
        return frame is not None and not self._refused and self._now() - frame.t <= self._max_age_s

    @property
    def rate_hz(self) -> float:
        """Frames a second by their stamps; NaN for fewer than three."""
        stamps = list(self._stamps)
        return (len(stamps) - 1) / (stamps[-1] - stamps[0]) if len(stamps) > 2 else math.nan

    def end(self) -> None:
        """Read no more frames, and end the wait of ``open``; returns at once."""
        self._closing.set()
        with self._came:
            self._came.notify_all()

    def close(self) -> None:
        """Let go of the camera, and wait until the thread that grabs it has ended.

        At the end of the interpreter a thread that comes back from OpenCV would abort the process.
        """
        self.end()
        if self._grabbing is not None:
            self._grabbing.join(_CLOSE_S)

    def _grab_always(self, capture: Any) -> None:
        """Keep the newest frame until the camera is closed; connect again if it is lost."""
        while not self._closing.is_set():
            if capture is None:
                try:
                    capture = self._connected()
                    self.reconnections += 1
                except WorkFailed as error:
                    (self._why,) = error.findings
                    self._closing.wait(_RETRY_S)
                continue
            came, image = capture.read()
            if not came and self._is_file and capture.set(_cv().CAP_PROP_POS_FRAMES, 0):
                came, image = capture.read()  # a film begins again
            if came:
                self._keep(image, self._stamp(capture))
                if self._is_file:
                    self._closing.wait(
                        1.0 / (self.settings.rate_hz or capture.get(_cv().CAP_PROP_FPS) or 30.0)
                    )
                continue
            self._why = Finding("stopped_frames", REFUSES, self._where)
            capture.release()
            capture = None
        if capture is not None:
            capture.release()

    @property
    def _is_file(self) -> bool:
        return isinstance(self.settings.source, str) and Path(self.settings.source).is_file()

    def _keep(self, image: Any, t: float) -> None:
        """Take a frame as the newest; refuse one of another size."""
        cv = _cv()
        grey = np.asarray(image if image.ndim == 2 else cv.cvtColor(image, cv.COLOR_BGR2GRAY), dtype=np.uint8)
        before, wanted = self._frame, self.settings.size_px
        size, wrong = grey.shape[::-1], unfit(image) if self._frame is None else None
        own = Finding("", REFUSES, self._where, size[0], limit=size[1], unit="px")
        with self._came:
            if wrong is not None:
                self._refused = replace(wrong, subject=self._where)
            elif wanted is not None and size != tuple(wanted):
                self._refused = replace(own, code="other_size", others=(_size(*wanted),))
            elif before is not None and before.grey.shape != grey.shape:
                self._refused = replace(own, code="changed_size", others=(_size(*before.grey.shape[::-1]),))
            else:
                self._frame = Frame(grey, t, 1 if before is None else before.serial + 1)
                self._stamps.append(t)
            self._came.notify_all()

    def _stamp(self, capture: Any) -> float:
        """When a frame was taken, s: V4L2 stamps buffers on the monotonic clock; otherwise now."""
        now = self._now()
        if self._now is not time.monotonic or device_of(self.settings.source) is None:
            return now
        stamp = 1e-3 * float(capture.get(_cv().CAP_PROP_POS_MSEC))
        self.stamped = 0.0 < now - stamp < _FIRST_S
        return stamp if self.stamped else now

    def _connected(self) -> Any:
        """Open its source, and apply its settings; WorkFailed with the reason if it does not open."""
        cv, source = _cv(), self.settings.source
        device = device_of(source)
        if device is not None:
            if device.exists() and not re.fullmatch(r"video\d+", device.name):
                raise InputError(f"{self.where}: is no camera: name one of the devices: {_listed(_nodes())}")
            if wrong := _wrong_device(device, self._where):
                raise self._failed(wrong)
            capture = cv.VideoCapture(int(device.name.removeprefix("video")), cv.CAP_V4L2)
        elif isinstance(source, str) and "://" in source:
            limits = [cv.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_MS, cv.CAP_PROP_READ_TIMEOUT_MSEC, _READ_MS]
            capture = cv.VideoCapture(source, cv.CAP_FFMPEG, limits)
        else:
            capture = cv.VideoCapture(source)
        if not capture.isOpened():
            holder = None if device is None else _holder(device, self._where)
            of = replace(self._where, name=masked(str(source)))
            raise self._failed(holder or Finding("unopened", REFUSES, of))
        if isinstance(source, int) or device is not None:
            self.remarks = list(_set_up(capture, self.settings, self._where))
        return capture


def _size(width: int, height: int) -> Finding:
    """Size of other frames."""
    return Finding("size", amount=width, limit=height, unit="px")


def _cv() -> Any:
    """Return OpenCV, of which V4L2 waits for a frame for no longer than a second."""
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv = opencv()
    cv.utils.logging.setLogLevel(cv.utils.logging.LOG_LEVEL_ERROR)
    return cv


def _set_up(capture: Any, settings: Source, where: Subject) -> Iterator[Finding]:
    """Set format, size, rate, exposure and focus of a device; yield settings that it did not take."""
    cv = _cv()
    capture.set(cv.CAP_PROP_FOURCC, cv.VideoWriter.fourcc(*settings.fourcc))
    if settings.size_px is not None:
        capture.set(cv.CAP_PROP_FRAME_WIDTH, settings.size_px[0])
        capture.set(cv.CAP_PROP_FRAME_HEIGHT, settings.size_px[1])
    if settings.rate_hz is not None:
        capture.set(cv.CAP_PROP_FPS, settings.rate_hz)
    capture.set(cv.CAP_PROP_BUFFERSIZE, 1)
    capture.set(cv.CAP_PROP_AUTO_WB, 0)
    capture.set(cv.CAP_PROP_AUTOFOCUS, 0)
    focuses = settings.focus is None or capture.set(cv.CAP_PROP_FOCUS, settings.focus)
    v4l = capture.getBackendName() == "V4L2"
    exposes = settings.exposure_ms is None or _expose(capture, settings.exposure_ms, v4l)
    # Drivers silently keep other settings: their values afterwards count.
    if v4l and (code := _code_of(capture.get(cv.CAP_PROP_FOURCC))) not in ("", settings.fourcc):
        asked = Finding("asked", subject=Subject(name=settings.fourcc))
        yield Finding("other_format", LIMITS, replace(where, name=code), others=(asked,))
    if capture.get(cv.CAP_PROP_AUTOFOCUS) == 1:
        yield Finding("autofocus", LIMITS, where)
    if settings.focus is not None:
        focus = capture.get(cv.CAP_PROP_FOCUS)
        if not focuses or (focus != _UNKNOWN and abs(focus - settings.focus) > _FOCUS_STEP):
            yield Finding("unset_focus", LIMITS, where, _known_or_nan(focus), limit=settings.focus)
    if settings.exposure_ms is None:
        yield Finding("free_exposure", LIMITS, where)
        return
    if v4l and capture.get(cv.CAP_PROP_AUTO_EXPOSURE) in _V4L_AUTOMATIC:
        yield Finding("kept_exposure", LIMITS, where)
        return
    value = capture.get(cv.CAP_PROP_EXPOSURE)
    time_ms = value if value in (0, _UNKNOWN) else 0.1 * value if v4l else 1e3 * 2.0**value
    if not exposes or (time_ms > 0 and abs(math.log2(time_ms / settings.exposure_ms)) > _EXPOSURE_STEP):
        yield Finding(
            "unset_exposure", LIMITS, where, _known_or_nan(time_ms), limit=settings.exposure_ms, unit="ms"
        )


def _expose(capture: Any, exposure_ms: float, v4l: bool) -> bool:
    """Fix the exposure of a device; whether its driver takes it."""
    cv = _cv()
    # V4L2: manual is 1, times in 100 µs; DirectShow and Media Foundation: 0.25, times as powers of two, s.
    manual, exposure = (1, 10.0 * exposure_ms) if v4l else (0.25, math.log2(1e-3 * exposure_ms))
    capture.set(cv.CAP_PROP_AUTO_EXPOSURE, manual)
    return bool(capture.set(cv.CAP_PROP_EXPOSURE, exposure))


def _code_of(number: float) -> str:
    """Four letters of a format; empty if its driver does not say it."""
    code = struct.pack("<I", int(number)).decode("latin-1") if 0 < number < 2**32 else ""
    return code if code.isascii() and code.isprintable() else ""


def _known_or_nan(value: float) -> float:
    """Return the value that a driver reports; NaN if it reports none."""
    return math.nan if value in (0, _UNKNOWN) else value


def stable_name(source: int | str) -> str:
    """Name of a device that stays when it is plugged in again; empty if there is none or it is given."""
    device, links = device_of(source), Path("/dev/v4l/by-path")
    if device is None or str(source).startswith("/dev/v4l/") or not links.is_dir():
        return ""
    return next((str(link) for link in sorted(links.iterdir()) if link.resolve() == device), "")


def _capabilities(device: Path) -> tuple[int, bytes] | None:
    """Capabilities of a device node and the bus it is on; None for other nodes."""
    import fcntl

    answer = bytearray(_SIZE_OF)
    try:
        node = os.open(device, os.O_RDWR | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        fcntl.ioctl(node, _QUERYCAP, answer)
    except OSError:
        return None
    finally:
        os.close(node)
    return struct.unpack_from("=I", answer, _CAPS)[0], bytes(answer[_BUS])


def _nodes() -> list[Path]:
    return sorted(Path("/dev").glob("video*"))


def _listed(nodes: list[Path]) -> str:
    return ", ".join(map(str, nodes)) or "none: look at the cable"


def _wrong_device(device: Path, where: Subject) -> Finding | None:
    """Return the reason why a device node gives no pictures; None if it may."""
    others, subject = _nodes(), replace(where, name=str(device))
    if not device.exists():
        return Finding("no_device", REFUSES, subject, others=_devices(others))
    if not os.access(device, os.R_OK | os.W_OK):
        return Finding("unreadable_device", REFUSES, subject)
    own = _capabilities(device)
    if own is None or own[0] & _GIVES_PICTURES:
        return None
    same = [
        node
        for node in others
        if (other := _capabilities(node)) and other[1] == own[1] and other[0] & _GIVES_PICTURES
    ]
    return Finding("second_node", REFUSES, subject, others=_devices(same))


def _devices(nodes: Sequence[Path]) -> tuple[Finding, ...]:
    """Devices that there are."""
    return tuple(Finding("device", subject=Subject(name=str(node))) for node in nodes)


def _holder(device: Path, where: Subject) -> Finding | None:
    """Tell which other process has a device open; None if none of this user's shows."""
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        number = int(link.parts[2])
        with contextlib.suppress(OSError):
            if number != os.getpid() and link.readlink() == device:
                name = Path("/proc", str(number), "comm").read_text(encoding="utf-8").strip()
                process = Finding("process", subject=Subject(name=name), amount=number)
                return Finding("held_device", REFUSES, replace(where, name=str(device)), others=(process,))
    return None
