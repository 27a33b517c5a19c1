"""Displacement of an object that a goal was taught on, and the goal carried along with it.

Points of the object and its displacements are the maximum of the likelihood of all looks at it. In the frame
in which the joints preserve the metric, a displacement is rigid, so has six coordinates. Where the joints
leave the metric open, it is affine: 12 coordinates, for which a look needs four markers off one plane.

Errors are those of all images and of the calibration, to first order. A calibration that is off displaces the
object and the tool alike: what both errors have in common drops out of the images of the carried goal.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from projservo_cli.calibration.prediction import error_factor_with_model, projection_derivative
from projservo_cli.geometry.displacements import cross_matrix, homogeneous
from projservo_cli.geometry.lens import distort, undistort
from projservo_cli.metric.frame import Metric, ProjectiveParameters, changes_of
from projservo_cli.records import (
    MM,
    TOOL,
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    WorkFailed,
)
from projservo_cli.task.body import make_body

# Singular value over the largest, below which joints leave the plane at infinity open, or preserve a form.
_OPEN = 1e-6
# Deviation of the invariant form from 1 above which the data do not determine it, as for a metric.
_UNDETERMINED = 0.3
# Number of symmetric forms of the plane at infinity.
_FORMS = 6
# Number of markers that six coordinates need, and that twelve need.
_RIGID, _AFFINE = 3, 4
# Coordinates of a rigid displacement.
_SIX = 6
# Deviation of a turn, rad, or of a stretch, above which it is not seen: first order means nothing there.
_UNSEEN = 0.3
# Difference of χ² below which two poses fit alike: the better one is the wrong one in 1 of 1,000 cases.
_UNDECIDED = 13.8
# Turn between two poses, rad, or their distance over the size of the body, below which they are one.
_SAME = 0.05
# Times the stated noise, and probability, beyond which residuals are not those of the same rigid object.
_NOISE, _CONFIDENCE = 2.0, 0.999
# Cosine of the angle between the axis of a turn and a line of markers, above which it is about that line.
_ALONG = 0.95
# Maximum number of steps of a fit; fall of the sum of squares, over it, of the last; and least damping.
_STEPS, _SETTLED = 100, 1e-12
# Turns that the search for a pose starts from, (24, 3) rotation vectors: none is farther than 63° from one.
_TURNS = Rotation.create_group("O").as_rotvec()


class Look(NamedTuple):
    """Images of markers at one time."""

    s: FloatArray  # (V, k, 2) px, as cameras report them; NaN where unseen
    sigma: FloatArray | None = None  # (V, k) deviation of a coordinate, px; None or NaN: as calibrated


class _Rig(NamedTuple):
    """Cameras and tool, as calibrated and off by its errors, with the plane at infinity (0, 0, 0, 1).

    Displacements are rigid there, if the joints determine the metric.
    """

    P: FloatArray  # (B, V, 3, 4)
    lens: FloatArray  # (B, V, 5)
    M: FloatArray  # (B, m, 4) markers of the tool at the reference
    G: FloatArray  # (4, 4) from the calibrated frame
    turns: FloatArray  # (3, 3, 3) rotations, per rad
    linear: FloatArray  # (3 or 9, 3, 3) rotations, or all, that displace an object
    sigma_px: float

    @classmethod
    def of(cls, c: Calibration) -> Self:
        """Raises WorkFailed if the joints do not determine the plane at infinity, or preserve no metric."""
        models = ProjectiveParameters.around(c, c.model().lens, error_factor_with_model(c))
        U, sizes, _ = np.linalg.svd(np.concatenate(np.moveaxis(models.H_hat, 1, 0), axis=-1))
        if sizes[0, 2] < _OPEN * sizes[0, 0]:
            raise WorkFailed(
                "objects: the joints do not determine the plane at infinity, so nothing tells how far an "
                "object has moved: record motions of two joints whose axes are not parallel"
            )
        a_inf = U[..., 3] / (U[..., 3] @ c.M.mean(axis=0))[:, None]
        D = np.linalg.svd(a_inf[:1])[2][1:]
        G = np.concatenate([np.broadcast_to(D, (len(a_inf), 3, 4)), a_inf[:, None]], axis=1)
        L = (G[:, None] @ models.H_hat @ np.linalg.inv(G)[:, None])[..., :3, :3]
        root = _metric_root(L)
        if root is None:
            to_first = np.linalg.inv(G[0])
            turns = (G[0] @ make_body(c.model(), c.M).H_hat @ to_first)[:, :3, :3]
            linear = np.eye(9).reshape(9, 3, 3)
        else:
            turns = linear = cross_matrix(np.eye(3))
            G[:, :3] = np.linalg.solve(root, G[:, :3])
        M = models.M @ G.swapaxes(1, 2)
        P = models.P @ np.linalg.inv(G)[:, None]
        return cls(P, models.lens, M / M[..., 3:], G[0], turns, linear, c.sigma_px)

    @property
    def rigid(self) -> bool:
        """Whether displacements are rigid."""
        return len(self.linear) == _RIGID

    def bundle(self, looks: Sequence[Look], E: FloatArray, fixed: int = -1) -> "_Bundle":
        """Least squares of some looks; arguments as of ``_Bundle``."""
        s = np.stack([np.asarray(look.s, dtype=np.float64) for look in looks])
        sigma = np.stack([np.full(s.shape[1:3], np.nan) if x.sigma is None else x.sigma for x in looks])
        sigma = np.where(np.isfinite(sigma) & (sigma > 0.0), sigma, self.sigma_px)
        weight = np.where(np.isfinite(s).all(axis=-1), 1.0 / sigma, 0.0)
        return _Bundle(self.P[0], self.lens[0], s, weight, E, fixed)

    def pixels(self, points: FloatArray) -> FloatArray:
        """Pixels (B, V, N, 2) of points (N, 4) or (B, N, 4) by each of the models."""
        m = points[..., None, :, :] @ self.P.swapaxes(2, 3)
        return distort(self.lens[:, :, None], m[..., :2] / m[..., 2:])


def _metric_root(L: FloatArray) -> FloatArray | None:
    """Root A (B, 3, 3) of the form S = A Aᵀ with L S + S Lᵀ = 0 for all actions L (B, n, 3, 3) of the joints.

    It changes smoothly from one model to the next. None if there is more than one form, within the errors.
    """
    i, j = np.triu_indices(3)
    basis = np.zeros((_FORMS, 3, 3))
    basis[range(_FORMS), i, j] = basis[range(_FORMS), j, i] = np.where(i == j, 1.0, np.sqrt(0.5))
    moved = np.einsum("bnij,sjk->bniks", L, basis)
    changes = (moved + moved.swapaxes(2, 3)).reshape(len(L), -1, _FORMS)
    _, sizes, rows = np.linalg.svd(changes)
    if sizes[0, -2] < _OPEN * max(sizes[0, 0], 1.0):
        return None
    form = rows[:, -1]
    S = np.einsum("bs,sij->bij", form * np.einsum("bs,sii->b", form, basis)[:, None], basis)
    try:
        A = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return None
    back = np.linalg.inv(A[0])
    return A if np.linalg.norm(changes_of(back @ S @ back.T)) < _UNDETERMINED else None


def _generators(linear: FloatArray, center: FloatArray) -> FloatArray:
    """Generators (3 + j, 4, 4) of translations, and of linear maps (j, 3, 3) about a point (3,)."""
    E = np.zeros((3 + len(linear), 4, 4))
    E[range(3), range(3), 3] = 1.0
    E[3:, :3, :3], E[3:, :3, 3] = linear, -linear @ center
    return E


class _Bundle(NamedTuple):
    """Least squares of the images of points after displacements, from many starts (B, …) at once."""

    P: FloatArray  # (V, 3, 4)
    lens: FloatArray  # (V, 5)
    s: FloatArray  # (L, V, k, 2) px, NaN where unseen
    weight: FloatArray  # (L, V, k) 1 over the deviation, px; 0 where unseen
    E: FloatArray  # (g, 4, 4) generators: a step takes a displacement T to T exp(ξ E)
    fixed: int  # look in whose frame the points are, which are unknown too; −1 for none, of known points

    @property
    def free(self) -> bool:
        """Whether the points are unknown too."""
        return self.fixed >= 0

    @property
    def moving(self) -> list[int]:
        """Looks with an unknown displacement."""
        return [look for look in range(len(self.s)) if look != self.fixed]

    def residuals(self, X: FloatArray, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (B, N) over their deviation, and derivatives (B, L, V, k, 2, 4) of pixels by points.

        X : (B, k, 4) points; T : (B, L, 4, 4) displacements.
        """
        Y = np.einsum("blij,bkj->blki", T, X)
        pixels, G, _ = projection_derivative(self.P, self.lens, Y.reshape(-1, 4))
        apart = (len(self.P), *Y.shape[:3])
        pixels, by = (
            np.moveaxis(part.reshape(*apart, *part.shape[2:]), 0, 2) for part in (pixels, G @ self.P[:, None])
        )
        weight = self.weight[..., None]
        r = np.where(weight > 0.0, weight * (self.s - pixels), 0.0)
        return r.reshape(len(X), -1), weight[..., None] * by

    def columns(self, look: int, k: int) -> slice:
        """Columns of the displacement of a look among those of k points."""
        g = len(self.E)
        first = (3 * k if self.free else 0) + g * self.moving.index(look)
        return slice(first, first + g)

    def by_motion(self, by_point: FloatArray, X: FloatArray, T: FloatArray) -> FloatArray:
        """Derivatives (B, L, V, k, 2, g) by displacements, from those by points; as above."""
        velocity = np.einsum("blij,gjm,bkm->blkgi", T, self.E, X, optimize=True)
        return np.einsum("blvkdi,blkgi->blvkdg", by_point, velocity, optimize=True)

    def linearized(self, X: FloatArray, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (B, N), and derivatives (B, N, p) of pixels, both over their deviation."""
        r, by_point = self.residuals(X, T)
        by_motion = self.by_motion(by_point, X, T)
        g, k = len(self.E), X.shape[1] if self.free else 0
        J = np.zeros((*by_motion.shape[:-1], 3 * k + g * len(self.moving)))
        by_X = by_point @ T[:, :, None, None, :, :3]
        for i in range(k):
            J[..., i, :, 3 * i : 3 * i + 3] = by_X[..., i, :, :]
        for look in self.moving:
            J[:, look, ..., self.columns(look, X.shape[1])] = by_motion[:, look]
        return r, J.reshape(len(X), r.shape[1], -1)

    def moved(self, X: FloatArray, T: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points and displacements after a step (B, p)."""
        of_points, of_motions = np.split(step, [3 * X.shape[1] if self.free else 0], axis=1)
        X, T = X.copy(), T.copy()
        if self.free:
            X[..., :3] += of_points.reshape(len(X), -1, 3)
        xi = of_motions.reshape(len(X), len(self.moving), len(self.E))
        T[:, self.moving] = T[:, self.moving] @ expm(np.einsum("blg,gij->blij", xi, self.E))
        return X, T

    def settled(self, X: FloatArray, T: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points, displacements and sums of squares (B,) at a minimum, by Levenberg–Marquardt steps."""
        damping, (r, J) = np.full(len(X), 1e-3), self.linearized(X, T)
        cost = (r**2).sum(axis=1)
        for _ in range(_STEPS):
            J, size = _unit_columns(J)
            N = J.swapaxes(1, 2) @ J + damping[:, None, None] * np.eye(J.shape[2])
            step = np.linalg.solve(N, J.swapaxes(1, 2) @ r[..., None])[..., 0] / size
            with np.errstate(all="ignore"):
                X_new, T_new = self.moved(X, T, step)
                cost_new = np.nan_to_num((self.residuals(X_new, T_new)[0] ** 2).sum(axis=1), nan=np.inf)
            better = cost_new < cost
            ended = np.where(better, cost - cost_new <= _SETTLED * cost, damping > 1.0 / _SETTLED)
            X, T = np.where(better[:, None, None], X_new, X), np.where(better[:, None, None, None], T_new, T)
            cost = np.where(better, cost_new, cost)
            damping = np.where(better, np.maximum(0.1 * damping, _SETTLED), 10.0 * damping)
            if ended.all():
                break
            r, J = self.linearized(X, T)
        return X, T, cost

    def poses(self, X: FloatArray, turns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacements (h, 4, 4) of known points X (k, 4) in one look, and χ² (h,): minima, least first.

        turns : (3, 3, 3) rotations that the search starts from.
        """
        center = X[:, :3].mean(axis=0)
        R = expm(np.einsum("bi,ijk->bjk", _TURNS, _generators(turns, center)[3:]))
        straight = undistort(self.lens, self.s[0])
        rows = self.P[:, None, :2] - straight[..., None] * self.P[:, None, 2:]
        rows = rows[self.weight[0] > 0.0]
        turned = np.einsum("bij,kj->bki", R, X)
        of = np.nonzero(self.weight[0] > 0.0)[1]
        off = np.einsum("nrj,bnj->bnr", rows, turned[:, of]).reshape(len(R), -1)
        R[:, :3, 3] -= off @ np.linalg.pinv(rows[..., :3].reshape(-1, 3)).T
        many = np.broadcast_to(X, (len(R), *X.shape))
        _, T, cost = self.settled(many, R[:, None])
        there = np.einsum("bij,kj->bki", T[:, 0], X)
        depth = np.einsum("vj,bkj->bvk", self.P[:, 2], there)
        ahead = (depth > 0.0).all(axis=(1, 2), where=self.weight[0] > 0.0) & np.isfinite(cost)
        kept: list[int] = []
        for i in np.argsort(cost).tolist():
            if ahead[i] and all(_apart(there[i], there[j]) for j in kept):
                kept.append(i)
        return T[kept, 0], cost[kept]


def _unit_columns(J: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives (…, N, p) over the norms of their columns, and these (…, p)."""
    size = np.maximum(np.linalg.norm(J, axis=-2), 1e-300)
    return J / size[..., None, :], size


def _apart(X: FloatArray, Y: FloatArray) -> bool:
    """Whether points (k, 4) differ by more than a share of their size."""
    size = np.linalg.norm(X - X.mean(axis=0), axis=1).max()
    return bool(np.linalg.norm(X - Y, axis=1).max() > _SAME * size)


class _Fit(NamedTuple):
    """Points of a body and its displacements at some looks."""

    bundle: _Bundle
    X: FloatArray  # (k, 4) points in the frame of the fixed look
    T: FloatArray  # (L, 4, 4)
    cost: float  # χ²

    @classmethod
    def settled(cls, bundle: _Bundle, X: FloatArray, T: FloatArray) -> Self:
        """The minimum beside points (k, 4) and displacements (L, 4, 4)."""
        X, T, cost = bundle.settled(X[None], T[None])
        return cls(bundle, X[0], T[0], float(cost[0]))

    def linearized(self) -> tuple[FloatArray, FloatArray]:
        """Residuals (N,) and derivatives (N, p) of what is seen, over their deviation."""
        r, J = self.bundle.linearized(self.X[None], self.T[None])
        seen = np.repeat(self.bundle.weight > 0.0, 2)
        return r[0, seen], J[0, seen]

    def moved(self, rig: _Rig, X: FloatArray) -> FloatArray:
        """Changes (N, c) of what is seen by the errors of a calibration; X : (k, 4) or (B, k, 4) points."""
        weight, looks = self.bundle.weight[..., None], range(len(self.T))
        pixels = np.stack([changes_of(rig.pixels(X @ self.T[look].T)) for look in looks], axis=1)
        return (weight * pixels)[:, self.bundle.weight > 0.0].reshape(len(pixels), -1).T

    def unseen(self, look: int) -> tuple[float, FloatArray]:
        """Largest deviation of the linear part of a displacement by the noise, and its direction."""
        J, size = _unit_columns(self.linearized()[1])
        # What is not seen at all gets a large deviation instead of an infinite one.
        C = np.linalg.inv(J.T @ J + _SETTLED * np.eye(len(size))) / np.outer(size, size)
        own = self.bundle.columns(look, len(self.X))
        values, vectors = np.linalg.eigh(C[own, own][3:, 3:])
        return float(np.sqrt(values[-1])), vectors[:, -1]


class _Placed(NamedTuple):
    """Object at the looks that it has been found in."""

    fit: _Fit
    looks: tuple[int, ...]  # (L,) indices of the looks
    known: BoolArray  # (k,) markers whose points are known


@dataclass(frozen=True, eq=False)
class _Search:
    """Search for an object in looks at it."""

    rig: _Rig
    marker: Sequence[int]  # (k,) numbers of its markers
    looks: Sequence[Look]

    @cached_property
    def views(self) -> IntArray:
        """Number of views (L, k) that see each marker at each look."""
        return np.array([np.isfinite(look.s).all(axis=-1).sum(axis=0) for look in self.looks])

    @property
    def least(self) -> int:
        """Number of markers that a look needs."""
        return _RIGID if self.rig.rigid else _AFFINE

    def numbers(self, markers: BoolArray) -> str:
        """Numbers of markers (k,), in words."""
        some = np.asarray(self.marker)[markers].tolist()
        return (
            ("marker " if len(some) == 1 else "markers ") + ", ".join(map(str, some)) if some else "no marker"
        )

    def bundle(self, looks: Sequence[int], markers: BoolArray, X: FloatArray, fixed: int = -1) -> _Bundle:
        """Least squares of looks at markers (k,) near points (k, 4); of known points if no look is fixed."""
        E = _generators(self.rig.linear, X[markers, :3].mean(axis=0))
        some = [
            Look(look.s[:, markers], None if look.sigma is None else look.sigma[:, markers])
            for look in (self.looks[i] for i in looks)
        ]
        return self.rig.bundle(some, E, fixed)

    def points(self, look: int, T: FloatArray) -> FloatArray:
        """Points (k, 4) that two views or more see at a look, in the frame that T displaces; others NaN."""
        s, X = undistort(self.rig.lens[0], self.looks[look].s), np.full((len(self.marker), 4), np.nan)
        P = self.rig.P[0] @ T
        for k in np.flatnonzero(self.views[look] > 1):
            rows = (P[:, :2] - s[:, k, :, None] * P[:, 2:])[np.isfinite(s[:, k, 0])].reshape(-1, 4)
            X[k] = homogeneous(np.linalg.lstsq(rows[:, :3], -rows[:, 3])[0])
        return X

    def found(self) -> _Placed:
        """The object at all looks that show where it is.

        Raises WorkFailed if the first or the last does not.
        """
        base = int(np.argmax((self.views > 1).sum(axis=1)))
        X = self.points(base, np.eye(4))
        known = np.isfinite(X[:, 0])
        if known.sum() < self.least:
            raise WorkFailed(self._no_shape(known, base))
        fit = _Fit.settled(self.bundle([base], known, X, 0), X[known], np.eye(4)[None])
        placed, last = _Placed(fit, (base,), known), len(self.looks) - 1
        for look in dict.fromkeys((last, 0, *range(1, last))):
            try:
                placed = placed if look == base else self._with(placed, look)
            except WorkFailed:
                if look in (0, last):
                    raise
        return placed

    def _with(self, placed: _Placed, look: int) -> _Placed:
        """The object with one more look at it."""
        when = "when the goal was taught" if look == 0 else "now"
        X = np.full((len(self.marker), 4), np.nan)
        X[placed.known] = placed.fit.X
        shown = placed.known & (self.views[look] > 0)
        if shown.sum() < self.least:
            raise WorkFailed(self._too_few(shown, when))
        T, _ = self.bundle([look], shown, X).poses(X[shown], self.rig.turns)
        if not len(T):
            raise WorkFailed(
                f"objects: {self.numbers(shown)} fit no place before the cameras {when}: markers may be "
                "numbered otherwise, or the cameras have moved; look again"
            )
        found = []
        for there in T[:2]:  # each of both minima that one view leaves
            at = sorted([*zip(placed.looks, placed.fit.T, strict=True), (look, there)], key=itemgetter(0))
            looks = tuple(i for i, _ in at)
            points = np.where(placed.known[:, None], X, self.points(look, there))
            known = np.isfinite(points[:, 0])
            bundle = self.bundle(looks, known, points, looks.index(placed.looks[placed.fit.bundle.fixed]))
            fit = _Fit.settled(bundle, points[known], np.array([place for _, place in at]))
            found.append(_Placed(fit, looks, known))
        best, *others = sorted(found, key=lambda one: one.fit.cost)
        at_look = best.looks.index(look)
        deviation, axis = best.fit.unseen(at_look)
        if deviation > _UNSEEN:
            raise WorkFailed(self._not_seen(best, shown, when, deviation, axis))
        for other in others:
            apart = other.fit.cost - best.fit.cost
            ends = [one.fit.T[at_look] @ X[shown].T for one in (best, other)]
            if apart < _UNDECIDED and _apart(ends[0].T, ends[1].T):
                raise WorkFailed(
                    f"objects: the images {when} fit two places of the object, χ² {apart:.3g} apart "
                    f"({_UNDECIDED} decide): one view of {self.numbers(shown)} does not tell which way it is "
                    "tilted; show it to a second camera, nearer, or more of its markers off one plane"
                )
        return best

    def _no_shape(self, known: BoolArray, base: int) -> str:
        """Why the shape of the object is not known."""
        if self.views.max() < 2 and len(self.looks[0].s) == 1:
            return (
                "objects: one camera tells the size of an object from its distance in no number of looks, so "
                "not how far it has moved: watch it with a second camera"
            )
        return (
            f"objects: two cameras together see {self.numbers(known)} at best (look {base + 1} of "
            f"{len(self.looks)}), and the shape of the object needs {self._needed()}: turn the object towards "
            "both cameras"
        )

    def _needed(self) -> str:
        """Markers that a look needs, and why."""
        if self.rig.rigid:
            return f"{_RIGID} off one line"
        return (
            f"{_AFFINE} off one plane, since the joints leave the metric open and 12 coordinates of its "
            "displacement instead of 6"
        )

    def _too_few(self, shown: BoolArray, when: str) -> str:
        """Which freedom so few markers leave."""
        count = int(shown.sum())
        left = {
            0: "it is hidden or turned away",
            1: "all its turns are open",
            2: "its turn about their line is open",
        }
        open_ = left[count] if count < _RIGID else "its stretch across them is open"
        return (
            f"objects: {self.numbers(shown)} of known shape is seen {when}: {open_}; show {self._needed()}"
            if count < 2
            else f"objects: only {self.numbers(shown)} are seen {when}: {open_}; show {self._needed()}"
        )

    def _not_seen(self, placed: _Placed, shown: BoolArray, when: str, std: float, axis: FloatArray) -> str:
        """Which freedom the images leave, by the direction (3 or 9,) of its largest deviation."""
        if not self.rig.rigid:
            return (
                f"objects: {self.numbers(shown)} do not show {when} how the object is stretched (± {std:.2g}, "
                f"{_UNSEEN} at most); show {self._needed()}"
            )
        numbers, lines = (
            np.asarray(self.marker)[placed.known],
            placed.fit.X[:, None, :3] - placed.fit.X[:, :3],
        )
        cosine = np.abs(lines @ axis) / np.maximum(np.linalg.norm(lines, axis=-1), 1e-300)
        i, j = sorted(np.unravel_index(int(np.argmax(cosine)), cosine.shape))
        about = f" about the line of markers {numbers[i]} and {numbers[j]}" if cosine[i, j] > _ALONG else ""
        degrees = f"± {min(np.degrees(std), 180.0):.2g}°, {np.degrees(_UNSEEN):.2g}° at most"
        return (
            f"objects: {self.numbers(shown)} do not show {when} how the object is turned{about} ({degrees}); "
            "show more markers, off one line, or show them from nearer"
        )


def _require_same_object(rig: _Rig, fit: _Fit, marker: Sequence[int]) -> None:
    """Refuse markers that do not lie as they did, beyond noise and errors of the calibration."""
    r, J = fit.linearized()
    dof = len(r) - J.shape[1]
    if dof < 1:
        return
    moved = fit.moved(rig, fit.X)
    left = moved - J @ np.linalg.lstsq(J, moved)[0]
    along = left.T @ r
    square = r @ r - along @ np.linalg.solve(np.eye(left.shape[1]) + left.T @ left, along)
    if square > _NOISE**2 * chi2.ppf(_CONFIDENCE, dof):
        of = np.broadcast_to(np.arange(len(fit.X)), fit.bundle.weight.shape)[fit.bundle.weight > 0.0]
        worst = marker[int(np.argmax(np.bincount(of, (r.reshape(-1, 2) ** 2).sum(axis=1))))]
        raise WorkFailed(
            f"objects: markers do not lie on the object as they did: residuals {np.sqrt(square / dof):.3g} times "
            f"the stated noise ({_NOISE:g} at most), most at marker {worst}: it has come off or slipped, the "
            "object is another one, or it moved while images were taken"
        )


@dataclass(frozen=True, eq=False)
class CarriedGoal:
    """Goal of the tool after the displacement of the object that it was taught on, with its errors."""

    s: FloatArray  # (V, m, 2) px of the markers of the tool, in the order of the calibration
    changes: FloatArray  # (c, V, m, 2) of them by independent errors of unit variance, px
    H: FloatArray  # (4, 4) displacement of the tool from its reference, in the calibrated frame
    pose_changes: FloatArray  # (c, 6) translation, unit, and turn about the middle of the tool, rad
    rms_px: float  # deviation of the pose in the images, rms per marker and view, px
    unit_mm: float  # mm in a unit; NaN without a known length

    @property
    def covariance(self) -> FloatArray:
        """Covariance (V m 2, V m 2) of the images, px²."""
        flat = self.changes.reshape(len(self.changes), -1)
        return np.asarray(flat.T @ flat)

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance (6, 6) of the pose, unit² and rad²."""
        return np.asarray(self.pose_changes.T @ self.pose_changes)

    @property
    def position_mm(self) -> float:
        """Deviation of the middle of the tool, rms distance, mm; NaN without a known length."""
        return float(self.unit_mm * np.linalg.norm(self.pose_changes[:, :3]))

    @property
    def rotation_deg(self) -> float:
        """Deviation of the rotation, rms angle, degrees."""
        return float(np.degrees(np.linalg.norm(self.pose_changes[:, 3:])))


@dataclass(frozen=True, eq=False)
class DisplacedObject:
    """Object as found in looks at it, the first when a goal was taught on it, the last now."""

    marker: tuple[int, ...]  # numbers of the markers that it was found by
    M: FloatArray  # (k, 4) them when the goal was taught, in the calibrated frame, a_inf·M = 1
    D: FloatArray  # (4, 4) displacement from there to now, in the calibrated frame, a_inf D = a_inf
    shift_px: float  # motion of its images, rms per marker and view
    shift_mm: float  # motion of its middle; NaN without a known length
    angle_deg: float  # turn; NaN if the joints do not determine the metric
    noise_factor: float  # residuals over their deviation, rms per degree of freedom
    unit_mm: float  # mm in a unit of the frame that it was found in; NaN without a known length
    _rig: _Rig
    _fit: _Fit

    @property
    def coordinates(self) -> int:
        """Number of coordinates of its displacement: 6, or 12 if the joints do not determine the metric."""
        return len(self._fit.bundle.E)

    @classmethod
    def of(
        cls, c: Calibration, marker: Sequence[int], looks: Sequence[Look], metric: Metric | None = None
    ) -> Self:
        """Find the displacement of an object by all looks at it.

        Looks in between refine its shape; those that do not show where it is are left out. A marker counts
        if two views or more see it at some look.

        c : calibration with its covariance.
        marker : (k,) numbers of the markers of the object, as messages name them.
        looks : two or more, the first when the goal was taught, the last now; views as of the calibration.
        metric : of the calibration with a known length, for mm.
        Raises InputError for cameras on the tool or a calibration without a covariance, and WorkFailed for
        what images or joints do not show, which names the freedom that is missing.
        """
        if c.mount == TOOL:
            raise InputError(
                "objects: cameras on the tool see the scene that the goal is on: its own images are the goal"
            )
        if not c.has_covariance or not c.sqrt_cov_shared.size:
            raise InputError(f"objects: the method {c.method} has no covariance: use bundle_adjustment")
        rig = _Rig.of(c)
        fit, _, known = _Search(rig, marker, looks).found()
        numbers = tuple(np.asarray(marker)[known].tolist())
        _require_same_object(rig, fit, numbers)
        T, back = fit.T[-1] @ np.linalg.inv(fit.T[0]), np.linalg.inv(rig.G)
        taught, now = fit.X @ fit.T[0].T, fit.X @ fit.T[-1].T
        shift = rig.pixels(now)[0] - rig.pixels(taught)[0]
        unit = np.nan if metric is None else MM * _unit_m(rig, metric)
        r, J = fit.linearized()
        return cls(
            marker=numbers,
            M=taught @ back.T,
            D=back @ T @ rig.G,
            shift_px=float(np.sqrt((shift**2).sum(axis=-1).mean())),
            shift_mm=float(unit * np.linalg.norm((now - taught).mean(axis=0))),
            angle_deg=float(np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())) if rig.rigid else np.nan,
            noise_factor=float(np.sqrt(fit.cost / max(len(r) - J.shape[1], 1))),
            unit_mm=float(unit),
            _rig=rig,
            _fit=fit,
        )

    def carry(self, goal: Look) -> CarriedGoal:
        """Carry a goal of the tool along that was taught at the first look.

        goal : images (V, m, 2) of the markers of the tool there, in the order of the calibration.
        Raises WorkFailed if they do not determine a pose of the tool, or the carried one is out of sight.
        """
        rig, fit, tool = self._rig, self._fit, _tool_at(self._rig, goal)
        to_taught = np.linalg.inv(fit.T[0])
        H = fit.T[-1] @ to_taught @ tool.T[0]
        placed = tool.X @ H.T
        if not (placed @ rig.P[0, :, 2].T > 0.0).all():
            raise WorkFailed("objects: with the object, the goal of the tool has moved behind a camera")
        s = rig.pixels(placed)[0]
        # All markers in all views; a motion of the object takes the tool along, as one of the tool itself.
        out = rig.bundle([Look(s, np.ones(s.shape[:2]))], tool.bundle.E)
        by_point = out.residuals(placed[None], np.eye(4)[None, None])[1]

        def by(E: FloatArray, points: FloatArray, T: FloatArray) -> FloatArray:
            """Derivatives (V m 2, g) of the images by steps of a displacement of points."""
            motion = out._replace(E=E).by_motion(by_point, points[None], T[None, None])
            return np.asarray(motion.reshape(s.size, -1))

        by_goal = by(tool.bundle.E, tool.X, H)
        by_now = by(fit.bundle.E, tool.X @ (to_taught @ tool.T[0]).T, fit.T[-1])
        J = fit.linearized()[1]
        by_object = np.zeros((s.size, J.shape[1]))
        for look, sign in ((0, -1.0), (len(fit.T) - 1, 1.0)):
            if look != fit.bundle.fixed:
                by_object[:, fit.bundle.columns(look, len(fit.X))] = sign * by_now
        of_object = by_object @ np.linalg.pinv(J)
        of_goal = by_goal @ np.linalg.pinv(tool.linearized()[1])
        of_calibration = changes_of(rig.pixels(rig.M @ H.T)).reshape(-1, s.size).T
        of_calibration -= of_object @ fit.moved(rig, fit.X) + of_goal @ tool.moved(rig, rig.M)
        changes = np.concatenate([of_object, of_goal, of_calibration], axis=1)
        pose = by(_generators(rig.turns, placed[:, :3].mean(axis=0)), placed, np.eye(4))
        pose_changes = np.linalg.pinv(pose) @ changes
        return CarriedGoal(
            s=s,
            changes=changes.T.reshape(-1, *s.shape),
            H=np.linalg.inv(rig.G) @ H @ rig.G,
            pose_changes=pose_changes.T,
            rms_px=float(np.linalg.norm(pose @ pose_changes) / np.sqrt(s.size / 2)),
            unit_mm=self.unit_mm,
        )


def _unit_m(rig: _Rig, metric: Metric) -> float:
    """Length of a unit of the frame of a rig, m, by the two markers of the tool farthest apart."""
    X, M = metric.markers, rig.M[0]
    apart = np.linalg.norm(X[:, None] - X, axis=-1)
    i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
    return float(apart[i, j] / np.linalg.norm(M[i] - M[j]))


def _tool_at(rig: _Rig, goal: Look) -> _Fit:
    """Fit the pose of the tool to its images at a goal.

    Raises WorkFailed if they do not determine it.
    """
    M = rig.M[0]
    bundle = rig.bundle([goal], _generators(rig.turns, M[:, :3].mean(axis=0)))
    seen = bundle.weight[0].any(axis=0)
    if seen.sum() < _RIGID:
        raise WorkFailed(
            f"objects: the goal shows {int(seen.sum())} markers of the tool, and its pose needs {_RIGID}: teach "
            "it where the cameras see more"
        )
    T, cost = bundle._replace(s=bundle.s[:, :, seen], weight=bundle.weight[:, :, seen]).poses(
        M[seen], rig.turns
    )
    if not len(T):
        raise WorkFailed(
            "objects: the images of the goal fit no pose of the tool before the cameras: teach again"
        )
    fit = _Fit(bundle, M, T[:1], float(cost[0]))
    deviation, _ = fit.unseen(0)
    if deviation > _UNSEEN:
        raise WorkFailed(
            f"objects: the images of the goal do not show how the tool is turned (± {np.degrees(deviation):.2g}°, "
            f"{np.degrees(_UNSEEN):.2g}° at most): teach it where the cameras see more markers, off one line"
        )
    if len(cost) > 1 and cost[1] - cost[0] < _UNDECIDED:
        raise WorkFailed(
            f"objects: the images of the goal fit two poses of the tool, χ² {cost[1] - cost[0]:.3g} apart "
            f"({_UNDECIDED} decide): teach it where two cameras see it, or more markers off one plane"
        )
    return fit
