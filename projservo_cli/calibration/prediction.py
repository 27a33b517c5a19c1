"""What a calibration predicts, and how certainly."""

from typing import Any

import numpy as np

from projservo_cli.calibration.forward import Images, Scene
from projservo_cli.records import (
    BoolArray,
    Calibration,
    Errors,
    FloatArray,
    InputError,
    Observation,
    apart,
)


def scene_of(calibration: Calibration) -> Scene:
    """The scene of a record."""
    c = calibration
    return Scene(c.P, c.H_hat_0, c.prismatic, c.M, c.lens)


def _scene(calibration: Calibration, q: FloatArray) -> tuple[Scene, FloatArray]:
    """The scene of a record, and joint values (K, n) from its reference after a check of the readings."""
    q = np.asarray(q, dtype=np.float64)
    n = len(calibration.H_hat_0)
    if q.ndim != 2 or q.shape[1] != n:
        raise InputError(f"joint readings of shape {q.shape}: expected one row of {n} a pose")
    if not np.isfinite(q).all():
        raise InputError("joint readings must be finite numbers")
    return scene_of(calibration), q - calibration.q_reference


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
    scene, q = _scene(calibration, q)
    return scene.seen(q)


def residual_statistics(calibration: Calibration, observation: Observation) -> dict[str, Any]:
    """How far predicted pixels are from seen ones, a distance for each marker and view.

    calibration : projective kinematics; observation : stereo images of the same robot, px; those in motion do
    not count.
    Returns ``count``; ``rms_px``, ``median_px``, ``p95_px`` (None without a pair); ``skipped`` with the
    pairs; of markers the calibration does not know, of points behind the camera, and not seen. Raises
    InputError if the readings have another number of joints or are not finite.
    """
    observation = observation.at_rest
    known = np.isin(observation.marker, calibration.marker)
    numbers = calibration.marker.tolist()
    order = [numbers.index(number) for number in observation.marker[known].tolist()]
    pixels = predict(calibration, observation.q)[:, :, order]
    seen: BoolArray = np.asarray(np.isfinite(observation.images).all(axis=-1))
    ahead = np.isfinite(pixels[..., 0])
    residual = (pixels - observation.images[:, :, known])[seen[:, :, known] & ahead]
    return distance_statistics(np.linalg.norm(residual, axis=1)) | {
        "skipped": {
            "unknown_marker": int(seen[:, :, ~known].sum()),
            "behind_camera": int((seen[:, :, known] & ~ahead).sum()),
            "missing": int((~seen).sum()),
        }
    }


def distance_statistics(distance: FloatArray) -> dict[str, Any]:
    """``count``, ``rms_px``, ``median_px``, ``p95_px`` of distances (L,), the last three None without one."""
    some = distance.size > 0
    return {
        "count": int(distance.size),
        "rms_px": float(np.sqrt(np.mean(distance**2))) if some else None,
        "median_px": float(np.median(distance)) if some else None,
        "p95_px": float(np.percentile(distance, 95)) if some else None,
    }


def prediction_variance(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Variance of predicted pixels from the covariance of the calibration, to first order.

    calibration : projective kinematics with its covariance; q : (K, n) joint readings, rad or m.
    Returns (K, 2, m, 2) variances of u and v, px². Raises InputError if the readings have another number of
    joints or are not finite.
    """
    scene, q = _scene(calibration, q)
    result = np.empty((len(q), 2, len(scene.M), 2))
    for k in range(len(q)):  # a pose at a time, which bounds what is in memory
        common, own = changed(scene, calibration.errors, q[k : k + 1])
        result[k] = ((common**2).sum(axis=-1) + (own**2).sum(axis=-1))[0]
    return result


def changed(
    scene: Scene, errors: Errors, q: FloatArray, images: Images | None = None
) -> tuple[FloatArray, FloatArray]:
    """Change of all pixels (K, 2, m, 2, r) and (K, 2, m, 2, 3) by ``errors``, joints from the reference."""
    shared, by_marker = scene.derivative(q, images)
    return shared @ errors.shared + by_marker @ errors.marker, by_marker @ errors.own


def all_changed(scene: Scene, errors: Errors, q: FloatArray, images: Images | None = None) -> FloatArray:
    """Change of all pixels by all ``errors``, (K, 2, m, 2, r + 3 m): for few markers."""
    m = len(scene.M)
    return apart(*changed(scene, errors, q, images), np.arange(m)[:, None], m)


def error_factor(calibration: Calibration) -> FloatArray:
    """Factor (24 + 16 n + 4 m, r + 3 m) of the covariance of P, H_hat_0, lenses, M: for few markers.

    Gauge fixed: of all errors that change images alike the least. Four rows more before M with lenses.
    """
    factor, free = calibration.errors.dense(), scene_of(calibration).gauge()
    return np.asarray(factor - free @ (free.T @ factor))


def joint_derivative(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Derivative (K, 2, m, 2, n) of predicted pixels by joints (K, n), px per rad or m."""
    scene, q = _scene(calibration, q)
    J = scene.everywhere(q).by_joint(scene.H_hat)
    return np.asarray(J.reshape(2, len(q), len(scene.M), *J.shape[2:]).swapaxes(0, 1))
