"""Epipolar geometry from noisy correspondences, some of them wrong."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.rotations import cross
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

SAMPLES = 500
PARAMETERS = 7  # of a fundamental matrix
# Median of |x| over the standard deviation of a normal variable.
MAD = 0.6744897501960817
# Correspondences farther than this many standard deviations do not count in the noise.
OUTLIER = 5.0
# Least median distance of the right view from a homography of the left one, in units of the noise.
LEAST_PARALLAX = 3.0


@dataclass(frozen=True, eq=False)
class Epipolar:
    """Fundamental matrix and what its residuals say.

    Attributes
    ----------
    F : (3, 3) with rightᵀ F left = 0, unit norm, px.
    sigma_px : noise per image coordinate from the residuals, px.
    inlier : (N,) which correspondences agree with F.
    """

    F: FloatArray
    sigma_px: float
    inlier: BoolArray

    @property
    def relative_error(self) -> float:
        """Standard error of the noise as a share of it, one residual a correspondence less those F takes."""
        return float(1.0 / np.sqrt(2.0 * (np.count_nonzero(self.inlier) - PARAMETERS)))


def homogeneous(pixels: FloatArray) -> FloatArray:
    """Append a one to each row."""
    return np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1)


def normalization(pixels: FloatArray) -> FloatArray:
    """Similarity that brings pixels to zero median and unit mean absolute deviation.

    Source: R. Hartley, "In defense of the eight-point algorithm", PAMI 19(6), 1997, with medians.

    Parameters
    ----------
    pixels : (N, 2) px.

    Returns
    -------
    (3, 3) matrix for homogeneous pixels.
    """
    center = np.median(pixels, axis=0)
    spread = float(np.median(np.abs(pixels - center))) or 1.0
    return np.array([[1.0, 0.0, -center[0]], [0.0, 1.0, -center[1]], [0.0, 0.0, spread]]) / spread


def incidence_and_slope(F: FloatArray, left: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residual rightᵀ F left of correspondences and the length of its gradient by all four pixels.

    Parameters are those of ``sampson``; so are the shapes of both results.
    """
    lines_right = left @ np.swapaxes(F, -1, -2)
    lines_left = right @ F
    incidence: FloatArray = (lines_right * right).sum(axis=-1)
    square = (lines_right[..., :2] ** 2).sum(axis=-1) + (lines_left[..., :2] ** 2).sum(axis=-1)
    slope: FloatArray = np.sqrt(np.maximum(square, np.finfo(float).tiny))
    return incidence, slope


def sampson(F: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Signed first-order distance of correspondences to the epipolar variety.

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., eq. (11.9), its square root.

    Parameters
    ----------
    F : (..., 3, 3) fundamental matrices.
    left, right : (N, 3) homogeneous pixels with last entry one.

    Returns
    -------
    (..., N) distances in the joint image plane, in the unit of the pixels.
    """
    incidence, slope = incidence_and_slope(F, left, right)
    return incidence / slope


def eight_point(left: FloatArray, right: FloatArray, weight: FloatArray | None = None) -> FloatArray:
    """Fundamental matrices of rank two from eight or more correspondences each.

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., section 11.1.

    Parameters
    ----------
    left, right : (..., N, 3) normalised homogeneous pixels.
    weight : (..., N) factors of the equations.

    Returns
    -------
    (..., 3, 3) matrices of unit norm.
    """
    rows = (right[..., :, None] * left[..., None, :]).reshape(*left.shape[:-1], 9)
    if weight is not None:
        rows = rows * weight[..., None]
    moments = np.swapaxes(rows, -1, -2) @ rows
    F = np.linalg.eigh(moments)[1][..., :, 0].reshape(*left.shape[:-2], 3, 3)
    U, s, Vt = np.linalg.svd(F)
    s[..., 2] = 0.0
    s /= np.linalg.norm(s, axis=-1, keepdims=True)
    result: FloatArray = (U * s[..., None, :]) @ Vt
    return result


def refine(F: FloatArray, left: FloatArray, right: FloatArray, scale: float) -> FloatArray:
    """Least Cauchy loss of the Sampson distances over the seven parameters of F.

    F = U diag(cos φ, sin φ, 0) Vᵀ; U and V turn by rotation vectors. Source of the parameters:
    A. Bartoli, P. Sturm, "Nonlinear estimation of the fundamental matrix with minimal parameters",
    PAMI 26(3), 2004. Reweighted least squares with Levenberg's damping.

    Parameters
    ----------
    F : (3, 3) start, rank two, in the normalised frame.
    left, right : (N, 3) normalised homogeneous pixels.
    scale : distance beyond which the loss flattens, in normalised units.
    """
    U, s, Vt = np.linalg.svd(F)
    phi = float(np.arctan2(s[1], s[0]))
    damping = 1e-6
    loss = np.inf
    for _ in range(100):
        F = (U * np.array([np.cos(phi), np.sin(phi), 0.0])) @ Vt
        r = sampson(F, left, right)
        new_loss = float(np.log1p((r / scale) ** 2).sum())
        if new_loss <= loss:
            settled = np.isfinite(loss) and loss - new_loss <= 1e-12 * loss
            U_kept, Vt_kept, phi_kept, loss = U, Vt, phi, new_loss
            if settled:
                break
            weight = 1.0 / (1.0 + (r / scale) ** 2)
            J = _sampson_gradient(F, left, right).reshape(-1, 9) @ _tangents(U, phi, Vt).reshape(7, 9).T
            A, g = (J.T * weight) @ J, (J.T * weight) @ r
            damping = max(0.1 * damping, 1e-14)
        else:
            damping *= 100.0
            if damping > 1e6:
                break
        x = -np.linalg.solve(A + damping * np.trace(A) * np.eye(7), g)
        U, Vt, phi = U_kept @ _turn(x[:3]), _turn(x[3:6]).T @ Vt_kept, phi_kept + x[6]
    result: FloatArray = (U_kept * np.array([np.cos(phi_kept), np.sin(phi_kept), 0.0])) @ Vt_kept
    return result


def _transfer(left: FloatArray, right: FloatArray) -> FloatArray:
    """Distance (N,) of the right points from a homography of the left ones, in normalised units.

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., section 4.1.
    """
    zero = np.zeros_like(left)
    first = np.concatenate([left, zero, -right[:, :1] * left], axis=1)
    second = np.concatenate([zero, left, -right[:, 1:2] * left], axis=1)
    H = np.linalg.svd(np.concatenate([first, second]))[2][8].reshape(3, 3)
    moved = left @ H.T
    distance: FloatArray = np.linalg.norm(moved[:, :2] / moved[:, 2:] - right[:, :2], axis=1)
    return distance


def _sampson_gradient(F: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Derivative of each Sampson distance by the entries of F, (N, 3, 3)."""
    flat = np.array([1.0, 1.0, 0.0])
    lines_right, lines_left = (left @ F.T) * flat, (right @ F) * flat
    incidence, slope = (part[:, None, None] for part in incidence_and_slope(F, left, right))
    turn = lines_right[:, :, None] * left[:, None, :] + right[:, :, None] * lines_left[:, None, :]
    result: FloatArray = (right[:, :, None] * left[:, None, :] - incidence / slope**2 * turn) / slope
    return result


def _tangents(U: FloatArray, phi: float, Vt: FloatArray) -> FloatArray:
    """Derivative of F by the turns of U and V and by φ, (7, 3, 3)."""
    D = np.diag([np.cos(phi), np.sin(phi), 0.0])
    generators = cross(np.eye(3))
    middle = [*(generators @ D), *(-D @ generators)]
    middle.append(np.diag([-np.sin(phi), np.cos(phi), 0.0]))
    result: FloatArray = U @ np.array(middle) @ Vt
    return result


def _turn(w: FloatArray) -> FloatArray:
    """Rotation near the identity by the Cayley map, (3, 3) from three numbers."""
    S = 0.5 * cross(w)
    return np.asarray(np.linalg.solve(np.eye(3) - S, np.eye(3) + S), dtype=np.float64)


def estimate(left: FloatArray, right: FloatArray, rng: np.random.Generator) -> Epipolar:
    """Fundamental matrix of a rig from correspondences with gross errors among them.

    Least median of squares over samples of eight, Cauchy reweighting, then the seven parameters.
    Source: P. Rousseeuw, A. Leroy, Robust Regression and Outlier Detection, 1987, chapter 5.

    Parameters
    ----------
    left, right : (N, 2) corresponding pixels.
    rng : draws the samples.

    Raises
    ------
    WorkFailed
        With fewer than eight correspondences, or where they do not determine the geometry.
    """
    count = left.shape[0]
    if count < 8:
        raise WorkFailed(
            f"{count} sightings of a marker by both cameras at once: at least 8 are needed; check that rows "
            "hold the pixels of both views"
        )
    T, T_ = normalization(left), normalization(right)
    a, b = homogeneous(left) @ T.T, homogeneous(right) @ T_.T
    picks = rng.permuted(np.broadcast_to(np.arange(count), (SAMPLES, count)), axis=1)[:, :8]
    candidates = eight_point(a[picks], b[picks])
    medians = np.median(np.abs(sampson(candidates, a, b)), axis=1)
    F = candidates[np.argmin(medians)]
    for _ in range(10):
        incidence, slope = incidence_and_slope(F, a, b)
        r = incidence / slope
        scale = max(float(np.median(np.abs(r))) / MAD, 1e-12)
        F = eight_point(a, b, 1.0 / (slope * np.sqrt(1.0 + (r / (2.0 * scale)) ** 2)))
    r = sampson(F, a, b)
    F = refine(F, a, b, 2.0 * max(float(np.median(np.abs(r))) / MAD, 1e-12))
    product = T_.T @ F @ T
    in_pixels: FloatArray = product / float(np.linalg.norm(product))
    residual = sampson(in_pixels, homogeneous(left), homogeneous(right))
    scale = max(float(np.median(np.abs(residual))) / MAD, 1e-9)
    inlier = np.abs(residual) <= OUTLIER * scale
    if inlier.sum() <= PARAMETERS:
        raise WorkFailed("the sightings of the two cameras share no epipolar geometry: check the rows")
    sigma = float(np.sqrt((residual[inlier] ** 2).sum() / (inlier.sum() - PARAMETERS)))
    parallax = _transfer(a[inlier], b[inlier]) / T_[0, 0]
    if float(np.median(parallax)) < LEAST_PARALLAX * sigma:
        raise WorkFailed(
            "both cameras see the same up to a change of image coordinates: without a baseline, or with all "
            "markers always in one plane, there is no depth; move the cameras apart, or the markers in depth"
        )
    return Epipolar(in_pixels, sigma, inlier)
