"""Two webcams before the emulated arm, each a stream of JPEGs on this machine."""

import threading
import time
from collections import deque
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from projservo_cli.simulation.rendering import Frames

_BOUNDARY = "frame"
_KEPT = 90  # frames of each camera for whoever comes late
_NAMES = ("left", "right")
_STILL = 1e-6  # rad, by which joints at rest creep


class _Unsearched(Frames):
    """Frames that nobody searches for tags where they are taken; an arm at rest is drawn once."""

    def __init__(self, rendered):
        super().__init__(rendered)
        self._kept = {}

    def _drawn(self, view, q):
        before = self._kept.get(view)
        if before is None or np.abs(before[0] - q).max() > _STILL:
            before = self._kept[view] = q.copy(), super()._drawn(view, q)
        return before[1]

    def _found(self, view):
        return np.empty((0, 2)), np.empty(0)


@dataclass
class Optics:
    """What the cameras do to their pictures, and when these arrive."""

    rate_hz: float = 30.0
    latency_s: float = 0.08  # from the middle of an exposure to the arrival of its frame
    offset_s: float = 0.007  # by which the right camera is later
    exposure_s: float = 0.0
    rolling_s: float = 0.0  # from the first row of a frame to its last; 0 for a global shutter
    quality: int = 92  # of JPEG
    light: float = 1.0  # factor of all grey values
    shift_px: tuple = (0, 0)  # along u, of the left and the right camera: it was knocked
    swapped: bool = False
    drawn: tuple = ()  # cameras whose cable is drawn: left, right
    size: tuple | None = None  # width and height of frames other than those of the rig, px


class Cameras:
    """Streams ``left`` and ``right``, addresses for ``cv2.VideoCapture``, of what an arm shows.

    ``optics`` may be changed while they run. ``taken``: for each camera, (instant, joints of the links there)
    of the frames, middle of exposure.
    """

    def __init__(self, arm, optics=None, seed=5):
        self.arm, self.clock, self.optics = arm, arm.clock, optics or Optics()
        self.taken = (deque(maxlen=2000), deque(maxlen=2000))
        self._frames = (deque(maxlen=_KEPT), deque(maxlen=_KEPT))  # (number, due, JPEG)
        self._random, self._stopping = np.random.default_rng(seed), threading.Event()
        self._ready, self._failure = threading.Event(), None

    def __enter__(self):
        cameras = self

        class Handler(BaseHTTPRequestHandler):
            """One reader of one stream."""

            def log_message(self, *_):
                pass

        # http.server looks methods up by the name of the request.
        Handler.do_GET = lambda reader: cameras._stream(reader)
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        base = f"http://127.0.0.1:{self._server.server_address[1]}"
        self.left, self.right = f"{base}/left.mjpg", f"{base}/right.mjpg"
        self._threads = [
            threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True),
            threading.Thread(target=self._draw, daemon=True),
        ]
        for thread in self._threads:
            thread.start()
        self._ready.wait(30.0)
        if self._failure is not None:
            self.__exit__()
            raise self._failure
        return self

    def __exit__(self, *_):
        self._stopping.set()
        self._server.shutdown()
        self._server.server_close()
        for thread in self._threads:
            thread.join(5.0)

    def _draw(self):
        """Draw both views, frame after frame, in the one thread that may."""
        eyes = _Unsearched(self.arm.rendered)
        try:
            eyes.open()
        except Exception as error:  # without GL, of whatever kind
            self._failure = error
            self._ready.set()
            return
        k = int(self.clock.now() * self.optics.rate_hz) + 1
        while not self._stopping.is_set():
            for view in (0, 1):
                middle = k / self.optics.rate_hz + view * self.optics.offset_s
                self.clock.sleep(middle + 0.5 * self._longest - self.clock.now())
                shown = 1 - view if self.optics.swapped else view
                due = middle + self.optics.latency_s
                self._frames[view].append((k, due, self._picture(eyes, shown, middle)))
                self.taken[view].append((middle, self.arm.at(middle)))
            self._ready.set()
            behind = self.clock.now() - (k + 1) / self.optics.rate_hz
            k += 1 + max(0, int(behind * self.optics.rate_hz))  # what is too late is never taken
        eyes.close()

    @property
    def _longest(self):
        return self.optics.exposure_s + self.optics.rolling_s

    def _picture(self, eyes, view, middle):
        """One frame as JPEG, of rows that are exposed one after the other where the shutter rolls."""
        import cv2

        optics = self.optics
        within = 0.5 * optics.exposure_s * np.linspace(-1.0, 1.0, 3 if optics.exposure_s else 1)

        def shot(instant):
            q = np.array([self.arm.at(instant + x) for x in within])
            eyes.capture(view, q, None, self._random)
            return eyes.last[view]

        if optics.rolling_s > 0.0:
            bands = np.array_split(np.arange(eyes.last.shape[1]), 8)
            image = np.empty_like(eyes.last[view])
            for i, rows in enumerate(bands):
                image[rows] = shot(middle + optics.rolling_s * ((i + 0.5) / len(bands) - 0.5))[rows]
        else:
            image = shot(middle).copy()
        if optics.light != 1.0:
            image = np.clip(image * optics.light, 0, 255).astype(np.uint8)
        if shift := optics.shift_px[view]:
            image = np.roll(image, shift, axis=1)
        if optics.size is not None:
            image = cv2.resize(image, optics.size)
        return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, optics.quality])[1].tobytes()

    def _stream(self, reader):
        """Send each frame to a reader when it is due."""
        name = reader.path.strip("/").split(".")[0]
        if name not in _NAMES:
            reader.send_error(404)
            return
        view, sent = _NAMES.index(name), -1
        reader.send_response(200)
        reader.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        reader.end_headers()
        try:
            while not self._stopping.is_set():
                now = self.clock.now()
                due = [frame for frame in list(self._frames[view]) if frame[0] > sent and frame[1] <= now]
                if not due or name in self.optics.drawn:
                    time.sleep(0.001)
                    continue
                sent, _, picture = due[-1] if sent < 0 else due[0]
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
                reader.wfile.write(head.encode() + picture + b"\r\n")
        except (BrokenPipeError, ConnectionResetError):
            pass
