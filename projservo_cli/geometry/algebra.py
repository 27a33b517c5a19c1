"""Points, planes and 4×4 operators of projective space as plain values.

Vectors are tuples of four floats, matrices tuples of sixteen in row order: values without memory,
which the compiler keeps in registers. Sums are written pairwise; their order is part of the result.
"""

import math

from projservo_cli.geometry.jit import inline
from projservo_cli.records import FloatArray

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
def put_vec(target: FloatArray, A: Vec4) -> None:
    """Write a value into a row of an array."""
    target[0] = A[0]
    target[1] = A[1]
    target[2] = A[2]
    target[3] = A[3]


@inline
def mat(H: FloatArray) -> Mat4:
    """4×4 array as a value."""
    return (
        float(H[0, 0]), float(H[0, 1]), float(H[0, 2]), float(H[0, 3]),
        float(H[1, 0]), float(H[1, 1]), float(H[1, 2]), float(H[1, 3]),
        float(H[2, 0]), float(H[2, 1]), float(H[2, 2]), float(H[2, 3]),
        float(H[3, 0]), float(H[3, 1]), float(H[3, 2]), float(H[3, 3]),
    )  # fmt: skip


@inline
def put_mat(target: FloatArray, H: Mat4) -> None:
    """Write a value into a 4×4 array."""
    target[0, 0] = H[0]
    target[0, 1] = H[1]
    target[0, 2] = H[2]
    target[0, 3] = H[3]
    target[1, 0] = H[4]
    target[1, 1] = H[5]
    target[1, 2] = H[6]
    target[1, 3] = H[7]
    target[2, 0] = H[8]
    target[2, 1] = H[9]
    target[2, 2] = H[10]
    target[2, 3] = H[11]
    target[3, 0] = H[12]
    target[3, 1] = H[13]
    target[3, 2] = H[14]
    target[3, 3] = H[15]


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
    """Product A B."""
    return (
        (A[0] * B[0] + A[1] * B[4]) + (A[2] * B[8] + A[3] * B[12]),
        (A[0] * B[1] + A[1] * B[5]) + (A[2] * B[9] + A[3] * B[13]),
        (A[0] * B[2] + A[1] * B[6]) + (A[2] * B[10] + A[3] * B[14]),
        (A[0] * B[3] + A[1] * B[7]) + (A[2] * B[11] + A[3] * B[15]),
        (A[4] * B[0] + A[5] * B[4]) + (A[6] * B[8] + A[7] * B[12]),
        (A[4] * B[1] + A[5] * B[5]) + (A[6] * B[9] + A[7] * B[13]),
        (A[4] * B[2] + A[5] * B[6]) + (A[6] * B[10] + A[7] * B[14]),
        (A[4] * B[3] + A[5] * B[7]) + (A[6] * B[11] + A[7] * B[15]),
        (A[8] * B[0] + A[9] * B[4]) + (A[10] * B[8] + A[11] * B[12]),
        (A[8] * B[1] + A[9] * B[5]) + (A[10] * B[9] + A[11] * B[13]),
        (A[8] * B[2] + A[9] * B[6]) + (A[10] * B[10] + A[11] * B[14]),
        (A[8] * B[3] + A[9] * B[7]) + (A[10] * B[11] + A[11] * B[15]),
        (A[12] * B[0] + A[13] * B[4]) + (A[14] * B[8] + A[15] * B[12]),
        (A[12] * B[1] + A[13] * B[5]) + (A[14] * B[9] + A[15] * B[13]),
        (A[12] * B[2] + A[13] * B[6]) + (A[14] * B[10] + A[15] * B[14]),
        (A[12] * B[3] + A[13] * B[7]) + (A[14] * B[11] + A[15] * B[15]),
    )  # fmt: skip


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
    return (
        k * A[0], k * A[1], k * A[2], k * A[3],
        k * A[4], k * A[5], k * A[6], k * A[7],
        k * A[8], k * A[9], k * A[10], k * A[11],
        k * A[12], k * A[13], k * A[14], k * A[15],
    )  # fmt: skip


@inline
def inner(A: Mat4, B: Mat4) -> float:
    """Sum of the products of all entries."""
    return (
        ((A[0] * B[0] + A[1] * B[1]) + (A[2] * B[2] + A[3] * B[3]))
        + ((A[4] * B[4] + A[5] * B[5]) + (A[6] * B[6] + A[7] * B[7]))
    ) + (
        ((A[8] * B[8] + A[9] * B[9]) + (A[10] * B[10] + A[11] * B[11]))
        + ((A[12] * B[12] + A[13] * B[13]) + (A[14] * B[14] + A[15] * B[15]))
    )


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
    ``A`` and ``D`` must be independent; of four candidate directions the one farthest from both is
    completed, so no division is by less than √½.
    """
    u = unit(A)
    v = unit(axpy(-dot(u, D), u, D))
    v = unit(axpy(-dot(u, v), u, v))
    least = u[0] * u[0] + v[0] * v[0]
    e = (1.0, 0.0, 0.0, 0.0)
    if u[1] * u[1] + v[1] * v[1] < least:
        least = u[1] * u[1] + v[1] * v[1]
        e = (0.0, 1.0, 0.0, 0.0)
    if u[2] * u[2] + v[2] * v[2] < least:
        least = u[2] * u[2] + v[2] * v[2]
        e = (0.0, 0.0, 1.0, 0.0)
    if u[3] * u[3] + v[3] * v[3] < least:
        e = (0.0, 0.0, 0.0, 1.0)
    w = unit(axpy(-dot(e, u), u, axpy(-dot(e, v), v, e)))
    return w, meet(u, v, w)
