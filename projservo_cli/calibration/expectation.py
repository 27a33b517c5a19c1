"""The error of predicted images that a calibration has to reckon with, and how large chance may make it."""

import numpy as np

from projservo_cli.calibration.chance import chi2_quantile
from projservo_cli.calibration.prediction import marker_pixels, prediction_derivative
from projservo_cli.records import FloatArray, Model

POSES, SEED, HALVINGS = 60, 0, 10
SURE = 0.99


def predicted_error(
    model: Model, M: FloatArray, factor: FloatArray, around: FloatArray, q: FloatArray
) -> tuple[float, float]:
    """Expected error of images at poses of all joints at once, and what 99 of 100 calibrations stay below.

    Root mean squares of the Euclidean error per marker and view, in units of the pixel noise, over poses
    drawn evenly within the ranges that the joints moved through; images that leave the surroundings of the
    data do not count, and where all do, the ranges are halved about the reference. No residual shows on
    which side of the expectation a calibration came to lie: to first order the error of a maximum of the
    likelihood does not depend on what it leaves.

    Parameters
    ----------
    model : projective robot and rig.
    M : (m, 4) markers at the reference.
    factor : (24 + 16 n + 4 m, r) factor of the covariance at a noise of one pixel.
    around : (2, 2, 2) lower and upper corner of the image region that counts, per view, px.
    q : (K, n) joint readings of the data, rad or m.
    """
    rng = np.random.default_rng(SEED)
    poses = rng.uniform(q.min(axis=0), q.max(axis=0), (POSES, q.shape[1]))
    for _ in range(HALVINGS):
        pixels = marker_pixels(model, M, poses)
        counts = ((pixels >= around[:, None, 0]) & (pixels <= around[:, None, 1])).all(axis=-1)
        if counts.any():
            break
        poses = 0.5 * (poses + model.q_reference)
    spread = prediction_derivative(model, M, poses)[counts].reshape(-1, len(factor)) @ factor
    variances = np.linalg.eigvalsh(spread.T @ spread) / max(int(counts.sum()), 1)
    return float(np.sqrt(variances.sum())), float(np.sqrt(quantile(variances, SURE)))


def quantile(variances: FloatArray, probability: float) -> float:
    """Quantile of a sum of squares of independent normal variables, from a χ² of the same three moments.

    Source: M. J. Buckley, G. K. Eagleson, "An approximation to the distribution of quadratic forms in
    normal random variables", Australian Journal of Statistics 30A, 1988.

    Parameters
    ----------
    variances : (r,) of the variables.
    probability : that the sum stays below.
    """
    mean, square, cube = (float((variances**power).sum()) for power in (1, 2, 3))
    if cube == 0.0:
        return mean
    freedom = square**3 / cube**2
    return mean + float(np.sqrt(square / freedom) * (chi2_quantile(probability, freedom) - freedom))
