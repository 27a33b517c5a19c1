"""Selection of the poses whose trial motions would reduce the variance of predictions most."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from projservo_cli.calibration.detections import even_choice
from projservo_cli.calibration.prediction import (
    dense_pixel_changes,
    errors_of,
    from_reference,
    parameters_from,
)
from projservo_cli.calibration.refit import errors_of_others, rows_of_camera
from projservo_cli.image_size import image_corners, image_sizes
from projservo_cli.planning.prediction_covariance import Region, drawn_poses
from projservo_cli.records import BoolArray, Calibration, FloatArray, Observation, WorkFailed

# The range of the recorded readings is widened at each end by this share of itself; for a robot
# whose limits are known, the candidates' by more.
_WIDER, FARTHER = 0.15, 1.0
# Poses drawn to choose from, and to judge by; batches before giving up.
_CANDIDATES, _TARGETS = 300, 150
_BATCHES = 20
# Markers that both views must see at a pose that determines the joints.
_LEAST_SEEN = 3
# Poses to choose from for a camera that moved, and the maximum number that are chosen.
_REFIT_CANDIDATES, _MOST_POSES = 150, 30
# Error of a camera that is fitted again, over that before it moved, at which poses are enough.
_ENOUGH = 1.5
# Markers that suggestions are judged by, at most.
_MOST_SHOWN = 25
# A prediction that errs by more than this share of the image does not predict the view.
_VAGUE = 0.02


@dataclass(frozen=True, eq=False)
class Suggestion:
    """A pose to record, in the order of choice."""

    q: FloatArray  # (n,) joint readings, rad or m
    from_pose: int  # number of the nearest pose recorded
    delta: FloatArray  # (n,) the path from it, rad or m
    # variance_before, variance_after: of predicted coordinates over the region of the data, px²
    variance_before: float
    variance_after: float


def region_around(
    observation: Observation, size: Any, low: FloatArray, high: FloatArray, share: float = _WIDER
) -> Region:
    """Region of the recorded readings, widened at each end by a share of their range within limits (n,).

    A recorded robot may have been where its limits do not reach. Of images without a ``size`` the region is
    of the pixels seen.
    """
    q, pixels = observation.q, observation.images
    least, most = q.min(axis=0), q.max(axis=0)
    span = share * (most - least)
    image = np.stack([np.nanmin(pixels, axis=(0, 2)), np.nanmax(pixels, axis=(0, 2))], axis=1)  # corners, px
    if size is not None:
        image = image_corners(image_sizes(size, observation.view))
    within = np.maximum(least - span, np.minimum(low, least)), np.minimum(most + span, np.maximum(high, most))
    return Region(*within, image)


def suggest(
    calibration: Calibration,
    observation: Observation,
    candidates: Region,
    targets: Region,
    count: int,
    rng: np.random.Generator,
) -> tuple[Suggestion, ...]:
    """Poses that reduce the mean variance of predictions most, one after the other.

    V-optimality, the mean variance over a region, taken greedily over random candidates: A. C.
    Atkinson, A. N. Donev, R. D. Tobias, "Optimum Experimental Designs, with SAS", 2007, chapter 10.
    With Λ Λᵀ the covariance, C the derivative of the images of a pose and T the derivative of the targets,
    both times Λ, the pose leaves tr T (I + Cᵀ C / σ²)⁻¹ Tᵀ. Markers count as seen if they are
    predicted within the image; some of many markers represent all.

    calibration : with its covariance.
    observation : the observations of the calibration.
    candidates : region of the poses to choose from.
    targets : region of the poses that are to be predicted well.
    count : poses to suggest.
    rng : draws both.
    Raises WorkFailed if no pose of a region shows the markers to both views.
    """
    few = calibration.with_markers(even_choice(len(calibration.M), _MOST_SHOWN))
    sigma = max(calibration.sigma_px, calibration.sigma_fitted_px)
    _, T = _visible_poses(few, targets, _TARGETS, rng)
    q, C = _visible_poses(few, candidates, _CANDIDATES, rng)
    coordinates = np.count_nonzero(T.any(axis=2))
    rows = T.reshape(-1, T.shape[2])
    gram = rows.T @ rows
    C /= sigma
    left = np.ones(len(q), dtype=np.bool_)
    suggestions: list[Suggestion] = []
    for _ in range(min(count, len(q))):
        before = float(np.trace(gram)) / coordinates
        inner = np.eye(C.shape[1]) + C @ np.swapaxes(C, 1, 2)
        gain = np.trace(np.linalg.solve(inner, C @ gram @ np.swapaxes(C, 1, 2)), axis1=1, axis2=2)
        best = int(np.argmax(np.where(left, gain, -np.inf)))
        left[best] = False
        # Λ after the pose: its product with the root of (I + Cᵀ C)⁻¹.
        root = np.linalg.inv(np.linalg.cholesky(np.eye(C.shape[2]) + C[best].T @ C[best])).T
        C, gram = C @ root, root.T @ gram @ root
        after = float(np.trace(gram)) / coordinates
        nearest = int(np.argmin(np.linalg.norm(observation.q - q[best], axis=1)))
        number = int(observation.pose[nearest])
        suggestions.append(
            Suggestion(
                q=q[best],
                from_pose=number,
                delta=q[best] - observation.q[nearest],
                variance_before=before,
                variance_after=after,
            )
        )
    return tuple(suggestions)


@dataclass(frozen=True, eq=False)
class RefitPoses:
    """Poses for a camera that moved, in the order of choice."""

    q: FloatArray  # (k, n) joint readings, rad or m
    error_px: float  # error of its images in the region after a refit from them, rms of distances
    before_px: float  # error of its images before it moved


def refit_poses(calibration: Calibration, v: int, region: Region, rng: np.random.Generator) -> RefitPoses:
    """Poses from which a camera that moved is fitted again nearly as well as it was.

    Greedily the ones after which its images err least over the region: by the camera's errors from noise, and
    by errors of operators and markers that it follows, −G T e as in ``calibration.refit``. The poses that it
    sees are those from where it was.

    v : its index; region : of the poses, with the border of each image.
    Raises WorkFailed if no pose of the region shows the markers to it, and to another camera if there is one.
    """
    few = calibration.with_markers(even_choice(len(calibration.M), _MOST_SHOWN))
    scene, others = parameters_from(few), np.arange(len(few.view)) != v
    poses, seen = list[FloatArray](), list[BoolArray]()
    for q, in_view in drawn_poses(few, region, _BATCHES, rng):
        enough_seen = in_view.sum(axis=2) >= _LEAST_SEEN
        good = np.flatnonzero(enough_seen[:, v] & (enough_seen[:, others].any(axis=1) | ~others.any()))
        good = good[: _REFIT_CANDIDATES - len(poses)]
        poses, seen = [*poses, *q[good]], [*seen, *in_view[good, v]]
        if len(poses) == _REFIT_CANDIDATES:
            break
    if not poses:
        raise WorkFailed(
            f"no pose shows {_LEAST_SEEN} markers to the {few.view[v]} camera: look for poses by hand"
        )
    q, mask = np.array(poses), np.array(seen)[..., None, None]
    away, sigma, K = from_reference(few, q), max(few.sigma_px, few.sigma_fitted_px), len(poses)
    J = scene.derivative(away)[0][:, v][..., rows_of_camera(few, v)] * mask
    T, whole = (
        dense_pixel_changes(scene, errors, away)[:, v] * mask
        for errors in (errors_of_others(few, v), errors_of(few))
    )
    scale = np.maximum(np.sqrt((J**2).sum(axis=(0, 1, 2))), 1e-12)
    J, T, count = (J / scale).reshape(K, -1, len(scale)), T.reshape(K, -1, T.shape[-1]), mask.sum()
    A, B = J.swapaxes(1, 2) @ J, J.swapaxes(1, 2) @ T
    gauge = np.zeros(len(scale))
    gauge[: few.P[v].size] = few.P[v].ravel()
    N, X = np.outer(scale * gauge, scale * gauge), np.zeros(B.shape[1:])
    N, before = N / np.trace(N) + 1e-9 * np.eye(len(N)), float((whole**2).sum() / count)
    chosen: list[int] = []
    while len(chosen) < min(_MOST_POSES, K):
        inverse = np.linalg.inv(N + A)
        G = inverse @ (X + B)
        error = (
            (T**2).sum()
            - 2.0 * (G * B.sum(axis=0)).sum(axis=(1, 2))
            + (G * (A.sum(axis=0) @ G)).sum(axis=(1, 2))
        )
        error = (error + sigma**2 * (inverse * A.sum(axis=0)).sum(axis=(1, 2))) / count
        error[chosen] = np.inf
        best = int(np.argmin(error))
        N, X, chosen = N + A[best], X + B[best], [*chosen, best]
        if error[best] <= _ENOUGH**2 * before:
            break
    return RefitPoses(q[chosen], float(np.sqrt(error[best])), float(np.sqrt(before)))


def _visible_poses(
    calibration: Calibration, region: Region, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw random poses (k, n) that show enough markers; with the derivative (k, 4 m, r) of their images.

    Rows of unseen markers are zero.
    """
    scene = parameters_from(calibration)
    poses: list[FloatArray] = []
    rows: list[FloatArray] = []
    for q, in_view in drawn_poses(calibration, region, _BATCHES, rng):
        enough = np.flatnonzero(in_view.all(axis=1).sum(axis=1) >= _LEAST_SEEN)[: count - len(poses)]
        if enough.size:
            J = dense_pixel_changes(scene, errors_of(calibration), from_reference(calibration, q[enough]))
            sharp = np.sqrt((J**2).sum(axis=-1)).max(axis=-1) <= _VAGUE * np.ptp(region.image, axis=1).max()
            in_view = in_view[enough] & sharp
            J[~in_view] = 0.0
            useful = np.flatnonzero(in_view.all(axis=1).sum(axis=1) >= _LEAST_SEEN)
            poses += list(q[enough[useful]])
            rows += list(J.reshape(len(J), -1, J.shape[-1])[useful])
        if len(poses) >= count:
            break
    if not poses:
        raise WorkFailed(
            f"no further pose to suggest: none within the joint ranges shows {_LEAST_SEEN} markers to all "
            "cameras by this calibration; improve it with single-joint trials first"
        )
    return np.array(poses), np.array(rows)
