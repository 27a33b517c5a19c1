"""Points, planes and displacements of projective space as plain values: [RH00] eqs. (2)–(5), (13)–(15), (24).

Vectors are tuples of four floats, matrices tuples of sixteen in row order, values that the compiler keeps in
registers. Sums are written pairwise; their order is part of the result.
"""

import math

import numpy as np

from projservo_cli.geometry.jit import inline, merged, njit
from projservo_cli.records import FloatArray, WorkFailed

Vec4 = tuple[float, float, float, float]
Mat4 = tuple[
    float, float, float, float, float, float, float, float,
    float, float, float, float, float, float, float, float,
]  # fmt: skip


@inline
def vec(A: FloatArray) -> Vec4:
    """Row of an array as a value."""
    return (float(A[0]), float(A[1]), float(A[2]), float(A[3]))


@inline
def vec_into(target: FloatArray, A: Vec4) -> None:
    """Write a value into a row of an array."""
    target[0] = A[0]
    target[1] = A[1]
    target[2] = A[2]
    target[3] = A[3]


@inline
def mat(H: FloatArray) -> Mat4:
    """4×4 array as a value."""
    return vec(H[0]) + vec(H[1]) + vec(H[2]) + vec(H[3])


@inline
def mat_into(target: FloatArray, H: Mat4) -> None:
    """Write a value into a 4×4 array."""
    vec_into(target[0], H[0:4])
    vec_into(target[1], H[4:8])
    vec_into(target[2], H[8:12])
    vec_into(target[3], H[12:16])


@inline
def dot(a: Vec4, A: Vec4) -> float:
    """Incidence aᵀA of a plane and a point."""
    return (a[0] * A[0] + a[1] * A[1]) + (a[2] * A[2] + a[3] * A[3])


@inline
def add(A: Vec4, B: Vec4) -> Vec4:
    """Sum A + B."""
    return (A[0] + B[0], A[1] + B[1], A[2] + B[2], A[3] + B[3])


@inline
def sub(A: Vec4, B: Vec4) -> Vec4:
    """Difference A − B."""
    return (A[0] - B[0], A[1] - B[1], A[2] - B[2], A[3] - B[3])


@inline
def scale(k: float, A: Vec4) -> Vec4:
    """Multiple k A."""
    return (k * A[0], k * A[1], k * A[2], k * A[3])


@inline
def axpy(k: float, A: Vec4, B: Vec4) -> Vec4:
    """Sum k A + B."""
    return (k * A[0] + B[0], k * A[1] + B[1], k * A[2] + B[2], k * A[3] + B[3])


@inline
def unit(A: Vec4) -> Vec4:
    """Vector of unit norm; a zero vector stays zero."""
    norm = math.sqrt(dot(A, A))
    if norm == 0.0:
        return A
    return scale(1.0 / norm, A)


@inline
def mul(A: Mat4, B: Mat4) -> Mat4:
    """Product A B, whose rows are those of A times B."""
    upper = apply_transposed(B, A[0:4]) + apply_transposed(B, A[4:8])
    return upper + apply_transposed(B, A[8:12]) + apply_transposed(B, A[12:16])


@inline
def apply(H: Mat4, A: Vec4) -> Vec4:
    """Point H A."""
    return (
        (H[0] * A[0] + H[1] * A[1]) + (H[2] * A[2] + H[3] * A[3]),
        (H[4] * A[0] + H[5] * A[1]) + (H[6] * A[2] + H[7] * A[3]),
        (H[8] * A[0] + H[9] * A[1]) + (H[10] * A[2] + H[11] * A[3]),
        (H[12] * A[0] + H[13] * A[1]) + (H[14] * A[2] + H[15] * A[3]),
    )  # fmt: skip


@inline
def apply_transposed(H: Mat4, a: Vec4) -> Vec4:
    """Plane Hᵀ a."""
    return (
        (H[0] * a[0] + H[4] * a[1]) + (H[8] * a[2] + H[12] * a[3]),
        (H[1] * a[0] + H[5] * a[1]) + (H[9] * a[2] + H[13] * a[3]),
        (H[2] * a[0] + H[6] * a[1]) + (H[10] * a[2] + H[14] * a[3]),
        (H[3] * a[0] + H[7] * a[1]) + (H[11] * a[2] + H[15] * a[3]),
    )  # fmt: skip


@inline
def combine(k: float, A: Mat4, l: float, B: Mat4) -> Mat4:
    """Sum k A + l B."""
    return (
        k * A[0] + l * B[0], k * A[1] + l * B[1], k * A[2] + l * B[2], k * A[3] + l * B[3],
        k * A[4] + l * B[4], k * A[5] + l * B[5], k * A[6] + l * B[6], k * A[7] + l * B[7],
        k * A[8] + l * B[8], k * A[9] + l * B[9], k * A[10] + l * B[10], k * A[11] + l * B[11],
        k * A[12] + l * B[12], k * A[13] + l * B[13], k * A[14] + l * B[14], k * A[15] + l * B[15],
    )  # fmt: skip


@inline
def multiple(k: float, A: Mat4) -> Mat4:
    """Multiple k A."""
    return scale(k, A[0:4]) + scale(k, A[4:8]) + scale(k, A[8:12]) + scale(k, A[12:16])


@inline
def inner(A: Mat4, B: Mat4) -> float:
    """Sum of the products of all entries."""
    return (dot(A[0:4], B[0:4]) + dot(A[4:8], B[4:8])) + (dot(A[8:12], B[8:12]) + dot(A[12:16], B[12:16]))


@inline
def meet(a: Vec4, b: Vec4, c: Vec4) -> Vec4:
    """Point on three planes, or plane through three points: the dual form of [RH00] eq. (3).

    The four signed 3×3 minors of the rows a, b, c: alternating and linear in each, so the sign of
    the result is carried along with the signs and the order of the arguments.
    """
    p01 = b[0] * c[1] - b[1] * c[0]
    p02 = b[0] * c[2] - b[2] * c[0]
    p03 = b[0] * c[3] - b[3] * c[0]
    p12 = b[1] * c[2] - b[2] * c[1]
    p13 = b[1] * c[3] - b[3] * c[1]
    p23 = b[2] * c[3] - b[3] * c[2]
    return (
        a[1] * p23 - a[2] * p13 + a[3] * p12,
        -(a[0] * p23 - a[2] * p03 + a[3] * p02),
        a[0] * p13 - a[1] * p03 + a[3] * p01,
        -(a[0] * p12 - a[1] * p02 + a[2] * p01),
    )


@inline
def dual_pencil(A: Vec4, D: Vec4) -> tuple[Vec4, Vec4]:
    """Two orthonormal vectors dual to the line through A and A + D: [RH00] eq. (3).

    For points they are two planes through the line, for planes two points on their intersection.
    ``A`` and ``D`` must be independent. The coordinate direction farthest from both completes them, so no
    division is by less than √½.
    """
    u = unit(A)
    v = unit(axpy(-dot(u, D), u, D))
    v = unit(axpy(-dot(u, v), u, v))
    smallest = u[0] * u[0] + v[0] * v[0]
    e = (1.0, 0.0, 0.0, 0.0)
    if u[1] * u[1] + v[1] * v[1] < smallest:
        smallest = u[1] * u[1] + v[1] * v[1]
        e = (0.0, 1.0, 0.0, 0.0)
    if u[2] * u[2] + v[2] * v[2] < smallest:
        smallest = u[2] * u[2] + v[2] * v[2]
        e = (0.0, 0.0, 1.0, 0.0)
    if u[3] * u[3] + v[3] * v[3] < smallest:
        e = (0.0, 0.0, 0.0, 1.0)
    w = unit(axpy(-dot(e, u), u, axpy(-dot(e, v), v, e)))
    return w, meet(u, v, w)


# Identity matrix.
IDENTITY: Mat4 = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


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


def exp_rotation(H_hat: FloatArray, theta: float) -> FloatArray:
    """Projective rotation (4, 4) of a revolute operator (4, 4) by an angle, rad: [RH00] eq. (4)."""
    return as_array(rotation(mat(H_hat), float(theta)))


def normalize_displacement(H: FloatArray, A: FloatArray, a_inf: FloatArray) -> FloatArray:
    """Scale a 4×4 homography to a displacement with det H = 1, [RH00] eq. (2).

    The determinant leaves ±H (4, 4); the sign keeps that of a_inf·A for points A (..., 4).

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


def as_array(H: Mat4) -> FloatArray:
    """Tuple of sixteen floats as a (4, 4) array."""
    return np.array(H, dtype=np.float64).reshape(4, 4)


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
def _wrap(theta: float) -> float:
    """Equal angle in (−π, π], rad."""
    turns = math.floor((theta + math.pi) / (2.0 * math.pi))
    wrapped = theta - 2.0 * math.pi * turns
    if wrapped <= -math.pi:
        wrapped += 2.0 * math.pi
    return wrapped


@njit
def incidence_angles(p_0: float, p_s: float, p_c: float) -> tuple[bool, float, float]:
    """Solutions of p_0 + p_s sin θ + p_c cos θ = 0, [RH00] eqs. (14), (15) as corrected.

    θ± = atan2(p_s, p_c) ± arccos(−p_0 / √(p_s² + p_c²)), each in (−π, π]. The printed
    θ⁻ = π − θ⁺ holds only where p_c = 0.

    Returns false and zeros if |p_0| exceeds the amplitude: the point never meets the plane.
    """
    amplitude = math.sqrt(p_s * p_s + p_c * p_c)
    if not abs(p_0) <= amplitude or not amplitude > 0.0:
        return False, 0.0, 0.0
    middle = math.atan2(p_s, p_c)
    spread = math.acos(-p_0 / amplitude)
    return True, _wrap(middle + spread), _wrap(middle - spread)


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


# Change of a quadratic form by the joints, over the largest, below which it is invariant.
_INVARIANT = 1e-6


def invariant_rotations(actions: FloatArray) -> FloatArray:
    """Three rotations (3, 3, 3) of the plane at infinity, per rad, in the metric that all joints preserve.

    The metric is the symmetric Q with LᵀQ + QL = 0 for every action L (n, 3, 3) of a joint on that plane. If
    few joints leave it open, it is the one nearest to the identity, which serves these joints as well.

    Raises WorkFailed if the joints preserve no metric.
    """
    i, j = np.triu_indices(3)
    basis = np.zeros((6, 3, 3))
    basis[range(6), i, j] = basis[range(6), j, i] = np.where(i == j, 1.0, 1.0 / np.sqrt(2.0))
    changes = np.einsum("nba,sbc->nsac", actions, basis) + np.einsum("sab,nbc->nsac", basis, actions)
    _, sizes, rows = np.linalg.svd(np.swapaxes(changes, 0, 1).reshape(6, -1).T, full_matrices=True)
    sizes = np.r_[sizes, np.zeros(6 - len(sizes))]
    kept = rows[sizes <= _INVARIANT * max(sizes[0], 1.0)]
    Q = np.einsum("s,sab->ab", kept.T @ (kept @ np.einsum("saa->s", basis)), basis)
    if len(kept) == 0 or np.linalg.eigvalsh(Q)[0] <= 1e-6 * np.abs(Q).max():
        raise WorkFailed(
            "the joints preserve no metric of the calibrated frame: calibrate again, or measure point by "
            "point with control.features: points"
        )
    C = np.linalg.cholesky(Q).T
    return np.array([np.linalg.solve(C, np.cross(np.eye(3), e) @ C) for e in np.eye(3)])
