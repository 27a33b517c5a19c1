"""Latency: when images were taken by the clock of the joint readings, and where the joints were then.

The delay of a view is the instant of a joint reading less the middle of the exposure of the image that came
with it. Only this difference can be seen, so a constant offset is always estimated: of the stamp of a frame
if it has one, which may be of another clock or of its arrival, otherwise of the reading itself.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.time_offset import is_repeated_frame
from projservo_cli.records import BoolArray, Calibration, FloatArray, InputError, WorkFailed

# Deviation of an unknown delay, and of a single frame if no calibration gives it, s.
_UNKNOWN_S, _JITTER_S = 0.3, 0.012
# Minimum deviation of a delay and of single frames, s; width of a 95 % interval in deviations.
_LEAST_JITTER_S, _INTERVAL = 0.002, 3.92
# Readings that are kept, and how far beyond the last one joints are taken to move on, s.
_KEPT, _AHEAD_S = 256, 0.1
# Delays that are reckoned with while little is known, s.
_DELAYS = np.arange(-0.1, 1.0, 0.01)
# An image is compared with predictions up to this time before and after; a delay known as well is followed,
# s.
_APART_S = 0.02
# Markers err alike: they count as this number of coordinates. Delays that no image excludes.
_COUNTED, _LEAST_CHANCE = 8.0, 1e-9
# A frame farther from its instant than this number of deviations is none of this delay, nor is that number in
# a row; the factor by which it fits better elsewhere, in squares.
_GATE, _STRAYS, _CLEARLY = 4.0, 3, 9.0
# Rate at which a delay may change, s for each frame that shows it; number in a row that err alike.
_DRIFT_S, _ALIKE = 0.2e-3, 10.0
# Error of the model at least if it gives the instant of a frame, px.
_MODEL_PX = 0.3
# Motion, px, that images should show before a frozen one is a fault.
_STILL_PX = 5.0


class History:
    """Joint readings of the past; before the first one the robot was at rest."""

    def __init__(self) -> None:
        self._t, self._q = np.zeros(0), np.zeros((0, 0))

    def __bool__(self) -> bool:
        return len(self._t) > 0

    def add(self, t: float, q: FloatArray) -> None:
        """Take in joints (n,), rad or m, of an instant, s; another reading of an instant replaces it."""
        first = max(0, len(self._t) + 1 - _KEPT)
        last = len(self._t) - int(len(self._t) > 0 and t == self._t[-1])
        self._t = np.append(self._t[first:last], t)
        self._q = np.concatenate([self._q[first:last].reshape(-1, len(q)), q[None]])

    @property
    def last(self) -> tuple[float, FloatArray]:
        """The last instant, s, and its joints (n,), rad or m."""
        return float(self._t[-1]), self._q[-1]

    def at(self, t: FloatArray) -> FloatArray:
        """Joints (k, n) at instants (k,), s; exact at readings, a little beyond the last one."""
        times, q = self._t, self._q
        if len(times) == 1:
            return np.repeat(q, len(t), axis=0)
        t = np.clip(t, times[0], times[-1] + _AHEAD_S)
        i = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        x = ((t - times[i]) / (times[i + 1] - times[i]))[:, None]
        return np.asarray((1.0 - x) * q[i] + x * q[i + 1])

    def speed_at(self, t: float) -> FloatArray:
        """Joint velocities (n,) about an instant, rad/s or m/s."""
        q = self.at(np.array([t - _APART_S, t + _APART_S]))
        return np.asarray((q[1] - q[0]) / (2.0 * _APART_S))


class DelayPrior(NamedTuple):
    """Knowledge of the delays of all views before the first image."""

    mean: FloatArray  # (V,) s
    sigma: FloatArray  # (V,) s, of the mean; 0 if it is given and not followed
    jitter: FloatArray  # (V,) s, deviation of single frames

    @classmethod
    def unknown(cls, views: int) -> "DelayPrior":
        """Return the prior of a number of views without knowledge."""
        return cls(np.zeros(views), np.full(views, _UNKNOWN_S), np.full(views, _JITTER_S))

    @classmethod
    def of(
        cls, calibration: Calibration, given: Sequence[float | None] | None, *, even: bool = False
    ) -> "DelayPrior":
        """Return the prior of a calibration: given delays of all views, s, calibrated ones, or wide.

        even : whether single frames are known to have no other delay.
        Raises InputError if a view has none among given ones.
        """
        view = calibration.view
        known = cls.unknown(len(view))
        if even:
            known = known._replace(jitter=np.zeros(len(view)))
        if (found := calibration.time_offset) is not None:
            sigma = np.maximum(
                np.ptp(found.time_offset_interval_s, axis=1) / _INTERVAL, 0.5 * _LEAST_JITTER_S
            )
            jitter = np.maximum(found.time_offset_jitter_s, _LEAST_JITTER_S)
            known = cls(found.time_offset_s.copy(), sigma, jitter)
        if given is None:
            return known
        if missing := [name for name, delay in zip(view, given, strict=True) if delay is None]:
            raise InputError(
                f"plant.time_offset_s: names no {', '.join(missing)}: give their numbers, or others"
            )
        return known._replace(mean=np.array(given, float), sigma=np.zeros(len(view)))


class Frames(NamedTuple):
    """Instants of the images of an observation."""

    t: FloatArray  # (V,) s, by the clock of the readings
    sigma: FloatArray  # (V,) s, how well that was known before the images were looked at
    fresh: BoolArray  # (V,) whether the image is another one than before
    sigma_shared: FloatArray  # (V,) s, deviation of the instants that frames share


def squares_by_joints(
    predicted: Callable[[FloatArray], FloatArray], q: FloatArray, sigma_q: FloatArray
) -> FloatArray:
    """Variances (V, m, 2) of pixels, px², by deviations (n,) of the readings at joints (n,), rad or m."""
    s = predicted(np.concatenate([q[None], q + np.diag(sigma_q)]))
    return np.asarray(np.square(s[1:] - s[0]).sum(axis=0))


class Delays:
    """The delays of all views, and the instants of frames.

    view : names of the views; predicted : pixels (k, V, m, 2) at joints (k, n).
    prior : of the delays; sigma_px : pixel noise; timeout_s : longest that an image may stay the same, s.
    sigma_q : (n,) deviation of the joint readings, rad or m; 0 if none shows.
    """

    def __init__(
        self,
        view: Sequence[str],
        predicted: Callable[[FloatArray], FloatArray],
        prior: DelayPrior,
        sigma_px: float,
        timeout_s: float,
        sigma_q: FloatArray,
    ) -> None:
        self._predicted, self._sigma_q, self._error_px = predicted, sigma_q, math.hypot(sigma_px, _MODEL_PX)
        self._views = [
            _View(name, v, predicted, prior, self._error_px, timeout_s) for v, name in enumerate(view)
        ]

    @property
    def mean(self) -> FloatArray:
        """Delays (V,) as followed, s: of images from their readings, or from their stamps."""
        return np.array([view.mean for view in self._views])

    def update(self, t_view: FloatArray, images: FloatArray, history: History) -> Frames:
        """Instants of the images of an observation.

        t_view : (V,) s, stamps, NaN if there are none; images : (V, m, 2) px, NaN where unseen.
        history : of the readings, the last of this observation.
        Raises WorkFailed if the clock of a camera jumped, or its image freezes while the joints move.
        """
        if self._sigma_q.any():
            self._reckon_with_joints(history.last[1])
        found = [
            view.update(float(t), s, history) for view, t, s in zip(self._views, t_view, images, strict=True)
        ]
        t, sigma, fresh = zip(*found, strict=True)
        sigma_shared = np.array([view.sigma_shared for view in self._views])
        return Frames(np.array(t), np.array(sigma), np.array(fresh), sigma_shared)

    def _reckon_with_joints(self, q: FloatArray) -> None:
        """Add the effect of errors of the readings at joints (n,) to the error of the model.

        While a joint goes through its backlash, readings move and images do not, as with latency.
        """
        squares = squares_by_joints(self._predicted, q, self._sigma_q)
        for view, square in zip(self._views, squares, strict=True):
            by_joints = square[np.isfinite(square)]
            view.error_px = math.hypot(self._error_px, math.sqrt(by_joints.mean() if by_joints.size else 0.0))


class _View:
    """The delay of one view, and the instants of its frames.

    While the joints move, an image shows when it was taken. Where little is known of the delay, the chance of
    each is kept; otherwise a Kalman filter follows the mean, from which single frames stray by jitter:
    s − ŝ(t) = ṡ (t′ − t), to first order.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
    Navigation", Wiley 2001, section 5.2.
    """

    def __init__(
        self,
        name: str,
        view: int,
        predicted: Callable[[FloatArray], FloatArray],
        prior: DelayPrior,
        error_px: float,
        timeout_s: float,
    ) -> None:
        self._name, self._view, self._predicted = name, view, predicted
        self.error_px, self._timeout_s = error_px, timeout_s
        mean, sigma, jitter = (float(both[view]) for both in prior)
        self.mean, self._variance, self._jitter, self._follows = mean, sigma**2, jitter, sigma > 0.0
        self.sigma_shared = sigma  # deviation of the instants that frames share, s
        blur = np.exp(-0.5 * (np.subtract.outer(_DELAYS, _DELAYS) / max(jitter, _LEAST_JITTER_S)) ** 2)
        self._blur = blur / blur.sum(axis=1, keepdims=True)
        self._log_chance = self._open(mean, sigma)
        self._strays = 0
        self._stamp, self._offset = math.nan, 0.0  # stamp of the last frame; offset of its clock
        self._image: FloatArray | None = None
        self._t = -math.inf  # when the last image was taken
        self._moved_at = math.nan  # when joints began to leave it

    def update(self, stamp: float, image: FloatArray, history: History) -> tuple[float, float, bool]:
        """Instant of an image (m, 2), s, how well it was known before, s, and whether the image is new."""
        nominal = self._nominal(stamp, history.last[0])
        expected, sigma = nominal - self.mean, math.sqrt(self._variance + self._jitter**2)
        if not np.isfinite(image).any():
            return expected, sigma, False
        if not self._is_fresh(stamp, image):
            self._require_motion(history)
            return self._t, sigma, False
        self._require_age(history.last[0] - expected, sigma)
        self._moved_at = math.nan
        self._t = (self._followed if self._log_chance is None else self._searched)(image, nominal, history)
        return self._t, sigma, True

    @staticmethod
    def _open(mean: float, sigma: float) -> FloatArray | None:
        """Logarithm of the chance of each delay where little is known; None if it need not be kept."""
        return None if sigma <= _APART_S else -0.5 * ((_DELAYS - mean) / sigma) ** 2

    def _nominal(self, stamp: float, t_q: float) -> float:
        """The instant, s, that a delay is the offset of: of the stamp, otherwise of the reading."""
        if math.isnan(stamp) or not self._follows:
            return t_q
        if math.isnan(self._stamp) and not -_AHEAD_S <= t_q - stamp + self.mean <= self._timeout_s:
            # Clocks that have nothing in common, or not as when it was calibrated, start together.
            self._offset, self.mean, self._variance = stamp - t_q, 0.0, _UNKNOWN_S**2
            self._log_chance = self._open(0.0, _UNKNOWN_S)
        return stamp - self._offset

    def _is_fresh(self, stamp: float, image: FloatArray) -> bool:
        """Whether an image is another one than the last."""
        if self._image is not None and is_repeated_frame(stamp, image, self._stamp, self._image):
            return False
        self._image, self._stamp = image.copy(), stamp
        return True

    def _require_age(self, age: float, sigma: float) -> None:
        """Refuse a stamp that makes an image far too old, or one of the future."""
        slack = _AHEAD_S + _GATE * sigma
        if not -slack <= age <= self._timeout_s + slack:
            raise WorkFailed(
                f"the stamp of a {self._name} image makes it {age:.3g} s old: the clock that stamps "
                "it jumped, or images come that late"
            )

    def _require_motion(self, history: History) -> None:
        """Refuse an image that has frozen for too long while the joints moved."""
        now = history.last[0]
        here, then = self._seen(history, np.array([now, self._t]))
        if not float(np.nanmax(np.abs(here - then), initial=0.0)) > _STILL_PX:
            self._moved_at = math.nan
            return
        if math.isnan(self._moved_at):
            self._moved_at = now
        if now - self._moved_at > self._timeout_s:
            raise WorkFailed(
                f"the {self._name} image has stood still for {now - self._moved_at:.3g} s while the "
                "joints moved: look whether its camera still runs"
            )

    def _seen(self, history: History, t: FloatArray) -> FloatArray:
        """Predicted pixels (k, m, 2) of the view at instants (k,)."""
        return np.asarray(self._predicted(history.at(t))[:, self._view])

    def _misfit(self, image: FloatArray, t: FloatArray, history: History) -> FloatArray:
        """Mean squares (k,) by which an image differs from predictions at instants (k,), px²."""
        off = (image - self._seen(history, t)) ** 2
        detected = np.isfinite(off)
        square = np.where(detected, off, 0.0).sum(axis=(1, 2)) / np.maximum(detected.sum(axis=(1, 2)), 1)
        return np.where(detected.any(axis=(1, 2)), square, math.inf)

    def _searched(self, image: FloatArray, nominal: float, history: History) -> float:
        """Instant of a fresh image, s, among all; each delay has its chance."""
        assert self._log_chance is not None
        misfit = self._misfit(image, nominal - _DELAYS, history)
        minimum = max(float(misfit.min()), self.error_px**2)
        chance = np.exp(-0.5 * _COUNTED * np.maximum(misfit / minimum - 1.0, 0.0))
        before = self._blur @ np.exp(self._log_chance - self._log_chance.max())
        t = nominal - float(_DELAYS[np.argmax(chance * before)])
        self._log_chance += np.log(self._blur @ chance + _LEAST_CHANCE)
        weight = np.exp(self._log_chance - self._log_chance.max())
        self.mean = float(np.average(_DELAYS, weights=weight))
        self._variance = float(np.average((_DELAYS - self.mean) ** 2, weights=weight))
        if self._variance < _APART_S**2 / 4.0:
            self._log_chance = None
        shift, sigma = self._shift(image, t, history)
        self.sigma_shared = min(sigma, math.sqrt(self._variance))
        return t + float(np.clip(shift, -_APART_S, _APART_S))

    def _followed(self, image: FloatArray, nominal: float, history: History) -> float:
        """Instant of a fresh image, s, by the present delay and the image; follow the delay."""
        expected, variance = nominal - self.mean, self._variance + self._jitter**2
        shift, sigma = self._shift(image, expected, history)
        self.sigma_shared = math.sqrt(self._variance)
        if not math.isfinite(sigma):
            return expected
        if abs(shift) > max(_APART_S, _GATE * math.sqrt(variance + sigma**2)):
            self._stray(image, nominal, history)
            return expected
        self._strays = 0
        if self._follows:
            gain = self._variance / (variance + _ALIKE * sigma**2)
            self.mean -= gain * shift
            self._variance = (1.0 - gain) * self._variance + _DRIFT_S**2
        share = variance / (variance + sigma**2)
        # Errors of the model make images seem late, and are much the same from frame to frame.
        self.sigma_shared = math.hypot((1.0 - share) * self.sigma_shared, share * sigma)
        return expected + share * shift

    def _stray(self, image: FloatArray, nominal: float, history: History) -> None:
        """A frame that is far from its instant is another delay's, if it clearly fits that."""
        here, *others = self._misfit(image, nominal - np.append(self.mean, _DELAYS), history)
        self._strays += here > _CLEARLY * max(min(others), self.error_px**2)
        if self._follows and self._strays >= _STRAYS:
            self._strays, self._variance = 0, _UNKNOWN_S**2
            self._log_chance = self._open(self.mean, _UNKNOWN_S)

    def _shift(self, image: FloatArray, t: float, history: History) -> tuple[float, float]:
        """Return the time of an image after t, to first order, and its standard deviation, s.

        An image gives its instant only if it moved in the same direction before and after.
        """
        predicted = self._seen(history, t + _APART_S * np.array([-1.0, 0.0, 1.0]))
        detected = np.isfinite(image[:, 0]) & np.isfinite(predicted[..., 0]).all(axis=0)
        before, after = np.diff(predicted[:, detected], axis=0) / _APART_S
        square = float(np.mean(before * after)) if detected.any() else 0.0
        if not square > 0.0:
            return 0.0, math.inf
        off, speed = image[detected] - predicted[1, detected], 0.5 * (before + after)
        shift = float(np.sum(speed * off) / np.sum(speed**2))
        left = float(np.sqrt(np.mean((off - shift * speed) ** 2)))
        return shift, max(self.error_px, left) / math.sqrt(square)
