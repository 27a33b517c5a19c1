"""How far predictions of a calibration err, by its covariance: models off it, each in its own way."""

from functools import lru_cache

import numpy as np

from projservo_cli.calibration.prediction import covariance_root, predict, prediction_derivative
from projservo_cli.records import NO_SPREAD, Calibration, FloatArray, Spread

# Lower and upper limits of n joints, rad or m, and width and height of both images, px.
Bounds = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
# Directions of the covariance that are told apart, and joints at which they are looked for.
DIRECTIONS, LOOKED_AT = 8, 150
BATCH, BATCHES = 1_500, 40


@lru_cache(maxsize=64)
def spread_of(
    calibration: Calibration,
    indices: tuple[int, ...],
    face: int,
    bounds: Bounds,
    seed: int,
) -> Spread:
    """How far predictions err, of markers by their indices, those of the face first.

    The directions are those that move the images of the face most, among joints drawn at random that show it;
    what they leave is taken to be the same everywhere. None without a covariance. It takes 20 ms, once
    for all tasks of a calibration.
    """
    if not np.isfinite(calibration.covariance).all():
        return NO_SPREAD
    q = _showing(calibration, indices[:face], bounds, seed)
    if len(q) == 0:
        return NO_SPREAD
    factor = covariance_root(calibration.covariance)
    J = prediction_derivative(calibration, q)[:, :, list(indices[:face])] @ factor
    variance = (J**2).sum(axis=-1)
    rows = J.reshape(-1, J.shape[-1]) / np.maximum(np.sqrt(variance).reshape(-1, 1), 1e-9)
    # LAPACK's singular value decomposition fails on some of these rows, finite as they are.
    main = np.linalg.eigh(rows.T @ rows)[1][:, : -DIRECTIONS - 1 : -1]
    rest = float(np.sqrt(np.median(np.maximum(variance - ((J @ main) ** 2).sum(axis=-1), 0.0))))
    moved = (factor @ main).T
    n, b = calibration.H_hat_0.shape[0], calibration.M.shape[0]
    P, H_hat, M = np.split(moved[:, : 24 + 16 * n + 4 * b], [24, 24 + 16 * n], axis=1)
    return Spread(
        np.concatenate([calibration.P[None], calibration.P + P.reshape(-1, 2, 3, 4)]),
        np.concatenate([calibration.H_hat_0[None], calibration.H_hat_0 + H_hat.reshape(-1, n, 4, 4)]),
        np.ascontiguousarray(
            np.concatenate([calibration.M[None], calibration.M + M.reshape(-1, b, 4)])[:, list(indices)]
        ),
        rest,
        float(np.sqrt(variance.max())),
    )


def _showing(calibration: Calibration, indices: tuple[int, ...], bounds: Bounds, seed: int) -> FloatArray:
    """Joints (k, n) within the limits at which both images hold the markers."""
    rng, (lower, upper, image_size) = np.random.default_rng(seed), bounds
    low = np.where(np.isfinite(lower), lower, calibration.q_reference - np.pi)
    high = np.where(np.isfinite(upper), upper, calibration.q_reference + np.pi)
    most = np.array(image_size) - 0.5
    found: list[FloatArray] = []
    for _ in range(BATCHES):
        q = rng.uniform(low, high, (BATCH, len(low)))
        s = predict(calibration, q)[:, :, list(indices)]
        found += list(q[((s >= -0.5) & (s <= most)).all(axis=(1, 2, 3))])
        if len(found) >= LOOKED_AT:
            break
    return np.array(found[:LOOKED_AT]).reshape(-1, len(low))
