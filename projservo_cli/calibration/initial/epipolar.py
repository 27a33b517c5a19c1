"""Epipolar geometry from noisy correspondences, some of them wrong, and reconstructions from it.

The metric reconstruction rests on guesses (focal length, image centre, square pixels) and only starts the
adjustment, which frees all of it and whose result is projective.

[HZ04] is R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., 2004.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.optimize import least_squares, minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from projservo_cli.calibration.detections import Detections, even_choice, medians, robust_deviation
from projservo_cli.geometry.displacements import homogeneous
from projservo_cli.image_size import ImageSize, image_sizes
from projservo_cli.records import BoolArray, FloatArray, IntArray, WorkFailed

# Residual, in standard deviations, above which correspondences and detections are outliers.
OUTLIER = 5.0
# Maximum number of correspondences used.
_CORRESPONDENCES = 20_000
# Number of random minimal samples, of eight correspondences each.
_SAMPLES = 500
# Number of correspondences that score each sample.
_JUDGES = 1000
# Degrees of freedom of a fundamental matrix.
_PARAMETERS = 7
# Relative change of the loss, the parameters and the gradient that ends its search.
_TIGHT = 1e-14
# Size of residuals, in deviations, up to which they form the core of their distribution.
_CORE = 3.0
# Mean square of a standard normal variable within the core.
_CORE_MEAN = 0.9733369246625415
# Maximum number of rounds of the search for the deviation of the core.
_CORE_ROUNDS = 100
# Relative change of the deviation that ends this search.
_CORE_SETTLED = 1e-9
# Relative step of the derivative of the scores by the deviation.
_CORE_STEP = 0.1
# Logarithm of the maximum factor by which the interval extends on either side.
_CORE_OPEN = 10.0
# Minimum median distance of the right view from a homography of the left one, in units of the noise.
_MIN_PARALLAX = 3.0
# Noise over the extent of the markers, below which images are exact: of 0.01 px no detector is better.
_EXACT = 1e-4
# Maximum number of markers a pose of which all pairs are compared.
_PAIRED = 20
# Maximum number of poses whose distances are compared.
_COMPARED = 200
# Minimum focal length tried, in image sizes, as in the centre of a fisheye.
_SHORTEST = 0.4
# Maximum focal length tried, in image sizes: a long lens, with the extent of the data as the image size.
_LONGEST = 24.0
# Number of focal lengths tried, in even steps of the logarithm.
_TRIALS = 28
# Maximum number of minima of the scan that are kept.
_MAX_GUESSES = 3
# Accuracy of a refined minimum, in steps of the scan.
_FINE = 0.01


@dataclass(frozen=True, eq=False)
class ImageGeometry(ABC):
    """Geometry that images show without the joints, and the noise of its residuals."""

    sigma_px: float  # noise per image coordinate from the residuals, px
    core: "Core"  # the same noise, robust against many wrong correspondences, and its interval
    min_px: float  # noise below which images are exact

    origin: ClassVar[str]  # origin of the noise: views, or body
    evidence: ClassVar[str]  # who shows it, for messages

    @property
    def noise_px(self) -> float:
        """Noise, px per coordinate, at least ``min_px``."""
        return max(self.sigma_px, self.min_px)

    @property
    @abstractmethod
    def relative_error(self) -> float:
        """Relative standard error of the noise."""

    @abstractmethod
    def within(self, detections: Detections, deviations: float) -> BoolArray:
        """Mask (N,) of observations that obey the geometry to some standard deviations."""

    def placeable_markers(self, detections: Detections) -> BoolArray:
        """Mask (m,) of markers that ``guesses`` can place; all, unless a class knows some alone."""
        return np.ones(detections.marker.size, dtype=np.bool_)

    @abstractmethod
    def guesses(
        self, detections: Detections, frame: "ImageFrame", factor: float
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Cameras (V, 3, 4) and points (N, 3), NaN if unknown, in guessed metric frames, best first."""


@dataclass(frozen=True, eq=False)
class Epipolar(ImageGeometry):
    """Fundamental matrix and the noise of its residuals."""

    F: FloatArray  # (3, 3) with rightᵀ F left = 0, unit norm, px
    inlier: BoolArray  # (N,) whether a correspondence used agrees with F
    parallax_px: float  # median distance of the second view from a homography of the first

    origin, evidence = "views", "both views show"

    @classmethod
    def of(cls, detections: Detections, rng: np.random.Generator) -> "Epipolar":
        """Estimate the geometry as ``fitted`` does; raises WorkFailed also if it shows no depth."""
        found = cls.fitted(detections, rng)
        if found.parallax_px < _MIN_PARALLAX * found.sigma_px:
            raise WorkFailed(
                "both cameras see the same up to a change of image coordinates, within "
                f"{found.parallax_px:.3g} px at a noise of {found.sigma_px:.3g} px: without a baseline, or "
                "with all markers always in one plane, there is no depth; move the cameras apart, the "
                "markers in depth, or have less noise"
            )
        return found

    @classmethod
    def fitted(cls, detections: Detections, rng: np.random.Generator) -> "Epipolar":
        """Estimate the fundamental matrix and the noise from observations by both views, some of them wrong.

        By the minimum median of Sampson distances over random samples of eight, then reweighted eight-point
        solutions, then a Cauchy loss over minimal parameters.

        Raises WorkFailed with fewer than eight pairs, or if they do not determine the geometry.
        """
        both, pair = detections.both, [*detections.pair]
        (left, right), weight = detections.pixels[pair][:, both], detections.weight[pair][:, both]
        count = len(left)
        if count < 8:
            raise WorkFailed(
                f"{count} observations of a marker by both cameras at once (8 required): check that rows "
                "hold the pixels of both views"
            )
        T, T_ = similarity(left), similarity(right)
        pose_of = detections.pose_of[both]
        if count > _CORRESPONDENCES:
            some = rng.choice(count, _CORRESPONDENCES, replace=False)
            left, right, weight, count = left[some], right[some], weight[:, some], _CORRESPONDENCES
            pose_of = pose_of[some]
        a, b = homogeneous(left) @ T.T, homogeneous(right) @ T_.T
        picks = np.stack([rng.choice(count, 8, replace=False, shuffle=False) for _ in range(_SAMPLES)])
        candidates = _eight_point(a[picks], b[picks])
        judges = np.arange(count) if count <= _JUDGES else rng.choice(count, _JUDGES, replace=False)
        medians = np.median(np.abs(sampson(candidates, a[judges], b[judges], weight[:, judges])[0]), axis=1)
        F = candidates[np.argmin(medians)]
        for _ in range(10):
            r, slope = sampson(F, a, b, weight)
            F = _eight_point(
                a, b, 1.0 / (slope * np.sqrt(1.0 + (r / (2.0 * robust_deviation(r, 1e-12))) ** 2))
            )
        F = _refine(F, a, b, weight)
        product = T_.T @ F @ T
        in_pixels: FloatArray = product / float(np.linalg.norm(product))
        residual, _ = sampson(in_pixels, homogeneous(left), homogeneous(right), weight)
        inlier = np.abs(residual) <= OUTLIER * robust_deviation(residual, 1e-9)
        if inlier.sum() <= _PARAMETERS:
            raise WorkFailed("the observations of the two cameras share no epipolar geometry: check the rows")
        sigma = float(np.sqrt((residual[inlier] ** 2).sum() / (inlier.sum() - _PARAMETERS)))
        parallax = float(np.median(_transfer(a[inlier], b[inlier]) / T_[0, 0]))
        return cls(sigma, Core.of(residual, pose_of), exact_px(left), in_pixels, inlier, parallax)

    @property
    def relative_error(self) -> float:
        """Relative standard error of the noise, one residual a correspondence less the parameters of F."""
        return float(1.0 / np.sqrt(2.0 * (np.count_nonzero(self.inlier) - _PARAMETERS)))

    def within(self, detections: Detections, deviations: float) -> BoolArray:
        """Mask (N,) of observations by both views that obey the geometry to some standard deviations."""
        pair = [*detections.pair]
        left, right = homogeneous(detections.pixels[pair])
        return np.abs(sampson(self.F, left, right, detections.weight[pair])[0]) <= deviations * self.sigma_px

    def guesses(
        self, detections: Detections, frame: "ImageFrame", factor: float
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Cameras and points by ``metric_guesses``, NaN if one view alone sees a marker."""
        found = []
        for P, points in metric_guesses(self, detections, frame, factor):
            known = np.full((detections.pose_of.size, 3), np.nan)
            known[detections.both] = points
            found.append((P, known))
        return found


def exact_px(pixels: FloatArray) -> float:
    """Noise of pixels (N, 2), px, below which they are exact, as those projected from estimated poses."""
    return _EXACT / float(similarity(pixels)[0, 0])


class Core(NamedTuple):
    """Deviation of the normal core of residuals, and its 95 % interval (2,), px.

    It counts residuals within ``_CORE`` deviations, less a flat background estimated from those between one
    and two times that: neither few gross errors nor many small ones widen it. Poses, not residuals, are
    independent draws for the interval, since the corners of one image err alike.
    """

    sigma_px: float
    interval: FloatArray

    @classmethod
    def of(cls, residual: FloatArray, pose_of: IntArray) -> "Core":
        """Estimate it from residuals (N,) at poses (N,), less the parameters of the fundamental matrix."""
        r, s = np.abs(residual), robust_deviation(residual, 1e-12)
        for _ in range(_CORE_ROUNDS):
            before, s = s, s * float(np.sqrt(min(max(_core_square(r / s), 0.25), 4.0)))
            if abs(s - before) <= _CORE_SETTLED * s:
                break
        below, above = (
            float(_core_scores(r / (s * (1.0 + step))).sum()) for step in (-_CORE_STEP, _CORE_STEP)
        )
        slope = max(0.5 * (below - above) / _CORE_STEP, 1e-300)
        error = float(np.sqrt((np.bincount(pose_of, _core_scores(r / s)) ** 2).sum())) / slope
        error = min(error * float(stdtrit(max(np.unique(pose_of).size - 1, 1), 0.975)), _CORE_OPEN)
        s *= float(np.sqrt(r.size / (r.size - _PARAMETERS)))
        return cls(s, s * np.exp(np.array([-error, error])))


def _core_scores(ratio: FloatArray) -> FloatArray:
    """Scores (N,) of absolute residuals in deviations (N,): their sum vanishes at the right deviation."""
    inside, beyond = ratio < _CORE, (ratio >= _CORE) & (ratio < 2.0 * _CORE)
    return np.where(inside, ratio**2 - _CORE_MEAN, 0.0) - np.where(beyond, _CORE**2 / 3.0 - _CORE_MEAN, 0.0)


def _core_square(ratio: FloatArray) -> float:
    """Variance of the core of absolute residuals (N,) in deviations, less the background."""
    inside = ratio < _CORE
    count = int(np.count_nonzero(inside))
    flat = min(int(np.count_nonzero((ratio >= _CORE) & (ratio < 2.0 * _CORE))), count // 2)
    square = float((ratio[inside] ** 2).sum()) - flat * _CORE**2 / 3.0
    return square / max(count - flat, 1) / _CORE_MEAN


def similarity(points: FloatArray) -> FloatArray:
    """Similarity (d + 1, d + 1) that gives points (N, d) zero median and unit deviation: [HZ04] 4.4."""
    center, d = np.median(points, axis=0), points.shape[1]
    spread = float(np.median(np.abs(points - center))) or 1.0
    T = np.eye(d + 1)
    T[:d, d], T[d, d] = -center, spread
    return np.asarray(T / spread)


def sampson(
    F: FloatArray, left: FloatArray, right: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Signed first-order distances (…, N) of points (N, 3) from F (…, 3, 3), the root of [HZ04] eq. (11.9).

    Also returns the length (…, N) of the gradient of rightᵀ F left by all four pixel coordinates, each over
    its weight (2, N).
    """
    lines_right, lines_left = left @ np.swapaxes(F, -1, -2), right @ F
    by_right, by_left = ((lines[..., :2] ** 2).sum(axis=-1) for lines in (lines_right, lines_left))
    square = by_right / weight[1] ** 2 + by_left / weight[0] ** 2
    slope = np.sqrt(np.maximum(square, np.finfo(float).tiny))
    return (lines_right * right).sum(axis=-1) / slope, slope


def _eight_point(left: FloatArray, right: FloatArray, weight: FloatArray | None = None) -> FloatArray:
    """Matrices (…, 3, 3) of rank two and unit norm from eight or more points (…, N, 3) each: [HZ04] 11.1."""
    rows = (right[..., :, None] * left[..., None, :]).reshape(*left.shape[:-1], 9)
    if weight is not None:
        rows = rows * weight[..., None]
    moments = np.swapaxes(rows, -1, -2) @ rows
    F = np.linalg.eigh(moments)[1][..., :, 0].reshape(*left.shape[:-2], 3, 3)
    U, s, Vt = np.linalg.svd(F)
    s[..., 2] = 0.0
    s /= np.linalg.norm(s, axis=-1, keepdims=True)
    return np.asarray((U * s[..., None, :]) @ Vt)


def _refine(F: FloatArray, left: FloatArray, right: FloatArray, weight: FloatArray) -> FloatArray:
    """Refine F to the minimum Cauchy loss of the Sampson distances over its seven parameters.

    F = U diag(cos φ, sin φ, 0) Vᵀ; U and V turn by rotation vectors. Source of the parameters:
    A. Bartoli, P. Sturm, "Nonlinear estimation of the fundamental matrix with minimal parameters",
    PAMI 26(3), 2004.
    """
    U, s, Vt = np.linalg.svd(F)
    phi = np.arctan2(s[1], s[0])

    def turned(x: FloatArray) -> FloatArray:
        turn, turn_ = Rotation.from_rotvec(x[:6].reshape(2, 3)).as_matrix()
        return np.asarray((U @ turn * [np.cos(phi + x[6]), np.sin(phi + x[6]), 0.0]) @ turn_.T @ Vt)

    def distances(x: FloatArray) -> FloatArray:
        return sampson(turned(x), left, right, weight)[0]

    scale = 2.0 * robust_deviation(sampson(F, left, right, weight)[0], 1e-12)
    fit = least_squares(
        distances, np.zeros(7), "3-point", loss="cauchy", f_scale=scale, ftol=_TIGHT, xtol=_TIGHT, gtol=_TIGHT
    )
    return turned(fit.x)


def _transfer(left: FloatArray, right: FloatArray) -> FloatArray:
    """Distance (N,) of the right points from a homography of the left ones, in their units: [HZ04] 4.1."""
    moved = left @ planar_homography(left, right).T
    return np.asarray(np.linalg.norm(moved[:, :2] / moved[:, 2:] - right[:, :2], axis=1))


def planar_homography(a: FloatArray, b: FloatArray) -> FloatArray:
    """Homography (3, 3) b ∼ H a of normalized points (N, 3), four or more, with a last coordinate of one."""
    zero = np.zeros_like(a)
    rows = np.block([[a, zero, -b[:, :1] * a], [zero, a, -b[:, 1:2] * a]])
    # Four points leave eight rows: their null vector is among all nine right singular ones alone.
    return np.asarray(np.linalg.svd(rows, full_matrices=len(rows) < rows.shape[1])[2][8].reshape(3, 3))


def triangulated(P: FloatArray, m: FloatArray) -> FloatArray:
    """Points (N, 4) of unit norm from homogeneous pixels (V, N, 3) of cameras (V, N, 3, 4): [HZ04] 12.2.

    Linear and all at once, to start fits; ``geometry.stereo`` has the point of minimum reprojection error.
    """
    rows = m[..., :2, None] * P[:, :, 2:] - P[:, :, :2]
    return np.linalg.svd(rows.swapaxes(0, 1).reshape(-1, 4, 4))[2][:, 3]


@dataclass(frozen=True, eq=False)
class ImageFrame:
    """Guessed principal points (V, 2) and sizes (V,) of the images, px, and whether the size was given."""

    center: FloatArray
    size: FloatArray
    known: bool

    @classmethod
    def of(cls, detections: Detections, image_size: ImageSize | None) -> "ImageFrame":
        """Frame of widths and heights, px, otherwise of the extent of the data in each view."""
        if image_size is not None:
            sizes = image_sizes(image_size, detections.view)
            return cls(0.5 * sizes, sizes.max(axis=1), True)
        # The outermost percent may be outliers.
        low, high = np.stack(
            [
                np.percentile(p[s], [1, 99], axis=0)
                for p, s in zip(detections.pixels, detections.seen, strict=True)
            ],
            axis=1,
        )
        size = (high - low).max(axis=1)
        return cls(0.5 * (low + high), np.where(size > 0.0, size, 1.0), False)

    def of_views(self, which: list[int]) -> "ImageFrame":
        """Frame of some views."""
        return ImageFrame(self.center[which], self.size[which], self.known)


def metric_guesses(
    epipolar: Epipolar, detections: Detections, frame: ImageFrame, factor: float
) -> list[tuple[FloatArray, FloatArray]]:
    """Cameras (2, 3, 4) and points (N, 3) seen by both, in some guessed metric frames, best first.

    The focal length is a factor of the one that keeps the distances between markers most constant over the
    poses, each local minimum of a scan refined within its neighbours.

    Raises WorkFailed if no two markers were seen together at two poses.
    """
    some, pairs = _compared(detections)

    def guess(detections: Detections, log_focal: float, factor: float) -> tuple[FloatArray, FloatArray]:
        return _guess_at(epipolar.F, detections, frame, factor * float(np.exp(log_focal)))

    def spread_at(log_focal: float) -> float:
        return _distance_spread(guess(some, log_focal, 1.0)[1], pairs)

    grid = np.linspace(np.log(_SHORTEST), np.log(_LONGEST), _TRIALS)
    spread = np.array([spread_at(x) for x in grid])
    if not np.isfinite(spread).any():
        raise WorkFailed("no two markers are seen together at two poses: more markers must be seen at once")
    padded = np.concatenate([[np.inf], spread, [np.inf]])
    minima = np.flatnonzero((spread <= padded[:-2]) & (spread < padded[2:]))
    minima = minima[np.argsort(spread[minima])][:_MAX_GUESSES]
    # A minimum at which the body deforms far more than at the best one is no start.
    minima = minima[spread[minima] <= max(4.0 * spread[minima[0]], 0.05)]
    step = float(grid[1] - grid[0])
    guesses = []
    for i in minima:
        bounds = float(grid[i]) - step, float(grid[i]) + step
        fine = minimize_scalar(spread_at, bounds=bounds, method="bounded", options={"xatol": _FINE * step})
        guesses.append(guess(detections, fine.x if fine.fun < spread[i] else grid[i], factor))
    return guesses


def _guess_at(
    F: FloatArray, detections: Detections, frame: ImageFrame, focal: float
) -> tuple[FloatArray, FloatArray]:
    """Cameras (2, 3, 4), and points (N, 3) at median distance one, by a focal length over image size.

    [HZ04] result 9.19, the solution of the four that has most points in front of both cameras.
    """
    K = np.zeros((2, 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = focal * frame.size
    K[:, :2, 2] = frame.center
    K[:, 2, 2] = 1.0
    U, _, Vt = np.linalg.svd(K[1].T @ F @ K[0])
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    x, y = (np.linalg.solve(K[v], homogeneous(detections.pixels[v][detections.both]).T).T for v in (0, 1))
    # Rotation and baseline, and depths along the rays of both cameras.
    solutions = [
        (R, t, *_ray_depths(R, t, x, y)) for R in (U @ W @ Vt, U @ W.T @ Vt) for t in (U[:, 2], -U[:, 2])
    ]
    R, t, depth, _ = max(solutions, key=lambda one: int(((one[2] > 0.0) & (one[3] > 0.0)).sum()))
    # A ray nearly parallel to its partner meets it anywhere: the median ignores the few.
    scale = float(np.median(np.abs(depth))) or 1.0
    P = K @ np.stack([np.eye(3, 4), np.hstack([R, t[:, None] / scale])])
    return P, x * (depth / scale)[:, None]


def _ray_depths(R: FloatArray, t: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Depths (N,) along left and right rays (N, 3) where they come closest, λ' y = λ R x + t."""
    Rx = x @ R.T
    xx, yy, xy = (Rx**2).sum(axis=1), (y**2).sum(axis=1), (Rx * y).sum(axis=1)
    xt, yt = Rx @ t, y @ t
    determinant = np.maximum(xx * yy - xy**2, 1e-15 * xx * yy)
    return (xy * yt - yy * xt) / determinant, (xx * yt - xy * xt) / determinant


def _compared(detections: Detections) -> tuple[Detections, tuple[IntArray, IntArray, IntArray]]:
    """Detections at evenly spaced poses, and their pairs of markers; all if a pair is not seen again."""
    K = len(detections.q)
    some = detections.of_poses(np.isin(np.arange(K), even_choice(K, _COMPARED)))
    if some.both.any():
        pairs = marker_pairs(some.pose_of[some.both], some.marker_of[some.both])
        if np.bincount(pairs[2]).max(initial=0) > 1:
            return some, pairs
    both = detections.both
    return detections, marker_pairs(detections.pose_of[both], detections.marker_of[both])


def marker_pairs(pose_of: IntArray, marker_of: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Pairs of markers seen at the same pose: rows of the first and of the second, and index of the pair.

    One random order selects at most ``_PAIRED`` markers a pose, so the same pairs recur at all poses.
    """
    rank = np.random.default_rng(0).permutation(int(marker_of.max()) + 1)
    pairs = []
    for k in np.unique(pose_of):
        here = np.flatnonzero(pose_of == k)
        here = np.sort(here[np.argsort(rank[marker_of[here]])[:_PAIRED]])
        pairs.append(here[np.stack(np.triu_indices(here.size, 1))])
    first, second = np.concatenate(pairs, axis=1)
    pair = marker_of[first] * rank.size + marker_of[second]
    return first, second, np.unique(pair, return_inverse=True)[1]


def log_distances(
    points: FloatArray, pairs: tuple[IntArray, IntArray, IntArray]
) -> tuple[FloatArray, BoolArray]:
    """|log distance − its median over the poses| of pairs of points (N, 3), and whether it is seen twice."""
    first, second, pair = pairs
    log = np.log(np.maximum(np.linalg.norm(points[first] - points[second], axis=1), 1e-12))
    middle = medians(log[:, None], pair)[:, 0]
    return np.abs(log - middle[pair]), np.bincount(pair)[pair] > 1


def _distance_spread(points: FloatArray, pairs: tuple[IntArray, IntArray, IntArray]) -> float:
    """Median over poses and pairs of points (N, 3) of |log distance − its median over the poses|."""
    deviation, compared = log_distances(points, pairs)
    return float(np.median(deviation[compared])) if compared.any() else np.inf
