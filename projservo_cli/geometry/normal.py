"""Normal equations of least squares in six unknowns, summed up row by row and solved.

The sums are values the compiler keeps in registers; nothing is allocated.
"""

from projservo_cli.geometry.jit import inline, merged
from projservo_cli.records import FloatArray

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

    Parameters
    ----------
    N : (6, 7) upper triangle of the matrix, and the right-hand side in the last column, which
        the solution replaces; the rest is overwritten.
    tolerance : a pivot below this share of its diagonal entry counts as zero. The share is what of
        a column of the least-squares problem the columns before do not explain, squared.

    Returns
    -------
    False where the matrix is singular.

    Source: G. Golub, C. Van Loan, Matrix Computations, section 4.1.2.
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
