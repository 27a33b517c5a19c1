"""Images that a calibration predicts, how certain they are, and how well they agree with data."""

from typing import Any

import numpy as np

from projservo_cli.calibration.adjustment import CAMERA, LENS, displacements
from projservo_cli.calibration.quality import chi2_quantile
from projservo_cli.geometry.lens import FIRST, bent_derivative, through
from projservo_cli.records import PRISMATIC, Calibration, FloatArray, InputError, Model, Observation


def image_points(model: Model, M: FloatArray, q: FloatArray) -> FloatArray:
    """Homogeneous image points (K, 2, m, 3) of markers at joint readings, [RH00] eqs. (1), (6), no lens.

    Parameters
    ----------
    model : robot and rig in one frame.
    M : (m, 4) markers at the reference.
    q : (K, n) joint readings, rad or m.

    Raises
    ------
    InputError
        If the readings have another number of joints or are not finite.
    """
    dq = _from_reference(model, q)
    n = len(model.H_hat_0)
    E = displacements(model.H_hat_0, model.joint_types == PRISMATIC, dq)
    moved = np.broadcast_to(M.T, (len(dq), 4, len(M)))
    for i in range(n - 1, -1, -1):
        moved = E[i] @ moved
    result: FloatArray = np.swapaxes(model.P[None] @ moved[:, None], 2, 3)
    return result


def _from_reference(model: Model, q: FloatArray) -> FloatArray:
    """Joint values (K, n) from the reference, after a check of the readings (K, n), rad or m."""
    q = np.asarray(q, dtype=np.float64)
    n = len(model.H_hat_0)
    if q.ndim != 2 or q.shape[1] != n:
        raise InputError(f"joint readings of shape {q.shape}: expected one row of {n} a pose")
    if not np.isfinite(q).all():
        raise InputError("joint readings must be finite numbers")
    result: FloatArray = q - model.q_reference
    return result


def predict(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Pixels of all markers in both views at joint readings, [RH00] eqs. (1), (6).

    Parameters
    ----------
    calibration : projective kinematics.
    q : (K, n) joint readings, rad or m.

    Returns
    -------
    (K, 2, m, 2) pixels, markers in the order of ``calibration.marker``; NaN for a point that does
    not lie in front of the camera, or beyond where its lens distortion turns back.

    Raises
    ------
    InputError
        If the readings have another number of joints or are not finite.
    """
    return marker_pixels(calibration.model(), calibration.M, q)


def marker_pixels(model: Model, M: FloatArray, q: FloatArray) -> FloatArray:
    """Pixels (K, 2, m, 2) of markers at joint readings; NaN as of ``predict``.

    Parameters are those of ``image_points``.
    """
    m = image_points(model, M, q)
    return through(model.lens[:, None], m[..., :2] / np.where(m[..., 2:] > 0.0, m[..., 2:], np.nan))


def residual_statistics(calibration: Calibration, observation: Observation) -> dict[str, Any]:
    """How far predicted pixels are from seen ones, a distance for each marker and view.

    Parameters
    ----------
    calibration : projective kinematics.
    observation : stereo images of the same robot, px.

    Returns
    -------
    ``count``; ``rms_px``, ``median_px``, ``p95_px`` (None without a pair); ``skipped`` with the pairs
    of markers the calibration does not know, of points behind the camera, and not seen.

    Raises
    ------
    InputError
        If the readings have another number of joints or are not finite.
    """
    known = np.isin(observation.marker, calibration.marker)
    column = {int(number): j for j, number in enumerate(calibration.marker)}
    order = np.array([column[int(number)] for number in observation.marker[known]], dtype=np.int64)
    pixels = predict(calibration, observation.q)[:, :, order]
    seen = np.isfinite(observation.images[..., 0]) & np.isfinite(observation.images[..., 1])
    ahead = np.isfinite(pixels[..., 0])
    residual = (pixels - observation.images[:, :, known])[seen[:, :, known] & ahead]
    distance = np.linalg.norm(residual, axis=1)
    some = distance.size > 0
    return {
        "count": int(distance.size),
        "rms_px": float(np.sqrt(np.mean(distance**2))) if some else None,
        "median_px": float(np.median(distance)) if some else None,
        "p95_px": float(np.percentile(distance, 95)) if some else None,
        "skipped": {
            "unknown_marker": int(seen[:, :, ~known].sum()),
            "behind_camera": int((seen[:, :, known] & ~ahead).sum()),
            "missing": int((~seen).sum()),
        },
    }


def prediction_variance(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Variance of predicted pixels from the covariance of the calibration, to first order.

    Parameters
    ----------
    calibration : projective kinematics with its covariance.
    q : (K, n) joint readings, rad or m.

    Returns
    -------
    (K, 2, m, 2) variances of u and v, px².

    Raises
    ------
    InputError
        If the readings have another number of joints or are not finite.
    """
    J = prediction_derivative(calibration.model(), calibration.M, q)
    variance = np.einsum("...a,...a->...", J @ calibration.covariance, J)
    result: FloatArray = np.maximum(variance, 0.0)
    return result


def prediction_derivative(model: Model, M: FloatArray, q: FloatArray) -> FloatArray:
    """Derivative of predicted pixels by P, H_hat_0, M (ravelled): (K, 2, m, 2, 24 + 16 n + 4 m).

    With a lens, by k1 and k2 of both views in four more columns.

    An operator enters by E = I + s Ĥ + c Ĥ², [RH00] eqs. (4), (5), so dE = s dĤ + c (dĤ Ĥ + Ĥ dĤ).

    Parameters
    ----------
    model : robot and rig in one frame.
    M : (m, 4) markers at the reference.
    q : (K, n) joint readings, rad or m.
    """
    H_hat, slides = model.H_hat_0, model.joint_types == PRISMATIC
    dq = _from_reference(model, q)
    K, n, m = len(dq), len(H_hat), len(M)
    E = displacements(H_hat, slides, dq)
    Y = np.empty((n + 1, K, m, 4))
    Y[n] = M
    for i in range(n - 1, -1, -1):
        Y[i] = Y[i + 1] @ np.swapaxes(E[i], 1, 2)
    image = Y[0][:, None] @ np.swapaxes(model.P, 1, 2)[None]
    G = np.zeros((K, 2, m, 2, 3))
    G[..., 0, 0] = G[..., 1, 1] = 1.0 / image[..., 2]
    G[..., 2] = -image[..., :2] / image[..., 2:] ** 2
    lenses = model.lens[:, FIRST:].any()
    size = 2 * CAMERA + 16 * n + 4 * m
    J = np.zeros((K, 2, m, 2, size + (2 * LENS if lenses else 0)))
    if lenses:
        by_pixel, by_lens = bent_derivative(model.lens[:, None], image[..., :2] / image[..., 2:])
        G = by_pixel @ G
        for v in (0, 1):
            J[:, v, ..., size + v * LENS : size + (v + 1) * LENS] = by_lens[:, v]
    for v in (0, 1):
        camera = G[:, v, :, :, :, None] * Y[0][:, :, None, None, :]
        J[:, v, ..., v * CAMERA : (v + 1) * CAMERA] = camera.reshape(K, m, 2, CAMERA)
    D = G @ model.P[None, :, None]
    for i in range(n):
        sine = np.where(slides[i], dq[:, i], np.sin(dq[:, i]))[:, None, None, None, None]
        versine = np.where(slides[i], 0.0, 2.0 * np.sin(0.5 * dq[:, i]) ** 2)[:, None, None, None, None]
        point = Y[i + 1][:, None, :, None]
        inner = sine * point + versine * (Y[i + 1] @ H_hat[i].T)[:, None, :, None]
        block = D[..., :, None] * inner[..., None, :]
        block = block + (versine * (D @ H_hat[i]))[..., :, None] * point[..., None, :]
        first = 2 * CAMERA + 16 * i
        J[..., first : first + 16] = block.reshape(K, 2, m, 2, 16)
        D = D @ E[i][:, None, None]
    for j in range(m):
        first = 2 * CAMERA + 16 * n + 4 * j
        J[:, :, j, :, first : first + 4] = D[:, :, j]
    return J


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
