"""Displacements of projective space: exponentials of operators, their composition and invariants.

[RH00] eqs. (2), (4), (5), (24), (25). Kernels take plain values, one displacement at a time; the functions
below them whole arrays.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.algebra import IDENTITY, Mat4, as_array, combine, mat, mul
from projservo_cli.geometry.jit import inline, merged, njit
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

# Pose of a base that stays where it is.
_NOWHERE = np.eye(4)
# Change of a quadratic form by the joints, over the largest, below which it is invariant.
_INVARIANT = 1e-6
# Sine of a trial's angle, or its length, from which on the displacement determines the operator.
_LEAST_LEVER = 1e-3
# Sine of an angle near a half turn below which the skew part of a rotation leaves its axis open.
_LEAST_SINE = 1e-4
# Rotation vectors (24, 3) of the symmetries of a cube.
_TURNS = Rotation.create_group("O").as_rotvec()
# Orthonormal basis (6, 3, 3) of symmetric forms, by the rows and columns of their entries.
_ROWS, _COLUMNS = np.triu_indices(3)
_SYMMETRIC = np.zeros((6, 3, 3))
_SYMMETRIC[range(6), _ROWS, _COLUMNS] = np.where(_ROWS == _COLUMNS, 1.0, 1.0 / np.sqrt(2.0))
_SYMMETRIC[range(6), _COLUMNS, _ROWS] = _SYMMETRIC[range(6), _ROWS, _COLUMNS]


@inline
def rotation(H_hat: Mat4, theta: float) -> Mat4:
    """Projective rotation I + sin θ Ĥ + (1 − cos θ) Ĥ² of [RH00] eq. (4), θ in rad."""
    half = math.sin(0.5 * theta)
    return _turned(H_hat, mul(H_hat, H_hat), 2.0 * half * math.cos(0.5 * theta), 2.0 * half * half)


@inline
def rotation_and_inverse(H_hat: Mat4, theta: float) -> tuple[Mat4, Mat4]:
    """Projective rotation of [RH00] eq. (4), θ in rad, and its inverse."""
    half = math.sin(0.5 * theta)
    sine, versine = 2.0 * half * math.cos(0.5 * theta), 2.0 * half * half
    squared = mul(H_hat, H_hat)
    return _turned(H_hat, squared, sine, versine), _turned(H_hat, squared, -sine, versine)


@inline
def _turned(H_hat: Mat4, H_hat_squared: Mat4, sine: float, versine: float) -> Mat4:
    """Sum I + sin θ Ĥ + (1 − cos θ) Ĥ²."""
    H = combine(sine, H_hat, versine, H_hat_squared)
    return (
        1.0 + H[0], H[1], H[2], H[3],
        H[4], 1.0 + H[5], H[6], H[7],
        H[8], H[9], 1.0 + H[10], H[11],
        H[12], H[13], H[14], 1.0 + H[15],
    )  # fmt: skip


@inline
def translation(H_hat: Mat4, tau: float) -> Mat4:
    """Projective translation I + τ Ĥ of [RH00] eq. (5)."""
    return combine(1.0, IDENTITY, tau, H_hat)


@inline
def twist_exponential(X: Mat4) -> Mat4:
    """Displacement exp(X) of any twist, with rotation and translation.

    Rodrigues' formula with the cubic term, I + X + (1 − cos θ)/θ² X² + (θ − sin θ)/θ³ X³ with
    θ² = −trace(X²)/2; below θ = 1e-4 the coefficients are their series, exact to 1e-18.
    """
    X2 = mul(X, X)
    square = max(-0.5 * (X2[0] + X2[5] + X2[10] + X2[15]), 0.0)
    theta = math.sqrt(square)
    if theta < 1e-4:
        second = 0.5 - square / 24.0
        third = 1.0 / 6.0 - square / 120.0
    else:
        half = math.sin(0.5 * theta)
        second = 2.0 * half * half / square
        third = (theta - math.sin(theta)) / (square * theta)
    H = combine(1.0, X, second, X2)
    return combine(1.0, IDENTITY, 1.0, combine(1.0, H, third, mul(X2, X)))


@njit
def composed_angle(theta_r: float, theta_p: float) -> tuple[float, float, float, float]:
    """Angle θ_s in [0, 2π) and coefficients a, b, c of [RH00] eqs. (24), (25), c as corrected.

    The axes are perpendicular, so cos(θ_s/2) = cos(θ_r/2) cos(θ_p/2).
    """
    sr = math.sin(0.5 * theta_r)
    cr = math.cos(0.5 * theta_r)
    sp = math.sin(0.5 * theta_p)
    cp = math.cos(0.5 * theta_p)
    cbh_a = sr * cp
    cbh_b = cr * sp
    cbh_c = sp * sr
    sine = math.sqrt(cbh_a * cbh_a + cbh_b * cbh_b + cbh_c * cbh_c)
    return 2.0 * math.atan2(sine, cr * cp), cbh_a, cbh_b, cbh_c


@merged
def composed_operator(H_r: Mat4, H_p: Mat4, cbh_a: float, cbh_b: float, cbh_c: float) -> tuple[bool, Mat4]:
    """Operator Ĥ_s of the single rotation equal to both, [RH00] eq. (24).

    Returns false if the rotation is the identity, without axis.
    """
    sine = math.sqrt(cbh_a * cbh_a + cbh_b * cbh_b + cbh_c * cbh_c)
    if not sine > 0.0:
        return False, H_r
    bracket = combine(1.0, mul(H_r, H_p), -1.0, mul(H_p, H_r))
    H = combine(cbh_a, H_r, cbh_b, H_p)
    return True, combine(1.0 / sine, H, cbh_c / sine, bracket)


def exp_rotation(H_hat: FloatArray, theta: float) -> FloatArray:
    """Projective rotation (4, 4) of a revolute operator (4, 4) by an angle, rad: [RH00] eq. (4)."""
    return as_array(rotation(mat(H_hat), float(theta)))


def normalize_displacement(H: FloatArray, A: FloatArray, a_inf: FloatArray) -> FloatArray:
    """Scale a 4×4 homography to a displacement with det H = 1, [RH00] eq. (2).

    The determinant leaves ±H (4, 4); the sign is kept of a_inf·A for points A (..., 4).

    Raises WorkFailed if det H is not positive, since H is then no displacement.
    """
    determinant = float(np.linalg.det(H))
    if not determinant > 0.0:
        raise WorkFailed(
            f"a homography with determinant {determinant:.3g} is no displacement: check the correspondences"
        )
    result: FloatArray = H / determinant**0.25
    if np.sum((A @ a_inf) * (A @ result.T @ a_inf)) < 0.0:
        result = -result
    return result


def tangent_operator(H: FloatArray, amplitude: float, *, prismatic: bool) -> FloatArray:
    """Operator (4, 4) of a joint that alone displaced by H (4, 4), [RH00] eqs. (4), (5), group to algebra.

    amplitude : of its motion, rad, or for a prismatic joint in the unit of the operator.
    Raises ValueError near 0 and near ±180° of a rotation, where the displacement leaves the operator open.
    """
    lever = amplitude if prismatic else math.sin(amplitude)
    if abs(lever) < _LEAST_LEVER:
        raise ValueError(f"a motion by {amplitude:.4g} leaves the operator open")
    return np.asarray((H - np.linalg.inv(H)) / (2.0 * lever))


def homogeneous(points: FloatArray) -> FloatArray:
    """Points (…, d) with one more coordinate of one."""
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def cross_matrix(w: FloatArray) -> FloatArray:
    """Matrices (…, 3, 3) of the cross products with w (…, 3).

    Columns lie one after the other in memory: their layout decides in which order products are summed, and
    so the last bits of fits.
    """
    columns = np.zeros((*w.shape, 3))
    columns[..., 1, 2], columns[..., 2, 0], columns[..., 0, 1] = w[..., 0], w[..., 1], w[..., 2]
    return (columns - columns.swapaxes(-1, -2)).swapaxes(-1, -2)


def generators(linear: FloatArray, center: FloatArray) -> FloatArray:
    """Generators (3 + j, 4, 4) of translations, and of linear maps (j, 3, 3) about a point (3,)."""
    E = np.zeros((3 + len(linear), 4, 4))
    E[range(3), range(3), 3] = 1.0
    E[3:, :3, :3], E[3:, :3, 3] = linear, -linear @ center
    return E


def to_all_sides(H_hat: FloatArray) -> FloatArray:
    """Displacements (24, 4, 4) by rotations (3, 4, 4), per rad, to all sides: no turn is 63° from each."""
    return np.asarray(expm(np.einsum("bi,ijk->bjk", _TURNS, H_hat)))


def twists(axes: FloatArray) -> FloatArray:
    """Twists (…, 4, 4) of screws (…, 6)."""
    result = np.zeros((*axes.shape[:-1], 4, 4))
    result[..., :3, :3] = cross_matrix(axes[..., :3])
    result[..., :3, 3] = axes[..., 3:]
    return result


def screws(H_hat: FloatArray) -> FloatArray:
    """Screws (…, 6) of twists (…, 4, 4)."""
    return np.concatenate([_axial(H_hat[..., :3, :3]), H_hat[..., :3, 3]], axis=-1)


def _axial(A: FloatArray) -> FloatArray:
    """Vectors (…, 3) whose cross products are the skew parts of matrices (…, 3, 3)."""
    skew = 0.5 * (A - A.swapaxes(-1, -2))
    return np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)


def rotation_vectors(R: FloatArray) -> FloatArray:
    """Rotation vectors (…, 3) of rotations (…, 3, 3), rad.

    By the skew part, in a fifth of the time of SciPy, which takes those near a half turn.
    """
    axis = _axial(R)
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0))
    vectors = axis / np.sinc(angle / np.pi)[..., None]
    turned = (sine < _LEAST_SINE) & (angle > 1.0)
    if turned.any():
        vectors[turned] = Rotation.from_matrix(R[turned]).as_rotvec()
    return np.asarray(vectors)


def nearest_rotations(A: FloatArray) -> FloatArray:
    """Rotations (…, 3, 3) nearest to matrices (…, 3, 3)."""
    U, _, Vt = np.linalg.svd(A)
    U[..., 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    return np.asarray(U @ Vt)


def sine_and_versine(prismatic: BoolArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients (…, n) of Ĥ and Ĥ² in [RH00] eqs. (4), (5) at joints (…, n) from the reference."""
    return np.where(prismatic, q, np.sin(q)), np.where(prismatic, 0.0, 2.0 * np.sin(0.5 * q) ** 2)


def displacements(H_hat: FloatArray, prismatic: BoolArray, q: FloatArray) -> FloatArray:
    """Displacements exp(q Ĥ) (n, K, 4, 4) of operators (n, 4, 4) at joints (K, n), [RH00] eqs. (4), (5).

    Joint values are from the reference, rad or m.
    """
    sine, versine = (part.T for part in sine_and_versine(prismatic, q))
    return _exponentials(H_hat[:, None], sine, versine)


def screw_displacements(axes: FloatArray, prismatic: BoolArray, q: FloatArray) -> FloatArray:
    """Displacements (…, n, 4, 4) of screws (…, n, 6) by readings (…, n), [RH00] eqs. (4), (5)."""
    return _exponentials(twists(axes), *sine_and_versine(prismatic, q))


def _exponentials(H_hat: FloatArray, sine: FloatArray, versine: FloatArray) -> FloatArray:
    """Sums I + s Ĥ + c Ĥ² (…, 4, 4) of operators (…, 4, 4) and coefficients (…)."""
    return np.asarray(np.eye(4) + sine[..., None, None] * H_hat + versine[..., None, None] * (H_hat @ H_hat))


def carried_screws(
    axes: FloatArray, prismatic: BoolArray, q: FloatArray, base: FloatArray = _NOWHERE
) -> tuple[FloatArray, FloatArray]:
    """Screws (…, n, 6) after motions by readings (…, n) of the joints before each, and the whole motion.

    base : (4, 4) pose that the first joint is moved by; the motion (…, 4, 4) is the product of it and of all
        exponentials, [RH00] eq. (6).
    """
    factors = np.moveaxis(screw_displacements(axes, prismatic, q), -3, 0)
    products = np.empty((len(factors) + 1, *factors.shape[1:]))
    products[0] = base
    for i, factor in enumerate(factors):
        products[i + 1] = products[i] @ factor
    before = np.moveaxis(products[:-1], 0, -3)
    return screws(before @ twists(axes) @ rigid_inverse(before)), products[-1]


def aligned(body: FloatArray, points: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rigid motions (K, 3, 3), (K, 3) of bodies (…, m, 3) to points (K, m, 3) of weights (K, m).

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 13(4), 1991. All poses at once: ``Rotation.align_vectors`` takes them one by one.
    """
    share = (weight / weight.sum(axis=1)[:, None])[:, None]
    center_body, center_points = (share @ body)[:, 0], (share @ points)[:, 0]
    moments = np.swapaxes(points - center_points[:, None], 1, 2) @ (
        weight[..., None] * (body - center_body[:, None])
    )
    R = nearest_rotations(moments)
    return R, center_points - np.einsum("kij,kj->ki", R, center_body)


def rigid(R: Rotation, t: Sequence[float] | FloatArray) -> FloatArray:
    """4×4 displacement of a rotation and a translation (3,), m."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.as_matrix(), t
    return T


def rigid_inverse(T: FloatArray) -> FloatArray:
    """Inverse of rigid displacements (…, 4, 4)."""
    R = T[..., :3, :3].swapaxes(-1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3], result[..., 3, 3] = R, 1.0
    result[..., :3, 3] = -(R @ T[..., :3, 3, None])[..., 0]
    return result


def invariant_rotations(actions: FloatArray) -> FloatArray:
    """Three rotations (3, 3, 3) of the plane at infinity, per rad, in the metric that all joints preserve.

    The metric is the symmetric Q with LᵀQ + QL = 0 for every action L (n, 3, 3) of a joint on that plane. If
    few joints leave it open, it is the one nearest to the identity, which serves these joints as well.
    ``metric.frame.invariant_upgrade`` takes no such joints, but many calibrations at once. Its last bits
    decide signs that a calibration leaves open, and those here the joint steps near a singularity.

    Raises WorkFailed if the joints preserve no metric.
    """
    changes = np.einsum("nba,sbc->nsac", actions, _SYMMETRIC) + np.einsum(
        "sab,nbc->nsac", _SYMMETRIC, actions
    )
    _, sizes, rows = np.linalg.svd(np.swapaxes(changes, 0, 1).reshape(6, -1).T)
    kept = rows[sizes <= _INVARIANT * max(sizes[0], 1.0)]
    Q = np.einsum("s,sab->ab", kept.T @ (kept @ np.einsum("saa->s", _SYMMETRIC)), _SYMMETRIC)
    if len(kept) == 0 or np.linalg.eigvalsh(Q)[0] <= 1e-6 * np.abs(Q).max():
        raise WorkFailed(
            "the joints preserve no metric of the calibrated frame: calibrate again, or measure point by "
            "point with control.features: points"
        )
    C = np.linalg.cholesky(Q).T
    return np.array([np.linalg.solve(C, np.cross(np.eye(3), e) @ C) for e in np.eye(3)])
