"""Radial lens distortion: whether the images show it, and estimating it with all the rest."""

import dataclasses

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import chdtri, fdtri

from projservo_cli.calibration.adjustment import LEAST_DAMPING, prepare
from projservo_cli.calibration.epipolar import Epipolar, ImageFrame
from projservo_cli.calibration.fit import Solution, follow
from projservo_cli.calibration.prediction import LENS
from projservo_cli.calibration.readings import Readings
from projservo_cli.geometry.lens import FIRST, straight_views, within
from projservo_cli.records import BoolArray, Calibration, FloatArray, WorkFailed

_COEFFICIENTS = 2 * LENS
# A lens is suspected where it explains this share of the squared residuals and chance, with its tail
# probability, would not.
_LEAST_SHARE, _TAIL = 0.02, 1e-3
_LEAST_CHI2 = 1e-20
# A share that makes a lens the likely reason of a refusal.
_DECISIVE_SHARE = 0.5
# Coefficients that noise alone exceeds with this probability show no lens.
_NO_LENS_TAIL = 0.01


def share_explained(solution: Solution, frame: ImageFrame) -> float:
    """Share of the squared residuals that a lens would explain; zero where there is one, or chance may do.

    Nothing is fitted: the scores of k1 and k2, cleared of what the other parameters explain, add up to
    the gain; C. R. Rao, "Large sample tests of statistical hypotheses concerning several parameters",
    1948. Errors of a pose's joint readings move all of its images alike, so that poses, not readings,
    are the independent draws: H. Hotelling's test of 1931 that the scores of the poses have no mean.
    """
    if solution.scene.lens is not None:
        return 0.0
    readings = solution.problem.readings
    poses = np.unique(readings.pose_of[solution.used.any(axis=0)])
    K, d = poses.size, _COEFFICIENTS
    if d + 1 >= K:
        return 0.0
    columns = _cleared_columns(solution, frame)
    scores = (columns * solution.residual).sum(axis=(1, 3))
    by_pose = np.stack([np.bincount(readings.pose_of, score)[poses] for score in scores])
    total = by_pose.sum(axis=1)
    flat = columns.reshape(d, -1)
    share = float(total @ np.linalg.solve(flat @ flat.T, total)) / max(solution.chi2, _LEAST_CHI2)
    square = float(total @ np.linalg.solve(K * np.cov(by_pose), total))
    chance = float(fdtri(d, K - d, 1.0 - _TAIL)) * d * (K - 1) / (K - d)
    return share if square > chance and share >= _LEAST_SHARE else 0.0


def _undistorted(frame: ImageFrame) -> FloatArray:
    """Lenses (2, 5) without distortion about the image centres; the radius is half the image size."""
    return np.concatenate([frame.center, 0.5 * frame.size[:, None], np.zeros((2, LENS))], axis=1)


def _cleared_columns(solution: Solution, frame: ImageFrame) -> FloatArray:
    """Change of the images by k1, k2 of both views (4, 2, N, 2), less what other parameters can undo."""
    problem = prepare(solution.problem.readings, solution.problem.q_reference, lens=True)
    scene = dataclasses.replace(solution.scene, lens=_undistorted(frame))
    weight = solution.used.astype(np.float64)
    J = problem.derivative(scene)[1]
    A, scale = problem.scaled_normal(scene, J, weight, 0, np.zeros(problem.size))
    m = problem.lens
    undo = cho_solve(cho_factor(A[:m, :m] + LEAST_DAMPING * np.eye(m)), A[:m, m:])
    steps = np.vstack([-undo, np.eye(_COEFFICIENTS)]) / scale[:, None]
    return np.stack([problem.change(J, step) for step in steps.T]) * weight[..., None]


def with_lens(solution: Solution, frame: ImageFrame, epipolar: Epipolar) -> Solution:
    """The solution with radial distortion freed: which readings count is found anew.

    Raises WorkFailed if the data do not determine the distortion.
    """
    problem = prepare(solution.problem.readings, solution.problem.q_reference, lens=True)
    scene = dataclasses.replace(solution.scene, lens=_undistorted(frame))
    found = follow(problem, scene, epipolar)
    if found is None or not _unfolded(found)[found.used].all():
        raise WorkFailed(
            "the images do not determine the distortion of the lenses: record poses with markers all over "
            "both images, or calibrate without --lens"
        )
    return found


def _unfolded(solution: Solution) -> BoolArray:
    """Readings (2, N) on this side of the radius at which the distortion turns back."""
    assert solution.scene.lens is not None
    straight, _ = solution.problem.pixels(dataclasses.replace(solution.scene, lens=None))
    return within(solution.scene.lens[:, None], straight)


def straight_readings(readings: Readings, lens: FloatArray | None) -> Readings:
    """Readings as projective cameras would have seen them; unseen where lenses (2, 5) bend no pixel there."""
    if lens is None:
        return readings
    pixels = straight_views(lens, readings.pixels)
    seen = readings.seen & np.isfinite(pixels).all(axis=2)
    return dataclasses.replace(readings, pixels=np.where(seen[..., None], pixels, 0.0), seen=seen)


def hint(share: float) -> str:
    """What a refusal adds where a lens explains most of the residuals."""
    if share < _DECISIVE_SHARE:
        return ""
    return f"; lens distortion would explain {100.0 * share:.0f} % of their squares: try --lens"


def lens_advice(calibration: Calibration, share: float, centered: bool) -> tuple[str, ...]:
    """What to do about the lens: where none was sought by the share it explains, else by its uncertainty."""
    if calibration.lens is None:
        if share == 0.0:
            return ()
        return (f"lens distortion would explain {100.0 * share:.0f} % of the squared residuals: try --lens",)
    k = calibration.lens[:, FIRST:].ravel()
    statistic = k @ np.linalg.solve(calibration.covariance[-_COEFFICIENTS:, -_COEFFICIENTS:], k)
    if statistic < chdtri(_COEFFICIENTS, _NO_LENS_TAIL):
        return ("the images show no lens distortion: leave out --lens",)
    if not centered:
        return (
            "the lens distortion is centred on the region where markers were seen: give --image-size, and "
            "it is centred on the image",
        )
    return ()
