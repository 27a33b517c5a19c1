"""Frames of both cameras, paired into observations in the order in which they were taken."""

from typing import NamedTuple

import numpy as np

from projservo_cli.records import BoolArray, FloatArray

# Frames of both views within this time, s, are one observation; number that waits for the other view.
_TOGETHER_S, _WAITING = 0.025, 25
# Between readings joints are taken to go straight: they are off by this share of the time times the change of
# their speed at most.
_STRAIGHT = 1.0 / 8.0


class Frame(NamedTuple):
    """An image of one view."""

    t: float  # when it was taken, s
    q: FloatArray  # (n,) joint readings then, rad or m
    q_dot: FloatArray  # (n,) and their velocities
    sigma_t: float  # standard deviation of the instant, s
    image: FloatArray  # (m, 2) px, NaN where unseen
    noise: FloatArray  # (m,) standard deviation of the pixels, px


class FramePair(NamedTuple):
    """Both images of one time; a view without a frame then sees no marker."""

    t: FloatArray  # (2,) s, from the first observation on
    q: FloatArray  # (2, n) rad or m
    q_dot: FloatArray  # (2, n)
    sigma_t: FloatArray  # (2,) s
    images: FloatArray  # (2, m, 2) px
    noise: FloatArray  # (2, m) px
    curved: FloatArray  # (n,) how far joints may be off since they do not go straight between readings

    @property
    def seen(self) -> BoolArray:
        """Markers (2, m) that are seen."""
        return np.asarray(np.isfinite(self.images[..., 0]))


class Pairing:
    """Queue of the frames of both views."""

    def __init__(self) -> None:
        self._waiting: tuple[list[Frame], list[Frame]] = ([], [])
        self._reached = np.full(2, -np.inf)
        self._start: float | None = None
        self._last: Frame | None = None

    def add(self, view: int, frame: Frame) -> None:
        """Take in a new frame of a view."""
        self._waiting[view].append(frame)

    def reach(self, t: FloatArray) -> None:
        """Note the instants (2,) that both views have come to, s."""
        self._reached = np.maximum(self._reached, t)

    def next(self, at_rest: bool) -> FramePair | None:
        """Next observation; None while a frame waits for that of the other view.

        at_rest : the robot has not moved yet, so that frames of any two instants show the same.
        """
        left, right = (frames[0].t if frames else np.inf for frames in self._waiting)
        first = int(right < left)
        due = at_rest or len(self._waiting[first]) > _WAITING or max(left, right) < np.inf
        due |= min(left, right) + _TOGETHER_S < self._reached[1 - first]
        together = at_rest or abs(left - right) <= _TOGETHER_S
        frames = [
            waiting.pop(0) if waiting and due and (together or v == first) else None
            for v, waiting in enumerate(self._waiting)
        ]
        earliest = frames[0] or frames[1]
        return None if earliest is None else self._pair(earliest, frames)

    def _pair(self, frame_now: Frame, frames: list[Frame | None]) -> FramePair:
        """Pair of the frames of both views, at least one of them."""
        both = [frame or frame_now._replace(image=np.full_like(frame_now.image, np.nan)) for frame in frames]
        last, self._last = self._last or frame_now, frame_now
        self._start = frame_now.t if self._start is None else self._start
        stacked = (np.array([frame[i] for frame in both]) for i in range(len(frame_now)))
        t, q, q_dot, sigma_t, images, noise = stacked
        curved = _STRAIGHT * np.abs(frame_now.q_dot - last.q_dot) * abs(frame_now.t - last.t)
        return FramePair(
            t=t - self._start, q=q, q_dot=q_dot, sigma_t=sigma_t, images=images, noise=noise, curved=curved
        )
