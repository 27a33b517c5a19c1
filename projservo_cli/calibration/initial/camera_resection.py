"""Resection of cameras: each camera beyond the first pair, from points that a fit has found.

[HZ04] is R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., 2004.
"""

import dataclasses

import numpy as np

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.detections import (
    Detections,
    cauchy_weights,
    even_choice,
    robust_deviation,
)
from projservo_cli.calibration.initial.epipolar import ImageGeometry, similarity
from projservo_cli.calibration.initial.triangulation import Tracks
from projservo_cli.calibration.robust_fit import Solution, fit_from
from projservo_cli.geometry.displacements import homogeneous
from projservo_cli.records import FloatArray, WorkFailed

# Number of points that determine a camera, and of random samples of them.
_MINIMAL, _SAMPLES = 6, 300
# Maximum number of points by which samples are compared.
_JUDGES = 2000
# Rounds of reweighting in a resection.
_ROUNDS = 10
# Minimum number of detections of a view for a camera: 11 numbers, and as many to judge them.
_LEAST = 12


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
        weight = cauchy_weights((distance / (2.0 * robust_deviation(distance, 1e-12))) ** 2)
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
