"""Null space (kernel vectors) and least squares of small dense matrices by Gram–Schmidt orthogonalisation.

Matrices are stored by columns: row j of the array is column j of the matrix, contiguous in memory.
All arrays are workspaces of the caller. Loops take four rows at a time, which the compiler turns into vector
instructions without changing the order of any sum.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.jit import inline, internal, merged, separate
from projservo_cli.records import FloatArray, IntArray

# Number of coordinates of a displacement.
COORDINATES = 6
# Pivot over the first above which it exceeds round-off; a kernel has one dimension if the last but one does.
RANK_TOLERANCE = 1e-9
# Last pivot over the first above which there is no kernel: noise leaves a few per cent.
_KERNEL_TOLERANCE = 0.1
# Last pivot over the first below which it is zero to working precision and back-substitution suffices.
_EXACT_TOLERANCE = 1e-14
# Relative change of the gain that ends the inverse iteration; a fixed number of steps errs under noise.
_GAIN_TOLERANCE = 1e-12
# Maximum number of inverse iterations.
_MAX_ITERATIONS = 100
# Number of solutions by normal equations; the second one corrects the round-off of the first.
_PASSES = 2


class System(NamedTuple):
    """A small dense system of n unknowns, and workspaces of its factorisation."""

    B: FloatArray  # (≥ n, rows) columns of the matrix; rows a multiple of four, n or more
    rhs: FloatArray  # (rows,) right-hand side
    z: FloatArray
    norms: FloatArray
    pivot: IntArray  # z, norms, pivot: (≥ n,)


def new_system(n: int, rows: int) -> System:
    """Arrays for n unknowns and up to ``rows`` rows."""
    width = (max(n, rows) + 3) // 4 * 4
    return System(
        B=np.zeros((n, width)),
        rhs=np.zeros(width),
        z=np.zeros(n),
        norms=np.zeros(n),
        pivot=np.zeros(n, dtype=np.int64),
    )


@merged
def row_into(target: FloatArray, source: FloatArray) -> None:
    """Copy a row; assigning a slice needs the runtime for allocations."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@inline
def _product(x: FloatArray, y: FloatArray, rows: int) -> float:
    """Scalar product of two columns."""
    s0 = s1 = s2 = s3 = 0.0
    for i in range(0, rows, 4):
        s0 += x[i] * y[i]
        s1 += x[i + 1] * y[i + 1]
        s2 += x[i + 2] * y[i + 2]
        s3 += x[i + 3] * y[i + 3]
    return (s0 + s2) + (s1 + s3)


@inline
def orthogonalize(system: System, m: int, n: int, solve: bool) -> tuple[float, float, float]:
    """Column-pivoted modified Gram–Schmidt in place; returns the first, last but one and last pivot.

    m, n : rows and columns of the matrix, m ≥ n − 1. On return ``B`` holds R above the diagonal by rows, and
        the inverse of the diagonal; ``pivot`` the column of the matrix in each position.
    solve : whether to leave Qᵀ rhs in ``z``; ``rhs`` is then overwritten.
    Source: Å. Björck, "Solving linear least squares problems by Gram–Schmidt orthogonalization", BIT
    7 (1967): R is as accurate as Householder's, and so is the solution with the right-hand side
    carried as a further column. Each step computes the norms instead of guarding a down-date.
    """
    B, rhs, z, norms, pivot = system
    rows = (m + 3) // 4 * 4
    for j in range(n):
        pivot[j] = j
        for i in range(m, rows):
            B[j, i] = 0.0
        norms[j] = _product(B[j], B[j], rows)
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
            r = _product(B[k], B[j], rows)
            z[j] = r
            for i in range(rows):
                B[j, i] -= r * B[k, i]
            norms[j] = _product(B[j], B[j], rows)
        if solve:
            r = _product(B[k], rhs, rows)
            z[k] = r
            for i in range(rows):
                rhs[i] -= r * B[k, i]
        B[k, k] = inverse
        for j in range(k + 1, n):
            B[k, j] = z[j]
    return first, before_last, last


@inline
def kernel_vector(system: System, m: int, x: FloatArray) -> bool:
    """Right singular vector of the smallest singular value: "ker" in [RH00] eqs. (8)–(10).

    Inverse iteration on RᵀR stops when its gain, the inverse of the squared singular value, changes
    by less than a relative 1e-12; a matrix that is singular to working precision needs none.

    m : rows of the matrix, which is overwritten.
    x : (n,) on return the unit kernel vector; its sign is arbitrary.
    Returns false if the kernel has not one dimension; x is then zero.
    """
    n = x.shape[0]
    B, _, z, _, pivot = system
    first, before_last, last = orthogonalize(system, m, n, False)
    if not before_last >= RANK_TOLERANCE * first or not first > 0.0 or not last <= _KERNEL_TOLERANCE * first:
        x[:] = 0.0
        return False
    for j in range(n - 1):
        z[j] = -B[j, n - 1]
    _back_substitute(B, n - 1, z)
    z[n - 1] = 1.0
    _normalize(z, n)
    if last > _EXACT_TOLERANCE * first:
        gain = 0.0
        for _ in range(_MAX_ITERATIONS):
            for j in range(n):
                total = z[j]
                for i in range(j):
                    total -= B[i, j] * z[i]
                z[j] = total * B[j, j]
            _back_substitute(B, n, z)
            previous = gain
            gain = _normalize(z, n)
            if abs(gain - previous) <= _GAIN_TOLERANCE * gain:
                break
    for j in range(n):
        x[pivot[j]] = z[j]
    return True


@inline
def _back_substitute(B: FloatArray, n: int, z: FloatArray) -> None:
    """Solve R x = z in place for the leading n×n triangle."""
    for j in range(n - 1, -1, -1):
        x = z[j] * B[j, j]
        z[j] = x
        for i in range(j):
            z[i] -= B[i, j] * x


@inline
def _normalize(z: FloatArray, n: int) -> float:
    """Scale to unit norm and return the previous norm."""
    size = 0.0
    for j in range(n):
        size += z[j] * z[j]
    size = math.sqrt(size)
    inverse = 1.0 / size
    for j in range(n):
        z[j] *= inverse
    return size


@separate
@internal
def least_squares(system: System, m: int, x: FloatArray) -> bool:
    """Least-squares solution x (n,) of B x = rhs, m rows of full column rank, both overwritten.

    Returns false if the columns are dependent or exceed the rows; x is then zero.
    """
    n = x.shape[0]
    B, _, z, _, pivot = system
    full = m >= n
    if full:
        first, _, last = orthogonalize(system, m, n, True)
        full = last > RANK_TOLERANCE * first
    if not full:
        x[:] = 0.0
        return False
    _back_substitute(B, n, z)
    for j in range(n):
        x[pivot[j]] = z[j]
    return True


@merged
def minimum_norm(system: System, J: FloatArray, b: FloatArray, x: FloatArray) -> bool:
    """Minimum-norm solution x (n,) of J x = b, for J (k, n) of full row rank; false if the rank is lower.

    With Jᵀ = Q R it is Jᵀ (J Jᵀ)⁻¹ b, J Jᵀ = Rᵀ R.
    """
    B, _, z, _, pivot = system
    rows, n = J.shape
    for i in range(n):
        for a in range(rows):
            B[a, i] = J[a, i]
    first, _, last = orthogonalize(system, n, rows, False)
    if not last > RANK_TOLERANCE * first:
        return False
    x[:] = 0.0
    for _ in range(_PASSES):
        for k in range(rows):
            a = pivot[k]
            total = b[a]
            for i in range(n):
                total -= J[a, i] * x[i]
            for i in range(k):
                total -= B[i, k] * z[i]
            z[k] = total * B[k, k]
        _back_substitute(B, rows, z)
        for k in range(rows):
            a = pivot[k]
            for i in range(n):
                x[i] += J[a, i] * z[k]
    return True


@merged
def solve_normal(N: FloatArray, n: int, tolerance: float) -> bool:
    """Solution of symmetric positive definite equations by the root-free Cholesky factorisation, in place.

    N : (n, n + 1) upper triangle of the matrix, and the right-hand side in the last column, which the
        solution replaces; the rest is overwritten.
    tolerance : a pivot below this share of its diagonal entry counts as zero. The share is the squared part
        of a column of the least-squares problem that is independent of the columns before it.
    Returns false if the matrix is singular. Source: G. Golub, C. Van Loan, Matrix Computations, sect. 4.1.2.
    """
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
