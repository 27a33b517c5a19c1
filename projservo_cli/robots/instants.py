"""When the images of a robot were taken by the clock of its joint readings, and where the joints were then.

The delay of a view is the instant of a joint reading less the middle of the exposure of the image that came
with it. Only this difference can be seen, so a constant offset is always estimated: of the stamp of a frame
where it has one, which may be of another clock or of its arrival, else of the reading itself.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from projservo_cli.records import BoolArray, FloatArray, WorkFailed

VIEWS = ("left", "right")
# Deviation of a delay of which nothing is known, s.
UNKNOWN_S = 0.3
# Deviation of a single frame where no calibration tells it: of arrival, and of stamps of the exposure, s.
_JITTER_S = 0.012
# Readings that are kept, and how far beyond the last one joints are taken to move on, s.
_KEPT = 256
_AHEAD_S = 0.1
# Images older than that are not reckoned with, s.
_OLDEST_S = 1.0
# Images are compared with those predicted so long before and after, and searched for in such steps, s.
_APART_S, _SEARCH_S = 0.02, 0.01
# A frame farther from its instant than so many deviations is none of this delay; nor are so many in a row.
_GATE, _STRAYS = 4.0, 3
# An instant fits this much better, in squares, before another one than expected is believed.
_CLEARLY = 9.0
# How fast a delay may change, s for each frame that tells it.
_DRIFT_S = 0.5e-3
# What the model is off at least where it tells the instant of a frame, px.
_MODEL_PX = 0.3
# Images should have moved so far, px, before one that stands still is a fault.
_STILL_PX = 5.0


class History:
    """Joint readings of the past; before the first one the robot was at rest."""

    def __init__(self) -> None:
        self._t: deque[float] = deque(maxlen=_KEPT)
        self._q: deque[FloatArray] = deque(maxlen=_KEPT)

    def __bool__(self) -> bool:
        return bool(self._t)

    def add(self, t: float, q: FloatArray) -> None:
        """Take in joints (n,), rad or m, of an instant, s; another reading of an instant replaces it."""
        if self._t and t == self._t[-1]:
            self._t.pop()
            self._q.pop()
        self._t.append(t)
        self._q.append(q.copy())

    @property
    def last(self) -> tuple[float, FloatArray]:
        """The last instant, s, and its joints (n,), rad or m."""
        return self._t[-1], self._q[-1]

    def at(self, t: FloatArray) -> FloatArray:
        """Joints (k, n) at instants (k,), s; those of a reading to the bit, a little beyond the last one."""
        times, q = np.array(self._t), np.array(self._q)
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
    """What is known of the delays of both views before the first image."""

    mean: FloatArray  # (2,) s
    sigma: FloatArray  # (2,) s, of the mean; 0 where it is given and not followed
    jitter: FloatArray  # (2,) s, deviation of single frames


NOTHING_KNOWN = DelayPrior(np.zeros(2), np.full(2, UNKNOWN_S), np.full(2, _JITTER_S))


class Frames(NamedTuple):
    """When the images of a look were taken."""

    t: FloatArray  # (2,) s, by the clock of the readings
    sigma: FloatArray  # (2,) s, how well that was known before the images were looked at
    fresh: BoolArray  # (2,) whether the image is another one than before


class Delays:
    """The delay of each view, followed by a Kalman filter, and the instants of frames.

    While the joints move, an image tells when it was taken: r = s − ŝ(t) = ṡ (t′ − t), to first order and
    after a search where little is known. The state is the mean delay; single frames stray from it by jitter.

    predicted : pixels (k, 2, m, 2) at joints (k, n).
    prior : of the delays; sigma_px : pixel noise; timeout_s : longest that an image may stand still, s.
    ``mean``: (2,) s, delays as followed.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
    Navigation", Wiley 2001, sections 5.2 (filter) and 6.? (gate).
    """

    def __init__(
        self,
        predicted: Callable[[FloatArray], FloatArray],
        prior: DelayPrior,
        sigma_px: float,
        timeout_s: float,
    ) -> None:
        self._predicted, self._prior, self._timeout_s = predicted, prior, timeout_s
        self._sigma_px = math.hypot(sigma_px, _MODEL_PX)
        self.mean, self._variance = prior.mean.copy(), prior.sigma**2
        self._strays = [0, 0]
        self._stamp = np.full(2, math.nan)
        self._offset = np.zeros(2)  # of the clocks that stamp frames
        self._images: list[FloatArray | None] = [None, None]
        self._t = np.full(2, -math.inf)  # when the last images were taken
        self._moved_at = np.full(2, math.nan)  # when joints began to leave them

    def look(self, t_view: FloatArray, images: FloatArray, history: History) -> Frames:
        """Instants of both images of a look.

        t_view : (2,) s, stamps, NaN where there are none; images : (2, m, 2) px, NaN where unseen.
        history : of the readings, that of this look the last.
        Raises WorkFailed if the clock of a camera jumped, or its image stands still while the joints move.
        """
        sigma = np.sqrt(self._variance + self._prior.jitter**2)
        fresh = np.zeros(2, dtype=np.bool_)
        t = np.empty(2)
        for view in range(2):
            nominal = self._nominal(view, float(t_view[view]), history.last[0])
            t[view] = nominal - self.mean[view]
            if not np.isfinite(images[view]).any():
                continue
            fresh[view] = self._is_fresh(view, float(t_view[view]), images[view])
            if not fresh[view]:
                t[view] = self._t[view]
                self._require_motion(view, history)
                continue
            self._require_age(view, history.last[0] - t[view], float(sigma[view]))
            self._t[view] = t[view] = self._followed(view, images[view], nominal, float(sigma[view]), history)
            self._moved_at[view] = math.nan
        return Frames(t, sigma, fresh)

    def _nominal(self, view: int, stamp: float, t_q: float) -> float:
        """The instant, s, that a delay is the offset of: of the stamp, else of the reading."""
        if math.isnan(stamp):
            return t_q
        if math.isnan(self._stamp[view]):  # clocks that have nothing in common start together
            age = t_q - stamp + self.mean[view]
            apart = not -_AHEAD_S <= age <= self._timeout_s
            self._offset[view] = stamp - t_q if apart else 0.0
        return stamp - float(self._offset[view])

    def _is_fresh(self, view: int, stamp: float, image: FloatArray) -> bool:
        """Whether an image is another one than the last."""
        last, before = self._images[view], float(self._stamp[view])
        if last is not None and (stamp == before or np.array_equal(image, last, equal_nan=True)):
            return False
        self._images[view], self._stamp[view] = image.copy(), stamp
        return True

    def _require_age(self, view: int, age: float, sigma: float) -> None:
        """Refuse a stamp that makes an image far too old, or one of the future."""
        slack = _AHEAD_S + _GATE * sigma
        if not -slack <= age <= self._timeout_s + slack:
            raise WorkFailed(
                f"the stamp of a {VIEWS[view]} image makes it {age:.3g} s old: the clock that stamps it "
                "jumped, or images come that late"
            )

    def _require_motion(self, view: int, history: History) -> None:
        """Refuse an image that has stood still for too long while the joints moved."""
        now = history.last[0]
        here, then = self._predicted(history.at(np.array([now, self._t[view]])))[:, view]
        if not float(np.nanmax(np.abs(here - then), initial=0.0)) > _STILL_PX:
            self._moved_at[view] = math.nan
            return
        if math.isnan(self._moved_at[view]):
            self._moved_at[view] = now
        if now - self._moved_at[view] > self._timeout_s:
            raise WorkFailed(
                f"the {VIEWS[view]} image has stood still for {now - self._moved_at[view]:.3g} s while the "
                "joints moved: look whether its camera still runs"
            )

    def _followed(
        self, view: int, image: FloatArray, nominal: float, sigma: float, history: History
    ) -> float:
        """Instant of a fresh image, s, by what was known and what it shows; the delay is followed."""
        expected = nominal - float(self.mean[view])
        t, sigma_seen = self._told(view, image, expected, sigma, history)
        if not math.isfinite(sigma_seen):
            return expected
        gap, total = t - expected, sigma**2 + sigma_seen**2
        follows = self._prior.sigma[view] > 0.0
        if gap**2 > _GATE**2 * total:
            self._strays[view] += sigma_seen < float(self._prior.jitter[view])
            if follows and self._strays[view] >= _STRAYS:
                self._variance[view] = UNKNOWN_S**2
            return expected
        self._strays[view] = 0
        if follows:
            variance = float(self._variance[view])
            gain = variance / (variance + float(self._prior.jitter[view]) ** 2 + sigma_seen**2)
            self.mean[view] -= gain * gap
            self._variance[view] = (1.0 - gain) * variance + _DRIFT_S**2
        return expected + sigma**2 / total * gap

    def _told(
        self, view: int, image: FloatArray, expected: float, sigma: float, history: History
    ) -> tuple[float, float]:
        """When an image was taken by what it shows, and the deviation of that, s; infinite for none."""
        shift, sigma_seen = self._shift(view, image, expected, history)
        if sigma <= _APART_S and abs(shift) <= _APART_S:
            return expected + shift, sigma_seen
        now, known = history.last[0], max(sigma, UNKNOWN_S)
        t = np.arange(now - _OLDEST_S, now + _AHEAD_S, _SEARCH_S)
        off = np.nanmean((image - self._predicted(history.at(t))[:, view]) ** 2, axis=(1, 2))
        least = max(float(off.min()), self._sigma_px**2)
        nearest = float(t[np.argmin(off / least + ((t - expected) / known) ** 2)])
        if sigma <= _APART_S and not np.interp(expected, t, off) > _CLEARLY * least:
            return expected, math.inf  # the model is off, not the instant
        shift, sigma_seen = self._shift(view, image, nearest, history)
        return nearest + float(np.clip(shift, -_APART_S, _APART_S)), sigma_seen

    def _shift(self, view: int, image: FloatArray, t: float, history: History) -> tuple[float, float]:
        """How much later than t an image was taken, to first order, and the deviation of that, s.

        An image tells its instant only where the joints moved both before and after it. Markers err alike, so
        they count as one.
        """
        predicted = self._predicted(history.at(t + _APART_S * np.array([-1.0, 0.0, 1.0])))[:, view]
        known = np.isfinite(image[:, 0]) & np.isfinite(predicted[..., 0]).all(axis=0)
        before, after = np.diff(predicted[:, known], axis=0) / _APART_S
        least = min(float(np.mean(before**2)), float(np.mean(after**2))) if known.any() else 0.0
        if least == 0.0:
            return 0.0, math.inf
        off, speed = image[known] - predicted[1, known], 0.5 * (before + after)
        shift = float(np.sum(speed * off) / max(np.sum(speed**2), least))
        left = float(np.sqrt(np.mean((off - shift * speed) ** 2)))
        return shift, max(self._sigma_px, left) / math.sqrt(least)
