"""Any number of views: the pair with which a fit begins, further cameras by resection, a noise of each.

[HZ04] is R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., 2004.
"""

import dataclasses
from itertools import combinations

import numpy as np

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.detections import (
    RAYLEIGH,
    Detections,
    cauchy_weights,
    deviation,
    even_choice,
)
from projservo_cli.calibration.initial.epipolar import Epipolar, ImageGeometry, similarity
from projservo_cli.calibration.initial.triangulation import Tracks
from projservo_cli.calibration.lens_estimation import undistorted
from projservo_cli.calibration.robust_fit import Solution, fit_from, fit_inliers
from projservo_cli.geometry.displacements import homogeneous
from projservo_cli.records import FloatArray, WorkFailed

# Number of points that determine a camera, and of random samples of them.
_MINIMAL, _SAMPLES = 6, 300
# Maximum number of points by which samples are compared.
_JUDGES = 2000
# Rounds of reweighting in a resection, and of the noise of each view.
_ROUNDS, _NOISE_ROUNDS = 10, 6
# Relative change of the noise of each view that ends these rounds.
_SETTLED = 0.01
# Minimum number of detections of a view for a camera: 11 numbers, and as many to judge them.
_LEAST = 12


def with_best_pair(detections: Detections) -> Detections:
    """Choose the pair of views that determines most; two views are the pair, one is alone.

    By parallax over noise, times the root of the number of markers that both see at poses where they share
    two or more: cameras far around see a tool from other sides.

    Raises WorkFailed if no pair has an epipolar geometry.
    """
    V = len(detections.view)
    if V <= 2:
        return detections
    found, failure = list[tuple[float, tuple[int, int]]](), None
    for pair in combinations(range(V), 2):
        some = detections.of_views([*pair])
        try:
            epipolar = Epipolar.of(some, np.random.default_rng(0))
        except WorkFailed as error:
            failure = error
            continue
        shared = np.bincount(some.pose_of[some.both])
        strength = float(np.sqrt(shared[shared > 1].sum())) * epipolar.parallax_px / epipolar.noise_px
        found.append((strength, pair))
    if not found and failure is not None:
        raise failure
    return dataclasses.replace(detections, pair=max(found)[1])


def with_all_views(of_pair: Solution, whole: Detections, epipolar: ImageGeometry) -> Solution:
    """Fit to all views, from that to the pair: each further camera by resection.

    Raises WorkFailed naming a view whose detections determine no camera.
    """
    problem = LeastSquares.of(whole, of_pair.problem.q_reference)
    known = np.isin(whole.marker, of_pair.problem.detections.marker)
    M = np.full((whole.marker.size, 4), np.nan)
    M[known] = of_pair.params.M
    P = np.full((len(whole.view), 3, 4), np.nan)
    P[[*whole.pair]] = of_pair.params.P
    params = dataclasses.replace(of_pair.params, P=P, M=M, offsets=None)
    points = params.moved(problem.q, whole.pose_of, whole.marker_of)
    for v in np.flatnonzero(np.isnan(P[:, 0, 0])):
        rows = np.flatnonzero(whole.seen[v] & np.isfinite(points[:, 0]))
        if rows.size < _LEAST:
            raise WorkFailed(
                f"the {whole.view[v]} camera saw {rows.size} markers that the "
                f"{' and '.join(whole.view[i] for i in whole.pair)} cameras see too; {_LEAST} are required: "
                "point it at the same markers, or leave this view out"
            )
        P[v] = resected(points[rows], whole.pixels[v, rows])
    if (lost := np.isnan(M[:, 0])).any():
        params = dataclasses.replace(params, M=Tracks(problem, params).locate(lost, epipolar.noise_px))
    solution = fit_from(problem, params, epipolar)
    if solution is None:
        raise WorkFailed(
            f"no robot explains the images of the views {', '.join(whole.view)} together: check that they "
            "show the same poses"
        )
    return solution


def with_own_noise(solution: Solution, epipolar: ImageGeometry) -> tuple[Solution, ImageGeometry]:
    """Weigh each view by its own noise until it settles; also the epipolar geometry of the quietest pair.

    In units of the root mean square noise of this pair. Two views share one noise, which their epipolar
    geometry shows.
    """
    if len(solution.used) <= 2:
        return solution, epipolar
    first_pair = solution.problem.detections.pair
    for _ in range(_NOISE_ROUNDS):
        detections = solution.problem.detections
        noise = np.array([_noise(solution, v) for v in range(len(solution.used))])
        first, second = np.sort(np.argsort(noise / detections.weight.max(axis=1))[:2]).tolist()
        noise /= np.sqrt(np.mean(noise[[first, second]] ** 2))
        if np.abs(np.log(noise)).max() <= _SETTLED:
            break
        weight = detections.weight / noise[:, None]
        weighed = dataclasses.replace(detections, weight=weight, pair=(first, second))
        problem = dataclasses.replace(solution.problem, detections=weighed)
        found = fit_inliers(problem, solution.params, solution.typical_px / RAYLEIGH, epipolar.noise_px)
        if found is None:
            break
        solution = found
    seen = undistorted(solution.problem.detections, solution.params.lens)
    try:
        return solution, Epipolar.of(seen, np.random.default_rng(0))
    except WorkFailed:  # without a baseline: the first pair has one
        detections = dataclasses.replace(solution.problem.detections, pair=first_pair)
        problem = dataclasses.replace(solution.problem, detections=detections)
        seen = dataclasses.replace(seen, pair=first_pair)
        return dataclasses.replace(solution, problem=problem), Epipolar.of(seen, np.random.default_rng(0))


def _noise(solution: Solution, v: int) -> float:
    """Robust noise of a view per coordinate, weighted, px: of all that was seen, so that none is cut off."""
    distance = np.linalg.norm(solution.residual[v, solution.problem.detections.seen[v]], axis=1)
    return max(float(np.median(distance)) / RAYLEIGH, 1e-9)


def resected(points: FloatArray, pixels: FloatArray) -> FloatArray:
    """Camera (3, 4) of points (N, 4) and their pixels (N, 2), some of them wrong: [HZ04] 7.1.

    The minimum median distance over random samples of six, then reweighted linear solutions.
    """
    rng, X = np.random.default_rng(0), points[:, :3] / points[:, 3:]
    T, U = similarity(pixels), similarity(X)
    x, X = homogeneous(pixels) @ T.T, homogeneous(X) @ U.T
    picks = np.stack([rng.choice(len(x), _MINIMAL, replace=False) for _ in range(_SAMPLES)])
    candidates, some = _linear(X[picks], x[picks]), even_choice(len(x), _JUDGES)
    medians = np.nanmedian(np.linalg.norm(_off(candidates, X[some], x[some]), axis=-1), axis=-1)
    P = candidates[np.nanargmin(medians)]
    for _ in range(_ROUNDS):
        distance = np.linalg.norm(_off(P, X, x), axis=-1)
        weight = cauchy_weights((distance / (2.0 * deviation(distance, 1e-12))) ** 2)
        P = _linear(X, x, np.sqrt(weight) / np.abs(X @ P[2]))
    P = np.linalg.inv(T) @ P @ U
    ahead = np.sign(np.median(points @ P[2] / points[:, 3]))
    return np.asarray(ahead * P / np.linalg.norm(P[2]))


def _off(P: FloatArray, X: FloatArray, x: FloatArray) -> FloatArray:
    """Distances (…, N, 2) of projected points (N, 4) from pixels (N, 3) with a last coordinate of one."""
    image = X @ np.swapaxes(P, -1, -2)
    return np.asarray(image[..., :2] / image[..., 2:] - x[:, :2])


def _linear(X: FloatArray, x: FloatArray, weight: FloatArray | None = None) -> FloatArray:
    """Cameras (…, 3, 4) of unit norm from points (…, N, 4) and pixels (…, N, 3), linearly: [HZ04] 7.1."""
    zero = np.zeros_like(X)
    rows = np.concatenate(
        [
            np.concatenate([X, zero, -x[..., :1] * X], axis=-1),
            np.concatenate([zero, X, -x[..., 1:2] * X], axis=-1),
        ],
        axis=-2,
    )
    if weight is not None:
        rows = rows * np.concatenate([weight, weight])[:, None]
    moments = np.swapaxes(rows, -1, -2) @ rows
    return np.asarray(np.linalg.eigh(moments)[1][..., 0].reshape(*X.shape[:-2], 3, 4))
