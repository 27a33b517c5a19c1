"""Prediction of images at many poses: the vectorised forward model, its derivative and its covariance.

It has the equations of the kernels in ``geometry`` for all poses and points together, for the adjustment,
predictions and random tasks.
"""

from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.calibration.detections import in_chain_order, per_rad
from projservo_cli.geometry.displacements import displacements, sine_and_versine
from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.geometry.joint_curve import backwards, basis, slopes, true_joints
from projservo_cli.geometry.lens import distort, distort_derivative, distort_visible
from projservo_cli.records import (
    FROM_ONE,
    TOOL,
    BoolArray,
    Calibration,
    Errors,
    FloatArray,
    InputError,
    IntArray,
    JointCurve,
    apart,
    changed,
)

# Number of parameters of a camera, a 3×4 matrix.
CAMERA = 12
# Number of parameters of a lens about a given image centre, k1 and k2; two more are its centre.
LENS = 2
# Fields of a calibration with an entry for each joint, besides those in the sense of its readings.
_PER_JOINT = (
    *("H_hat_0", "excitation", "poorly_observable", "prediction_noise"),
    *("operator_defect", "trace_defect", "plane_defect"),
)


def moved_points(E: FloatArray, M: FloatArray) -> FloatArray:
    """Points M, (m, 4) or (K, m, 4), moved by the last joints only, (n + 1, K, m, 4): [RH00] eq. (6).

    E : (n, K, 4, 4) displacements. Entry n of the result has points at the reference, entry 0 those moved by
    all joints.
    """
    n, K = E.shape[:2]
    Y = np.empty((n + 1, K, *M.shape[-2:]))
    Y[n] = M
    for i in range(n - 1, -1, -1):
        Y[i] = Y[i + 1] @ np.swapaxes(E[i], 1, 2)
    return Y


def image_points(P: FloatArray, points: FloatArray) -> FloatArray:
    """Homogeneous image points (…, V, m, 3) of points (…, m, 4) in cameras (…, V, 3, 4), [RH00] eq. (1)."""
    return np.asarray(points[..., None, :, :] @ np.swapaxes(P, -1, -2))


def pixels_of(P: FloatArray, lens: FloatArray, points: FloatArray) -> FloatArray:
    """Raw pixels (…, V, m, 2) of points (…, m, 4) in cameras (…, V, 3, 4) with lenses (…, V, 5)."""
    m = image_points(P, points)
    return distort(lens[..., None, :], m[..., :2] / m[..., 2:])


def projection_derivative(
    P: FloatArray, lens: FloatArray | None, points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Pixels (V, N, 2) of points (N, 4), and derivatives by image points (V, N, 2, 3) and terms of a lens.

    [RH00] eq. (7), second row corrected: rows (1, 0, −u)/m3 and (0, 1, −v)/m3; then the lenses (V, 5).
    """
    m = image_points(P, points)
    pixels = m[..., :2] / m[..., 2:]
    G = np.zeros((*pixels.shape, 3))
    G[..., 0, 0] = G[..., 1, 1] = 1.0 / m[..., 2]
    G[..., 2] = -pixels / m[..., 2:]
    if lens is None:
        return pixels, G, None
    by_pixel, by_lens = distort_derivative(lens[:, None], pixels)
    return distort(lens[:, None], pixels), by_pixel @ G, by_lens


class Images(NamedTuple):
    """Pixels of N observations and their derivatives."""

    pixels: FloatArray  # (V, N, 2) px
    points: FloatArray  # (n + 1, N, 4) the point behind each joint, entry 0 moved by all joints
    by_camera: FloatArray  # (V, N, 2, 12)
    by_point: FloatArray  # (n + 1, 2, N, 2, 4) by ``points``, for fixed joints before it
    by_lens: FloatArray | None  # (V, N, 2, 4) by the ``TERMS`` of a lens, if there is one
    slopes: FloatArray | None  # (N, n, n) derivatives of true joints by readings, where they differ

    def by_true_joint(self, H_hat: FloatArray) -> FloatArray:
        """Derivative (V, N, 2, n) by the joints of operators (n, 4, 4), [RH00] eqs. (7), (19)."""
        velocity = self.points[:-1] @ H_hat.swapaxes(1, 2)
        return np.asarray(np.einsum("ivNrc,iNc->vNri", self.by_point[:-1], velocity))

    def by_joint(self, H_hat: FloatArray) -> FloatArray:
        """Derivative (V, N, 2, n) by the readings of joints of operators (n, 4, 4)."""
        by_joint = self.by_true_joint(H_hat)
        return by_joint if self.slopes is None else np.asarray(by_joint @ self.slopes)

    def by_motion(self, generators: FloatArray, behind: int) -> FloatArray:
        """Derivative (V, N, 2, d) by motions (d, 4, 4) of parts behind a joint: 0 the base, −1 the tool."""
        velocity = np.einsum("dab,Nb->Nad", generators, self.points[behind])
        return np.asarray(self.by_point[behind] @ velocity)

    def of_own_poses(self) -> "Images":
        """Images of all markers by each view at its respective pose, of as many poses as views: (1, N)."""
        V, N = self.pixels.shape[:2]
        own = np.repeat(np.arange(V), N // V), np.arange(N)
        return Images(
            pixels=self.pixels[own][None],
            points=self.points,
            by_camera=self.by_camera[own][None],
            by_point=self.by_point[:, *own][:, None],
            by_lens=None if self.by_lens is None else self.by_lens[own][None],
            slopes=self.slopes,
        )


@dataclass(frozen=True, eq=False)
class Parameters:
    """Fitted parameters of rig, robot and markers in one frame; readings from the reference, rad or m."""

    P: FloatArray  # (V, 3, 4) cameras to pixels
    H_hat: FloatArray  # (n, 4, 4) operators at the reference
    prismatic: BoolArray  # (n,) whether the joint is prismatic
    M: FloatArray  # (m, 4) markers at the reference
    lens: FloatArray | None = None  # (V, 5) lenses, None without
    # (K, n) true joints less their readings at the poses of a problem, rad or m; None if they are exact
    offsets: FloatArray | None = None
    lens_terms: int = 0  # number of estimated ``TERMS`` of each lens: 0, k1 and k2, or those and the centre
    curve: JointCurve | None = None  # of true joints by readings, None where they are equal
    known_arm: bool = False  # whether the operators are known, as of poses of the flange, and not fitted

    def turned(self, q: FloatArray) -> FloatArray:
        """True joints (K, n) at readings (K, n), both from the reference."""
        return q if self.curve is None else true_joints(self.curve, self.prismatic, q)

    def by_curve(self, images: Images, q: FloatArray) -> FloatArray:
        """Derivative (V, N, 2, T) of images, with readings (N, n), by the coefficients of the curve."""
        if self.curve is None:
            return images.by_camera[..., :0]
        moved = images.by_true_joint(self.H_hat)[..., self.curve.terms[:, 1].astype(np.int64)]
        return np.asarray(moved * basis(self.curve, self.prismatic, q)[:, None])

    def predict(self, q: FloatArray) -> FloatArray:
        """Pixels (K, V, m, 2) of all markers at joints (K, n), [RH00] eqs. (1), (6).

        NaN for a point behind the camera, or beyond the radius at which its lens model folds back.
        """
        E = displacements(self.H_hat, self.prismatic, self.turned(q))
        m = image_points(self.P, moved_points(E, self.M)[0])
        pixels: FloatArray = m[..., :2] / np.where(m[..., 2:] > 0.0, m[..., 2:], np.nan)
        return pixels if self.lens is None else distort_visible(self.lens[:, None], pixels)

    def motion(self, q: FloatArray) -> FloatArray:
        """Displacements (K, 4, 4) by all joints together at joints (K, n), [RH00] eq. (6)."""
        return reduce(np.matmul, displacements(self.H_hat, self.prismatic, self.turned(q)))

    def moved(self, q: FloatArray, pose_of: IntArray, marker_of: IntArray) -> FloatArray:
        """Points (N, 4) of observations after the motion of all joints."""
        return np.asarray((self.motion(q)[pose_of] @ self.M[marker_of][..., None])[..., 0])

    def images(self, q: FloatArray, pose_of: IntArray, marker_of: IntArray) -> Images:
        """Images (N,) of markers at rows of q (K, n), with derivatives by [RH00] eq. (6)."""
        E = displacements(self.H_hat, self.prismatic, self.turned(q))[:, pose_of]
        Y = moved_points(E, self.M[marker_of][:, None])[:, :, 0]
        pixels, G, by_lens = projection_derivative(self.P, self.lens, Y[0])
        D = np.empty((len(Y), *pixels.shape, 4))
        D[0] = G @ self.P[:, None]
        for i, by_joint in enumerate(E):
            D[i + 1] = D[i] @ by_joint
        by_camera = (G[..., None] * Y[0][:, None, None, :]).reshape(*pixels.shape, CAMERA)
        curve_slopes = None if self.curve is None else slopes(self.curve, self.prismatic, q)[pose_of]
        return Images(pixels, Y, by_camera, D, by_lens, curve_slopes)

    def everywhere(self, q: FloatArray) -> Images:
        """Images of all markers at joints (K, n), pose by pose, with derivatives."""
        pose_of, marker_of = np.divmod(np.arange(len(q) * len(self.M)), len(self.M))
        return self.images(q, pose_of, marker_of)

    def derivative(self, q: FloatArray, images: Images | None = None) -> tuple[FloatArray, FloatArray]:
        """Derivatives of all markers' pixels by P, H_hat (ravelled), and by the marker's own coordinates.

        Of shapes (K, V, m, 2, 12 V + 16 n), with more columns for the ``lens_terms`` of both views and the
        terms of the curve, and (K, V, m, 2, 4). An operator enters by E = I + s Ĥ + c Ĥ², [RH00] eqs. (4),
        (5), so dE = s dĤ + c (dĤ Ĥ + Ĥ dĤ). images : result of ``everywhere``, if known.
        """
        (K, n), m = q.shape, len(self.M)
        pose_of = np.repeat(np.arange(K), m)
        images = self.everywhere(q) if images is None else images
        V, joints, terms = len(self.P), self.P.size, self.lens_terms
        lenses = joints + 16 * n
        by_curve = self.by_curve(images, q[pose_of])
        J = np.zeros((V, K * m, 2, lenses + V * terms + by_curve.shape[-1]))
        J[..., lenses + V * terms :] = by_curve
        for v in range(V):
            J[v, ..., v * CAMERA : (v + 1) * CAMERA] = images.by_camera[v]
            if images.by_lens is not None:
                J[v, ..., lenses + v * terms : lenses + (v + 1) * terms] = images.by_lens[v][..., :terms]
        parts = sine_and_versine(self.prismatic, self.turned(q))
        sine, versine = (part[pose_of].T[..., None, None, None] for part in parts)
        for i, (s, c, H) in enumerate(zip(sine, versine, self.H_hat, strict=True)):
            D, Y = images.by_point[i], images.points[i + 1]
            Y, HY = Y[:, None, None], (Y @ H.T)[:, None, None]
            block = D[..., None] * (s * Y + c * HY) + (c * (D @ H)[..., None]) * Y
            J[..., joints + 16 * i : joints + 16 * (i + 1)] = block.reshape(V, K * m, 2, 16)
        shared, own = (part.reshape(V, K, m, 2, -1).swapaxes(0, 1) for part in (J, images.by_point[n]))
        return shared, own

    def gauge(self) -> FloatArray:
        """Orthonormal directions (12 V + 16 n + 4 m, 16 + V) of P, H_hat, M that change no image.

        They change the frame and the scales of both cameras; rows of zeros for lenses and curve precede M.
        """
        Z = np.eye(16).reshape(16, 1, 4, 4)
        V = len(self.P)
        lenses = np.zeros((16, V * self.lens_terms + (0 if self.curve is None else len(self.curve.terms))))
        parts = -(self.P @ Z), Z @ self.H_hat - self.H_hat @ Z, lenses, self.M @ Z.swapaxes(2, 3)
        frame = np.hstack([part.reshape(16, -1) for part in parts])
        cameras = np.zeros((V, frame.shape[1]))
        for v, P in enumerate(self.P):
            cameras[v, v * CAMERA : (v + 1) * CAMERA] = P.ravel()
        return np.asarray(np.linalg.svd(np.vstack([frame, cameras]).T, full_matrices=False)[0])


def parameters_from(calibration: Calibration) -> Parameters:
    """Parameters of a calibration record; for cameras on the tool, of the chain of the scene."""
    c, way = calibration, -1 if calibration.mount == TOOL else 1
    prismatic, terms, curve = c.prismatic[::way], c.lens_terms, c.curve
    if curve is not None and c.mount == TOOL:
        curve = backwards(curve, len(prismatic))
    known = c.flange_chart is not None
    H_hat = c.H_hat_0[::way]
    return Parameters(c.P, H_hat, prismatic, c.M, c.lens, lens_terms=terms, curve=curve, known_arm=known)


def errors_of(calibration: Calibration) -> Errors:
    """Errors of the parameters of a calibration, in their order."""
    errors = calibration.parameter_errors.errors
    if calibration.mount == TOOL:
        errors = errors._replace(shared=errors.shared[_in_reverse(calibration)])
    return errors


def from_reference(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Values (K, n) of the joints of its parameters from their reference, at readings (K, n)."""
    return in_chain_order(calibration.mount, q - calibration.q_reference)


def _in_reverse(c: Calibration) -> IntArray:
    """Rows of ``sqrt_cov_shared`` with the operators in reverse."""
    rows, own = np.arange(len(c.sqrt_cov_shared)), slice(c.P.size, c.P.size + c.H_hat_0.size)
    rows[own] = rows[own].reshape(-1, 16)[::-1].ravel()
    return rows


def along_the_arm(c: Calibration) -> Calibration:
    """Return the record of cameras on the tool, with joints in the order and sense of the readings."""
    rows, bias, values = _in_reverse(c), c.model_error_bias, c.joint_curve
    curve = None if c.curve is None else backwards(c.curve, len(c.prismatic)).terms + FROM_ONE
    if bias is not None:
        bias = np.concatenate([bias[rows], bias[len(rows) :]])
    per_joint: dict[str, Any] = {name: np.ascontiguousarray(getattr(c, name)[::-1]) for name in _PER_JOINT}
    return changed(
        c,
        **per_joint,
        joint_types=c.joint_types[::-1],
        q_reference=np.ascontiguousarray(-c.q_reference[::-1]),
        joint_min=np.ascontiguousarray(-(c.joint_min + c.excitation)[::-1]),
        corner_q=None if c.corner_q is None else np.ascontiguousarray(-c.corner_q[:, ::-1]),
        sqrt_cov_shared=c.sqrt_cov_shared[rows],
        joint_curve=None if curve is None or values is None else np.hstack([curve, values[:, 4:]]),
        model_error_bias=bias,
    )


def _checked(calibration: Calibration, q: FloatArray) -> tuple[Parameters, FloatArray]:
    """Parameters of a record, and joint values (K, n) from its reference.

    Raises InputError if the readings have another number of joints or are not finite.
    """
    q = np.asarray(q, dtype=np.float64)
    n = len(calibration.H_hat_0)
    if q.ndim != 2 or q.shape[1] != n:
        raise InputError(f"joint readings of shape {q.shape}: expected (poses, {n})")
    if not np.isfinite(q).all():
        raise InputError("joint readings must be finite numbers")
    return parameters_from(calibration), from_reference(calibration, q)


def predict(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Return the pixels of all markers in both views at joint readings, [RH00] eqs. (1), (6).

    Parameters
    ----------
    calibration : projective kinematics.
    q : (K, n) joint readings, rad or m.

    Returns
    -------
    (K, V, m, 2) pixels, markers in the order of ``calibration.marker``; NaN for a point behind the camera,
    or beyond the radius at which its lens model folds back.

    Raises
    ------
    InputError
        If the readings have another number of joints or are not finite.
    """
    params, q = _checked(calibration, q)
    return params.predict(q)


def prediction_variance(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Variances (K, V, m, 2) of predicted pixels u, v from the covariance of the calibration, px².

    calibration : projective kinematics with its covariance; q : (K, n) joint readings, rad or m.
    Raises InputError if the readings have another number of joints or are not finite.
    """
    params, q = _checked(calibration, q)
    result = np.empty((len(q), len(params.P), len(params.M), 2))
    for k in range(len(q)):  # a pose at a time, to bound the memory
        common, own = pixel_changes(params, errors_of(calibration), q[k : k + 1])
        result[k] = ((common**2).sum(axis=-1) + (own**2).sum(axis=-1))[0]
    return result


def pixel_changes(
    params: Parameters, errors: Errors, q: FloatArray, images: Images | None = None
) -> tuple[FloatArray, FloatArray]:
    """Changes of all pixels (K, V, m, 2, r) and (K, V, m, 2, 3) by ``errors``, joints from the reference."""
    shared, by_marker = params.derivative(q, images)
    return shared @ errors.shared + by_marker @ errors.marker, by_marker @ errors.own


def dense_pixel_changes(
    params: Parameters, errors: Errors, q: FloatArray, images: Images | None = None
) -> FloatArray:
    """Changes of all pixels by all ``errors``, (K, V, m, 2, r + 3 m): for few markers."""
    m = len(params.M)
    return apart(*pixel_changes(params, errors, q, images), np.arange(m)[:, None], m)


def error_factor(calibration: Calibration) -> FloatArray:
    """Factor (12 V + 16 n + 4 m, r + 3 m) of the covariance of P, H_hat_0, lenses, M: for few markers.

    The gauge is fixed to errors of minimum norm. Rows of the lenses precede M.
    """
    factor, free = errors_of(calibration).dense(), parameters_from(calibration).gauge()
    factor = np.asarray(factor - free @ (free.T @ factor))
    if calibration.mount == TOOL:
        rows = _in_reverse(calibration)
        factor[: len(rows)] = factor[rows]
    return factor


def error_factor_with_model(calibration: Calibration) -> FloatArray:
    """``error_factor``, with a column for the error that each deviation of arm and rig from the model causes.

    Images err by less: to first order the deviation itself undoes most of it there.
    """
    factor, bias = error_factor(calibration), calibration.model_error_bias
    return factor if bias is None else np.hstack([factor, bias])


def reading_deviations(calibration: Calibration) -> FloatArray:
    """Deviations (n,) of joint readings, rad or m; of poses of a flange, those of its twist, m then rad."""
    sigma_q = calibration.sigma_q or 0.0
    if calibration.flange_chart is None:
        return sigma_q * per_rad(calibration.prismatic)
    return np.where(calibration.prismatic, calibration.sigma_flange_m or 0.0, sigma_q)


def reading_changes(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Changes (K, V, m, 2, n) of predicted pixels by a deviation of each reading."""
    J, chart = joint_derivative(calibration, q), FlangeChart.from_optional(calibration.flange_chart)
    if chart is not None:
        J = J @ chart.by_twist(q)[:, None, None]
    return np.asarray(J * reading_deviations(calibration))


def joint_derivative(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Derivative (K, V, m, 2, n) of predicted pixels by joints (K, n), px per rad or m."""
    params, q = _checked(calibration, q)
    J = params.everywhere(q).by_joint(params.H_hat)
    J = -J[..., ::-1] if calibration.mount == TOOL else J
    return np.asarray(J.reshape(len(params.P), len(q), len(params.M), *J.shape[2:]).swapaxes(0, 1))
