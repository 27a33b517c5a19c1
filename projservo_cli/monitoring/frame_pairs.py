"""Frames of both cameras, paired into observations in the order in which they were taken."""

from typing import NamedTuple

import numpy as np

from projservo_cli.records import Calibration, FloatArray, IntArray

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

    @classmethod
    def at_rest(cls, q: FloatArray, images: FloatArray, noise: FloatArray) -> "FramePair":
        """Images (2, m, 2) of an arm that stands still at joints (n,), with deviations (2, m) of pixels."""
        none = np.zeros(2)
        return cls(none, np.stack([q, q]), np.zeros((2, len(q))), none, images, noise, np.zeros(len(q)))


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


def at_known_markers(calibration: Calibration, marker: IntArray, images: FloatArray) -> FloatArray:
    """Values (2, m, …) of the markers of a calibration among those (2, b, …) of the numbers marker (b,)."""
    has = np.isin(marker, calibration.marker)
    values = np.full((2, len(calibration.marker), *images.shape[2:]), np.nan)
    values[:, calibration.indices_of(marker[has])] = images[:, has]
    return values


def mean_image(images: FloatArray) -> FloatArray:
    """Mean (…, 2) of images (K, …, 2) of an arm that stands still; NaN where most show no marker."""
    often, mean = 2 * np.isfinite(images).sum(axis=0) > len(images), np.full(images.shape[1:], np.nan)
    mean[often] = np.nanmean(images[:, often], axis=0)
    return mean
