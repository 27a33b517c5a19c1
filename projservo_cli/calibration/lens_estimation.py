"""Estimation of radial lens distortion: a test of the residuals for it, and the fit with it."""

import dataclasses

import numpy as np
from scipy.special import fdtri

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.detections import Detections
from projservo_cli.calibration.initial.epipolar import Epipolar, ImageFrame, ImageGeometry
from projservo_cli.calibration.initial.initialization import Search
from projservo_cli.calibration.initial.single_view import RigidBody
from projservo_cli.calibration.prediction import LENS, Parameters
from projservo_cli.calibration.robust_fit import (
    Expected,
    Solution,
    fit_from,
    fit_inliers,
    fit_joint_noise,
    left_out_px,
)
from projservo_cli.geometry.invariant_forms import intrinsics_of
from projservo_cli.geometry.lens import before_fold, undistort
from projservo_cli.records import FloatArray, WorkFailed

# Minimum share of the squared residuals that a lens explains for a suspicion.
_MIN_SHARE = 0.02
# Probability that chance explains as much.
_TAIL = 1e-3
# Share of rejected detections from which another centre of the lens is tried in any case.
_MUCH = 0.05
# Maximum number of fits about principal points, which move a little with each.
_CENTERED = 3
# Minimum sum of squared residuals, px², against a division by zero.
_MIN_CHI2 = 1e-20


def share_explained(solution: Solution, frame: ImageFrame) -> float:
    """Share of the squared residuals that a lens would explain; zero with a lens, or if not significant."""
    if solution.params.lens is not None:
        return 0.0
    few = solution.judged()
    share = _share(few, dataclasses.replace(few.params, lens=_undistorted(frame)), LENS)
    return share if share >= _MIN_SHARE else 0.0


def _share(solution: Solution, params: Parameters, terms: int) -> float:
    """Share of the squared residuals that the last two terms of the lenses explain; zero if by chance.

    A score test needs no fit: the scores, orthogonal to the other parameters, give the gain; C. R. Rao,
    "Large sample tests of statistical hypotheses concerning several parameters", 1948. Errors of a pose's
    joint readings move all of its images alike, so poses, not detections, are independent draws: H.
    Hotelling's test of 1931 that the scores of the poses have no mean.
    """
    detections = solution.problem.detections
    poses = np.unique(detections.pose_of[solution.used.any(axis=0)])
    K, d = poses.size, len(solution.used) * LENS
    if d + 1 >= K:
        return 0.0
    columns = _cleared_columns(solution, params, terms)
    left = solution.problem.whitened(solution.params, solution.raw.reshape(-1, 1), solution.used)
    scores = (columns * left.reshape(solution.raw.shape)).sum(axis=(1, 3))
    by_pose = np.stack([np.bincount(detections.pose_of, score)[poses] for score in scores])
    total = by_pose.sum(axis=1)
    flat = columns.reshape(d, -1)
    share = float(total @ np.linalg.lstsq(flat @ flat.T, total)[0]) / max(solution.chi2, _MIN_CHI2)
    square = float(total @ np.linalg.lstsq(K * np.cov(by_pose), total)[0])
    chance = float(fdtri(d, K - d, 1.0 - _TAIL)) * d * (K - 1) / (K - d)
    return share if square > chance else 0.0


def _undistorted(frame: ImageFrame) -> FloatArray:
    """Lenses (V, 5) without distortion about the image centres; the radius is half the image size."""
    return np.concatenate(
        [frame.center, 0.5 * frame.size[:, None], np.zeros((len(frame.size), LENS))], axis=1
    )


def _cleared_columns(solution: Solution, params: Parameters, terms: int) -> FloatArray:
    """Changes of the images by the last two terms of the lenses (4, 2, N, 2), orthogonal to all others."""
    there = solution.problem
    exact = LeastSquares.of(there.detections, there.q_reference, terms, there.curve_terms)
    problem = exact.with_noise(solution.problem.tau)
    J = problem.whitened(params, problem.dense(problem.derivative(params), solution.used), solution.used)
    J /= np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    tested = (problem.joint[-1] + np.arange(len(solution.used) * terms).reshape(-1, terms)[:, -LENS:]).ravel()
    others, lenses = np.delete(J, tested, axis=1), J[:, tested]
    left = lenses - others @ np.linalg.lstsq(others, lenses, rcond=None)[0]
    return np.asarray(left.T.reshape(-1, *solution.residual.shape))


def _geometry_of(detections: Detections, frame: ImageFrame, rng: np.random.Generator) -> ImageGeometry:
    """Geometry of the images of the pair of views, or of the only view."""
    return RigidBody.of(detections, frame) if len(detections.pair) == 1 else Epipolar.of(detections, rng)


def fit_lens(solution: Solution, search: Search) -> tuple[Solution, ImageGeometry]:
    """Fit with radial distortion, and estimate the epipolar geometry of the undistorted detections.

    The distortion is centred on the image, or if the residuals show another centre that predicts left-out
    poses better, on that. Inliers are selected again. Raises WorkFailed if the data do not determine the
    distortion.
    """
    params = dataclasses.replace(solution.params, lens=_undistorted(search.frame))
    found = _fit_terms(solution, params, LENS, search)
    if found is not None:
        few = found.judged()
        much = found.used.sum() < (1.0 - _MUCH) * solution.problem.detections.seen.sum()
        if much or _share(few, few.params, 2 * LENS) > 0.0:
            freed = _fit_terms(solution, found.params, 2 * LENS, search)
            if freed is not None and left_out_px(freed) < left_out_px(found):
                found = freed
        detections = undistorted(solution.problem.detections, found.params.lens)
        return found, _geometry_of(detections, search.frame, search.rng)
    raise WorkFailed(
        "the images do not determine the distortion of the lenses: record poses with markers all over "
        "both images, or calibrate without lens (calibration.lens)"
    )


def _fit_terms(solution: Solution, params: Parameters, terms: int, search: Search) -> Solution | None:
    """Fit some terms of the lenses; None if it fails, or a lens folds within the images."""
    problem = LeastSquares.of(solution.problem.detections, solution.problem.q_reference, terms)
    if params.known_arm:  # poses of a flange err, and an exact fit would reject some of them whole
        problem = problem.with_noise(solution.problem.tau)
    found = fit_from(problem, dataclasses.replace(params, lens_terms=terms), search.epipolar)
    return None if found is None or _folds(found) else found


def _folds(solution: Solution) -> bool:
    """Whether a lens folds within the images used."""
    lens = solution.params.lens
    if lens is None:
        return False
    unbent, _ = solution.problem.pixels(dataclasses.replace(solution.params, lens=None))
    return not before_fold(lens[:, None], unbent)[solution.used].all()


def about_principal_points(
    solution: Solution, expected: Expected, frame: ImageFrame, noise: float | None
) -> Solution:
    """Fit with distortion about the principal points, while that agrees better with the images.

    Lenses are symmetric about them, and poses of a flange determine them.

    noise : of joint readings, rad; None to estimate it.
    """
    for _ in range(_CENTERED):
        lens, center = solution.params.lens, intrinsics_of(solution.params.P)[:, :2, 2]
        inside = (np.abs(center - frame.center) < 0.5 * frame.size[:, None]).all()
        if lens is None or solution.params.lens_terms > LENS or not inside:
            break
        params = dataclasses.replace(solution.params, lens=np.hstack([center, lens[:, 2:]]))
        found = fit_inliers(solution.problem, params, solution.sigma_px, min_px=expected.min_px)
        if found is None or _folds(found):
            break
        found = fit_joint_noise(found, expected, noise)
        if found.sigma_px >= solution.sigma_px:
            break
        solution = found
    return solution


def undistorted(detections: Detections, lens: FloatArray | None) -> Detections:
    """Undistort detections by lenses (V, 5); those that no point distorts to are unseen."""
    if lens is None:
        return detections
    pixels = undistort(lens, detections.pixels)
    seen = detections.seen & np.isfinite(pixels).all(axis=2)
    return dataclasses.replace(detections, pixels=np.where(seen[..., None], pixels, 0.0), seen=seen)
