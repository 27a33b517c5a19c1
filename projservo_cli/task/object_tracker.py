"""Tracker of an object that moves, by images of calibrated cameras: its displacement, and how that changes.

Extended Kalman filter on the group of displacements: a step takes T to T exp(ξ E), with generators E about
the middle of the object, so rates that stay as they are make a line, a circle or a screw. Accelerations are
white noise. Source: A. W. Long et al., "The banana distribution is Gaussian", RSS 2012; Y. Bar-Shalom et al.,
"Estimation with Applications to Tracking and Navigation", 2001, sections 6.2 and 11.

Errors of the shape and of the calibration are the same in all frames. They do not average out, so they are
no noise of the filter, but a part of what it states.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import eigh, expm
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.geometry.displacements import generators
from projservo_cli.metric.frame import Metric, changes_of
from projservo_cli.records import MM, BoolArray, Calibration, FloatArray
from projservo_cli.task.displaced_object import ALIKE_PX, DisplacedObject
from projservo_cli.task.object_bundle_adjustment import ObjectView, ObjectViewRig

# Time over which an acceleration lasts, s; radii of an object at which a point accelerates by its rotation
# as the object does itself: what turns it is mostly wider than it.
_LASTS_S, _LEVER = 0.1, 4.0
# Chances by which residuals of a view are of no motion; views disagree; a motion is not as predicted; its
# acceleration is beyond its limit.
_UNLIKE, _DISAGREE, _SUDDEN, _BEYOND = 1e-5, 1e-6, 1e-4, 1e-7
# Chance by which a view that was left out still has to be alike to be used again.
_ALIKE = 0.05
# Motion of the images, rms px, by which a step is linearized again, and errors are; most steps.
_LINEAR_PX, _ALIKE_WITHIN_PX, _STEPS = 2.0, 20.0, 6
# Time over which errors are seen to change with the place, s.
_AHEAD_S = 0.1
# Frames by which the kind of a motion is told, and degree of it over time.
_LAST, _DEGREE = 80, 3
# Unknown displacements and rates at the start, radii and rad of the object, and per s.
_WIDE = 10.0


class MotionKind(NamedTuple):
    """Kind of a motion."""

    name: str  # still, belt (a direction), turntable (an axis), free
    operator: (
        FloatArray | None
    )  # (4, 4) of its direction, per unit, or axis, per rad, in the calibrated frame


class ObjectMotion(NamedTuple):
    """Displacement of an object at a time since it was taught, and its rates, with their errors.

    Twists are of g coordinates, 6 or 12: T exp(ξ E).
    """

    t: float  # s
    D: FloatArray  # (4, 4) in the calibrated frame
    E: FloatArray  # (g, 4, 4) generators about the middle of the object, in the calibrated frame as taught
    rates: FloatArray  # (g,) 1/s
    by_images: FloatArray  # (2 g, 2 g) covariance of displacement and rates by the images of the motion
    by_calibration: FloatArray  # (2 g, c) errors by shape and calibration, which all frames share
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


class _Shared(NamedTuple):
    """Errors that all frames share, at a displacement T (4, 4)."""

    T: FloatArray
    weight: FloatArray  # (V, k) of the views there
    by_motion: FloatArray  # (V, k, 2, g) derivatives of the images
    covariance: FloatArray  # (V, 2 k, 2 k) of the images of a view, px²
    errors: FloatArray  # (2 g, c) of displacement and rates


class _Seen(NamedTuple):
    """Views of one time against a displacement: normal equations (V, g, g), (V, g) and squares (V,)."""

    N: FloatArray
    b: FloatArray  # by the noise of images
    N_shared: FloatArray
    b_shared: FloatArray  # with the errors that frames share
    unlike: FloatArray  # (V,) χ² of what no motion explains
    free: FloatArray  # (V,) degrees of freedom of it
    T: FloatArray  # (4, 4)

    def disagreement(self, used: BoolArray) -> float:
        """χ² of views (V,) against a common motion, beyond a motion for each."""
        N, b = self.N_shared[used], self.b_shared[used]
        each = sum(float(_explained(*one)) for one in zip(N, b, strict=True))
        return each - _explained(N.sum(axis=0), b.sum(axis=0))


class ObjectTracker:
    """Tracker of an object whose shape and first place looks have shown.

    ``covered``: views that the last images left out, since they show no motion of the object, or another
    than the rest; ``pushed``: that it accelerated beyond its limit as all views agree.
    """

    def __init__(
        self,
        found: DisplacedObject,
        view: Sequence[str],
        places: Sequence[int],
        acceleration: float,
        max_acceleration: float,
        name: str,
    ) -> None:
        points, rig = found.markers(found.marker, 0), found.rig
        self._places = list(places)  # of its markers among those of the images
        self._rig, self._view, self._unit_mm = rig, tuple(view), found.unit_mm
        self._of = Subject(markers=found.marker, name=name)
        self._X, self._X_by = points.X, (points.by_images, points.by_calibration)
        middle = points.X[:, :3].mean(axis=0)
        self._E = generators(rig.linear, middle)
        self._brackets = _brackets(self._E)
        self._radius = float(np.sqrt(np.square(points.X[:, :3] - middle).sum(axis=1).mean()))
        self._size = np.r_[np.full(3, self._radius), np.ones(len(self._E) - 3)]
        T, g = rig.G @ found.D @ np.linalg.inv(rig.G), len(self._E)
        self._T, self._rates, self._t = T, np.zeros(g), -math.inf
        self._P = np.diag(np.square(_WIDE * np.tile(self._size, 2)))
        weight = np.full((len(view), len(points.X)), 1.0 / rig.sigma_px)
        self._shared = self._shared_at(T, weight)
        per_unit = 1.0 / found.unit_mm
        if math.isnan(per_unit):  # px
            per_unit = 1.0 / float(np.sqrt(np.square(self._shared.by_motion[..., :3]).sum(axis=2).mean()))
        lever = np.r_[np.ones(3), np.full(g - 3, 1.0 / (_LEVER * self._radius))]
        self._acceleration, self._most = acceleration * per_unit * lever, max_acceleration * per_unit * lever
        self._captured, self._taken = np.full(len(view), -math.inf), deque([-math.inf] * 2, maxlen=2)
        self._used = self._left_out = np.zeros(len(view), dtype=bool)
        self._history: deque[tuple[float, int, FloatArray, FloatArray]] = deque(maxlen=_LAST)
        self.covered: Finding | None = None
        self.pushed: Finding | None = None

    @classmethod
    def of(
        cls,
        c: Calibration,
        marker: Sequence[int],
        looks: Sequence[ObjectView],
        *,
        metric: Metric | None = None,
        acceleration: float,
        max_acceleration: float = math.inf,
        name: str = "",
    ) -> Self:
        """Return the tracker of an object of these looks.

        c, marker, looks, metric : as for ``DisplacedObject.of``, which it raises the errors of.
        acceleration, max_acceleration : rms and at most, mm/s² with a metric, else px/s².
        """
        found = DisplacedObject.of(c, marker, looks, metric)
        places = [list(marker).index(number) for number in found.marker]
        return cls(found, c.view, places, acceleration, max_acceleration, name)

    def observe(self, t: FloatArray, s: FloatArray, sigma: FloatArray | None = None) -> None:
        """Take images of the views, each of its own time.

        t : (V,) capture times, s; a view whose time is not later than before shows nothing new.
        s : (V, k, 2) px, NaN where unseen; sigma : (V, k) px, NaN or None as calibrated.
        """
        now = ObjectView(s[:, self._places], None if sigma is None else sigma[:, self._places])
        bundle = self._rig.bundle([now], self._E)
        weight = bundle.weight[0] * ((t > self._captured) & np.isfinite(t))[:, None]
        fresh = weight.any(axis=1)
        if not fresh.any():
            return
        at = max(self._t, float(t[fresh].max()))
        ago = np.where(fresh, at - t, 0.0)
        T, P, dt = self._predicted(at)
        self._refresh(T, weight)
        images = (now.s, weight, ago)
        seen = self._seen(T, self._rates, *images)
        used = self._agreeing(seen, fresh, P)
        self._captured[fresh] = t[fresh]
        self._left_out = (self._left_out & ~fresh) | (fresh & ~used)
        self.covered = self._covered()
        if not used.any():
            return
        if math.isfinite(dt) and _off(seen.N[used].sum(axis=0), seen.b[used].sum(axis=0), P) > chdtri(
            len(self._E), _SUDDEN
        ):
            self._judge(seen, used, P, at)
            P = P + self._sudden(dt)
        self._update(T, P, seen, used, images)
        self._t, self._used = at, used
        if (weight[used] > 0.0).any(axis=0).sum() >= _least(self._rig):
            self._taken.append(at)

    def at(self, t: float) -> ObjectMotion:
        """Return the motion at a time, s, from the last images on by rates that stay."""
        T, P, _ = self._predicted(t)
        G, by_motion = self._rig.G, self._shared.by_motion
        v = self._rates[:3]
        return ObjectMotion(
            t=t,
            D=np.linalg.solve(G, T) @ G,
            E=np.linalg.solve(G, self._E) @ G,
            rates=self._rates.copy(),
            by_images=P,
            by_calibration=self._shared.errors,
            speed_mm_s=self._unit_mm * float(np.linalg.norm(T[:3, :3] @ v)),
            speed_px_s=float(np.sqrt(np.square(by_motion @ self._rates).sum(axis=-1).mean())),
        )

    def unseen_s(self, t: float) -> float:
        """Time since enough markers were seen last, s."""
        return t - self._taken[-1]

    @property
    def kind(self) -> MotionKind:
        """Kind of the motion of the last frames, the likeliest by Schwarz's criterion."""
        most = max((views for _, views, _, _ in self._history), default=0)
        frames = [one for one in self._history if one[1] == most]
        if len(frames) < 2 * (_DEGREE + 1):
            return MotionKind("still", None)
        times, _, T, N = (np.array(part) for part in zip(*frames, strict=True))
        G, middle = self._rig.G, T[len(T) // 2]
        z = self._coordinates(np.asarray(np.linalg.solve(middle, T)))
        ends = [self._shared_at(place, self._shared.weight).errors[: len(self._E)] for place in (T[0], T[-1])]
        change = (ends[1] - ends[0]) * math.sqrt(len(T) / 12.0)
        W = np.linalg.inv(np.linalg.inv(N.mean(axis=0)) + change @ change.T)
        name, twist = _kind(times, z, np.asarray(W), self._E)
        if twist is None:
            return MotionKind(name, None)
        there = middle @ np.tensordot(twist, self._E, 1) @ np.linalg.inv(middle)
        return MotionKind(name, np.linalg.solve(G, there) @ G)

    def _predicted(self, t: float) -> tuple[FloatArray, FloatArray, float]:
        """Displacement (4, 4) and covariance (2 g, 2 g) at a time, and the time since the last images."""
        dt = t - self._t
        if not math.isfinite(dt):
            return self._T, self._P, dt
        g = len(self._E)
        turned = np.eye(g) - dt * (by := self._rates @ self._brackets) + 0.5 * dt * dt * (by @ by)
        F = np.block([[turned, dt * np.eye(g) - 0.5 * dt * dt * by], [np.zeros((g, g)), np.eye(g)]])
        share = np.array([[abs(dt) ** 3 / 3.0, dt * dt / 2.0], [dt * dt / 2.0, abs(dt)]])
        noise = np.kron(share, np.diag(self._acceleration**2 * _LASTS_S))
        return self._stepped(self._T, dt * self._rates), F @ self._P @ F.T + noise, dt

    def _sudden(self, dt: float) -> FloatArray:
        """Covariance (2 g, 2 g) that the largest acceleration adds in a time, s."""
        if not math.isfinite(self._most[0]):
            return np.diag(np.square(np.tile(self._size, 2)) * np.repeat([1.0, _WIDE**2], len(self._E)))
        share = np.array([[dt**4 / 4.0, dt**3 / 2.0], [dt**3 / 2.0, dt**2]])
        return np.kron(share, np.diag(self._most**2))

    def _stepped(self, T: FloatArray, xi: FloatArray) -> FloatArray:
        """Displacement (4, 4) after a step (g,)."""
        return np.asarray(T @ expm(np.tensordot(xi, self._E, 1)))

    def _seen(
        self, T: FloatArray, rates: FloatArray, s: FloatArray, weight: FloatArray, ago: FloatArray
    ) -> _Seen:
        """Views against a displacement (4, 4), each as long before it as they were taken."""
        V, g = len(s), len(self._E)
        bundle = self._rig.bundle([ObjectView(s)] * V, self._E)
        bundle = bundle._replace(weight=weight[None] * np.eye(V)[..., None])
        places = np.array([self._stepped(T, -one * rates) for one in ago])[None]
        r, by_point = bundle.residuals(self._X[None], places)
        each = np.arange(V)
        A = bundle.by_motion(by_point, self._X[None], places)[0, each, each].reshape(V, -1, g)
        r = r.reshape(V, V, -1)[each, each]
        root = np.repeat(weight, 2, axis=1)
        R = root[:, :, None] * self._shared.covariance * root[:, None] + np.eye(root.shape[1])
        both = np.concatenate([r[..., None], A], axis=2)
        whole, shared = both.swapaxes(1, 2) @ both, both.swapaxes(1, 2) @ np.linalg.solve(R, both)
        N, b = shared[:, 1:, 1:], shared[:, 1:, 0]
        unlike = [shared[v, 0, 0] - _explained(N[v], b[v]) for v in each]
        free = (root > 0.0).sum(axis=1) - g
        return _Seen(whole[:, 1:, 1:], whole[:, 1:, 0], N, b, np.array(unlike), free, T)

    def _agreeing(self, seen: _Seen, fresh: BoolArray, P: FloatArray) -> BoolArray:
        """Views (V,) that show a motion of the object, the same."""
        g = len(self._E)
        chance = np.where(self._left_out, _ALIKE, _UNLIKE)
        used = fresh & ~(seen.unlike > chdtri(np.maximum(seen.free, 1), chance))

        def disagree() -> bool:
            """Whether views contradict each other."""
            chance = _ALIKE if (used & self._left_out).any() else _DISAGREE
            several = bool(used.sum() > 1)
            return several and seen.disagreement(used) > chdtri(g * (used.sum() - 1), chance)

        while disagree():

            def without(view: int) -> float:
                """χ² of the other views, against each other and as predicted."""
                rest = used & (np.arange(len(used)) != view)
                return seen.disagreement(rest) + _off(
                    seen.N_shared[rest].sum(axis=0), seen.b_shared[rest].sum(axis=0), P
                )

            used[min(np.flatnonzero(used).tolist(), key=without)] = False
        return used

    def _covered(self) -> Finding | None:
        """The finding of views that were left out; None without any."""
        views = tuple(self._view[v] for v in np.flatnonzero(self._left_out))
        of = Subject(views=views, markers=self._of.markers, name=self._of.name)
        return Finding("covered_object", LIMITS, of) if views else None

    def _judge(self, seen: _Seen, used: BoolArray, P: FloatArray, at: float) -> None:
        """Hold a sudden motion, by two views or more that saw it before, against the largest acceleration."""
        if used.sum() < 2 or not np.array_equal(used, self._used) or not math.isfinite(self._taken[0]):
            return
        g = len(self._E)
        N, b = seen.N_shared[used].sum(axis=0), seen.b_shared[used].sum(axis=0)
        xi = np.linalg.lstsq(N, b)[0]
        scale = self._most[:3].mean() / self._most
        off = max(float(np.linalg.norm(part)) for part in np.split(scale * xi, [3]))
        most = 0.5 * float(self._most[0]) * (at - self._taken[0]) ** 2
        if off > most and (1.0 - most / off) ** 2 * _off(N, b, P) > chdtri(g, _BEYOND):
            known = not math.isnan(self._unit_mm)
            px = float(np.sqrt(np.square(self._shared.by_motion[..., :3]).sum(axis=2).mean()))
            per, unit = (self._unit_mm / MM, "m") if known else (px, "px")
            self.pushed = self.pushed or Finding(
                "pushed_object", REFUSES, self._of, per * off, limit=per * most, unit=unit
            )

    def _update(
        self,
        T: FloatArray,
        P: FloatArray,
        seen: _Seen,
        used: BoolArray,
        images: tuple[FloatArray, FloatArray, FloatArray],
    ) -> None:
        """Take images of some views (V,) at a displacement (4, 4), linearized again where a step is large."""
        g, ago = len(self._E), images[2]
        before, step = self._rates, np.zeros(2 * g)
        for _ in range(_STEPS):
            by = [np.hstack([np.eye(g), -ago[v] * np.eye(g)]) for v in np.flatnonzero(used)]
            N = sum(M.T @ one @ M for M, one in zip(by, seen.N[used], strict=True))
            b = sum(M.T @ one for M, one in zip(by, seen.b[used], strict=True))
            gain = P @ np.linalg.inv(np.eye(2 * g) + N @ P)
            last, step = step, gain @ (b + N @ step)
            there = self._stepped(T, step[:g])
            rates = before + step[g:]
            moved = self._shared.by_motion @ (step - last)[:g]
            if np.sqrt(np.square(moved).sum(axis=-1).mean()) < _LINEAR_PX:
                break
            seen = self._seen(there, rates, *images)
        self._T, self._rates, self._P = there, rates, 0.5 * (gain + gain.T)
        N_all = seen.N[used].sum(axis=0)
        if np.linalg.matrix_rank(N_all, hermitian=True) == g:
            measured = self._stepped(seen.T, np.linalg.solve(N_all, seen.b[used].sum(axis=0)))
            self._history.append((self._t, int(used.sum()), measured, N_all))

    def _refresh(self, T: FloatArray, weight: FloatArray) -> None:
        """Find the errors that frames share anew, where the object is elsewhere or seen by other views."""
        last = self._shared
        xi = self._coordinates(np.asarray(np.linalg.solve(last.T, T))[None])[0]
        moved = np.sqrt(np.square(last.by_motion @ xi).sum(axis=-1).mean())
        if moved > _ALIKE_WITHIN_PX or not np.array_equal(last.weight > 0.0, weight > 0.0):
            self._shared = self._shared_at(T, weight)

    def _shared_at(self, T: FloatArray, weight: FloatArray) -> _Shared:
        """Errors at a displacement (4, 4) that all frames share, of views of a weight (V, k)."""
        g, shape = len(self._E), (*weight.shape, 2)
        places = np.stack([T, self._stepped(T, _AHEAD_S * self._rates)])
        points = self._X @ places.swapaxes(1, 2)
        pixels = changes_of(self._rig.pixels(points.reshape(-1, 4)))
        pixels = np.moveaxis(pixels.reshape(-1, shape[0], 2, *shape[1:]), (0, 2), (4, 0))
        bundle = self._rig.bundle([ObjectView(np.zeros(shape), np.ones(weight.shape))] * 2, self._E)
        by_point = bundle.residuals(self._X[None], places[None])[1]
        A = bundle.by_motion(by_point, self._X[None], places[None])[0]
        B = by_point[0] @ places[:, None, None, :, :3]
        by_images, by_calibration = (np.einsum("lvkdi,kic->lvkdc", B, by, optimize=True) for by in self._X_by)
        pixel = ALIKE_PX * np.eye(math.prod(shape)).reshape(*shape, -1)
        own = np.broadcast_to(pixel, (2, *pixel.shape))
        K = np.concatenate([by_images, by_calibration + pixels, own], axis=-1)
        errors, root = [], np.repeat(weight.ravel(), 2)[:, None]
        for J, by in zip(A, K, strict=True):
            inverse = np.linalg.pinv(root * J.reshape(-1, g), rcond=1e-9)
            errors.append(-inverse @ (root * by.reshape(len(root), -1)))
        rate = (errors[1] - errors[0]) / _AHEAD_S + (self._rates @ self._brackets) @ errors[0]
        flat = K[0].reshape(shape[0], -1, K.shape[-1])
        return _Shared(T, weight, A[0], flat @ flat.swapaxes(1, 2), np.concatenate([errors[0], rate]))

    def _coordinates(self, T: FloatArray) -> FloatArray:
        """Coordinates (L, g) of displacements (L, 4, 4): logarithms."""
        if self._rig.rigid:
            w = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
            middle = self._X[:, :3].mean(axis=0)
            return np.hstack([_straight(w, (T[:, :3, :3] @ middle + T[:, :3, 3]) - middle), w])
        X = T - np.eye(4)
        log = X - X @ X / 2.0 + X @ X @ X / 3.0 - X @ X @ X @ X / 4.0
        by = self._E.reshape(len(self._E), -1).T
        return np.asarray(np.linalg.lstsq(by, log.reshape(len(T), -1).T)[0].T)


def _straight(w: FloatArray, t: FloatArray) -> FloatArray:
    """Velocities (L, 3) that with rotation vectors (L, 3) take a point by (L, 3) within a unit of time."""
    angle = np.linalg.norm(w, axis=1)[:, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    third = np.where(small, 1.0 / 12.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    turn = np.cross(w, t)
    return np.asarray(t - 0.5 * turn + third * np.cross(w, turn))


def _least(rig: ObjectViewRig) -> int:
    """Number of markers that a displacement needs."""
    return 3 if rig.rigid else 4


def _brackets(E: FloatArray) -> FloatArray:
    """Brackets (g, g, g) of generators: [E_i, E_j] = Σ_k E_k c[i, k, j]."""
    products = np.einsum("iab,jbc->ijac", E, E)
    brackets = (products - products.swapaxes(0, 1)).reshape(len(E) ** 2, -1)
    found = np.linalg.lstsq(E.reshape(len(E), -1).T, brackets.T)[0]
    return np.asarray(found.reshape(len(E), len(E), len(E)).transpose(1, 0, 2))


def _explained(N: FloatArray, b: FloatArray) -> float:
    """χ² that a motion of normal equations (g, g), (g,) explains."""
    values, vectors = np.linalg.eigh(N)
    kept = values > 1e-10 * max(values[-1], 1e-300)
    along = vectors[:, kept].T @ b
    return float((along * along / values[kept]).sum())


def _off(N: FloatArray, b: FloatArray, P: FloatArray) -> float:
    """χ² of a motion of normal equations (g, g), (g,) against a prediction of covariance (2 g, 2 g)."""
    g = len(b)
    prior = P[:g, :g]
    return _explained(N, b) - float(b @ prior @ np.linalg.solve(np.eye(g) + N @ prior, b))


def _kind(t: FloatArray, z: FloatArray, W: FloatArray, E: FloatArray) -> tuple[str, FloatArray | None]:
    """Likeliest kind of motion, and its twist (g,) of unit length or angle.

    t : (n,) times; z : (n, g) coordinates, of weight W (g, g) each; E : (g, 4, 4) generators.
    """
    n, g = z.shape
    basis = np.linalg.qr(np.vander((t - t.mean()) / max(np.ptp(t), 1e-9), _DEGREE + 1, increasing=True))[0]
    Z = basis[:, 1:].T @ z
    M = Z.T @ Z
    L = np.linalg.cholesky(W)
    free = float(np.trace(L.T @ M @ L))
    along, directions = np.linalg.eigh(L.T @ M @ L)
    screw = np.linalg.solve(L.T, directions[:, -1])
    MW = W @ M @ W
    straight, lines = eigh(MW[:3, :3], W[:3, :3])
    belt = np.r_[lines[:, -1], np.zeros(g - 3)]
    wald, axis = _turntable(screw, along[-1], W, E)
    each = math.log(n * g)
    turns = g - 2 if g == 6 else g - 4
    costs = {
        "still": free,
        "belt": free - straight[-1] + each * (2 + _DEGREE),
        "turntable": free - along[-1] + wald + each * (turns + _DEGREE),
        "free": each * g * _DEGREE,
    }
    name = min(costs, key=lambda one: costs[one])
    if name == "belt":
        return name, belt / np.linalg.norm(belt)
    return name, axis if name == "turntable" else None


def _turntable(screw: FloatArray, square: float, W: FloatArray, E: FloatArray) -> tuple[float, FloatArray]:
    """χ² by which a twist (g,) is no rotation about an axis, and the nearest such twist, per rad.

    Its linear part has no trace and no determinant, and it has a fixed point.
    square : χ² of the motion along it.
    """

    def misses(xi: FloatArray) -> FloatArray:
        X = np.tensordot(xi, E, 1)
        L = X[:3, :3]
        angle = math.sqrt(abs(0.5 * np.trace(L @ L)))
        null = np.linalg.svd(L)[0][:, 2]
        pitch = null @ (X[:3, 3])
        det = np.linalg.det(L) / max(angle, 1e-12) ** 2
        return np.array([np.trace(L), det, pitch * np.sign(null @ [1, 2, 3])])

    size = np.linalg.norm(screw)
    total = 0.0
    covariance = np.linalg.inv(W) / max(square, 1e-12)
    covariance -= np.outer(screw, screw) / max(square, 1e-12)
    axis = screw.copy()
    for _ in range(3):
        c = misses(axis)
        step = 1e-6 * size * np.eye(len(axis))
        J = np.array([(misses(axis + one) - misses(axis - one)) / (2e-6 * size) for one in step]).T
        gain = covariance @ J.T @ np.linalg.pinv(J @ covariance @ J.T, rcond=1e-8)
        axis = axis - gain @ c
    apart = axis - screw
    total = float(apart @ W @ apart) * square
    X = np.tensordot(axis, E, 1)
    return total, axis / math.sqrt(max(-0.5 * np.trace(X[:3, :3] @ X[:3, :3]), 1e-300))
