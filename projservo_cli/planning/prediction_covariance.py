"""How far predictions of a calibration err among joints drawn at random.

Along ways as a few directions that are told apart; and which further poses would make them err less.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from projservo_cli.calibration.prediction import all_changed, error_factor, scene_of
from projservo_cli.calibration.readings import even_choice
from projservo_cli.records import (
    NO_SPREAD,
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    Observation,
    Spread,
    WorkFailed,
)

_BATCH = 1500  # poses drawn at once


@dataclass(frozen=True, eq=False)
class Region:
    """Where poses may lie and markers be seen."""

    low: FloatArray
    high: FloatArray  # low, high: (n,) joint readings between which candidates are drawn, rad or m
    image: FloatArray  # (2, 2, 2) lower and upper corner of each image, px


def drawn_poses(
    calibration: Calibration, region: Region, batches: int, rng: np.random.Generator
) -> Iterator[tuple[FloatArray, BoolArray]]:
    """Batches of random poses (k, n) of a region, and which images (k, 2, m) lie within it."""
    scene, (low, high) = scene_of(calibration), region.image.swapaxes(0, 1)[:, :, None]
    for _ in range(batches):
        q = rng.uniform(region.low, region.high, (_BATCH, len(region.low)))
        pixels = scene.seen(q - calibration.q_reference)
        yield q, ((pixels >= low) & (pixels <= high)).all(axis=-1)  # none that is NaN, behind the camera


# Lower and upper limits of n joints, rad or m, and width and height of both images, px.
_Bounds = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
# Directions of the covariance that are told apart; joints at which they are looked for, and batches of them.
_DIRECTIONS, _LOOKED_AT, _MOST_BATCHES = 8, 150, 40


@lru_cache(maxsize=64)
def spread_of(
    calibration: Calibration, indices: tuple[int, ...], face: int, bounds: _Bounds, seed: int
) -> Spread:
    """How far predictions err, of markers by their indices, those of the face first.

    The directions are those that move the images of the face most, among joints drawn at random that show it;
    what they leave is taken to be the same everywhere. None without a covariance. It takes 20 ms, once
    for all tasks of a calibration.
    """
    if not calibration.has_covariance:
        return NO_SPREAD
    calibration = calibration.with_markers(list(indices))
    q = _showing(calibration, face, bounds, seed)
    if len(q) == 0:
        return NO_SPREAD
    scene, factor = scene_of(calibration), error_factor(calibration)
    J = all_changed(scene, calibration.errors, q - calibration.q_reference)[:, :, :face]
    variance = (J**2).sum(axis=-1)
    rows = J.reshape(-1, J.shape[-1]) / np.maximum(np.sqrt(variance).reshape(-1, 1), 1e-9)
    # LAPACK's singular value decomposition fails on some of these rows, finite as they are.
    main = np.linalg.eigh(rows.T @ rows)[1][:, : -_DIRECTIONS - 1 : -1]
    rest = float(np.sqrt(np.median(np.maximum(variance - ((J @ main) ** 2).sum(axis=-1), 0.0))))
    moved = (factor @ main).T
    n, b = calibration.H_hat_0.shape[0], calibration.M.shape[0]
    P, H_hat, M = moved[:, :24], moved[:, 24 : 24 + 16 * n], moved[:, -4 * b :]
    return Spread(
        np.concatenate([calibration.P[None], calibration.P + P.reshape(-1, 2, 3, 4)]),
        np.concatenate([calibration.H_hat_0[None], calibration.H_hat_0 + H_hat.reshape(-1, n, 4, 4)]),
        np.concatenate([calibration.M[None], calibration.M + M.reshape(-1, b, 4)]),
        rest,
        float(np.sqrt(variance.max())),
    )


def _showing(calibration: Calibration, face: int, bounds: _Bounds, seed: int) -> FloatArray:
    """Joints (k, n) within the limits at which both images hold the first markers, those of the face."""
    lower, upper, image_size = bounds
    low = np.where(np.isfinite(lower), lower, calibration.q_reference - np.pi)
    high = np.where(np.isfinite(upper), upper, calibration.q_reference + np.pi)
    corners = np.array([[-0.5, -0.5], np.array(image_size) - 0.5])
    region, found = Region(low, high, np.stack([corners, corners])), np.zeros((0, len(low)))
    for q, seen in drawn_poses(calibration, region, _MOST_BATCHES, np.random.default_rng(seed)):
        found = np.concatenate([found, q[seen[:, :, :face].all(axis=(1, 2))]])
        if len(found) >= _LOOKED_AT:
            break
    return found[:_LOOKED_AT]


# Poses drawn to choose from, and to judge by; batches before giving up.
_CANDIDATES, _TARGETS = 300, 150
_BATCHES = 20
# Markers that both views must see at a pose for it to tell the joints.
_LEAST_SEEN = 3
# Markers that suggestions are judged by, at most.
_MOST_SHOWN = 25
# A prediction that errs by more than this share of the image does not say what will be seen.
_VAGUE = 0.02


@dataclass(frozen=True, eq=False)
class Suggestion:
    """A pose to record, in the order of choice."""

    q: FloatArray  # (n,) joint readings, rad or m
    from_pose: int  # number of the nearest pose recorded
    delta: FloatArray  # (n,) the way from it, rad or m
    # variance_before, variance_after: of predicted coordinates over the region of the data, px²
    variance_before: float
    variance_after: float


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
    With Λ Λᵀ the covariance, C the derivative of what a pose would show and T that of the targets,
    both times Λ, the pose leaves tr T (I + Cᵀ C / σ²)⁻¹ Tᵀ. Markers count as seen where they are
    predicted within the image; of many markers some stand for all.

    calibration : with its covariance.
    observation : what it was made from.
    candidates : region of the poses to choose from.
    targets : region of the poses that are to be predicted well.
    count : poses to suggest.
    rng : draws both.
    Raises InputError if the method of the calibration has no covariance; WorkFailed if no pose of a region
    shows the markers to both views.
    """
    if not calibration.has_covariance:
        raise InputError(
            f"suggestions need a covariance, which the method {calibration.method} has not: "
            "use --set calibration.method=refined"
        )
    few = calibration.with_markers(even_choice(len(calibration.M), _MOST_SHOWN))
    sigma = max(calibration.sigma_px, calibration.sigma_fitted_px)
    _, T = _shown(few, targets, _TARGETS, rng)
    q, C = _shown(few, candidates, _CANDIDATES, rng)
    coordinates = np.count_nonzero(T.any(axis=2))
    rows = T.reshape(-1, T.shape[2])
    gram = rows.T @ rows
    C /= sigma
    left = np.ones(len(q), dtype=np.bool_)
    found: list[Suggestion] = []
    for _ in range(min(count, len(q))):
        before = float(np.trace(gram)) / coordinates
        inner = np.eye(C.shape[1]) + C @ np.swapaxes(C, 1, 2)
        gain = np.trace(np.linalg.solve(inner, C @ gram @ np.swapaxes(C, 1, 2)), axis1=1, axis2=2)
        best = int(np.argmax(np.where(left, gain, -np.inf)))
        left[best] = False
        # What is left of Λ after the pose: its product with the root of (I + Cᵀ C)⁻¹.
        root = np.linalg.inv(np.linalg.cholesky(np.eye(C.shape[2]) + C[best].T @ C[best])).T
        C, gram = C @ root, root.T @ gram @ root
        after = float(np.trace(gram)) / coordinates
        nearest = int(np.argmin(np.linalg.norm(observation.q - q[best], axis=1)))
        number = int(observation.pose[nearest])
        found.append(Suggestion(q[best], number, q[best] - observation.q[nearest], before, after))
    return tuple(found)


def _shown(
    calibration: Calibration, region: Region, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Random poses (k, n) that show enough markers, and the derivative (k, 4 m, r) of what they show.

    Rows of what is not seen are zero.
    """
    scene = scene_of(calibration)
    poses: list[FloatArray] = []
    rows: list[FloatArray] = []
    for q, seen in drawn_poses(calibration, region, _BATCHES, rng):
        enough = np.flatnonzero(seen.all(axis=1).sum(axis=1) >= _LEAST_SEEN)[: count - len(poses)]
        if enough.size:
            J = all_changed(scene, calibration.errors, q[enough] - calibration.q_reference)
            sharp = np.sqrt((J**2).sum(axis=-1)).max(axis=-1) <= _VAGUE * np.ptp(region.image, axis=1).max()
            seen = seen[enough] & sharp
            J[~seen] = 0.0
            useful = np.flatnonzero(seen.all(axis=1).sum(axis=1) >= _LEAST_SEEN)
            poses += list(q[enough[useful]])
            rows += list(J.reshape(len(J), -1, J.shape[-1])[useful])
        if len(poses) >= count:
            break
    if not poses:
        raise WorkFailed(
            f"no further pose to suggest: none within the joint ranges shows {_LEAST_SEEN} markers to both "
            "cameras as far as the calibration can tell; make it better with single-joint trials first"
        )
    return np.array(poses), np.array(rows)
