"""Kernel vectors and least squares of small dense matrices by Householder QR.

Matrices are stored by columns: row j of the array is column j of the matrix, contiguous in memory.
All arrays are workspaces of the caller; nothing is allocated.
"""

import math

from projservo_cli.geometry.jit import njit
from projservo_cli.records import FloatArray, IntArray

# A kernel is one-dimensional when the next pivot stands above round-off by this factor of the first.
RANK_TOLERANCE = 1e-9
# A last pivot above this share of the first is no kernel at all: noise leaves a few per cent.
KERNEL_TOLERANCE = 0.1
# A last pivot below this is zero to working precision: back-substitution alone gives the kernel.
EXACT_TOLERANCE = 1e-14
GAIN_TOLERANCE = 1e-12
MOST_ITERATIONS = 100


@njit
def factorize(B: FloatArray, m: int, n: int, pivot: IntArray, rhs: FloatArray) -> float:
    """Column-pivoted Householder QR in place; returns |r_kk| of the last but one pivot over the first.

    Parameters
    ----------
    B : (≥n, ≥m) columns of the matrix; on return row j holds column j of R in its first entries.
    m, n : rows and columns, m ≥ n − 1.
    pivot : (≥n,) on return the column of the matrix in each position.
    rhs : (≥m,) right-hand side, replaced by Qᵀ rhs.

    Source: G. Golub, C. Van Loan, Matrix Computations, section 5.4.2; norms are computed anew in
    each step, which at these sizes is cheaper than guarding a down-date.
    """
    for j in range(n):
        pivot[j] = j
    first = 0.0
    before_last = 0.0
    for k in range(min(m, n)):
        best = k
        most = 0.0
        for j in range(k, n):
            size = 0.0
            for i in range(k, m):
                size += B[j, i] * B[j, i]
            if size > most:
                most = size
                best = j
        if best != k:
            pivot[k], pivot[best] = pivot[best], pivot[k]
            for i in range(m):
                B[k, i], B[best, i] = B[best, i], B[k, i]
        norm = math.sqrt(most)
        if k == 0:
            first = norm
        if k == n - 2:
            before_last = norm
        if norm == 0.0:
            break
        alpha = -norm if B[k, k] >= 0.0 else norm
        head = B[k, k] - alpha
        # The reflector is (head, B[k, k+1:]); its squared norm is 2 norm (norm + |B_kk|) > 0.
        beta = 1.0 / (norm * (norm + abs(B[k, k])))
        for j in range(k + 1, n):
            projection = head * B[j, k]
            for i in range(k + 1, m):
                projection += B[k, i] * B[j, i]
            projection *= beta
            B[j, k] -= projection * head
            for i in range(k + 1, m):
                B[j, i] -= projection * B[k, i]
        projection = head * rhs[k]
        for i in range(k + 1, m):
            projection += B[k, i] * rhs[i]
        projection *= beta
        rhs[k] -= projection * head
        for i in range(k + 1, m):
            rhs[i] -= projection * B[k, i]
        B[k, k] = alpha
        for i in range(k + 1, m):
            B[k, i] = 0.0
    if first == 0.0:
        return 0.0
    return before_last / first


@njit
def kernel_vector(
    B: FloatArray, m: int, n: int, x: FloatArray, pivot: IntArray, z: FloatArray, rhs: FloatArray
) -> bool:
    """Right singular vector of the smallest singular value: "ker" in [RH00] eqs. (8)–(10).

    Inverse iteration on RᵀR stops when its gain, the inverse of the squared singular value, changes
    by less than a relative 1e-12; a matrix that is singular to working precision needs none.

    Parameters
    ----------
    B : (≥n, ≥m) columns of the matrix, overwritten.
    m, n : rows and columns.
    x : (n,) on return the unit kernel vector; its sign is arbitrary.
    pivot, z, rhs : workspaces of at least n, n and m entries.

    Returns
    -------
    False where there is no kernel or more than one dimension of it; x is then zero.
    """
    for i in range(m):
        rhs[i] = 0.0
    if not factorize(B, m, n, pivot, rhs) >= RANK_TOLERANCE:
        for j in range(n):
            x[j] = 0.0
        return False
    last = abs(B[n - 1, n - 1]) if m >= n else 0.0
    if not last <= KERNEL_TOLERANCE * abs(B[0, 0]):
        for j in range(n):
            x[j] = 0.0
        return False
    z[n - 1] = 1.0
    back_substitute(B, n - 1, z, B[n - 1], -1.0)
    normalize(z, n)
    if last > EXACT_TOLERANCE * abs(B[0, 0]):
        gain = 0.0
        for _ in range(MOST_ITERATIONS):
            for j in range(n):
                total = z[j]
                for i in range(j):
                    total -= B[j, i] * x[i]
                x[j] = total / B[j, j]
            back_substitute(B, n, z, x, 1.0)
            previous = gain
            gain = normalize(z, n)
            if abs(gain - previous) <= GAIN_TOLERANCE * gain:
                break
    for j in range(n):
        x[pivot[j]] = z[j]
    return True


@njit
def back_substitute(B: FloatArray, n: int, z: FloatArray, b: FloatArray, sign: float) -> None:
    """Solve R z = sign · b for the leading n×n triangle."""
    for j in range(n - 1, -1, -1):
        total = sign * b[j]
        for i in range(j + 1, n):
            total -= B[i, j] * z[i]
        z[j] = total / B[j, j]


@njit
def normalize(z: FloatArray, n: int) -> float:
    """Scale to unit norm and return the norm it had."""
    size = 0.0
    for j in range(n):
        size += z[j] * z[j]
    size = math.sqrt(size)
    for j in range(n):
        z[j] /= size
    return size


@njit
def least_squares(
    B: FloatArray, m: int, n: int, x: FloatArray, pivot: IntArray, z: FloatArray, rhs: FloatArray
) -> bool:
    """Least-squares solution x of B x = rhs for a matrix of full column rank.

    Parameters are those of ``kernel_vector``, with the right-hand side in ``rhs``, overwritten.

    Returns
    -------
    False where the columns are dependent (or fewer rows than columns); x is then zero.
    """
    full = m >= n
    if full:
        factorize(B, m, n, pivot, rhs)
        full = abs(B[n - 1, n - 1]) > RANK_TOLERANCE * abs(B[0, 0])
    if not full:
        for j in range(n):
            x[j] = 0.0
        return False
    back_substitute(B, n, z, rhs, 1.0)
    for j in range(n):
        x[pivot[j]] = z[j]
    return True
