"""Maximum of the likelihood of the shape of a body and its displacements, by looks at it.

In the frame in which the joints preserve the metric, a displacement is rigid, so has six coordinates. Where
the joints leave the metric open, it is affine, and has twelve.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import expm

from projservo_cli.calibration.prediction import (
    error_factor_with_model,
    pixels_of,
    projection_derivative,
)
from projservo_cli.findings import REFUSES, Finding
from projservo_cli.geometry.displacements import cross_matrix, generators, to_all_sides
from projservo_cli.geometry.least_squares import Equations, levenberg_marquardt
from projservo_cli.geometry.lens import undistort
from projservo_cli.messages import failed
from projservo_cli.metric.frame import ProjectiveParameters, changes_of, invariant_form
from projservo_cli.records import BoolArray, Calibration, FloatArray, WorkFailed
from projservo_cli.task.body_pose import make_body

# Singular value over the largest, below which joints leave the plane at infinity open, or preserve a form.
_OPEN = 1e-6
# Deviation of the invariant form from 1 above which the data do not determine it, as for a metric.
_UNDETERMINED = 0.3
# Distance of two places of a body over its size, below which they are one.
_SAME = 0.05
# Maximum number of steps of a fit.
_STEPS = 100
# Least eigenvalue of second derivatives by coordinates of unit deviation.
_REGULAR = 1e-12
# Number of steps from all turns, and of places that are then followed to the end.
_FIRST_STEPS, _PLACES = 12, 6
# Step of the differences of gradients, over the deviation of a coordinate.
_PROBE = 0.01


def unknown(one: Finding) -> WorkFailed:
    """Return the error that a finding on an object, or on a goal that it carries, is."""
    return failed([one], stage="objects")


class ObjectView(NamedTuple):
    """Images of markers at one time."""

    s: FloatArray  # (V, k, 2) px, as cameras report them; NaN where unseen
    sigma: FloatArray | None = None  # (V, k) deviation of a coordinate, px; None or NaN: as calibrated

    def of(self, markers: BoolArray) -> "ObjectView":
        """Images of some markers (k,)."""
        return ObjectView(self.s[:, markers], None if self.sigma is None else self.sigma[:, markers])


class ObjectViewRig(NamedTuple):
    """Cameras and tool, as calibrated and changed by its errors, with the plane at infinity (0, 0, 0, 1).

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
            raise unknown(Finding("object_open_infinity", REFUSES))
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
        return len(self.linear) == len(self.turns)

    def bundle(self, frames: Sequence[ObjectView], E: FloatArray, fixed: int = -1) -> "Bundle":
        """Least squares of some looks; arguments as of ``Bundle``."""
        s = np.stack([np.asarray(frame_index.s, dtype=np.float64) for frame_index in frames])
        sigma = np.stack([np.full(s.shape[1:3], np.nan) if x.sigma is None else x.sigma for x in frames])
        sigma = np.where(np.isfinite(sigma) & (sigma > 0.0), sigma, self.sigma_px)
        weight = np.where(np.isfinite(s).all(axis=-1), 1.0 / sigma, 0.0)
        return Bundle(self.P[0], self.lens[0], s, weight, E, fixed)

    def pixels(self, points: FloatArray) -> FloatArray:
        """Pixels (B, V, N, 2) of points (N, 4) or (B, N, 4) by each of the models."""
        return pixels_of(self.P, self.lens, points)


def _metric_root(L: FloatArray) -> FloatArray | None:
    """Root A (B, 3, 3) of the form S = A Aᵀ with L S + S Lᵀ = 0 for all actions L (B, n, 3, 3) of the joints.

    It changes smoothly from one model to the next. None if there is more than one form, within the errors.
    """
    sizes, S = invariant_form(L)
    if sizes[0, -2] < _OPEN * max(sizes[0, 0], 1.0):
        return None
    S *= np.trace(S, axis1=1, axis2=2)[:, None, None]
    try:
        A = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    back = np.linalg.inv(A[0])
    return A if np.linalg.norm(changes_of(back @ S @ back.T)) < _UNDETERMINED else None


class Bundle(NamedTuple):
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
        return [frame_index for frame_index in range(len(self.s)) if frame_index != self.fixed]

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

    def columns(self, frame_index: int, k: int) -> slice:
        """Columns of the displacement of a frame among the columns of k points."""
        g = len(self.E)
        first = (3 * k if self.free else 0) + g * self.moving.index(frame_index)
        return slice(first, first + g)

    def by_motion(self, by_point: FloatArray, X: FloatArray, T: FloatArray) -> FloatArray:
        """Derivatives (B, L, V, k, 2, g) by displacements, from those by points; as above."""
        velocity = np.einsum("blij,gjm,bkm->blkgi", T, self.E, X, optimize=True)
        by_motion: FloatArray = np.einsum("blvkdi,blkgi->blvkdg", by_point, velocity, optimize=True)
        return by_motion

    def linearized(self, X: FloatArray, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (B, N), and derivatives (B, N, p) of pixels, both over their deviation."""
        r, by_point = self.residuals(X, T)
        by_motion = self.by_motion(by_point, X, T)
        g, k = len(self.E), X.shape[1] if self.free else 0
        J = np.zeros((*by_motion.shape[:-1], 3 * k + g * len(self.moving)))
        by_X = by_point @ T[:, :, None, None, :, :3]
        for i in range(k):
            J[..., i, :, 3 * i : 3 * i + 3] = by_X[..., i, :, :]
        for frame_index in self.moving:
            J[:, frame_index, ..., self.columns(frame_index, X.shape[1])] = by_motion[:, frame_index]
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

    def settled(
        self, X: FloatArray, T: FloatArray, steps: int = _STEPS
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points, displacements and sums of squares (B,) at a minimum, from each start."""

        def equations(X: FloatArray, T: FloatArray) -> Equations:
            r, J = self.linearized(X, T)
            return Equations.of(-r, J)

        def moved(step: FloatArray, X: FloatArray, T: FloatArray) -> tuple[FloatArray, FloatArray]:
            return self.moved(X, T, step)

        (X, T), there = levenberg_marquardt((X, T), equations, moved, steps)
        return X, T, there.cost

    def poses(self, X: FloatArray, turns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacements (h, 4, 4) of known points X (k, 4) in one frame, and χ² (h,): minima, sorted.

        turns : (3, 3, 3) rotations that the search starts from.
        """
        center = X[:, :3].mean(axis=0)
        R = to_all_sides(generators(turns, center)[3:])
        straight = undistort(self.lens, self.s[0])
        rows = self.P[:, None, :2] - straight[..., None] * self.P[:, None, 2:]
        rows = rows[self.weight[0] > 0.0]
        turned = np.einsum("bij,kj->bki", R, X)
        of = np.nonzero(self.weight[0] > 0.0)[1]
        off = np.einsum("nrj,bnj->bnr", rows, turned[:, of]).reshape(len(R), -1)
        R[:, :3, 3] -= off @ np.linalg.pinv(rows[..., :3].reshape(-1, 3)).T
        return self._minima(X, self._minima(X, R, _FIRST_STEPS)[0][:_PLACES], _STEPS)

    def _minima(self, X: FloatArray, T: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
        """Displacements (h, 4, 4) to before the cameras, and χ² (h,), by steps from some (B, 4, 4)."""
        _, ends, cost = self.settled(np.broadcast_to(X, (len(T), *X.shape)), T[:, None], steps)
        there = X @ ends[:, 0].swapaxes(1, 2)
        depth = np.einsum("vj,bkj->bvk", self.P[:, 2], there)
        ahead = (depth > 0.0).all(axis=(1, 2), where=self.weight[0] > 0.0) & np.isfinite(cost)
        kept: list[int] = []
        for i in np.argsort(cost).tolist():
            if ahead[i] and all(differ(there[i], there[j]) for j in kept):
                kept.append(i)
        return ends[kept, 0], cost[kept]


def differ(X: FloatArray, Y: FloatArray) -> bool:
    """Whether points (k, 4) differ by more than a share of their size."""
    size = np.linalg.norm(X - X.mean(axis=0), axis=1).max()
    return bool(np.linalg.norm(X - Y, axis=1).max() > _SAME * size)


class UncertainPoints(NamedTuple):
    """Points in the frame of a rig, and their changes by independent errors of unit variance."""

    X: FloatArray  # (k, 4)
    by_images: FloatArray  # (k, 3, N)
    by_calibration: FloatArray  # (k, 3, c)


NO_POINTS = UncertainPoints(np.zeros((0, 4)), *np.zeros((2, 0, 3, 0)))


@dataclass(frozen=True, eq=False)
class BundleFit:
    """Points of a body and its displacements at some looks."""

    bundle: Bundle
    X: FloatArray  # (k, 4) points in the frame of the fixed look
    T: FloatArray  # (L, 4, 4)
    cost: float  # χ²

    @classmethod
    def settled(cls, bundle: Bundle, X: FloatArray, T: FloatArray) -> Self:
        """The minimum near points (k, 4) and displacements (L, 4, 4)."""
        X, T, cost = bundle.settled(X[None], T[None])
        return cls(bundle, X[0], T[0], float(cost[0]))

    def linearized(self) -> tuple[FloatArray, FloatArray]:
        """Residuals (N,) and derivatives (N, p) of visible markers, over their deviation."""
        r, J = self.bundle.linearized(self.X[None], self.T[None])
        seen = np.repeat(self.bundle.weight > 0.0, 2)
        return r[0, seen], J[0, seen]

    def moved(self, rig: ObjectViewRig, X: FloatArray) -> FloatArray:
        """Changes (N, c) of visible markers by errors of a calibration; X : (k, 4) or (B, k, 4) points."""
        weight, frames = self.bundle.weight[..., None], range(len(self.T))
        pixels = np.stack(
            [changes_of(rig.pixels(X @ self.T[frame_index].T)) for frame_index in frames], axis=1
        )
        return (weight * pixels)[:, self.bundle.weight > 0.0].reshape(len(pixels), -1).T

    @cached_property
    def inverse_hessian(self) -> FloatArray:
        """Inverse (p, p) of the second derivatives of χ²/2, with the derivatives of the images.

        Noise in the points makes them look better determined than they are: the residuals correct that.
        """
        size = np.maximum(np.linalg.norm(self.linearized()[1], axis=0), 1e-300)
        p = len(size)
        step = np.concatenate([np.eye(p), -np.eye(p)]) * (_PROBE / size)
        X, T = (np.broadcast_to(part, (len(step), *part.shape)) for part in (self.X, self.T))
        r, J = self.bundle.linearized(*self.bundle.moved(X, T, step))
        up, down = np.split(-(J.swapaxes(1, 2) @ r[..., None])[..., 0] / size, 2)
        H = (up - down) / (2.0 * _PROBE)
        values, vectors = np.linalg.eigh(0.5 * (H + H.T))
        # An unseen marker gets a large deviation instead of an infinite one.
        root = vectors / np.sqrt(np.maximum(values, _REGULAR)) / size[:, None]
        return np.asarray(root @ root.T)

    def errors(self, rig: ObjectViewRig, X: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors (p, N) of the minimum by the images that are seen, and (p, c) by the calibration.

        Each by independent ones of unit variance; X as for ``moved``.
        """
        by_images = self.inverse_hessian @ self.linearized()[1].T
        return by_images, -by_images @ self.moved(rig, X)

    def points_at(self, frame_index: int, rig: ObjectViewRig) -> "UncertainPoints":
        """Return the points in a frame, with their errors."""
        T, (k, p) = self.T[frame_index], (len(self.X), self.linearized()[1].shape[1])
        J = np.zeros((k, 3, p))
        for i in range(k if self.bundle.free else 0):
            J[i, :, 3 * i : 3 * i + 3] = T[:3, :3]
        if frame_index != self.bundle.fixed:
            velocity = np.einsum("ij,gjm,km->kig", T, self.bundle.E, self.X)
            J[..., self.bundle.columns(frame_index, k)] = velocity[:, :3]
        by_images, by_calibration = (J @ errors for errors in self.errors(rig, self.X))
        return UncertainPoints(self.X @ T.T, by_images, by_calibration)

    def unseen(self, frame_index: int) -> tuple[float, FloatArray]:
        """Largest deviation of the linear part of a displacement by the noise, and its direction."""
        own = self.bundle.columns(frame_index, len(self.X))
        values, vectors = np.linalg.eigh(self.inverse_hessian[own, own][3:, 3:])
        return float(np.sqrt(values[-1])), vectors[:, -1]
