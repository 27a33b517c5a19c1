"""Frames of a run that are kept for its film, as JPEG."""

import io
from typing import NamedTuple

import numpy as np
from PIL import Image

from projservo_cli.records import ByteArray, FloatArray, RecordedFrames

MOST_FRAMES = 60  # instants of a run that are kept
_QUALITY = 85  # quality of JPEG


class _Shot(NamedTuple):
    """The frames of an instant that is kept, one per view."""

    instant: int
    s: FloatArray  # (V, m, 2) px, its detections
    jpeg: tuple[bytes, ...]


class FrameRecorder:
    """Frames of a run, evenly thinned while it runs, the first and the last among them."""

    def __init__(self) -> None:
        self._kept: list[_Shot] = []
        self._every = 1  # instants from one to the next
        self._last: tuple[int, FloatArray, ByteArray] | None = None

    def show(self, instant: int, s: FloatArray, frames: ByteArray) -> None:
        """Take the frames (V, height, width) of an instant, and the pixels (V, m, 2) that were found."""
        self._last = instant, s, frames
        if instant % self._every == 0 and len(self._kept) == MOST_FRAMES - 1:
            self._kept, self._every = self._kept[::2], 2 * self._every
        if instant % self._every == 0:
            self._kept.append(_Shot(instant, s, _as_jpeg(frames)))

    def recorded(self) -> RecordedFrames | None:
        """The part that a ``Trace`` holds; None of a robot without frames."""
        if self._last is None:
            return None
        instant, s, frames = self._last
        shots = [*self._kept]
        if not shots or shots[-1].instant != instant:
            shots.append(_Shot(instant, s, _as_jpeg(frames)))
        whole = b"".join(one for shot in shots for one in shot.jpeg)
        return RecordedFrames(
            frame_index=np.array([shot.instant for shot in shots], dtype=np.int64),
            frame_s=np.array([shot.s for shot in shots]),
            frame_size=np.array([[len(one) for one in shot.jpeg] for shot in shots], dtype=np.int64),
            frame_jpeg=np.frombuffer(whole, dtype=np.uint8),
        )


def _as_jpeg(frames: ByteArray) -> tuple[bytes, ...]:
    """Frames (V, height, width) as files."""
    files = [io.BytesIO() for _ in frames]
    for file, frame in zip(files, frames, strict=True):
        Image.fromarray(frame).save(file, "JPEG", quality=_QUALITY)
    return tuple(file.getvalue() for file in files)
