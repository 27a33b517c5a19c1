"""Tracker of an object that moves, by images of calibrated cameras: its displacement, and how that changes.

Extended Kalman filter on the group of displacements: a step takes T to T exp(ξ E), with generators E about
the middle of the object, so rates that stay as they are make a line, a circle or a screw. Accelerations are
white noise. Source: A. W. Long et al., "The banana distribution is Gaussian", RSS 2012; Y. Bar-Shalom et al.,
"Estimation with Applications to Tracking and Navigation", 2001, sections 6.2 and 11.

Errors of the shape and of the calibration are the same in all frames. They do not average out, so they are
no noise of the filter, but a part of its stated errors. The residuals that they leave in each image are
learnt, so that views agree, and one alone shows the object where it did with the others.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.special import chdtri

from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.geometry.displacements import generators
from projservo_cli.metric.frame import Metric, changes_of
from projservo_cli.records import MM, BoolArray, Calibration, FloatArray
from projservo_cli.task.objects.displaced_object import (
    ALIKE_PX,
    RIGID,
    CarriedGoal,
    Displaced,
    DisplacedObject,
)
from projservo_cli.task.objects.motion_kind import STILL, MotionKind
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView

# Time over which an acceleration lasts, s; radii of an object at which a point accelerates by its rotation
# as the object does itself: what turns it is mostly wider than it.
_LASTS_S, _LEVER = 0.1, 4.0
# Chances by which residuals of a view are of no motion; views disagree; a motion is not as predicted; its
# acceleration is beyond its limit.
_UNLIKE, _DISAGREE, _SUDDEN, _BEYOND = 1e-5, 1e-6, 1e-4, 1e-4
# Chance by which a view that was left out still has to be alike to be used again.
_ALIKE = 0.05
# Motion of the images, rms px, by which a step is linearized again, and errors are; maximum number of steps.
_LINEAR_PX, _ALIKE_WITHIN_PX, _STEPS = 2.0, 20.0, 6
# Time over which errors are seen to change with the place, s; frames by which their residuals are learnt, at
# a minimum, and a maximum.
_AHEAD_S, _LEARNT, _MEMORY = 0.5, 10, 25
# Time over which what came of a sudden change is held against the largest acceleration, s, and number of
# frames of the same views by which the motion is known first.
_JUDGED_S, _FIRST = 0.2, 10
# Frames by which the kind of a motion is found.
_LAST = 80
# Deviations of unknown displacements, in radii of the object and rad, and of its rates, in radii/s and rad/s.
_WIDE, _FAST, _TURNS = 10.0, 10.0, 1.0


class ObjectMotion(NamedTuple):
    """Displacement of an object at a time since it was taught, and its rates, with their errors.

    Twists are of g coordinates, 6 or 12: T exp(ξ E).
    """

    t: float  # s
    D: FloatArray  # (4, 4) in the calibrated frame
    E: FloatArray  # (g, 4, 4) generators about the middle of the object, in the calibrated frame as taught
    rates: FloatArray  # (g,) 1/s
    by_images: FloatArray  # (2 g, 2 g) covariance of displacement and rates by the images of the motion
    by_calibration: FloatArray  # (2 g, c) errors by shape, calibration and latency, which all frames share
    speed_mm_s: float  # of its middle; NaN without a known length
    speed_px_s: float  # rms of its markers in all views

    @property
    def _covariance(self) -> FloatArray:
        return np.asarray(self.by_images + self.by_calibration @ self.by_calibration.T)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (g, g) of the twist of the displacement."""
        return self._covariance[: len(self.E), : len(self.E)]

    @property
    def rates_covariance(self) -> FloatArray:
        """Covariance (g, g) of the rates, 1/s²."""
        return self._covariance[len(self.E) :, len(self.E) :]


class _State(NamedTuple):
    """State of the filter at a time."""

    t: float  # s; -inf before any images
    T: FloatArray  # (4, 4)
    rates: FloatArray  # (g,) 1/s
    P: FloatArray  # (2 g, 2 g) covariance of both


class _Shared(NamedTuple):
    """Errors that all frames share, at a time, a displacement (4, 4) and rates (g,)."""

    t: float  # s
    T: FloatArray
    rates: FloatArray
    weight: FloatArray  # (V, k) of the views there
    by_motion: FloatArray  # (V, k, 2, g) derivatives of the images
    covariance: FloatArray  # (V, 2 k, 2 k) of the images of a view, px²
    change: FloatArray  # (V, 2 k, 2 k) of how they change meanwhile, px²
    errors: FloatArray  # (2 g, c) of displacement and rates


class _Images(NamedTuple):
    """Images of views, less the residuals that were learnt."""

    s: FloatArray  # (V, k, 2) px
    weight: FloatArray  # (V, k) 1 over the deviation, px; 0 where unseen
    ago: FloatArray  # (V,) time since, s


class _Seen(NamedTuple):
    """Views of one time against a displacement: normal equations (V, g, g), (V, g) and χ²."""

    N: FloatArray
    b: FloatArray  # by the noise of images
    N_shared: FloatArray
    b_shared: FloatArray  # with the errors that frames share
    explained: FloatArray  # (V,) χ² of a motion of each
    unlike: FloatArray  # (V,) χ² of what no motion explains
    free: FloatArray  # (V,) degrees of freedom of it
    T: FloatArray  # (4, 4)
    r: FloatArray  # (V, 2 k) residuals over their deviation
    A: FloatArray  # (V, 2 k, g) derivatives of the images by motions, so too

    def by_itself(self, used: BoolArray) -> FloatArray:
        """Step (g,) to the motion that views (V,) show, whatever the prediction."""
        return np.asarray(np.linalg.lstsq(self.N[used].sum(axis=0), self.b[used].sum(axis=0))[0])

    def off(self, used: BoolArray, P: FloatArray) -> float:
        """χ² of views (V,) against a prediction of covariance (2 g, 2 g)."""
        return _off(self.N[used].sum(axis=0), self.b[used].sum(axis=0), P)

    def disagreement(self, used: BoolArray) -> tuple[float, int]:
        """χ² of views (V,) against a common motion, beyond a motion for each, and its degrees of freedom."""
        together = _explained(self.N_shared[used].sum(axis=0), self.b_shared[used].sum(axis=0))
        g = self.b.shape[1]
        free = int(np.minimum(self.free[used] + g, g).sum()) - g
        return float(self.explained[used].sum() - together), free


class ObjectTracker:
    """Tracker of an object whose shape and first place frames have shown.

    ``covered``: views that the last images left out, since they show no motion of the object, or another
    than the rest; ``pushed``: that it accelerated beyond its limit as all views agree; ``planned``: the
    object as its first frames showed it.
    """

    def __init__(
        self,
        found: DisplacedObject,
        view: Sequence[str],
        indices: Sequence[int],
        acceleration: float,
        max_acceleration: float,
        name: str,
    ) -> None:
        points, rig = found.markers(found.marker, 0), found.rig
        self.M = found.M  # (k, 4) its markers when taught, in the calibrated frame
        self.planned, self._indices = found, list(indices)  # of its markers among those of the images
        self._rig, self._view, self._unit_mm = rig, tuple(view), found.unit_mm
        self._of = Subject(markers=found.marker, name=name)
        self._X, self._X_by = points.X, (points.by_images, points.by_calibration)
        middle = points.X[:, :3].mean(axis=0)
        self._E = generators(rig.linear, middle)
        self._brackets = _brackets(self._E)
        self._radius = float(np.sqrt(np.square(points.X[:, :3] - middle).sum(axis=1).mean()))
        self._size = np.r_[np.full(3, self._radius), np.ones(len(self._E) - 3)]
        T, g = rig.G @ found.D @ np.linalg.inv(rig.G), len(self._E)
        self._fast = self._size * np.r_[np.full(3, _FAST), np.full(g - 3, _TURNS)]
        P = _by(_WIDE**2, 0.0, 0.0, self._size**2) + _by(0.0, 0.0, 1.0, self._fast**2)
        self._state = _State(-math.inf, T, np.zeros(g), P)
        self._alike, self._scatters = 0, False  # frames in a row by the same views
        self._earlier, self._before = -math.inf, list[tuple[float, _State]]()
        weight = np.full((len(view), len(points.X)), 1.0 / rig.sigma_px)
        self._learnt, self._count = np.zeros((*weight.shape, 2)), np.zeros(weight.shape, dtype=int)
        self._shared = self._shared_at(self._state, weight)
        self._px = float(np.sqrt(np.square(self._shared.by_motion[..., :3]).sum(axis=2).mean()))  # per unit
        per_unit = 1.0 / (self._px if math.isnan(found.unit_mm) else found.unit_mm)
        lever = np.r_[np.ones(3), np.full(g - 3, 1.0 / (_LEVER * self._radius))]
        self._acceleration, self._limit = acceleration * per_unit * lever, max_acceleration * per_unit * lever
        self._captured, self._seen_at = np.full(len(view), -math.inf), -math.inf
        self._left_out = np.zeros(len(view), dtype=bool)
        self._sigma_t = 0.0  # deviation of the times that images share, s
        self._last = _Images(
            np.full((*weight.shape, 2), math.nan), np.zeros(weight.shape), np.zeros(len(view))
        )
        self._history: deque[tuple[float, int, FloatArray, FloatArray]] = deque(maxlen=_LAST)
        self.covered: Finding | None = None
        self.pushed: Finding | None = None

    @classmethod
    def of(
        cls,
        c: Calibration,
        marker: Sequence[int],
        frames: Sequence[ObjectView],
        *,
        metric: Metric | None = None,
        acceleration: float,
        max_acceleration: float = math.inf,
        name: str = "",
    ) -> Self:
        """Return the tracker of an object of these frames.

        c, marker, frames, metric : as for ``DisplacedObject.of``, which it raises the errors of.
        acceleration, max_acceleration : rms and maximum, mm/s² with a metric, else px/s². The former of
            changes that last 0.1 s, so in 1 s the speed deviates by 0.3 s times it. Stops and the like are
            found as sudden changes, so it may be small.
        """
        found = DisplacedObject.of(c, marker, frames, metric)
        indices = [list(marker).index(number) for number in found.marker]
        return cls(found, c.view, indices, acceleration, max_acceleration, name)

    def observe(
        self, t: FloatArray, s: FloatArray, sigma: FloatArray | None = None, sigma_t: FloatArray | None = None
    ) -> None:
        """Take images of the views, each taken at another time.

        t : (V,) capture times, s; a view whose time is not later than before shows nothing new.
        s : (V, k, 2) px, NaN where unseen.
        sigma : (V, k) px; None, or NaN, is as calibrated, and then as residuals scatter.
        sigma_t : (V,) deviation of the times, s, of an error that all images share; None is 0.
        """
        self._scatters = sigma is None or not np.isfinite(sigma).any()
        now = ObjectView(s[:, self._indices], None if sigma is None else sigma[:, self._indices])
        bundle = self._rig.bundle([now], self._E)
        weight = bundle.weight[0] * ((t > self._captured) & np.isfinite(t))[:, None]
        fresh = (weight > 0.0).sum(axis=1) >= (RIGID if self._rig.rigid else RIGID + 1)
        if not fresh.any():
            return
        state = self._predicted(self._state, max(self._state.t, float(t[fresh].max())))
        self._refresh(state, weight)
        images = _Images(now.s - self._learnt, weight, np.where(fresh, state.t - t, 0.0))
        seen = self._seen(state.T, state.rates, *images)
        near = self._near(seen, fresh, state, images)
        used = self._agreeing(seen, near, fresh, state.P)
        self._compare(t, images, fresh, used)
        views = tuple(self._view[v] for v in np.flatnonzero(self._left_out))
        self.covered = Finding("covered_object", LIMITS, replace(self._of, views=views)) if views else None
        if not used.any():
            return
        self._sigma_t = 0.0 if sigma_t is None else float(np.sqrt(np.mean(sigma_t[used] ** 2)))
        if math.isinf(dt := state.t - self._state.t):
            state, seen = state._replace(T=near.T), near
        else:
            if seen.off(used, state.P) > chdtri(len(self._E), _SUDDEN):
                if self._alike >= _FIRST and math.isfinite(self._limit[0]):
                    self._before = self._before or [(self._earlier, self._state)]
                state = state._replace(P=state.P + self._sudden(dt))
            self._judge(state.t)
        if (updated := self._updated(state, seen, used, images)) is not None:
            self._earlier, self._state, self._seen_at = self._state.t, updated, state.t

    def at(self, t: float) -> ObjectMotion:
        """Return the motion at a time, s, from the last images on by rates that stay."""
        state, G = self._predicted(self._state, t), self._rig.G
        return ObjectMotion(
            t=t,
            D=np.linalg.solve(G, state.T) @ G,
            E=np.linalg.solve(G, self._E) @ G,
            rates=state.rates,
            by_images=state.P,
            by_calibration=self._shared_errors(t),
            speed_mm_s=self._unit_mm * float(np.linalg.norm(state.T[:3, :3] @ state.rates[:3])),
            speed_px_s=self._moved_px(state.rates),
        )

    def carry(self, goal: ObjectView | FloatArray, t: float) -> CarriedGoal:
        """Return a goal of the tool, taught with the object, at a time, s; as ``DisplacedObject.carry``."""
        state, g = self._predicted(self._state, t), len(self._E)
        N, c = (by.shape[-1] for by in self._X_by)
        by_shape, by_calibration, alike = np.split(self._shared_errors(t)[:g], [N, N + c], axis=1)
        values, vectors = np.linalg.eigh(state.P[:g, :g])
        by_images = np.hstack([vectors * np.sqrt(np.maximum(values, 0.0)), by_shape, alike])
        return self.planned.carry(goal, Displaced(state.T, np.eye(4), self._E, by_images, by_calibration))

    def unseen_s(self, t: float) -> float:
        """Time since enough markers were seen last, s."""
        return t - self._seen_at

    @property
    def kind(self) -> MotionKind:
        """Kind of the motion of the last frames that as many views showed as any; takes some 10 ms."""
        best = max((views for _, views, _, _ in self._history), default=0)
        frames = [one for one in self._history if one[1] == best]
        if len(frames) < _FIRST:
            return STILL
        t, _, T, N = (np.array(part) for part in zip(*frames, strict=True))
        ends = (self._shared_at(self._state._replace(T=end), self._shared.weight) for end in (T[0], T[-1]))
        first, last = (shared.errors[: len(self._E)] for shared in ends)
        return MotionKind.of(t, T, N.mean(axis=0), last - first, self._E).in_frame(self._rig.G)

    def _predicted(self, state: _State, t: float) -> _State:
        """State at a time, by rates that stay and accelerations by chance."""
        dt = t - state.t
        if not math.isfinite(dt):
            return state._replace(t=t)
        F = self._transition(state.rates, dt)
        noise = _by(abs(dt) ** 3 / 3.0, dt * dt / 2.0, abs(dt), self._acceleration**2 * _LASTS_S)
        return _State(t, self._stepped(state.T, dt * state.rates), state.rates, F @ state.P @ F.T + noise)

    def _transition(self, rates: FloatArray, dt: float) -> FloatArray:
        """Errors (2 g, 2 g) of displacement and rates after a time, s, by those before."""
        g, by, F = len(self._E), dt * (rates @ self._brackets), np.eye(2 * len(self._E))
        F[:g, :g] += 0.5 * by @ by - by
        F[:g, g:] = dt * (np.eye(g) - 0.5 * by)
        return F

    def _shared_errors(self, t: float) -> FloatArray:
        """Errors (2 g, c) at a time, s, that all frames share."""
        last, errors = self._shared, self._shared.errors
        if not math.isinf(last.t):
            errors = self._transition(last.rates, t - last.t) @ errors
        by_time = self._sigma_t * self._state.rates
        return np.column_stack([errors, np.concatenate([by_time, np.zeros(len(by_time))])])

    def _sudden(self, dt: float) -> FloatArray:
        """Covariance (2 g, 2 g) that the largest acceleration adds in a time, s."""
        if not math.isfinite(self._limit[0]):
            return _by(1.0, 0.0, 0.0, self._size**2) + _by(0.0, 0.0, 1.0, self._fast**2)
        return _by(dt**4 / 4.0, dt**3 / 2.0, dt**2, self._limit**2)

    def _stepped(self, T: FloatArray, xi: FloatArray) -> FloatArray:
        """Displacement (..., 4, 4) after a step (..., g)."""
        return np.asarray(T @ expm(np.tensordot(xi, self._E, 1)))

    def _seen(
        self,
        T: FloatArray,
        rates: FloatArray,
        s: FloatArray,
        weight: FloatArray,
        ago: FloatArray,
        uncertain: FloatArray | float = 0.0,
    ) -> _Seen:
        """Views against a displacement (4, 4) and rates, each as long before it as they were taken.

        uncertain : (g,) deviation of the rates.
        """
        V, g = len(s), len(self._E)
        bundle = self._rig.bundle([ObjectView(s)] * V, self._E)
        bundle = bundle._replace(weight=weight[None] * np.eye(V)[..., None])
        poses = self._stepped(T, -ago[:, None] * rates)[None]
        r, by_point = bundle.residuals(self._X[None], poses)
        each = np.arange(V)
        A = bundle.by_motion(by_point, self._X[None], poses)[0, each, each].reshape(V, -1, g)
        r = r.reshape(V, V, -1)[each, each]
        root = np.repeat(weight, 2, axis=1)
        new = np.repeat(self._count < _LEARNT, 2, axis=1)
        error = np.where(new[:, :, None] & new[:, None], self._shared.covariance, self._shared.change)
        slip = ago[:, None] * (A @ np.broadcast_to(uncertain, g))
        R = (
            root[:, :, None] * error * root[:, None]
            + slip[:, :, None] * slip[:, None]
            + np.eye(root.shape[1])
        )
        both = np.concatenate([r[..., None], A], axis=2)
        whole, shared = both.swapaxes(1, 2) @ both, both.swapaxes(1, 2) @ np.linalg.solve(R, both)
        N, b = shared[:, 1:, 1:], shared[:, 1:, 0]
        explained, free = _explained(N, b), (root > 0.0).sum(axis=1) - g
        unlike = shared[:, 0, 0] - explained
        return _Seen(whole[:, 1:, 1:], whole[:, 1:, 0], N, b, explained, unlike, free, T, r, A)

    def _near(self, seen: _Seen, fresh: BoolArray, state: _State, images: _Images) -> _Seen:
        """Views against the motion that they show together, if it is far from the prediction.

        Its rates are those of the motion to there, as uncertain as large.
        """
        dt, total = state.t - self._state.t, np.zeros(len(self._E))
        for _ in range(_STEPS):
            xi = seen.by_itself(fresh)
            xi = xi / max(1.0, float(np.abs(xi / self._size).max()))  # no more than its size at once
            if self._moved_px(xi) < _LINEAR_PX:
                break
            total = total + xi
            change = total / dt if dt > 0.0 else 0.0 * xi
            seen = self._seen(self._stepped(seen.T, xi), state.rates + change, *images, change)
        return seen

    def _moved_px(self, xi: FloatArray) -> float:
        """Motion of the images of all markers by a step (g,), rms px."""
        return float(np.sqrt(np.square(self._shared.by_motion @ xi).sum(axis=-1).mean()))

    def _agreeing(self, seen: _Seen, near: _Seen, fresh: BoolArray, P: FloatArray) -> BoolArray:
        """Views (V,) that show a motion of the object, the same, linearized there."""
        chance = np.where(self._left_out, _ALIKE, _UNLIKE)
        used = fresh & ~(near.unlike > chdtri(np.maximum(near.free, 1), chance))

        def disagree() -> bool:
            """Whether views contradict each other."""
            chance = _ALIKE if (used & self._left_out).any() else _DISAGREE
            square, free = near.disagreement(used)
            return free > 0 and square > float(chdtri(free, chance))

        while disagree():

            def without(view: int) -> float:
                """χ² of the other views, against each other and as predicted."""
                rest = used & (np.arange(len(used)) != view)
                return near.disagreement(rest)[0] + seen.off(rest, P)

            used[min(np.flatnonzero(used).tolist(), key=without)] = False
        return used

    def _compare(self, t: FloatArray, images: _Images, fresh: BoolArray, used: BoolArray) -> None:
        """Note which fresh views are used, and since when the same are; keep their last images."""
        returned = fresh & (t - self._captured > _JUDGED_S)
        same = np.array_equal(used[fresh], ~self._left_out[fresh]) and not returned.any()
        self._alike = self._alike + 1 if same else 0
        if not same:
            self._before.clear()
        self._captured[fresh], self._left_out[fresh] = t[fresh], ~used[fresh]
        self._last.s[fresh], self._last.weight[fresh] = images.s[fresh], images.weight[fresh]

    def _judge(self, t: float) -> None:
        """Hold what came of a sudden change against the largest acceleration, from before it on.

        By the last images of the same views all the while, two or more: errors that frames share drop out.
        """
        ago = t - self._captured
        used = (ago < _JUDGED_S) & ~self._left_out
        if not self._before or used.sum() < 2:
            return
        since, before = self._before[0]  # it may have begun with the frame before
        if t - before.t > _JUDGED_S:
            self._before.clear()
            return
        state = self._predicted(before, t)
        seen = self._seen(state.T, state.rates, *self._last._replace(ago=np.where(used, ago, 0.0)))
        N, g = seen.N[used].sum(axis=0), len(self._E)
        P = state.P[:g, :g]
        size = 0.5 * self._limit * (t - since) ** 2
        W = size[:, None] * (N - N @ P @ np.linalg.solve(np.eye(g) + N @ P, N)) * size
        y = seen.by_itself(used) / size
        if _beyond(W, y) > chdtri(g, _BEYOND):
            known = not math.isnan(self._unit_mm)
            per, unit = (self._unit_mm / MM, "m") if known else (self._px, "px")
            surest = W @ y / np.linalg.norm(W @ y)
            off, limit = (float(per * size[0] * one) for one in (y @ surest, 1.0))
            found = Finding("pushed_object", REFUSES, self._of, off, limit=limit, unit=unit)
            self.pushed = self.pushed or found

    def _updated(self, state: _State, seen: _Seen, used: BoolArray, images: _Images) -> _State | None:
        """State with the images of some views (V,), linearized again where a step is large.

        None if no step leads there, as where few markers leave the motion open.
        """
        g, step = len(self._E), np.zeros(2 * len(self._E))
        widest = _WIDE * np.concatenate([self._size, self._fast])
        by = [np.hstack([np.eye(g), -ago * np.eye(g)]) for ago in images.ago[used]]
        for _ in range(_STEPS):
            N = sum(M.T @ one @ M for M, one in zip(by, seen.N[used], strict=True))
            b = sum(M.T @ one for M, one in zip(by, seen.b[used], strict=True))
            gain = state.P @ np.linalg.inv(np.eye(2 * g) + N @ state.P)
            last, step = step, gain @ (b + N @ step)
            if not (np.abs(step) < widest).all():
                return None
            there, rates = self._stepped(state.T, step[:g]), state.rates + step[g:]
            if self._moved_px((step - last)[:g]) < _LINEAR_PX:
                break
            seen = self._seen(there, rates, *images)
        xi = seen.by_itself(used)
        raw = seen.r + (images.weight[..., None] * self._learnt).reshape(len(seen.r), -1)
        every, b = seen.N[used].sum(axis=0), np.einsum("vng,vn->g", seen.A[used], raw[used])
        alone = np.linalg.lstsq(every, b)[0]
        if len(self._history) >= _FIRST:  # else views of other times seem to disagree
            self._learn(seen.r - seen.A @ xi, used, images.weight)
        if np.abs(alone / self._size).max() < 1.0:  # else few markers leave the motion open
            self._history.append((state.t, int(used.sum()), self._stepped(seen.T, alone), every))
        return _State(state.t, there, rates, 0.5 * (gain + gain.T))

    def _learn(self, left: FloatArray, used: BoolArray, weight: FloatArray) -> None:
        """Learn what errors that frames share leave of images, and their noise, from residuals (V, 2 k).

        These are of no motion, so they take no part in one that the same views show.
        """
        detected = (weight > 0.0) & used[:, None]
        # Residuals of hidden markers are forgotten, since errors change with the place.
        self._count = np.clip(self._count + np.where(detected, 1, -1), 0, _MEMORY)
        share = detected / np.maximum(self._count, 1) / np.where(detected, weight, 1.0)
        self._learnt += share[..., None] * left.reshape(self._learnt.shape)
        if self._scatters and (free := 2 * int(detected.sum()) - len(self._E)) > 0:
            times = float(np.square(left[used]).sum()) / free
            sigma = self._rig.sigma_px * math.sqrt(1.0 + (times - 1.0) / _MEMORY)
            self._rig = self._rig._replace(sigma_px=max(sigma, ALIKE_PX))

    def _refresh(self, state: _State, weight: FloatArray) -> None:
        """Find again the errors that frames share, where it is elsewhere or faster, or more is seen."""
        last = self._shared
        weight = np.where(weight > 0.0, weight, np.where(self._count > 0, last.weight, 0.0))
        moved = np.sqrt(np.square(self._X @ (state.T - last.T).T).sum(axis=1).mean())
        ahead = _AHEAD_S + (0.0 if math.isinf(last.t) else state.t - last.t)
        faster = ahead * np.linalg.norm((state.rates - last.rates) * self._size)
        if max(moved, faster) * self._px > _ALIKE_WITHIN_PX or not np.array_equal(
            last.weight > 0.0, weight > 0.0
        ):
            self._shared = self._shared_at(state, weight)

    def _shared_at(self, state: _State, weight: FloatArray) -> _Shared:
        """Errors at a state that all frames share, of views of a weight (V, k)."""
        g, shape = len(self._E), (*weight.shape, 2)
        poses = np.stack([state.T, self._stepped(state.T, _AHEAD_S * state.rates)])
        points = self._X @ poses.swapaxes(1, 2)
        pixels = changes_of(self._rig.pixels(points.reshape(-1, 4)))
        pixels = np.moveaxis(pixels.reshape(-1, shape[0], 2, *shape[1:]), (0, 2), (4, 0))
        bundle = self._rig.bundle([ObjectView(np.zeros(shape), np.ones(weight.shape))] * 2, self._E)
        by_point = bundle.residuals(self._X[None], poses[None])[1]
        A = bundle.by_motion(by_point, self._X[None], poses[None])[0]
        B = by_point[0] @ poses[:, None, None, :, :3]
        by_images, by_calibration = (B @ by for by in self._X_by)
        pixel = ALIKE_PX * np.eye(math.prod(shape)).reshape(*shape, -1)
        own = np.broadcast_to(pixel, (2, *pixel.shape))
        K = np.concatenate([by_images, by_calibration + pixels, own], axis=-1)
        errors, root = [], np.repeat(weight.ravel(), 2)[:, None]
        for J, by in zip(A, K, strict=True):
            inverse = np.linalg.pinv(root * J.reshape(-1, g), rcond=1e-9)
            errors.append(-inverse @ (root * by.reshape(len(root), -1)))
        rate = (errors[1] - errors[0]) / _AHEAD_S + (state.rates @ self._brackets) @ errors[0]
        flat, change = (part.reshape(shape[0], -1, K.shape[-1]) for part in (K[0], K[1] - K[0]))
        covariance, change = (part @ part.swapaxes(1, 2) for part in (flat, change))
        change = change + ALIKE_PX**2 * np.eye(change.shape[1])
        both = np.concatenate([errors[0], rate])
        return _Shared(state.t, state.T, state.rates, weight, A[0], covariance, change, both)


def _beyond(W: FloatArray, y: FloatArray) -> float:
    """χ² of a motion (g,) with the inverse covariance W (g, g) against the likeliest of no more than 1."""
    values, vectors = np.linalg.eigh(W)
    values, along = np.maximum(values, 1e-12 * values[-1]), vectors.T @ y

    def over(mu: float) -> float:
        return float(np.linalg.norm(values * along / (values + mu))) - 1.0

    if over(0.0) <= 0.0:
        return 0.0
    # With the largest value times the motion as a multiplier, less than 1 of it is left.
    mu = brentq(over, 0.0, float(values[-1] * np.linalg.norm(along)))
    return float((values * np.square(along * mu / (values + mu))).sum())


def _by(place: float, both: float, rate: float, share: FloatArray) -> FloatArray:
    """Covariance (2 g, 2 g) of displacement and rates of a share (g,) of each coordinate."""
    blocks = np.array([[place, both], [both, rate]])[:, None, :, None] * np.diag(share)[:, None]
    return np.asarray(blocks.reshape(2 * len(share), -1))


def _brackets(E: FloatArray) -> FloatArray:
    """Brackets (g, g, g) of generators: [E_i, E_j] = Σ_k E_k c[i, k, j]."""
    products = np.einsum("iab,jbc->ijac", E, E)
    brackets = (products - products.swapaxes(0, 1)).reshape(len(E) ** 2, -1)
    found = np.linalg.lstsq(E.reshape(len(E), -1).T, brackets.T)[0]
    return np.asarray(found.reshape(len(E), len(E), len(E)).transpose(1, 0, 2))


def _explained(N: FloatArray, b: FloatArray) -> FloatArray:
    """χ² (…) that motions of normal equations (…, g, g), (…, g) explain."""
    values, vectors = np.linalg.eigh(N)
    along = (b[..., None, :] @ vectors)[..., 0, :]
    kept = values > 1e-10 * np.maximum(values[..., -1:], 1e-300)
    return np.asarray((along * along / np.where(kept, values, np.inf)).sum(axis=-1))


def _off(N: FloatArray, b: FloatArray, P: FloatArray) -> float:
    """χ² of a motion of normal equations (g, g), (g,) against a prediction of covariance (2 g, 2 g)."""
    g = len(b)
    prior = P[:g, :g]
    return float(_explained(N, b) - b @ prior @ np.linalg.solve(np.eye(g) + N @ prior, b))
