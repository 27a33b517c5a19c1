"""Radial lens distortion: whether the images show it, and estimating it with all the rest."""

import dataclasses

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.adjustment import LENS
from projservo_cli.calibration.epipolar import Epipolar
from projservo_cli.calibration.epipolar import estimate as epipolar_geometry
from projservo_cli.calibration.fit import RAYLEIGH, Solution, cauchy, distances, hopeless_px, least_squares
from projservo_cli.calibration.optimization import LEAST_DAMPING, minimize, prepare, scaled_normal
from projservo_cli.calibration.quality import chi2_beyond, f_beyond
from projservo_cli.calibration.readings import Readings
from projservo_cli.calibration.reconstruction import Frame
from projservo_cli.geometry.lens import FIRST, straight_views, within
from projservo_cli.records import BoolArray, Calibration, FloatArray, InputError, WorkFailed

COEFFICIENTS = 2 * LENS
# A lens is suspected where it explains this share of the squared residuals and chance, with its tail
# probability, would not.
LEAST_SHARE, TAIL = 0.02, 1e-3
LEAST_CHI2 = 1e-20
# A share that makes a lens the likely reason of a refusal.
DECISIVE_SHARE = 0.5
# Coefficients that noise alone exceeds with this probability show no lens.
NO_LENS_TAIL = 0.01
# Share of readings that may lie outside the images: they are outliers.
STRAYS = 0.01


def require_size(readings: Readings, size: tuple[int, int]) -> None:
    """Refuse an image size that does not hold the pixels seen, but for one in a hundred.

    Parameters
    ----------
    readings : what was seen.
    size : width and height, px.

    Raises
    ------
    InputError
        Saying where markers were seen.
    """
    seen = readings.pixels[readings.seen]
    if np.mean(((seen >= -0.5) & (seen <= np.array(size) - 0.5)).all(axis=1)) < 1.0 - STRAYS:
        low, high = np.percentile(seen, [1, 99], axis=0)
        raise InputError(
            f"image size {size[0]}x{size[1]} px: markers were seen at u from {low[0]:.0f} to {high[0]:.0f}, "
            f"v from {low[1]:.0f} to {high[1]:.0f}; give the size of the images, width before height"
        )


def undistorted(frame: Frame) -> FloatArray:
    """Lenses (2, 5) without distortion about the image centres; the radius is half the image size."""
    return np.concatenate([frame.center, 0.5 * frame.size[:, None], np.zeros((2, LENS))], axis=1)


def share_explained(solution: Solution, frame: Frame) -> float:
    """Share of the squared residuals that a lens would explain, zero where chance may explain as much.

    Nothing is fitted: the scores of k1 and k2, cleared of what the other parameters explain, add up to
    the gain; C. R. Rao, "Large sample tests of statistical hypotheses concerning several parameters",
    1948. Errors of a pose's joint readings move all of its images alike, so that poses, not readings,
    are the independent draws: H. Hotelling's test of 1931 that the scores of the poses have no mean.

    Parameters
    ----------
    solution : without lens.
    frame : image centres and sizes.
    """
    readings, agreement = solution.problem.readings, solution.agreement
    columns = _cleared_columns(solution, frame)
    scores = (columns * agreement.residual).sum(axis=(1, 3))
    poses = np.unique(readings.pose_of[agreement.used.any(axis=0)])
    by_pose = np.stack([np.bincount(readings.pose_of, score)[poses] for score in scores])
    K, d = poses.size, COEFFICIENTS
    if poses.size <= d + 1:
        return 0.0
    total = by_pose.sum(axis=1)
    flat = columns.reshape(d, -1)
    share = float(total @ np.linalg.solve(flat @ flat.T, total)) / max(agreement.chi2, LEAST_CHI2)
    square = float(total @ np.linalg.solve(K * np.cov(by_pose), total))
    chance = float(f_beyond(TAIL, d, K - d)) * d * (K - 1) / (K - d)
    return share if square > chance and share >= LEAST_SHARE else 0.0


def _cleared_columns(solution: Solution, frame: Frame) -> FloatArray:
    """Change of the images by k1, k2 of both views (4, 2, N, 2), less what other parameters can undo."""
    problem = prepare(solution.problem.readings, solution.problem.q_reference, lens=True)
    scene = dataclasses.replace(solution.scene, lens=undistorted(frame))
    used, residual = solution.agreement.used, solution.agreement.residual
    weight = used.astype(np.float64)
    _, J = adjustment.derivative(scene, problem.readings, problem.q)
    free, scale = np.ones(problem.place.size, dtype=bool), np.zeros(problem.place.size)
    A, _, scale, _ = scaled_normal(problem, scene, J, weight, residual, free, scale)
    m = problem.place.lens
    undo = cho_solve(cho_factor(A[:m, :m] + LEAST_DAMPING * np.eye(m)), A[:m, m:])
    steps = np.vstack([-undo, np.eye(COEFFICIENTS)]) / scale[:, None]
    return np.stack([problem.change(J, step) for step in steps.T]) * weight[..., None]


def with_lens(solution: Solution, frame: Frame, epipolar: Epipolar) -> Solution:
    """The solution with radial distortion freed: which readings count is found anew.

    Parameters
    ----------
    solution : without lens.
    frame : image centres and sizes.
    epipolar : epipolar geometry of the pixels as they are.

    Raises
    ------
    WorkFailed
        If the data do not determine the distortion.
    """
    readings = solution.problem.readings
    problem = prepare(readings, solution.problem.q_reference, lens=True)
    scene = dataclasses.replace(solution.scene, lens=undistorted(frame))
    searched = minimize(problem, scene, cauchy(readings.seen), most=100)
    level = float(np.median(distances(searched.residual, readings.seen)))
    found = least_squares(problem, searched.scene, level / RAYLEIGH, hopeless_px(epipolar))
    if found is None or not _unfolded(found)[found.agreement.used].all():
        raise WorkFailed(
            "the images do not determine the distortion of the lenses: record poses with markers all over "
            "both images, or calibrate without --lens"
        )
    return found


def _unfolded(solution: Solution) -> BoolArray:
    """Readings (2, N) on this side of the radius at which the distortion turns back."""
    problem, scene = solution.problem, solution.scene
    assert scene.lens is not None
    pixels, _ = adjustment.predict_pixels(dataclasses.replace(scene, lens=None), problem.readings, problem.q)
    return within(scene.lens[:, None], pixels)


def straight_epipolar(solution: Solution, rng: np.random.Generator) -> Epipolar:
    """Epipolar geometry of the images as projective cameras would have seen them.

    Parameters
    ----------
    solution : with its lenses.
    rng : draws samples.
    """
    straight = straight_readings(solution.problem.readings, solution.scene.lens)
    return epipolar_geometry(straight.pixels[0][straight.both], straight.pixels[1][straight.both], rng)


def straight_readings(readings: Readings, lens: FloatArray | None) -> Readings:
    """Readings as projective cameras would have seen them; unseen where the lens bends no pixel there.

    Parameters
    ----------
    readings : what was seen.
    lens : (2, 5) lenses; None leaves the readings as they are.
    """
    if lens is None:
        return readings
    pixels = straight_views(lens, readings.pixels)
    seen = readings.seen & np.isfinite(pixels).all(axis=2)
    return dataclasses.replace(readings, pixels=np.where(seen[..., None], pixels, 0.0), seen=seen)


def hint(share: float) -> str:
    """What a refusal adds where a lens explains most of the residuals.

    Parameters
    ----------
    share : result of ``share_explained``.
    """
    if share < DECISIVE_SHARE:
        return ""
    return f"; lens distortion would explain {100.0 * share:.0f} % of their squares: try --lens"


def advice(calibration: Calibration, share: float, centered: bool) -> tuple[str, ...]:
    """What to do about the lens, a sentence each.

    Parameters
    ----------
    calibration : with or without lens.
    share : result of ``share_explained`` where no lens was sought.
    centered : whether the image centres are known.
    """
    if calibration.lens is None:
        if share == 0.0:
            return ()
        return (f"lens distortion would explain {100.0 * share:.0f} % of the squared residuals: try --lens",)
    k = calibration.lens[:, FIRST:].ravel()
    statistic = k @ np.linalg.solve(calibration.covariance[-COEFFICIENTS:, -COEFFICIENTS:], k)
    if statistic < chi2_beyond(NO_LENS_TAIL, COEFFICIENTS):
        return ("the images show no lens distortion: leave out --lens",)
    if not centered:
        return (
            "the lens distortion is centred on the region where markers were seen: give --image-size, and "
            "it is centred on the image",
        )
    return ()
