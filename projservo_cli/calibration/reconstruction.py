"""A guessed metric reconstruction of the markers: a place to start from, never a result.

Everything guessed here (focal length, principal point, square pixels) is free in the adjustment,
whose result is projective.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.epipolar import homogeneous, normalization
from projservo_cli.calibration.readings import Readings
from projservo_cli.records import FloatArray, IntArray, WorkFailed

# Focal lengths tried, in units of the image size: from a fisheye's centre to a long lens. Without an
# image size the extent of the data stands in for it, which may be several times smaller.
SHORTEST, LONGEST, TRIALS = 0.4, 24.0, 28
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, eq=False)
class Guess:
    """Cameras and points in a guessed metric frame.

    Attributes
    ----------
    P : (2, 3, 4) cameras to pixels.
    points : (N, 3) reconstructed points, in units of their median distance from the left camera.
    spread : how much marker distances vary over the poses, median of |log ratio|.
    focal : guessed focal length over image size.
    """

    P: FloatArray
    points: FloatArray
    spread: float
    focal: float


@dataclass(frozen=True, eq=False)
class Frame:
    """Guessed principal points (2, 2) and sizes (2,) of both images, px; whether the images are known."""

    center: FloatArray
    size: FloatArray
    known: bool


def image_frame(readings: Readings, image_size: tuple[int, int] | None) -> Frame:
    """Centre and size of the images, from the extent of the data where they are not known.

    Parameters
    ----------
    readings : pixels of both views.
    image_size : width and height in px, or None.
    """
    if image_size is not None:
        center = np.tile(0.5 * np.asarray(image_size, dtype=np.float64), (2, 1))
        return Frame(center, np.full(2, float(max(image_size))), True)
    # The outermost percent is left out: it may be outliers.
    low, high = zip(
        *(np.percentile(readings.pixels[v][readings.seen[v]], [1, 99], axis=0) for v in (0, 1)), strict=True
    )
    size = np.array([float(np.max(h - l)) or 1.0 for l, h in zip(low, high, strict=True)])
    return Frame(0.5 * (np.array(low) + np.array(high)), size, False)


def intrinsics(frame: Frame, focal: float) -> FloatArray:
    """Guessed camera matrices (2, 3, 3) with square pixels, focal length in units of the image size."""
    K = np.zeros((2, 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = focal * frame.size
    K[:, :2, 2] = frame.center
    K[:, 2, 2] = 1.0
    return K


def relative_pose(F: FloatArray, K: FloatArray, left: FloatArray, right: FloatArray) -> Guess:
    """Metric pair of cameras from F and guessed intrinsics, with the points it reconstructs.

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., result 9.19; the solution of
    the four that has most points in front of both cameras.

    Parameters
    ----------
    F : (3, 3) fundamental matrix, rightᵀ F left = 0.
    K : (2, 3, 3) guessed intrinsics.
    left, right : (N, 2) corresponding pixels.
    """
    U, _, Vt = np.linalg.svd(K[1].T @ F @ K[0])
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    x = np.linalg.solve(K[0], homogeneous(left).T).T
    y = np.linalg.solve(K[1], homogeneous(right).T).T
    best = -1
    for R in (U @ W @ Vt, U @ W.T @ Vt):
        for t in (U[:, 2], -U[:, 2]):
            depth, depth_ = ray_depths(R, t, x, y)
            count = int(((depth > 0.0) & (depth_ > 0.0)).sum())
            if count > best:
                best, solution = count, (R, t, depth)
    R, t, depth = solution
    # A ray nearly parallel to its partner meets it anywhere: the median ignores the few.
    scale = float(np.median(np.abs(depth))) or 1.0
    left_camera = np.hstack([np.eye(3), np.zeros((3, 1))])
    right_camera = np.hstack([R, t[:, None] / scale])
    P = np.stack([K[0] @ left_camera, K[1] @ right_camera])
    return Guess(P, x * (depth / scale)[:, None], np.inf, 0.0)


def ray_depths(R: FloatArray, t: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Depths (N,) along both rays where they come closest: least squares of λ' y = λ R x + t.

    Parameters
    ----------
    R, t : rotation (3, 3) and translation (3,) from the left to the right camera.
    x, y : (N, 3) rays of the left and the right camera.
    """
    Rx = x @ R.T
    xx, yy, xy = (Rx**2).sum(axis=1), (y**2).sum(axis=1), (Rx * y).sum(axis=1)
    xt, yt = Rx @ t, y @ t
    determinant = np.maximum(xx * yy - xy**2, 1e-15 * xx * yy)
    return (xy * yt - yy * xt) / determinant, (xx * yt - xy * xt) / determinant


def marker_pairs(pose_of: IntArray, marker_of: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Two markers seen at the same pose: rows of the first, of the second, and which two markers they are."""
    order = np.lexsort((marker_of, pose_of))
    firsts, seconds = [], []
    for rows in np.split(order, np.flatnonzero(np.diff(pose_of[order])) + 1):
        a, b = np.triu_indices(rows.size, 1)
        firsts.append(rows[a])
        seconds.append(rows[b])
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    pair = marker_of[first] * (int(marker_of.max()) + 1) + marker_of[second]
    return first, second, np.unique(pair, return_inverse=True)[1]


def distance_spread(points: FloatArray, pairs: tuple[IntArray, IntArray, IntArray]) -> float:
    """Median over poses and marker pairs of |log distance − its median over the poses|.

    Parameters
    ----------
    points : (N, 3) reconstruction.
    pairs : result of ``marker_pairs``.
    """
    first, second, pair = pairs
    distance = np.linalg.norm(points[first] - points[second], axis=1)
    log = np.log(np.maximum(distance, 1e-12))
    order = np.argsort(pair, kind="stable")
    groups = np.split(log[order], np.flatnonzero(np.diff(pair[order])) + 1)
    deviations = [np.abs(g - np.median(g)) for g in groups if g.size > 1]
    return float(np.median(np.concatenate(deviations))) if deviations else np.inf


def guess_at(F: FloatArray, readings: Readings, frame: Frame, focal: float) -> Guess:
    """Reconstruction of the pairs seen by both cameras from a focal length in units of the image size.

    Parameters
    ----------
    F : (3, 3) fundamental matrix.
    readings : what was seen.
    frame : guessed principal points and sizes.
    focal : guessed.
    """
    left, right = (readings.pixels[v][readings.both] for v in (0, 1))
    return dataclasses.replace(relative_pose(F, intrinsics(frame, focal), left, right), focal=focal)


def metric_guesses(F: FloatArray, readings: Readings, frame: Frame, keep: int) -> list[Guess]:
    """Guessed reconstructions of the pairs seen by both cameras, best first.

    The focal length is the one that keeps the distances between markers most constant over the
    poses, each local minimum of a scan refined by golden section.

    Parameters
    ----------
    F : (3, 3) fundamental matrix.
    readings : what was seen.
    frame : guessed principal points and sizes.
    keep : most guesses to return.

    Raises
    ------
    WorkFailed
        If no two markers were seen together at two poses.
    """
    both = readings.both
    pairs = marker_pairs(readings.pose_of[both], readings.marker_of[both])

    def guess(log_focal: float) -> Guess:
        found = guess_at(F, readings, frame, float(np.exp(log_focal)))
        return dataclasses.replace(found, spread=distance_spread(found.points, pairs))

    grid = np.linspace(np.log(SHORTEST), np.log(LONGEST), TRIALS)
    scan = [guess(x) for x in grid]
    spread = np.array([g.spread for g in scan])
    if not np.isfinite(spread).any():
        raise WorkFailed("no two markers are seen together at two poses: more markers must be seen at once")
    padded = np.concatenate([[np.inf], spread, [np.inf]])
    minima = np.flatnonzero((spread <= padded[:-2]) & (spread < padded[2:]))
    minima = minima[np.argsort(spread[minima])][:keep]
    # A minimum at which the body changes its shape a lot more than at the best is none to start from.
    minima = minima[spread[minima] <= max(4.0 * spread[minima[0]], 0.05)]
    step = float(grid[1] - grid[0])
    return [_golden(guess, grid[i] - step, grid[i] + step, scan[i]) for i in minima]


def _golden(guess: Callable[[float], Guess], low: float, high: float, best: Guess) -> Guess:
    """Golden section search for the least spread between two logarithms of the focal length."""
    for _ in range(12):
        width = GOLDEN * (high - low)
        inner = [guess(high - width), guess(low + width)]
        if inner[0].spread < inner[1].spread:
            high = low + width
        else:
            low = high - width
        best = min([best, *inner], key=lambda g: g.spread)
    return best


WHITENINGS = 30


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Cameras and points in an isotropic projective frame.

    Attributes
    ----------
    P : (2, 3, 4) cameras to pixels.
    points : (N, 4) points of unit norm, with positive depth in both views where the data allow it.
    """

    P: FloatArray
    points: FloatArray


def canonical_pair(F: FloatArray) -> FloatArray:
    """Cameras (2, 3, 4) of a fundamental matrix, [I | 0] and [[e']× F | e'].

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., result 9.14.

    Parameters
    ----------
    F : (3, 3) matrix with rightᵀ F left = 0.
    """
    e = np.linalg.svd(F)[0][:, 2]
    right = np.hstack([np.cross(e[:, None], F, axis=0), e[:, None]])
    return np.stack([np.hstack([np.eye(3), np.zeros((3, 1))]), right])


def triangulate(P: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Points (N, 4) of unit norm from linear equations in both views.

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., section 12.2.

    Parameters
    ----------
    P : (2, 3, 4) cameras.
    left, right : (N, 3) homogeneous pixels with last entry one.
    """
    rows = np.concatenate(
        [image[:, :2, None] * camera[2] - camera[:2] for camera, image in zip(P, (left, right), strict=True)],
        axis=1,
    )
    return np.linalg.svd(rows)[2][:, 3]


def isotropic_frame(points: FloatArray) -> FloatArray:
    """Frame change W (4, 4) after which points of unit norm have a multiple of I as second moment.

    Without it one coordinate is a thousand times another and every linear method after it fails.

    Parameters
    ----------
    points : (N, 4) points of any scale.
    """
    W = np.eye(4)
    for _ in range(WHITENINGS):
        moved = points @ W.T
        moved = moved / np.linalg.norm(moved, axis=1, keepdims=True)
        W = np.linalg.inv(np.linalg.cholesky(4.0 * moved.T @ moved / len(moved))) @ W
    return W


def reconstruct(F: FloatArray, left: FloatArray, right: FloatArray) -> Reconstruction:
    """Isotropic projective reconstruction of corresponding pixels.

    Parameters
    ----------
    F : (3, 3) fundamental matrix, px.
    left, right : (N, 2) corresponding pixels.
    """
    T = np.stack([normalization(left), normalization(right)])
    back = np.linalg.inv(T)
    P = canonical_pair(back[1].T @ F @ back[0])
    # The right camera is known up to P' + e' vᵀ: a frame in which its left block is not singular.
    points = triangulate(P, homogeneous(left) @ T[0].T, homogeneous(right) @ T[1].T)
    W = isotropic_frame(points)
    points = points @ W.T
    P = back @ P @ np.linalg.inv(W)
    depth = points @ P[:, 2].T
    points = points * np.sign(depth[:, :1]) / np.linalg.norm(points, axis=1, keepdims=True)
    P[1] *= np.sign(np.median(points @ P[1, 2]))
    return Reconstruction(P, points)
