"""Kernel vectors and least squares of small dense matrices by Gram–Schmidt orthogonalisation.

Matrices are stored by columns: row j of the array is column j of the matrix, contiguous in memory.
All arrays are workspaces of the caller; nothing is allocated. Rows are taken four at a time, which
the compiler turns into vector instructions without changing the order of any sum.
"""

import math

from projservo_cli.geometry.jit import inline, internal, merged
from projservo_cli.records import FloatArray, IntArray

# A kernel is one-dimensional when the next pivot stands above round-off by this factor of the first.
RANK_TOLERANCE = 1e-9
# A last pivot above this share of the first is no kernel at all: noise leaves a few per cent.
_KERNEL_TOLERANCE = 0.1
# A last pivot below this is zero to working precision: back-substitution alone gives the kernel.
_EXACT_TOLERANCE = 1e-14
_GAIN_TOLERANCE = 1e-12
_MOST_ITERATIONS = 100


@inline
def _projected(B: FloatArray, k: int, v: FloatArray, rows: int) -> float:
    """Product of column k with a vector."""
    s0 = s1 = s2 = s3 = 0.0
    for i in range(0, rows, 4):
        s0 += B[k, i] * v[i]
        s1 += B[k, i + 1] * v[i + 1]
        s2 += B[k, i + 2] * v[i + 2]
        s3 += B[k, i + 3] * v[i + 3]
    return (s0 + s2) + (s1 + s3)


@inline
def _paired(B: FloatArray, j: int, k: int, rows: int) -> float:
    """Product of two columns."""
    s0 = s1 = s2 = s3 = 0.0
    for i in range(0, rows, 4):
        s0 += B[j, i] * B[k, i]
        s1 += B[j, i + 1] * B[k, i + 1]
        s2 += B[j, i + 2] * B[k, i + 2]
        s3 += B[j, i + 3] * B[k, i + 3]
    return (s0 + s2) + (s1 + s3)


@inline
def orthogonalize(
    B: FloatArray,
    m: int,
    n: int,
    norms: FloatArray,
    z: FloatArray,
    pivot: IntArray,
    rhs: FloatArray,
    solve: bool,
) -> tuple[float, float, float]:
    """Column-pivoted modified Gram–Schmidt in place; returns the first, last but one and last pivot.

    B : (≥n, ≥max(n, m rounded up to four)) columns of the matrix; on return R above the diagonal by rows, and
        the inverse of the diagonal.
    m, n : rows and columns, m ≥ n − 1.
    norms : (n,) workspace.
    z : (n,) on return Qᵀ rhs where ``solve`` is set.
    pivot : (n,) on return the column of the matrix in each position.
    rhs : (≥m rounded up to four) right-hand side, overwritten where ``solve`` is set.
    Source: Å. Björck, "Solving linear least squares problems by Gram–Schmidt orthogonalization", BIT
    7 (1967): R is as accurate as Householder's, and so is the solution with the right-hand side
    carried as a further column. Norms are computed anew in each step instead of guarding a down-date.
    """
    rows = (m + 3) // 4 * 4
    for j in range(n):
        pivot[j] = j
        for i in range(m, rows):
            B[j, i] = 0.0
        norms[j] = _paired(B, j, j, rows)
    if solve:
        for i in range(m, rows):
            rhs[i] = 0.0
    first = 0.0
    before_last = 0.0
    last = 0.0
    for k in range(min(m, n)):
        best = k
        for j in range(k + 1, n):
            if norms[j] > norms[best]:
                best = j
        norm = math.sqrt(norms[best])
        if k == 0:
            first = norm
        if k == n - 2:
            before_last = norm
        if k == n - 1:
            last = norm
        if norm == 0.0:
            for j in range(k, n):
                B[j, j] = 0.0
            break
        if best != k:
            pivot[k], pivot[best] = pivot[best], pivot[k]
            norms[best] = norms[k]
            for i in range(k):
                B[i, k], B[i, best] = B[i, best], B[i, k]
            for i in range(rows):
                B[k, i], B[best, i] = B[best, i], B[k, i]
        inverse = 1.0 / norm
        for i in range(rows):
            B[k, i] *= inverse
        for j in range(k + 1, n):
            r = _paired(B, k, j, rows)
            z[j] = r
            for i in range(rows):
                B[j, i] -= r * B[k, i]
            norms[j] = _paired(B, j, j, rows)
        if solve:
            r = _projected(B, k, rhs, rows)
            z[k] = r
            for i in range(rows):
                rhs[i] -= r * B[k, i]
        B[k, k] = inverse
        for j in range(k + 1, n):
            B[k, j] = z[j]
    return first, before_last, last


@inline
def kernel_vector(
    B: FloatArray, m: int, n: int, x: FloatArray, pivot: IntArray, z: FloatArray, rhs: FloatArray
) -> bool:
    """Right singular vector of the smallest singular value: "ker" in [RH00] eqs. (8)–(10).

    Inverse iteration on RᵀR stops when its gain, the inverse of the squared singular value, changes
    by less than a relative 1e-12; a matrix that is singular to working precision needs none.

    B : (≥n, ≥max(n, m rounded up to four)) columns of the matrix, overwritten.
    m, n : rows and columns.
    x : (n,) on return the unit kernel vector; its sign is arbitrary.
    pivot, z, rhs : workspaces of at least n, n and m entries.
    Returns false where there is no kernel or more than one dimension of it; x is then zero.
    """
    first, before_last, last = orthogonalize(B, m, n, x, z, pivot, rhs, False)
    if not before_last >= RANK_TOLERANCE * first or not first > 0.0 or not last <= _KERNEL_TOLERANCE * first:
        for j in range(n):
            x[j] = 0.0
        return False
    for j in range(n - 1):
        z[j] = -B[j, n - 1]
    back_substitute(B, n - 1, z)
    z[n - 1] = 1.0
    _normalize(z, n)
    if last > _EXACT_TOLERANCE * first:
        gain = 0.0
        for _ in range(_MOST_ITERATIONS):
            for j in range(n):
                total = z[j]
                for i in range(j):
                    total -= B[i, j] * z[i]
                z[j] = total * B[j, j]
            back_substitute(B, n, z)
            previous = gain
            gain = _normalize(z, n)
            if abs(gain - previous) <= _GAIN_TOLERANCE * gain:
                break
    for j in range(n):
        x[pivot[j]] = z[j]
    return True


@inline
def back_substitute(B: FloatArray, n: int, z: FloatArray) -> None:
    """Solve R x = z in place for the leading n×n triangle."""
    for j in range(n - 1, -1, -1):
        x = z[j] * B[j, j]
        z[j] = x
        for i in range(j):
            z[i] -= B[i, j] * x


@inline
def _normalize(z: FloatArray, n: int) -> float:
    """Scale to unit norm and return the norm it had."""
    size = 0.0
    for j in range(n):
        size += z[j] * z[j]
    size = math.sqrt(size)
    inverse = 1.0 / size
    for j in range(n):
        z[j] *= inverse
    return size


@internal
def least_squares(
    B: FloatArray, m: int, n: int, x: FloatArray, pivot: IntArray, z: FloatArray, rhs: FloatArray
) -> bool:
    """Least-squares solution x of B x = rhs for a matrix of full column rank.

    Parameters are those of ``kernel_vector``, with the right-hand side in ``rhs``, overwritten.

    Returns false where the columns are dependent (or fewer rows than columns); x is then zero.
    """
    full = m >= n
    if full:
        first, _, last = orthogonalize(B, m, n, x, z, pivot, rhs, True)
        full = last > RANK_TOLERANCE * first
    if not full:
        for j in range(n):
            x[j] = 0.0
        return False
    back_substitute(B, n, z)
    for j in range(n):
        x[pivot[j]] = z[j]
    return True


COORDINATES = 6
Row = tuple[float, float, float, float, float, float, float]
# Products of the columns of (J, e) with those of J, upper triangle by rows.
Sums = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float, float,
    float, float, float, float, float, float, float, float, float, float, float, float, float,
]  # fmt: skip
NOTHING: Sums = (
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
)  # fmt: skip


@inline
def accumulate(N: Sums, a: Row, b: Row) -> Sums:
    """Sums after two more rows (J, e) of Jacobian and residual."""
    return (
        N[0] + (a[0] * a[0] + b[0] * b[0]), N[1] + (a[0] * a[1] + b[0] * b[1]),
        N[2] + (a[0] * a[2] + b[0] * b[2]), N[3] + (a[0] * a[3] + b[0] * b[3]),
        N[4] + (a[0] * a[4] + b[0] * b[4]), N[5] + (a[0] * a[5] + b[0] * b[5]),
        N[6] + (a[0] * a[6] + b[0] * b[6]), N[7] + (a[1] * a[1] + b[1] * b[1]),
        N[8] + (a[1] * a[2] + b[1] * b[2]), N[9] + (a[1] * a[3] + b[1] * b[3]),
        N[10] + (a[1] * a[4] + b[1] * b[4]), N[11] + (a[1] * a[5] + b[1] * b[5]),
        N[12] + (a[1] * a[6] + b[1] * b[6]), N[13] + (a[2] * a[2] + b[2] * b[2]),
        N[14] + (a[2] * a[3] + b[2] * b[3]), N[15] + (a[2] * a[4] + b[2] * b[4]),
        N[16] + (a[2] * a[5] + b[2] * b[5]), N[17] + (a[2] * a[6] + b[2] * b[6]),
        N[18] + (a[3] * a[3] + b[3] * b[3]), N[19] + (a[3] * a[4] + b[3] * b[4]),
        N[20] + (a[3] * a[5] + b[3] * b[5]), N[21] + (a[3] * a[6] + b[3] * b[6]),
        N[22] + (a[4] * a[4] + b[4] * b[4]), N[23] + (a[4] * a[5] + b[4] * b[5]),
        N[24] + (a[4] * a[6] + b[4] * b[6]), N[25] + (a[5] * a[5] + b[5] * b[5]),
        N[26] + (a[5] * a[6] + b[5] * b[6]),
    )  # fmt: skip


@merged
def put_sums(N: FloatArray, sums: Sums) -> None:
    """Write the sums into the upper triangle and the last column of an array (6, 7)."""
    n = 0
    for i in range(COORDINATES):
        for j in range(i, COORDINATES + 1):
            N[i, j] = sums[n]
            n += 1


@merged
def solve_normal(N: FloatArray, tolerance: float) -> bool:
    """Solution of symmetric positive definite equations by the root-free Cholesky factorisation, in place.

    N : (6, 7) upper triangle of the matrix, and the right-hand side in the last column, which the solution
        replaces; the rest is overwritten.
    tolerance : a pivot below this share of its diagonal entry counts as zero. The share is what of a column
        of the least-squares problem the columns before do not explain, squared.
    Returns false where the matrix is singular; source: G. Golub, C. Van Loan, Matrix Computations, section
    4.1.2.
    """
    n = COORDINATES
    for j in range(n):
        pivot = N[j, j]
        for k in range(j):
            pivot -= N[j, k] * N[k, j]
        if not pivot > tolerance * N[j, j]:
            return False
        N[j, j] = pivot
        for i in range(j + 1, n + 1):
            total = N[j, i]
            for k in range(j):
                total -= N[j, k] * N[k, i]
            N[j, i] = total
        inverse = 1.0 / pivot
        for i in range(j + 1, n):
            N[i, j] = inverse * N[j, i]
    for j in range(n - 1, -1, -1):
        total = N[j, n] / N[j, j]
        for i in range(j + 1, n):
            total -= N[i, j] * N[i, n]
        N[j, n] = total
    return True
