"""Two webcams before the emulated arm, each a stream of JPEGs on this machine."""

import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.simulation.rendering import Frames
from tests.emulated.streams import Served

_KEPT = 90  # frames of each camera for whoever comes late
_STILL = 1e-6  # rad, by which joints at rest creep


class _Unsearched(Frames):
    """Frames that nobody searches for tags where they are taken; an arm at rest is drawn once."""

    def __init__(self, arm):
        super().__init__(arm.rendered)
        self._arm, self._kept = arm, {}

    def _drawn(self, view, q, time):
        T, before = self._arm.displacement, self._kept.get(view)
        T = T(time) if callable(T) else T
        if before is None or np.abs(before[0] - q).max() > _STILL or (before[1] != T).any():
            if self.rendered.scene.objects:
                objects = self._model.body("scene with tags")
                objects.pos, turn = T[:3, 3], Rotation.from_matrix(T[:3, :3])
                objects.quat = turn.as_quat(scalar_first=True)
            before = self._kept[view] = q.copy(), T, super()._drawn(view, q, time)
        return before[2]

    def _found(self, view):
        return np.empty((0, 2)), np.empty(0)


@dataclass
class Optics:
    """How often frames are taken, and when they arrive."""

    rate_hz: float = 30.0
    latency_s: float = 0.08  # from an exposure to the arrival of its frame
    offset_s: float = 0.007  # by which the right camera is later
    quality: int = 92  # of JPEG


class _Webcam(Served):
    """Sends each of its frames, (number, due, JPEG), when it is due."""

    def __init__(self, clock):
        self.clock, self.kept = clock, deque(maxlen=_KEPT)
        super().__init__()

    def frames(self):
        sent = -1
        while not self.paused.is_set():
            now = self.clock.now()
            due = [frame for frame in list(self.kept) if frame[0] > sent and frame[1] <= now]
            if not due:
                time.sleep(0.001)
                continue
            sent, _, picture = due[-1] if sent < 0 else due[0]
            yield picture


class Cameras:
    """Streams ``left`` and ``right``, addresses for ``cv2.VideoCapture``, of what an arm shows."""

    def __init__(self, arm, optics=None, seed=5):
        self.arm, self.clock, self.optics = arm, arm.clock, optics or Optics()
        self._random, self._stopping = np.random.default_rng(seed), threading.Event()
        self._ready, self._failure = threading.Event(), None
        self.shift = np.zeros((2, 2), dtype=np.int64)  # px, of each view, as of one that turned

    def __enter__(self):
        self._webcams = [_Webcam(self.clock) for _ in range(2)]
        self.left, self.right = (webcam.url for webcam in self._webcams)
        self._thread = threading.Thread(target=self._draw, daemon=True)
        self._thread.start()
        self._ready.wait(30.0)
        if self._failure is not None:
            self.__exit__()
            raise self._failure
        return self

    def __exit__(self, *_):
        self._stopping.set()
        for webcam in self._webcams:
            webcam.close()
        self._thread.join(5.0)

    def picture(self, view):
        """The last frame of a view, JPEG."""
        return self._webcams[view].kept[-1][2]

    def _draw(self):
        """Draw both views, frame after frame, in the one thread that may."""
        eyes = _Unsearched(self.arm)
        try:
            eyes.open()
        except Exception as error:  # without GL, of whatever kind
            self._failure = error
            self._ready.set()
            return
        k = int(self.clock.now() * self.optics.rate_hz) + 1
        while not self._stopping.is_set():
            for view, webcam in enumerate(self._webcams):
                instant = k / self.optics.rate_hz + view * self.optics.offset_s
                self.clock.sleep(instant - self.clock.now())
                webcam.kept.append((k, instant + self.optics.latency_s, self._picture(eyes, view, instant)))
            self._ready.set()
            behind = self.clock.now() - (k + 1) / self.optics.rate_hz
            k += 1 + max(0, int(behind * self.optics.rate_hz))  # what is too late is never taken
        eyes.close()

    def _picture(self, eyes, view, instant):
        """One frame as JPEG."""
        import cv2

        eyes.capture(view, self.arm.at(instant)[None], None, self._random, np.array([instant]))
        image = np.roll(eyes.last[view], self.shift[view][::-1], axis=(0, 1))
        return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.optics.quality])[1].tobytes()
