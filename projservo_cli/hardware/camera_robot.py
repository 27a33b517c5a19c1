"""A robot of the contract made of an arm that reads joints alone, cameras, and the detector of tags."""

import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol

import numpy as np

from projservo_cli import messages
from projservo_cli.detection.finders import Corners, Finder
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.hardware.exposure import exposure_of
from projservo_cli.hardware.video_cameras import Frame, VideoCamera
from projservo_cli.records import ByteArray, FloatArray, WorkFailed
from projservo_cli.settings.cameras import Cameras

# Number of frames of a view without tags of which the mirror image is searched: more are a tool out of sight.
_MIRRORS = 10


class Arm(Protocol):
    """A robot class whose images are projservo's.

    It may have ``now``, ``truth``, ``release``, ``hold``, ``act`` and ``holding`` as in ``Robot``, and what
    the checks before the first motion show: ``health() -> dict[str, float | str]``, such as the voltage.
    """

    def open(self) -> None:
        """Connect to the arm; the first call."""

    def joints(self) -> tuple[Any, float | None]:
        """Return readings (n,), rad or m, and when they were read, s, by ``now``; None for just now."""

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Be at the joints ``target`` when the clock shows ``due``, as in ``Robot``."""

    def stop(self) -> None:
        """Come to rest."""

    def close(self) -> None:
        """Let go of the arm; the last call."""


class View(NamedTuple):
    """Tags in a frame."""

    frame: Frame
    tags: dict[int, Corners]  # tags by their numbers
    repeated: tuple[int, ...]  # numbers that occur more than once


class CameraRobot:
    """A robot of the contract: joints of an arm, and corners of tags in the newest frame of each camera.

    numbers : of the markers, of which 4 t to 4 t + 3 are the corners of tag t; or all corners of a board.
    whole : whether the loss of one camera loses the robot; otherwise it goes on with the others.
    ``view``: names of the cameras. ``views`` are the views of the last frames, None before.
    """

    def __init__(
        self, arm: Arm, rig: Cameras, finder: Finder, numbers: Sequence[int], *, whole: bool = True
    ) -> None:
        self.arm, self.finder, self._numbers = arm, finder, np.array(numbers, dtype=np.int64)
        for name in ("now", "truth", "release", "hold", "health", "identity", "act", "holding"):
            if callable(method := getattr(arm, name, None)):
                setattr(self, name, method)
        now: Callable[[], float] = getattr(arm, "now", time.monotonic)
        self.cameras = [
            VideoCamera(view, settings, rig.max_age_s, rig.reconnect_s, now)
            for view, settings in rig.sources.items()
        ]
        self.view = tuple(camera.name for camera in self.cameras)
        self.views: list[View | None] = [None for _ in self.view]
        self._begun, self._blind = False, [0 for _ in self.view]
        self._whole, self._lost = whole, set[int]()  # views whose cameras give nothing any more

    def open(self) -> None:
        """Connect to all cameras, and then to the arm."""
        with ThreadPoolExecutor(len(self.cameras)) as pool:
            for opened in [pool.submit(camera.open) for camera in self.cameras]:
                opened.result()
        self._begun = True
        self.arm.open()

    def read(self) -> tuple[Any, ...]:
        """Readings of the joints, corners of the tags, their stamps and standard deviations."""
        q, t_q = self.arm.joints()
        views = [self._looked(view) for view in range(len(self.view))]
        pixels, sigma = (np.stack(sides) for sides in zip(*map(self._corners, views), strict=True))
        return q, pixels, t_q, *(None if view is None else view.frame.t for view in views), sigma

    @property
    def frames(self) -> ByteArray | None:
        """Last frames (V, height, width) of the cameras; None if their sizes differ."""
        grey = [view.frame.grey for view in self.views if view is not None]
        alike = len(grey) == len(self.views) and len({one.shape for one in grey}) == 1
        return np.stack(grey) if alike else None

    def _newest(self, view: int) -> Frame | None:
        """Newest frame of a view; None while its camera is lost and others are not.

        The robot waits for a lost camera once.
        """
        camera = self.cameras[view]
        if view in self._lost and not camera.runs:
            return None
        try:
            frame = camera.newest()
        except WorkFailed as error:
            if self._whole or len(self._lost) == len(self.view) - 1:
                raise
            self._lost.add(view)
            print(f"{error}; going on without it", file=sys.stderr)
            return None
        self._lost.discard(view)
        return frame

    def _looked(self, view: int) -> View | None:
        """Find tags in the newest frame of a view, unless that was done before; None if it is lost."""
        frame, last = self._newest(view), self.views[view]
        if frame is None:
            return None
        if last is None or last.frame.serial != frame.serial:
            tags, repeated = self.finder.find(frame.grey.astype(np.float64))
            last = View(frame, self.finder.like(tags, None if last is None else last.tags), repeated)
            self.views[view] = last
            if not last.tags.keys() & {*(self._numbers // self.finder.corners).tolist()}:
                self._blind[view] += 1
                if self._blind[view] <= _MIRRORS:
                    self._require_not_mirrored(view, frame.grey)
        return last

    def _require_not_mirrored(self, view: int, grey: ByteArray) -> None:
        """Raise WorkFailed for an image (height, width) without tags whose mirror image shows them."""
        tags = self.finder.find(grey[:, ::-1].astype(np.float64))[0].keys()
        if mirrored := tags & {*(self._numbers // self.finder.corners).tolist()}:
            corners = tuple(self.finder.corners * number for number in sorted(mirrored))
            where = Subject(views=(self.view[view],), markers=corners)
            raise messages.failed([Finding("mirrored_image", REFUSES, where)])

    def _corners(self, view: View | None) -> tuple[FloatArray, FloatArray]:
        """Pixels (m, 2) of all markers and their deviations (m,); NaN where unseen, rejected or lost."""
        pixels, sigma = np.full((len(self._numbers), 2), np.nan), np.full(len(self._numbers), np.nan)
        tags = {} if view is None else view.tags
        for k, number in enumerate(self._numbers.tolist()):
            if (tag := tags.get(number // self.finder.corners)) is not None:
                pixels[k], sigma[k] = (
                    tag.pixels[number % self.finder.corners],
                    tag.sigma[number % self.finder.corners],
                )
        pixels[np.isnan(sigma)] = np.nan
        sigma[np.isnan(pixels[:, 0])] = np.nan
        return pixels, sigma

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Pass a set-point on to the arm."""
        self.arm.command(target, speed, due)

    def stop(self) -> None:
        """Bring the arm to rest; where cameras are still awaited, end that, and the arm is never opened."""
        if self._begun:
            self.arm.stop()
        else:
            self._end_cameras()

    def close(self) -> None:
        """Let go of the arm, and of all cameras in any case."""
        try:
            if self._begun:
                self.arm.close()
        finally:
            self._end_cameras()  # end all before waiting for any
            for camera in self.cameras:
                camera.close()

    def _end_cameras(self) -> None:
        for camera in self.cameras:
            camera.end()

    def remarks(self) -> list[Finding]:
        """Return the faults of the last frames: dark, clipped or blurred ones."""
        visible = [(name, view) for name, view in zip(self.view, self.views, strict=True) if view is not None]
        return [one for name, view in visible for one in exposure_of(view.frame.grey).faults(name)]
