"""One view: the tool as a rigid body that moves freely before a camera, without joint readings.

It starts a calibration by one camera, and shows the noise of its images, as the epipolar geometry does
for two. A small body is nearly seen by scaled orthography: a factorisation gives its shape and its turns up
to a reflection in depth. Perspective decides on the reflection and gives the focal length.
C. Tomasi, T. Kanade, "Shape and motion from image streams under orthography", IJCV 9(2), 1992.

[HZ04] is R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., 2004.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.calibration.detections import (
    MAD,
    MIN_SIGMA,
    RAYLEIGH,
    Detections,
    cauchy_weights,
    even_choice,
    robust_deviation,
)
from projservo_cli.calibration.initial.epipolar import (
    OUTLIER,
    Core,
    ImageFrame,
    ImageGeometry,
    exact_px,
    planar_homography,
    similarity,
)
from projservo_cli.geometry.displacements import cross_matrix, homogeneous
from projservo_cli.records import BoolArray, FloatArray, IntArray, WorkFailed

# Focal lengths with which the body is fitted, in image sizes.
_FOCALS = (0.6, 1.0, 1.7, 3.0, 5.0)
# Maximum number of poses in the fit, number of markers wanted in each, and minimum numbers of both.
_POSES, _MARKERS, _LEAST_MARKERS, _LEAST_POSES = 120, 40, 4, 4
# Golden ratio, whose multiples modulo one spread evenly.
_GOLDEN = 1.618033988749895
# Number of poses with more markers than the minimum from which the others stay out of the fit.
_ENOUGH_POSES = 10
# Rounds of the factorisation, each of all cameras, then of the shape; the first ones, of least squares.
_ROUNDS, _PLAIN_ROUNDS = 80, 20
# Minimum noise of a factorisation over the extent of the markers in an image, of which perspective is a part.
_AFFINE = 0.005
# Minimum depth of a shape over its width in the frame of a factorisation, which noise may take below zero.
_FLAT = 0.02
# Distance from a homography, over the extent of the markers in the image, up to which a body is flat.
_PLANE = 0.02
# Number of the likeliest planes that are tried at each focal length.
_PLANES_TRIED = 3
# Tilts of these planes, rad.
_TILTS = np.radians([15.0, 30.0, 45.0, 60.0, 72.0])
# Steps of a rough fit and of a full one, of the few best; fall of the cost that ends it, and damping.
_ROUGHLY, _FULLY, _FEW, _PRECISE, _HOPELESS = 20, 100, 3, 1e-10, 1e8
# Expected relative deviations of aspect and middle of the image, the latter over the focal length.
_ASPECT, _MIDDLE = 0.01, 0.1
# Roots of the weights of ``_State.g`` at a unit width of the loss, which is two deviations.
_PRIOR = 0.5 * np.array([0.0, 1.0 / _ASPECT, 1.0 / _MIDDLE, 1.0 / _MIDDLE])
# Cost over the best one up to which another focal length or reflection is a start too.
_AS_LIKELY = 4.0
# Number of intrinsic parameters: logarithm of the focal length, aspect, and the middle of the image.
_INTRINSICS = 4
# Directions of the change of frame and scale, which no image shows.
_GAUGE = 7


class _Start(NamedTuple):
    """Guessed poses and shape of a body, and a focal length."""

    R: FloatArray  # (K, 3, 3)
    t: FloatArray  # (K, 3)
    X: FloatArray  # (m, 3)
    focal: float  # px


class _Body(NamedTuple):
    """A body, its poses before a camera, and the camera."""

    R: FloatArray  # (K, 3, 3)
    t: FloatArray  # (K, 3)
    X: FloatArray  # (m, 3)
    focal: FloatArray  # (2,) of u and v, px
    middle: FloatArray  # (2,) px
    cost: float  # cost of the fit
    residual: FloatArray  # (N, 2) px, weighted

    @property
    def start(self) -> _Start:
        """Start of a further fit."""
        return _Start(self.R, self.t, self.X, float(self.focal[0]))

    @property
    def camera(self) -> FloatArray:
        """Camera (1, 3, 4) at the origin of the frame."""
        P = np.zeros((1, 3, 4))
        P[0, [0, 1], [0, 1]], P[0, :2, 2], P[0, 2, 2] = self.focal, self.middle, 1.0
        return P


@dataclass(frozen=True, eq=False)
class RigidBody(ImageGeometry):
    """Rigid motions of the tool before one camera, and the noise of its images."""

    bodies: list[_Body]  # fits that explain the images, best first
    pose: IntArray  # (K,) rows of the poses in the fit
    marker: IntArray  # (m,) numbers of the markers in the fit
    dof: int

    origin, evidence = "body", "a rigid body shows"

    @classmethod
    def of(cls, detections: Detections, frame: ImageFrame) -> "RigidBody":
        """Fit a rigid body to the images of one view.

        Raises WorkFailed with too few poses of four markers, or if no rigid body explains the images.
        """
        pose, marker, images, weight = _chosen(detections)
        focals, middle = float(frame.size[0]) * np.array(_FOCALS), frame.center[0]
        bodies = _explaining(images, weight, focals, middle)
        if not bodies:
            raise WorkFailed(
                f"no rigid body explains the images of the {detections.view[0]} camera: check marker "
                "numbers, and add poses in which several joints move"
            )
        count = 2 * len(bodies[0].residual)
        dof = count - (6 * len(pose) + 3 * len(marker) + _INTRINSICS - _GAUGE)
        if dof <= 0:
            raise WorkFailed(
                "too few markers for one camera: show four or more in each image, and more poses"
            )
        residual, seen = bodies[0].residual, np.isfinite(images[..., 0])
        distance, factor = np.linalg.norm(residual, axis=1), float(np.sqrt(count / dof))
        inlier = distance <= OUTLIER * factor * float(np.median(distance)) / RAYLEIGH
        sigma = float(np.sqrt((distance[inlier] ** 2).sum() / max(dof - 2 * np.count_nonzero(~inlier), 1)))
        core = Core.of(residual.ravel(), np.repeat(np.nonzero(seen)[0], 2))
        core = Core(factor * core.sigma_px, factor * core.interval)
        min_px = exact_px(detections.pixels[0, detections.seen[0]])
        return cls(sigma, core, min_px, bodies, pose, detections.marker[marker], dof)

    @property
    def relative_error(self) -> float:
        """Relative standard error of the noise."""
        return float(1.0 / np.sqrt(2.0 * self.dof))

    def placeable_markers(self, detections: Detections) -> BoolArray:
        """Mask (m,) of the markers in the fit."""
        return np.isin(detections.marker, self.marker)

    def _points(self, detections: Detections, body: _Body) -> FloatArray:
        """Points (N, 3) of observations before the camera, NaN where pose or marker is not in the fit."""
        row = np.full(len(detections.q), -1)
        row[self.pose] = np.arange(len(self.pose))
        number = {int(j): i for i, j in enumerate(self.marker)}
        column = np.array([number.get(int(j), -1) for j in detections.marker], dtype=np.int64)
        k, j = row[detections.pose_of], column[detections.marker_of]
        points = (body.R[k] @ body.X[j][..., None])[..., 0] + body.t[k]
        return np.where(((k >= 0) & (j >= 0))[:, None], points, np.nan)

    def within(self, detections: Detections, deviations: float) -> BoolArray:
        """Mask (N,) of observations that fit the body to some standard deviations."""
        body = self.bodies[0]
        m = self._points(detections, body) @ body.camera[0, :, :3].T
        off = (m[:, :2] / m[:, 2:] - detections.pixels[0]) * detections.weight[0, :, None]
        return np.asarray(np.linalg.norm(off, axis=1) <= deviations * self.sigma_px)

    def guesses(
        self, detections: Detections, frame: ImageFrame, factor: float
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Cameras (1, 3, 4) and points (N, 3), NaN if unknown, in guessed metric frames, best first.

        factor : on the focal length and the depth, which are hardly known apart.
        """
        found = []
        for body in self.bodies:
            if body.cost > _AS_LIKELY * self.bodies[0].cost:
                break
            P, points = body.camera, self._points(detections, body)
            scale = float(np.nanmedian(points[:, 2])) or 1.0
            P[0, [0, 1], [0, 1]] *= factor
            found.append((P, points * [1.0, 1.0, factor] / (scale * factor)))
        return found


def _chosen(detections: Detections) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Rows of poses (K,), indices of markers (m,), images (K, m, 2), NaN if unseen, and weights (K, m)."""
    images, seen = detections.dense()[0], detections.seen[0]
    weight = np.ones(images.shape[:2])
    weight[detections.pose_of[seen], detections.marker_of[seen]] = detections.weight[0, seen]
    often = np.isfinite(images[..., 0]).sum(axis=0)
    # Neighbours show nearly the same: steps of the golden ratio take distant ones of those seen as often.
    spread = _GOLDEN * np.arange(often.size) % 1.0
    order = np.lexsort((spread, -often))
    marker = np.flatnonzero(detections.covering(order[often[order] >= _LEAST_POSES], _MARKERS))
    count = np.isfinite(images[:, marker, 0]).sum(axis=1)
    # A start knows poses of four markers badly, and a fit then falls into minima of these: more, if enough.
    more = np.count_nonzero(count > _LEAST_MARKERS) >= _ENOUGH_POSES
    pose = np.flatnonzero(count >= _LEAST_MARKERS + more)
    if pose.size < _LEAST_POSES:
        raise WorkFailed(
            f"the {detections.view[0]} camera alone saw {_LEAST_MARKERS} markers at once in {pose.size} "
            f"poses: {_LEAST_POSES} are required; show more markers, or add the images of a second camera"
        )
    pose = pose[even_choice(pose.size, _POSES)]
    which = np.ix_(pose, marker)
    return pose, marker, images[which], weight[which]


def _explaining(
    images: FloatArray, weight: FloatArray, focals: FloatArray, middle: FloatArray
) -> list[_Body]:
    """Return bodies that explain images (K, m, 2), best first: flat or not, and in both senses of depth.

    weight : (K, m) of the residuals; focals : focal lengths to begin with, px.
    """

    def fitted(starts: list[_Start], count: int) -> list[_Body]:
        """Fit the best few of many starts."""
        rough = _all_fitted(images, weight, starts, middle, _ROUGHLY)[:count]
        return _all_fitted(images, weight, [body.start for body in rough], middle, _FULLY)

    bodies = fitted(_flat_starts(images, focals, middle, _PLANE), _FEW)
    bodies = bodies or fitted(_deep_starts(images, focals, middle), _FEW)
    # Small turns hardly show the depth of a body: it is taken as flat at first.
    bodies = bodies or fitted(_flat_starts(images, focals, middle, np.inf), _FEW)
    others = fitted(_reversed(bodies[0], focals), 1) if bodies else []
    return sorted([*bodies, *others], key=lambda body: body.cost)


def _factorised(images: FloatArray, placed: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Affine cameras A (K, 2, 3) and b (K, 2), and a shape (m, 3), of images (K, m, 2), NaN if unseen.

    By alternating least squares from markers (m,) that are seen together, since others are missing, and under
    a Cauchy loss, since some are wrong.
    """
    seen, known = np.isfinite(images[..., 0]), np.nan_to_num(images)
    whole = seen[:, placed].all(axis=1)
    block = known[whole][:, placed]
    rows = (block - block.mean(axis=1, keepdims=True)).swapaxes(1, 2).reshape(-1, np.count_nonzero(placed))
    X = np.zeros((images.shape[1], 3))
    X[placed] = np.linalg.svd(rows, full_matrices=False)[2][:3].T * np.sqrt(np.count_nonzero(placed))
    loss, extent = np.ones(seen.shape), float(np.abs(rows).mean())
    for number in range(_ROUNDS):
        weight = loss * (seen & placed)
        posed = np.count_nonzero(weight, axis=1) >= _LEAST_MARKERS
        H = np.hstack([X, np.ones((len(X), 1))])
        G = np.einsum("kj,ja,jb->kab", weight, H, H) + 1e-9 * np.eye(4)
        C = np.linalg.solve(G, np.einsum("kj,ja,kjc->kac", weight, H, known))
        A, b = C[:, :3].swapaxes(1, 2), C[:, 3]
        weight = loss * (seen & posed[:, None])
        placed = np.count_nonzero(weight, axis=0) >= _LEAST_POSES
        G = np.einsum("kj,kca,kcb->jab", weight, A, A)
        G += 1e-12 * np.trace(G, axis1=1, axis2=2).max() * np.eye(3)
        right = np.einsum("kj,kca,kjc->ja", weight, A, known - b[:, None])
        X = np.where(placed[:, None], np.linalg.solve(G, right[..., None])[..., 0], 0.0)
        X -= X[placed].mean(axis=0) * placed[:, None]
        if number >= _PLAIN_ROUNDS:
            off = np.linalg.norm(np.einsum("kca,ja->kjc", A, X) + b[:, None] - known, axis=2)
            width = 2.0 * robust_deviation(off[seen & placed], _AFFINE * extent)
            loss = cauchy_weights((off / width) ** 2)
    return A, b, X


def _together(seen: BoolArray) -> BoolArray:
    """Mask (m,) of a few markers that most poses (K, m) show at once."""
    chosen, whole = np.zeros(seen.shape[1], dtype=np.bool_), np.ones(len(seen), dtype=np.bool_)
    for _ in range(_LEAST_MARKERS + 1):
        count = np.where(chosen, -1, np.count_nonzero(seen & whole[:, None], axis=0))
        best = int(np.argmax(count))
        if count[best] >= _LEAST_POSES:
            chosen[best] = True
            whole &= seen[:, best]
    return chosen


def _upgraded(A: FloatArray, X: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Change the frame so that both rows of each camera (K, 2, 3) are of equal length and orthogonal."""
    i, j = np.triu_indices(3)
    twice = np.where(i == j, 0.5, 1.0)

    def quadratic(u: FloatArray, v: FloatArray) -> FloatArray:
        """Coefficients (K, 6) of uᵀ S v by the entries of a symmetric S."""
        return np.asarray(twice * (u[:, i] * v[:, j] + u[:, j] * v[:, i]))

    u, v = A[:, 0], A[:, 1]
    rows = np.concatenate([quadratic(u, u) - quadratic(v, v), quadratic(u, v)])
    rows /= np.tile((A**2).sum(axis=(1, 2)), 2)[:, None]
    S = np.zeros((3, 3))
    S[i, j] = S[j, i] = np.linalg.svd(rows)[2][-1]
    values, V = np.linalg.eigh(S * np.sign(np.trace(S)))
    Q = V * np.sqrt(np.maximum(values, _FLAT**2 * values.max()))
    return A @ Q, X @ np.linalg.inv(Q).T


def _deep_starts(images: FloatArray, focals: FloatArray, middle: FloatArray) -> list[_Start]:
    """Starts of a body that is not flat: of both reflections at each focal length, px.

    Empty if too few markers are seen together.
    """
    together = _together(np.isfinite(images[..., 0]))
    if np.count_nonzero(together) < _LEAST_MARKERS:
        return []
    A, b, X = _factorised(images, together)
    A, X = _upgraded(A, X)
    sides = (np.array([1.0, 1.0, side]) for side in (1.0, -1.0))
    return [_posed(A * side, b, X * side, focal, middle) for side in sides for focal in focals.tolist()]


def _posed(A: FloatArray, b: FloatArray, X: FloatArray, focal: float, middle: FloatArray) -> _Start:
    """Start by scaled orthographic cameras A (K, 2, 3), b (K, 2) of a shape (m, 3), and a focal length, px.

    Each turn is about the line of sight to the body.
    """
    U, s, Vt = np.linalg.svd(A)
    across = U @ Vt[:, :2]
    R = np.concatenate([across, np.cross(across[:, 0], across[:, 1])[:, None]], axis=1)
    ray = np.hstack([(b - middle) / focal, np.ones((len(b), 1))])
    turn = np.cross([0.0, 0.0, 1.0], ray)
    size = np.linalg.norm(turn, axis=1, keepdims=True)
    turn *= np.arctan(size) / np.maximum(size, 1e-12)
    R = Rotation.from_rotvec(turn).as_matrix() @ R
    return _Start(R, ray * (focal / s.mean(axis=1))[:, None], X, focal)


def _reversed(body: _Body, focals: FloatArray) -> list[_Start]:
    """Starts of a body reversed in depth, which orthography sees alike, at each focal length, px."""
    ray, inside_out = body.t / np.linalg.norm(body.t, axis=1, keepdims=True), np.diag([1.0, 1.0, -1.0])
    R = (np.eye(3) - 2.0 * ray[:, :, None] * ray[:, None]) @ body.R @ inside_out
    X, unit = body.X @ inside_out, float(body.focal[0])
    return [_Start(R, body.t * [1.0, 1.0, focal / unit], X, focal) for focal in focals.tolist()]


def _flat_starts(
    images: FloatArray, focals: FloatArray, middle: FloatArray, max_distance: float
) -> list[_Start]:
    """Starts of a flat body, empty if it is not flat: of the likeliest planes at each focal length, px.

    Homographies from one image to the others, [HZ04] 4.1, show any plane; in metric coordinates of the right
    plane the first two columns of each are orthogonal and of equal length, Z. Zhang, PAMI 22(11), 2000.

    max_distance : distance from a homography, over the extent of the markers in the image, of a flat body.
    """
    seen = np.isfinite(images[..., 0])
    across = [np.linalg.svd(x[k] - x[k].mean(axis=0))[1] for x, k in zip(images, seen, strict=True)]
    extent = np.array(across)[:, 1]
    first = int(np.argmax(extent * (seen.sum(axis=1) >= 0.8 * seen.sum(axis=1).max())))
    others = np.flatnonzero((seen & seen[first]).sum(axis=1) > _LEAST_MARKERS)
    H, off = np.zeros((len(images), 3, 3)), np.full(len(images), np.inf)
    for k in others:
        both = seen[k] & seen[first]
        H[k] = moved_plane(images[first, both], images[k, both])
        moved = homogeneous(images[first, both]) @ H[k].T
        left = moved[:, :2] / moved[:, 2:] - images[k, both]
        off[k] = np.median(np.linalg.norm(left, axis=1)) / max(float(extent[k]), 1e-9)
    if others.size < _LEAST_POSES or float(np.median(off[others])) > max_distance:
        return []
    near, starts = np.isfinite(off) & (off <= 4.0 * max_distance), list[_Start]()
    center = homogeneous(images[first, seen[first]].mean(axis=0)[None])[0]
    for focal in focals.tolist():
        camera = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
        planes = _planes(np.linalg.solve(camera, center))
        columns = np.linalg.solve(camera, H[near] @ camera)[:, None] @ planes  # (k, planes, 3, 3)
        u, v = columns[..., 0], columns[..., 1]
        uu, vv, uv = (u**2).sum(axis=-1), (v**2).sum(axis=-1), (u * v).sum(axis=-1)
        wrong = np.median(((uu - vv) ** 2 + 4.0 * uv**2) / (uu + vv) ** 2, axis=0)
        for number in np.argsort(wrong)[:_PLANES_TRIED]:
            starts.append(_flat_start(images, camera, H, planes[number], near))
    return starts


def _planes(ray: FloatArray) -> FloatArray:
    """Planes (p, 3, 3) through a point on a ray: two directions of the plane, then the point, as columns."""
    angles = np.arange(0.0, 2.0 * np.pi, np.pi / 8.0)
    around = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    turns = np.concatenate([np.zeros((1, 3)), *(tilt * around for tilt in _TILTS)])
    planes = Rotation.from_rotvec(turns).as_matrix()
    planes[..., 2] = ray
    return np.asarray(planes)


def moved_plane(a: FloatArray, b: FloatArray) -> FloatArray:
    """Homography (3, 3) of pixels (N, 2) to others of the same markers, four or more: [HZ04] 4.1."""
    T, U = similarity(a), similarity(b)
    H = planar_homography(homogeneous(a) @ T.T, homogeneous(b) @ U.T)
    return np.asarray(np.linalg.inv(U) @ H @ T)


def _flat_start(
    images: FloatArray, camera: FloatArray, H: FloatArray, plane: FloatArray, known: BoolArray
) -> _Start:
    """Start of a flat body in a plane (3, 3), by homographies (K, 3, 3) of which some are known."""
    seen = np.isfinite(images[..., 0])
    G = np.where(known[:, None, None], np.linalg.solve(camera, H @ camera) @ plane, plane)
    back = np.linalg.inv(camera @ G)
    on_plane = homogeneous(images.reshape(-1, 2)).reshape(*images.shape[:2], 3) @ back.swapaxes(1, 2)
    positions = np.where((seen & known[:, None])[..., None], on_plane[..., :2] / on_plane[..., 2:], np.nan)
    X = np.zeros((images.shape[1], 3))
    some = np.isfinite(positions[..., 0]).any(axis=0)
    X[some, :2] = np.nanmedian(positions[:, some], axis=0)
    size = np.linalg.norm(G[..., :2], axis=1).mean(axis=1)
    G = G / size[:, None, None] * np.sign(G[:, 2, 2])[:, None, None]
    U, _, Vt = np.linalg.svd(G[..., :2], full_matrices=False)
    across = U @ Vt
    R = np.concatenate([across, np.cross(across[..., 0], across[..., 1])[..., None]], axis=2)
    return _Start(R, G[..., 2], X, float(camera[0, 0]))


def _all_fitted(
    images: FloatArray,
    weight: FloatArray,
    starts: Sequence[_Start],
    middle: FloatArray,
    steps: int,
) -> list[_Body]:
    """Fits from starts that keep the body in front of the camera, best first."""
    found = [_fitted(images, weight, start, middle, steps) for start in starts]
    return sorted((body for body in found if body is not None), key=lambda body: body.cost)


def _fitted(
    images: FloatArray, weight: FloatArray, start: _Start, middle: FloatArray, steps: int
) -> _Body | None:
    """Fit body, poses and camera to images (K, m, 2) under a Cauchy loss; None if points fall behind it.

    weight : (K, m) of the residuals; steps : maximum number for each of two widths of the loss.
    """
    unit = float(np.linalg.norm(start.t, axis=1).mean())
    state = _State(np.zeros(_INTRINSICS), start.R, start.t / unit, start.X / unit)
    problem = _Images.of(images, weight, start.focal, middle)
    with np.errstate(all="ignore"):  # of points in the plane of the camera
        for _ in range(2):  # the width of the loss follows the residuals
            off = np.abs(problem.residual(state))
            if not np.isfinite(off).all():
                return None
            state = problem.fitted(state, 2.0 * max(float(np.median(off)) / MAD, MIN_SIGMA), steps)
    off, Y = problem.residual(state), problem.placed(state)
    if not np.isfinite(off).all() or (Y[:, 2] <= 0.0).any():
        return None
    cost = float(np.median(np.linalg.norm(off, axis=1)))
    shift = middle + start.focal * state.g[2:]
    return _Body(state.R, state.t, state.X, problem.focal(state), shift, cost, off)


class _State(NamedTuple):
    """Unknowns of a body before a camera."""

    g: FloatArray  # (4,) logarithms of focal length and aspect, and shift of the middle over the focal length
    R: FloatArray  # (K, 3, 3) rotations
    t: FloatArray  # (K, 3) places
    X: FloatArray  # (m, 3) shape

    def moved(self, camera: FloatArray, poses: FloatArray, shape: FloatArray) -> "_State":
        """State after a step of the camera (4,), of turns and places (K, 6), and of the shape (m, 3)."""
        turn = Rotation.from_rotvec(poses[:, :3]).as_matrix()
        return _State(self.g + camera, turn @ self.R, self.t + poses[:, 3:], self.X + shape)


class _Normal(NamedTuple):
    """Normal equations of camera and shape, of the poses, and between them."""

    A: FloatArray  # (4 + 3 m, 4 + 3 m)
    B: FloatArray  # (K, 6, 4 + 3 m)
    D: FloatArray  # (K, 6, 6)
    a: FloatArray  # (4 + 3 m,) gradient
    d: FloatArray  # (K, 6)

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Damped step of camera and shape (4 + 3 m,), and of the poses (K, 6), which are eliminated."""
        factor = 1.0 + damping
        D = np.where(np.eye(6, dtype=bool), factor * self.D + 1e-12, self.D)
        A = np.where(np.eye(len(self.A), dtype=bool), factor * self.A + 1e-12, self.A)
        solved = np.linalg.solve(D, np.concatenate([self.B, self.d[..., None]], axis=2))
        flat = self.B.reshape(-1, len(A))
        left = A - flat.T @ solved[..., :-1].reshape(-1, len(A))
        x = -np.linalg.solve(left, self.a - flat.T @ solved[..., -1].ravel())
        return np.asarray(x), np.asarray(-solved[..., -1] - solved[..., :-1] @ x)


class _Images(NamedTuple):
    """Images (N, 2) of a body by one camera, and priors of the camera."""

    k: IntArray  # (N,) pose
    j: IntArray  # (N,) marker
    seen: FloatArray  # (N, 2) px
    weight: FloatArray  # (N, 1)
    f: float  # focal length that the logarithm is from, px
    middle: FloatArray  # (2,) px

    @classmethod
    def of(cls, images: FloatArray, weight: FloatArray, f: float, middle: FloatArray) -> "_Images":
        """Return the images (K, m, 2) that were seen, with weights (K, m)."""
        k, j = np.nonzero(np.isfinite(images[..., 0]))
        return cls(k, j, images[k, j], weight[k, j][:, None], f, middle)

    def focal(self, state: _State) -> FloatArray:
        """Focal lengths (2,) of u and v, px."""
        return np.asarray(self.f * np.exp(state.g[0]) * np.array([1.0, np.exp(state.g[1])]))

    def placed(self, state: _State) -> FloatArray:
        """Points (N, 3) before the camera."""
        return np.asarray((state.R[self.k] @ state.X[self.j][..., None])[..., 0] + state.t[self.k])

    def residual(self, state: _State) -> FloatArray:
        """Weighted predicted minus seen pixels (N, 2)."""
        Y = self.placed(state)
        pixels = self.focal(state) * Y[:, :2] / Y[:, 2:] + self.middle + self.f * state.g[2:]
        return np.asarray(self.weight * (pixels - self.seen))

    def cost(self, state: _State, width: float) -> float:
        """Cauchy loss of a width, px, with the priors of the camera; NaN at infinity."""
        loss = width**2 * float(np.log1p(np.square(self.residual(state) / width)).sum())
        return loss + float(np.square(width * _PRIOR * state.g).sum())

    def normal(self, state: _State, width: float) -> _Normal:
        """Normal equations of the residuals, weighted as the Cauchy loss does."""
        f, Y, r = self.focal(state), self.placed(state), self.residual(state)
        (K, m), N = (len(state.R), len(state.X)), len(Y)
        root = self.weight * np.sqrt(cauchy_weights(np.square(r / width)))
        D = np.zeros((N, 2, 3))
        D[:, 0, 0], D[:, 1, 1] = f[0] / Y[:, 2], f[1] / Y[:, 2]
        D[:, :, 2] = -f * Y[:, :2] / Y[:, 2:] ** 2
        by_camera = np.zeros((N, 2, _INTRINSICS))
        by_camera[..., 0] = f * Y[:, :2] / Y[:, 2:]
        by_camera[:, 1, 1] = by_camera[:, 1, 0]
        by_camera[:, 0, 2] = by_camera[:, 1, 3] = self.f
        by_turn = -D @ cross_matrix(Y - state.t[self.k])
        by_pose = root[..., None] * np.concatenate([by_turn, D], axis=2)
        J = np.zeros((N, 2, _INTRINSICS + 3 * m))
        J[..., :_INTRINSICS] = root[..., None] * by_camera
        own = _INTRINSICS + 3 * self.j[:, None, None] + np.arange(3)
        np.put_along_axis(J, np.broadcast_to(own, (N, 2, 3)), root[..., None] * (D @ state.R[self.k]), axis=2)
        r = r * root / self.weight
        edges = np.searchsorted(self.k, np.arange(K))
        own = np.concatenate([by_pose, r[..., None]], axis=2)
        across = np.add.reduceat(by_pose.swapaxes(1, 2) @ own, edges)
        flat = J.reshape(2 * N, -1)
        A, a = flat.T @ flat, flat.T @ r.ravel()
        prior = np.arange(_INTRINSICS)
        A[prior, prior] += (width * _PRIOR) ** 2
        a[:_INTRINSICS] += (width * _PRIOR) ** 2 * state.g
        B = np.stack([by_pose[at].reshape(-1, 6).T @ J[at].reshape(-1, len(a)) for at in self._rows(edges)])
        return _Normal(A, B, across[..., :-1], a, across[..., -1])

    def _rows(self, edges: IntArray) -> list[slice]:
        """Observations of each pose, which come one after the other."""
        return [slice(*pair) for pair in zip(edges, [*edges[1:], len(self.k)], strict=True)]

    def fitted(self, state: _State, width: float, steps: int) -> _State:
        """Minimize the loss of a width, px, by the method of Levenberg and Marquardt."""
        cost, damping, here = self.cost(state, width), 1e-3, None
        for _ in range(steps):
            here = here or self.normal(state, width)
            try:
                x, poses = here.step(damping)
            except np.linalg.LinAlgError:
                break
            candidate = state.moved(x[:_INTRINSICS], poses, x[_INTRINSICS:].reshape(-1, 3))
            new_cost = self.cost(candidate, width)
            if new_cost <= cost:
                settled = cost - new_cost <= _PRECISE * cost
                state, cost, here, damping = candidate, new_cost, None, max(0.1 * damping, 1e-9)
            else:
                damping, settled = 10.0 * damping, damping > _HOPELESS
            if settled:
                break
        return state
