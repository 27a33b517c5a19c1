"""Frames of all cameras, put together into observations in the order in which they were taken."""

from typing import NamedTuple

import numpy as np

from projservo_cli.records import Calibration, FloatArray, IntArray

# Frames of all views within this time, s, are one observation; number that waits for the other views.
_TOGETHER_S, _WAITING = 0.025, 25
# Between readings joints are taken to go straight: they err by this share of the time times the change of
# their speed at most.
_STRAIGHT = 1.0 / 8.0


class TimedImage(NamedTuple):
    """An image of one view."""

    t: float  # when it was taken, s
    q: FloatArray  # (n,) joint readings then, rad or m
    q_dot: FloatArray  # (n,) and their velocities
    sigma_t: float  # standard deviation of the instant, s
    image: FloatArray  # (m, 2) px, NaN where unseen
    noise: FloatArray  # (m,) standard deviation of the pixels, px


class FramePair(NamedTuple):
    """Images of all views of one time; a view without a frame then sees no marker."""

    t: FloatArray  # (V,) s, from the first observation on
    q: FloatArray  # (V, n) rad or m
    q_dot: FloatArray  # (V, n)
    sigma_t: FloatArray  # (V,) s
    images: FloatArray  # (V, m, 2) px
    noise: FloatArray  # (V, m) px
    curved: FloatArray  # (n,) possible error of joints since they do not go straight between readings

    @classmethod
    def at_rest(cls, q: FloatArray, images: FloatArray, noise: FloatArray) -> "FramePair":
        """Images (V, m, 2) of an arm at rest at joints (n,), with deviations (V, m) of pixels."""
        V = len(images)
        none, at_rest = np.zeros(V), np.zeros((V, len(q)))
        return cls(none, np.stack([q] * V), at_rest, none, images, noise, np.zeros(len(q)))


class Pairing:
    """Queues of the frames of each view."""

    def __init__(self, views: int) -> None:
        self._waiting = [list[TimedImage]() for _ in range(views)]
        self._reached = np.full(views, -np.inf)
        self._start: float | None = None
        self._last: TimedImage | None = None

    def add(self, view: int, frame: TimedImage) -> None:
        """Take in a new frame of a view."""
        self._waiting[view].append(frame)

    def reach(self, t: FloatArray) -> None:
        """Note the instants (V,) that the views have come to, s."""
        self._reached = np.maximum(self._reached, t)

    def next(self, at_rest: bool) -> FramePair | None:
        """Next observation; None while a frame waits for frames of the other views.

        at_rest : the robot has not moved yet, so that frames of any two instants show the same.
        """
        t = np.array([frames[0].t if frames else np.inf for frames in self._waiting])
        first, until = int(np.argmin(t)), t.min() + _TOGETHER_S
        due = at_rest or len(self._waiting[first]) > _WAITING
        due |= bool(((t < np.inf) | (self._reached > until)).all())
        frames = [
            waiting.pop(0) if waiting and due and (at_rest or t[v] - t[first] <= _TOGETHER_S) else None
            for v, waiting in enumerate(self._waiting)
        ]
        earliest = next(filter(None, frames), None)
        return None if earliest is None else self._pair(earliest, frames)

    def _pair(self, frame_now: TimedImage, frames: list[TimedImage | None]) -> FramePair:
        """Observation of the frames of all views, at least one of them."""
        every = [frame or frame_now._replace(image=np.full_like(frame_now.image, np.nan)) for frame in frames]
        last, self._last = self._last or frame_now, frame_now
        self._start = frame_now.t if self._start is None else self._start
        stacked = (np.array([frame[i] for frame in every]) for i in range(len(frame_now)))
        t, q, q_dot, sigma_t, images, noise = stacked
        curved = _STRAIGHT * np.abs(frame_now.q_dot - last.q_dot) * abs(frame_now.t - last.t)
        return FramePair(
            t=t - self._start, q=q, q_dot=q_dot, sigma_t=sigma_t, images=images, noise=noise, curved=curved
        )


def at_known_markers(calibration: Calibration, marker: IntArray, images: FloatArray) -> FloatArray:
    """Values (V, m, …) of the markers of a calibration among those (V, b, …) of the numbers marker (b,)."""
    has = np.isin(marker, calibration.marker)
    values = np.full((len(images), len(calibration.marker), *images.shape[2:]), np.nan)
    values[:, calibration.indices_of(marker[has])] = images[:, has]
    return values


def mean_image(images: FloatArray) -> FloatArray:
    """Mean (…, 2) of images (K, …, 2) of an arm at rest; NaN where most show no marker."""
    often, mean = 2 * np.isfinite(images).sum(axis=0) > len(images), np.full(images.shape[1:], np.nan)
    mean[often] = np.nanmean(images[:, often], axis=0)
    return mean
