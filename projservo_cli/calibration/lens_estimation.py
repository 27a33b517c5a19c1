"""Estimation of radial lens distortion: whether the residuals ask for it, and the fit that frees it."""

import dataclasses

import numpy as np
from scipy.special import fdtri

from projservo_cli.calibration.adjustment import LeastSquares
from projservo_cli.calibration.epipolar import Epipolar, ImageFrame
from projservo_cli.calibration.fit import Solution, fit_from
from projservo_cli.calibration.initialization import Search
from projservo_cli.calibration.prediction import LENS
from projservo_cli.calibration.readings import MOST_JUDGED, Readings
from projservo_cli.geometry.lens import straight_views, within
from projservo_cli.records import FloatArray, WorkFailed

# A lens is suspected where it explains this share of the squared residuals and chance, with its tail
# probability, would not.
_LEAST_SHARE, _TAIL = 0.02, 1e-3
_LEAST_CHI2 = 1e-20


def share_explained(solution: Solution, frame: ImageFrame) -> float:
    """Share of the squared residuals that a lens would explain; zero where there is one, or chance may do.

    Nothing is fitted: the scores of k1 and k2, cleared of what the other parameters explain, add up to
    the gain; C. R. Rao, "Large sample tests of statistical hypotheses concerning several parameters",
    1948. Errors of a pose's joint readings move all of its images alike, so that poses, not readings,
    are the independent draws: H. Hotelling's test of 1931 that the scores of the poses have no mean.
    """
    if solution.scene.lens is not None:
        return 0.0
    solution = solution.of_some(MOST_JUDGED)
    readings = solution.problem.readings
    poses = np.unique(readings.pose_of[solution.used.any(axis=0)])
    K, d = poses.size, 2 * LENS
    if d + 1 >= K:
        return 0.0
    columns = _cleared_columns(solution, frame)
    left = solution.problem.whitened(solution.scene, solution.raw.reshape(-1, 1), solution.used)
    scores = (columns * left.reshape(solution.raw.shape)).sum(axis=(1, 3))
    by_pose = np.stack([np.bincount(readings.pose_of, score)[poses] for score in scores])
    total = by_pose.sum(axis=1)
    flat = columns.reshape(d, -1)
    share = float(total @ np.linalg.lstsq(flat @ flat.T, total)[0]) / max(solution.chi2, _LEAST_CHI2)
    square = float(total @ np.linalg.lstsq(K * np.cov(by_pose), total)[0])
    chance = float(fdtri(d, K - d, 1.0 - _TAIL)) * d * (K - 1) / (K - d)
    return share if square > chance and share >= _LEAST_SHARE else 0.0


def _undistorted(frame: ImageFrame) -> FloatArray:
    """Lenses (2, 5) without distortion about the image centres; the radius is half the image size."""
    return np.concatenate([frame.center, 0.5 * frame.size[:, None], np.zeros((2, LENS))], axis=1)


def _cleared_columns(solution: Solution, frame: ImageFrame) -> FloatArray:
    """Change of the images by k1, k2 of both views (4, 2, N, 2), less what other parameters can undo."""
    exact = LeastSquares.of(solution.problem.readings, solution.problem.q_reference, lens=True)
    problem = exact.with_noise(solution.problem.tau)
    scene = dataclasses.replace(solution.scene, lens=_undistorted(frame))
    J = problem.whitened(scene, problem.dense(problem.derivative(scene), solution.used), solution.used)
    J /= np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    first, last = problem.joint[-1], problem.shared
    others, lenses = np.delete(J, np.s_[first:last], axis=1), J[:, first:last]
    left = lenses - others @ np.linalg.lstsq(others, lenses, rcond=None)[0]
    return np.asarray(left.T.reshape(-1, *solution.residual.shape))


def with_lens(solution: Solution, search: Search) -> tuple[Solution, Epipolar]:
    """The solution with radial distortion freed, and the epipolar geometry of what it straightens.

    Which readings count is found anew. Raises WorkFailed if the data do not determine the distortion.
    """
    readings = solution.problem.readings
    problem = LeastSquares.of(readings, solution.problem.q_reference, lens=True)
    scene = dataclasses.replace(solution.scene, lens=_undistorted(search.frame))
    found = fit_from(problem, scene, search.epipolar)
    if found is not None:
        assert found.scene.lens is not None
        unbent, _ = problem.pixels(dataclasses.replace(found.scene, lens=None))
        if within(found.scene.lens[:, None], unbent)[found.used].all():
            straight = straightened(readings, found.scene.lens)
            return found, Epipolar.of(straight, search.rng)
    raise WorkFailed(
        "the images do not determine the distortion of the lenses: record poses with markers all over "
        "both images, or calibrate without --lens"
    )


def straightened(readings: Readings, lens: FloatArray | None) -> Readings:
    """Readings as projective cameras would have seen them; unseen where lenses (2, 5) bend no pixel there."""
    if lens is None:
        return readings
    pixels = straight_views(lens, readings.pixels)
    seen = readings.seen & np.isfinite(pixels).all(axis=2)
    return dataclasses.replace(readings, pixels=np.where(seen[..., None], pixels, 0.0), seen=seen)
