"""Images at many poses at once: the vectorised forward model, what it predicts, and how certainly.

The twin of the kernels in ``geometry``: the same equations for all poses and points together, which the
adjustment, predictions and random tasks share.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.readings import LEAST_SIGMA
from projservo_cli.geometry.lens import FIRST, bent, bent_derivative, through
from projservo_cli.records import (
    PRISMATIC,
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    Model,
    Observation,
)

CAMERA = 12
LENS = 2


def displacements(H_hat: FloatArray, prismatic: BoolArray, q: FloatArray) -> FloatArray:
    """Displacements exp(q Ĥ) (n, K, 4, 4) of operators (n, 4, 4) at joints (K, n), [RH00] eqs. (4), (5).

    Joint values are from the reference, rad or m.
    """
    squared = H_hat @ H_hat
    sine, versine = (part.T[..., None, None] for part in _sine_and_versine(prismatic, q))
    result: FloatArray = np.eye(4) + sine * H_hat[:, None] + versine * squared[:, None]
    return result


def _sine_and_versine(prismatic: BoolArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients (K, n) of Ĥ and Ĥ² in [RH00] eqs. (4), (5)."""
    return np.where(prismatic, q, np.sin(q)), np.where(prismatic, 0.0, 2.0 * np.sin(0.5 * q) ** 2)


def moved_points(E: FloatArray, M: FloatArray) -> FloatArray:
    """Points (m, 4) or (K, m, 4) after the last joints alone, (n + 1, K, m, 4): [RH00] eq. (6) from its end.

    By displacements (n, K, 4, 4). Entry n holds points at the reference, entry 0 those moved by all joints.
    """
    n, K = E.shape[:2]
    Y = np.empty((n + 1, K, *M.shape[-2:]))
    Y[n] = M
    for i in range(n - 1, -1, -1):
        Y[i] = Y[i + 1] @ np.swapaxes(E[i], 1, 2)
    return Y


def image_points(P: FloatArray, points: FloatArray) -> FloatArray:
    """Homogeneous image points (…, 2, m, 3) of points (…, m, 4) in both cameras (2, 3, 4), [RH00] eq. (1)."""
    return np.asarray(points[..., None, :, :] @ np.swapaxes(P, 1, 2))


def projection_derivative(
    P: FloatArray, lens: FloatArray | None, points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Pixels (…, 2, m, 2) of points (…, m, 4), and derivatives by image points (…, 2, m, 2, 3) and a lens.

    [RH00] eq. (7), second row corrected: rows (1, 0, −u)/m3 and (0, 1, −v)/m3; then the lenses (2, 5), if
    any, with a derivative (…, 2, m, 2, 2) by k1 and k2.
    """
    m = image_points(P, points)
    pixels = m[..., :2] / m[..., 2:]
    G = np.zeros((*pixels.shape, 3))
    G[..., 0, 0] = G[..., 1, 1] = 1.0 / m[..., 2]
    G[..., 2] = -pixels / m[..., 2:]
    if lens is None:
        return pixels, G, None
    by_pixel, by_lens = bent_derivative(lens[:, None], pixels)
    return bent(lens[:, None], pixels), by_pixel @ G, by_lens


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
    """Pixels (K, 2, m, 2) of markers (m, 4) at joint readings (K, n); NaN and raising as of ``predict``."""
    E = displacements(model.H_hat_0, model.joint_types == PRISMATIC, _from_reference(model, q))
    m = image_points(model.P, moved_points(E, M)[0])
    return through(model.lens[:, None], m[..., :2] / np.where(m[..., 2:] > 0.0, m[..., 2:], np.nan))


def residual_statistics(calibration: Calibration, observation: Observation) -> dict[str, Any]:
    """How far predicted pixels are from seen ones, a distance for each marker and view.

    calibration : projective kinematics; observation : stereo images of the same robot, px.
    Returns ``count``; ``rms_px``, ``median_px``, ``p95_px`` (None without a pair); ``skipped`` with the
    pairs; of markers the calibration does not know, of points behind the camera, and not seen. Raises
    InputError if the readings have another number of joints or are not finite.
    """
    known = np.isin(observation.marker, calibration.marker)
    column = {int(number): j for j, number in enumerate(calibration.marker)}
    order = np.array([column[int(number)] for number in observation.marker[known]], dtype=np.int64)
    pixels = predict(calibration, observation.q)[:, :, order]
    seen: BoolArray = np.isfinite(observation.images[..., 0]) & np.isfinite(observation.images[..., 1])
    ahead = np.isfinite(pixels[..., 0])
    residual = (pixels - observation.images[:, :, known])[seen[:, :, known] & ahead]
    return distance_statistics(np.linalg.norm(residual, axis=1)) | {
        "skipped": {
            "unknown_marker": int(seen[:, :, ~known].sum()),
            "behind_camera": int((seen[:, :, known] & ~ahead).sum()),
            "missing": int((~seen).sum()),
        },
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
    J = prediction_derivative(calibration.model(), calibration.M, q)
    variance = np.einsum("...a,...a->...", J @ calibration.covariance, J)
    result: FloatArray = np.maximum(variance, 0.0)
    return result


def prediction_derivative(model: Model, M: FloatArray, q: FloatArray) -> FloatArray:
    """Derivative of predicted pixels by P, H_hat_0, M (ravelled): (K, 2, m, 2, 24 + 16 n + 4 m).

    With a lens, by k1 and k2 of both views in four more columns.

    An operator enters by E = I + s Ĥ + c Ĥ², [RH00] eqs. (4), (5), so dE = s dĤ + c (dĤ Ĥ + Ĥ dĤ).

    model : robot and rig in one frame.
    M : (m, 4) markers at the reference.
    q : (K, n) joint readings, rad or m.
    """
    H_hat, prismatic = model.H_hat_0, model.joint_types == PRISMATIC
    dq = _from_reference(model, q)
    K, n, m = len(dq), len(H_hat), len(M)
    E = displacements(H_hat, prismatic, dq)
    Y = moved_points(E, M)
    _, G, by_lens = projection_derivative(model.P, model.lens if model.lens[:, FIRST:].any() else None, Y[0])
    joints, markers = 2 * CAMERA, 2 * CAMERA + 16 * n
    J = np.zeros((K, 2, m, 2, markers + 4 * m + (0 if by_lens is None else 2 * LENS)))
    for v in (0, 1):
        camera = G[:, v, :, :, :, None] * Y[0][:, :, None, None, :]
        J[:, v, ..., v * CAMERA : (v + 1) * CAMERA] = camera.reshape(K, m, 2, CAMERA)
        if by_lens is not None:
            first = markers + 4 * m + v * LENS
            J[:, v, ..., first : first + LENS] = by_lens[:, v]
    D = G @ model.P[None, :, None]
    coefficients = (part.T[..., None, None, None, None] for part in _sine_and_versine(prismatic, dq))
    for i, (sine, versine) in enumerate(zip(*coefficients, strict=True)):
        point = Y[i + 1][:, None, :, None]
        inner = sine * point + versine * (Y[i + 1] @ H_hat[i].T)[:, None, :, None]
        block = D[..., :, None] * inner[..., None, :]
        block = block + (versine * (D @ H_hat[i]))[..., :, None] * point[..., None, :]
        J[..., joints + 16 * i : joints + 16 * (i + 1)] = block.reshape(K, 2, m, 2, 16)
        D = D @ E[i][:, None, None]
    for j in range(m):
        J[:, :, j, :, markers + 4 * j : markers + 4 * (j + 1)] = D[:, :, j]
    return J


# Observations in a row that must agree on a disturbance: one may be blurred, or a marker taken for another.
WINDOW = 3
# Chance that a run of undisturbed observations is called disturbed, at most.
_FALSE_ALARM = 1e-3
# What the first order leaves out of a prediction's error, at most, as a share of the calibration's own noise:
# nearer than that no image need come to what is predicted, however good the detector.
_BEYOND_FIRST_ORDER = 0.02
# Smallest over largest variance that is no rounding.
_RANK = 1e-12


@dataclass(eq=False)
class Innovation:
    """Whether a sequence of observations still agrees with a calibration: a bumped camera, a moved marker.

    At given joint readings the calibration predicts the pixels of every marker. What is seen differs by
    the pixel noise and by the error of the calibration, r = J δ + ε with δ ~ N(0, Σ) and ε ~ N(0, σ² I),
    to first order. δ is the same all along, so it is estimated from one observation to the next by a
    Kalman filter, and each innovation has the χ² distribution of its own S = J C Jᵀ + σ² I. The parts that
    are tested are the two views and each marker; one that is beyond its threshold several times in a row
    is no chance and no slip of the detector.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
    Navigation", Wiley 2001, section 5.4 (innovation as a test of the filter).
    """

    calibration: Calibration  # what predicts the pixels, with its covariance
    sigma_px: float  # pixel noise per coordinate
    observations: int  # most observations of one sequence, which sets the threshold
    _beyond: list[BoolArray] = field(default_factory=list)

    def __post_init__(self) -> None:
        spread, axes = np.linalg.eigh(self.calibration.covariance)
        known = spread > _RANK * spread[-1]  # the gauge, and what a rigid robot cannot do, have no spread
        self._factor: FloatArray = np.sqrt(spread[known]) * axes[:, known]
        self._mean, self._C = np.zeros(known.sum()), np.eye(known.sum())
        self._sigma = max(self.sigma_px, _BEYOND_FIRST_ORDER * self.calibration.sigma_px, LEAST_SIGMA)
        m = len(self.calibration.marker)
        tail = _FALSE_ALARM / (self.observations * (2 + m))
        self._threshold: FloatArray = np.asarray(chdtri(np.maximum(np.arange(4 * m + 1), 1), tail))

    def disturbed(self, q: FloatArray, images: FloatArray) -> str:
        """What is wrong, in words; empty while nothing is.

        q : (n,) joint readings, rad or m.
        images : (2, m, 2) pixels of the markers of the calibration, NaN where unseen.
        """
        J = prediction_derivative(self.calibration.model(), self.calibration.M, q[None])[0] @ self._factor
        r = images - predict(self.calibration, q[None])[0] - J @ self._mean
        m = len(self.calibration.marker)
        views, numbers = np.arange(2)[:, None], np.arange(m)
        parts = [*(np.tile(views == view, m) for view in range(2))]
        parts += [np.tile(numbers == j, (2, 1)) for j in range(m)]
        beyond = np.array([self._beyond_chance(r, J, part) for part in parts])
        self._beyond = [*self._beyond[1 - WINDOW :], beyond]
        lasting = np.all(self._beyond, axis=0)
        if len(self._beyond) == WINDOW and lasting.any():
            return self._culprit(r, J, lasting[2:])
        if not beyond.any():
            self._learn(r, J)
        return ""

    def _seen(
        self, r: FloatArray, J: FloatArray, part: BoolArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Innovation, derivative and covariance of the innovation of what was seen of a part (2, m)."""
        seen = part & np.isfinite(r[..., 0])
        B = J[seen].reshape(-1, J.shape[-1])
        return r[seen].ravel(), B, B @ self._C @ B.T + self._sigma**2 * np.eye(len(B))

    def _beyond_chance(self, r: FloatArray, J: FloatArray, part: BoolArray) -> bool:
        """Whether χ² of what was seen of a part (2, m) is beyond what chance allows."""
        values, _, S = self._seen(r, J, part)
        return bool(values @ np.linalg.solve(S, values) > self._threshold[values.size])

    def _learn(self, r: FloatArray, J: FloatArray) -> None:
        """Kalman update of the error of the calibration."""
        values, B, S = self._seen(r, J, np.ones(r.shape[:2], dtype=np.bool_))
        gain = np.linalg.solve(S, B @ self._C).T
        self._mean = self._mean + gain @ values
        self._C = self._C - gain @ B @ self._C
        self._C = 0.5 * (self._C + self._C.T)

    def _culprit(self, r: FloatArray, J: FloatArray, moved: BoolArray) -> str:
        """The least that explains it: some markers, one camera, or everything."""
        few = moved.sum() <= len(moved) // 2
        views = [
            self._beyond_chance(r, J, np.outer(np.arange(2) == view, ~moved | (not few))) for view in range(2)
        ]
        rms = float(np.sqrt(np.nanmean(r**2)))
        fit = f"images are {rms:.3g} px rms per coordinate off what the calibration predicts"
        if few and not any(views):
            numbers = ", ".join(map(str, self.calibration.marker[moved]))
            return f"{fit}: marker {numbers} was moved on the tool; put it back, or recalibrate"
        if views[0] != views[1]:
            side = ("left", "right")[int(views[1])]
            return f"{fit}, those of the {side} camera alone: it was moved; recalibrate"
        return (
            f"{fit}, in both cameras alike: the joint readings are wrong, or the tool or the rig was moved; "
            "check them and recalibrate"
        )
