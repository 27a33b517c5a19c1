"""Covariance of predictions among joints drawn at random: a few principal directions for a planner."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from projservo_cli.calibration.prediction import (
    dense_pixel_changes,
    error_factor,
    errors_of,
    from_reference,
    parameters_from,
)
from projservo_cli.image_size import image_corners
from projservo_cli.records import NO_SPREAD, BoolArray, Calibration, FloatArray, Spread

_BATCH = 1500  # poses drawn at once


@dataclass(frozen=True, eq=False)
class Region:
    """Domain of the poses and of the images."""

    low: FloatArray
    high: FloatArray  # low, high: (n,) joint readings between which candidates are drawn, rad or m
    image: FloatArray  # (V, 2, 2) lower and upper corner of each image, px


def drawn_poses(
    calibration: Calibration, region: Region, batches: int, rng: np.random.Generator
) -> Iterator[tuple[FloatArray, BoolArray]]:
    """Batches of random poses (k, n) of a region, and which images (k, V, m) lie within it."""
    scene, (low, high) = parameters_from(calibration), region.image.swapaxes(0, 1)[:, :, None]
    for _ in range(batches):
        q = rng.uniform(region.low, region.high, (_BATCH, len(region.low)))
        pixels = scene.predict(from_reference(calibration, q))
        yield q, ((pixels >= low) & (pixels <= high)).all(axis=-1)  # none that is NaN, behind the camera


# Lower and upper limits of n joints, rad or m, and width and height of each image, px.
_Bounds = tuple[tuple[float, ...], tuple[float, ...], tuple[tuple[float, ...], ...]]
# Number of principal directions; of joints at which they are computed, and batches of them.
_DIRECTIONS, _LOOKED_AT, _MOST_BATCHES = 8, 150, 40


@lru_cache(maxsize=64)
def spread_of(
    calibration: Calibration,
    indices: tuple[int, ...],
    face: int,
    bounds: _Bounds,
    seed: int,
    min_views: int,
) -> Spread:
    """Return the prediction errors of markers by their indices, the face first.

    The directions are those that move the images of the face most, among joints drawn at random that show it
    in ``min_views`` views; the rest is taken as constant. None without a covariance. It takes 20 ms, once for
    all tasks of a calibration.
    """
    if not calibration.has_covariance:
        return NO_SPREAD
    calibration = calibration.with_markers(list(indices))
    q = _showing(calibration, face, bounds, seed, min_views)
    if len(q) == 0:
        return NO_SPREAD
    scene, factor = parameters_from(calibration), error_factor(calibration)
    J = dense_pixel_changes(scene, errors_of(calibration), from_reference(calibration, q))[:, :, :face]
    variance = (J**2).sum(axis=-1)
    rows = J.reshape(-1, J.shape[-1]) / np.maximum(np.sqrt(variance).reshape(-1, 1), 1e-9)
    # LAPACK's singular value decomposition fails on some of these rows, finite as they are.
    main = np.linalg.eigh(rows.T @ rows)[1][:, : -_DIRECTIONS - 1 : -1]
    rest = float(np.sqrt(np.median(np.maximum(variance - ((J @ main) ** 2).sum(axis=-1), 0.0))))
    moved = np.ascontiguousarray((factor @ main).T)  # for other strides all constraints are compiled again
    model, V, b = calibration.model(), len(calibration.P), len(calibration.M)
    n = len(model.H_hat_0)
    P, H_hat, M = moved[:, : 12 * V], moved[:, 12 * V : 12 * V + 16 * n], moved[:, -4 * b :]
    H_hat = -H_hat if model.on_tool else H_hat
    return Spread(
        P=np.concatenate([calibration.P[None], calibration.P + P.reshape(-1, V, 3, 4)]),
        H_hat=np.concatenate([model.H_hat_0[None], model.H_hat_0 + H_hat.reshape(-1, n, 4, 4)]),
        M=np.concatenate([calibration.M[None], calibration.M + M.reshape(-1, b, 4)]),
        rest=rest,
        max_sigma=float(np.sqrt(variance.max())),
    )


def _showing(calibration: Calibration, face: int, bounds: _Bounds, seed: int, min_views: int) -> FloatArray:
    """Joints (k, n) within the limits at which enough images hold the first markers, the face."""
    lower, upper, image_size = bounds
    low = np.where(np.isfinite(lower), lower, calibration.q_reference - np.pi)
    high = np.where(np.isfinite(upper), upper, calibration.q_reference + np.pi)
    corners = image_corners(np.array(image_size, dtype=np.float64))
    region, joints = Region(low, high, corners), np.zeros((0, len(low)))
    for q, in_view in drawn_poses(calibration, region, _MOST_BATCHES, np.random.default_rng(seed)):
        joints = np.concatenate([joints, q[in_view[:, :, :face].all(axis=2).sum(axis=1) >= min_views]])
        if len(joints) >= _LOOKED_AT:
            break
    return joints[:_LOOKED_AT]
