"""Points, planes and matrices of projective space as plain values: [RH00] eqs. (3), (13)–(15).

Vectors are tuples of four floats, matrices tuples of sixteen in row order, values that the compiler keeps in
registers. Sums are written pairwise; their order is part of the result.
"""

import math

import numpy as np
import numpy.typing as npt

from projservo_cli.geometry.jit import inline, njit

_Array = npt.NDArray[np.float64]
Vec4 = tuple[float, float, float, float]
Mat4 = tuple[
    float, float, float, float, float, float, float, float,
    float, float, float, float, float, float, float, float,
]  # fmt: skip


@inline
def vec(A: _Array) -> Vec4:
    """Row of an array as a value."""
    return (float(A[0]), float(A[1]), float(A[2]), float(A[3]))


@inline
def vec_into(target: _Array, A: Vec4) -> None:
    """Write a value into a row of an array."""
    target[0] = A[0]
    target[1] = A[1]
    target[2] = A[2]
    target[3] = A[3]


@inline
def mat(H: _Array) -> Mat4:
    """4×4 array as a value."""
    return vec(H[0]) + vec(H[1]) + vec(H[2]) + vec(H[3])


@inline
def mat_into(target: _Array, H: Mat4) -> None:
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
    """Product A B, whose rows are the rows of A times B."""
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
def inverse(H: Mat4) -> Mat4:
    """Inverse of a matrix: each row is dual to the three other columns."""
    a, b, c, d = (H[0], H[4], H[8], H[12]), (H[1], H[5], H[9], H[13]), (H[2], H[6], H[10], H[14]), (
        H[3], H[7], H[11], H[15],
    )  # fmt: skip
    A, B, C, D = meet(b, c, d), meet(a, c, d), meet(a, b, d), meet(a, b, c)
    A, B = scale(1.0 / dot(A, a), A), scale(1.0 / dot(B, b), B)
    C, D = scale(1.0 / dot(C, c), C), scale(1.0 / dot(D, d), D)
    return (
        A[0], A[1], A[2], A[3], B[0], B[1], B[2], B[3],
        C[0], C[1], C[2], C[3], D[0], D[1], D[2], D[3],
    )  # fmt: skip


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


def as_array(H: Mat4) -> _Array:
    """Tuple of sixteen floats as a (4, 4) array."""
    return np.array(H, dtype=np.float64).reshape(4, 4)


@njit
def wrapped_angle(theta: float) -> float:
    """Equal angle in (−π, π], rad."""
    turns = math.floor((theta + math.pi) / (2.0 * math.pi))
    angle = theta - 2.0 * math.pi * turns
    if angle <= -math.pi:
        angle += 2.0 * math.pi
    return angle


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
    return True, wrapped_angle(middle + spread), wrapped_angle(middle - spread)
