"""Kernel vectors and least squares against the singular value decomposition of NumPy."""

import numpy as np
import pytest

from projservo_cli.geometry.null_space import kernel_vector, least_squares, new_system


def system_of(A, b=0.0):
    """The columns of A as the kernels want them, with rubbish beside them."""
    m, n = A.shape
    system = new_system(n, m)
    system.B[:] = system.rhs[:] = np.nan
    system.B[:, :m], system.rhs[:m] = A.T, b
    return system


def kernel(A):
    x = np.zeros(A.shape[1])
    return kernel_vector(system_of(A), len(A), x), x


def solve(A, b):
    x = np.zeros(A.shape[1])
    return least_squares(system_of(A, b), len(A), x), x


def singular(rng, m, n, sizes):
    """Matrix with the given singular values, each column scaled by up to a factor of 30."""
    U = np.linalg.qr(rng.normal(size=(m, m)))[0]
    V = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return U[:, : len(sizes)] @ np.diag(sizes) @ V[:, : len(sizes)].T


def least_right_vector(A):
    return np.linalg.svd(A)[2][-1]


@pytest.mark.parametrize(("m", "n"), [(8, 5), (8, 6), (8, 7), (12, 6), (5, 6), (6, 6), (1, 2)])
def test_kernel_of_an_exactly_singular_matrix(rng, m, n):
    for _ in range(20):
        A = singular(rng, m, n, rng.uniform(0.1, 10.0, n - 1))
        found, x = kernel(A)
        assert found
        assert np.linalg.norm(x) == pytest.approx(1.0, abs=1e-14)
        # Round-off of the factorisation over the least non-zero singular value, 0.1.
        assert np.abs(A @ x).max() < 1e-13
        assert abs(x @ least_right_vector(A)) == pytest.approx(1.0, abs=1e-13)


@pytest.mark.parametrize("n", [5, 6, 7])
@pytest.mark.parametrize("noise", [1e-16, 1e-13, 1e-6, 2e-2])
def test_noisy_kernel_is_the_least_right_singular_vector(rng, n, noise):
    """The gain settles to 1e-12, hence the vector to 1e-6 times one further step of convergence."""
    for _ in range(20):
        A = singular(rng, 8, n, rng.uniform(0.5, 2.0, n - 1)) + noise * rng.normal(size=(8, n))
        found, x = kernel(A)
        sizes = np.linalg.svd(A, compute_uv=False)
        ratio = (sizes[-1] / sizes[-2]) ** 2
        v = least_right_vector(A)
        assert found
        assert np.linalg.norm(x - v * np.sign(v @ x)) < 1e-13 + 2e-6 * ratio / (1 - ratio)


@pytest.mark.parametrize("n", [5, 6, 7])
def test_a_kernel_of_two_dimensions_is_refused(rng, n):
    """Two dimensions, three, and all of them; exactly and up to round-off."""
    A = rng.normal(size=(8, n))
    twice, empty = A.copy(), A.copy()
    twice[:, 1], twice[:, 3] = A[:, 0], A[:, 2]
    empty[:, [1, 3]] = 0.0
    missing = [singular(rng, 8, n, rng.uniform(0.1, 10.0, n - k)) for k in (2, 3)]
    # Nor is one where the least singular value has the size of the others: nothing is left still.
    full = singular(rng, 8, n, rng.uniform(1.0, 2.0, n))
    for matrix in (*missing, twice, empty, np.zeros((8, n)), full):
        found, x = kernel(matrix)
        assert not found
        assert not x.any()


def test_kernel_scales_with_its_matrix(rng):
    """Rank is judged against the size of the matrix, whatever its unit."""
    A = singular(rng, 8, 6, [3.0, 2.0, 1.0, 0.5, 0.2])
    wanted = kernel(A)[1]
    for unit in (1e-30, 1e30):
        found, x = kernel(unit * A)
        assert found
        assert abs(x @ wanted) == pytest.approx(1.0, abs=1e-13)


def test_least_squares_agrees_with_numpy(rng):
    for m, n in [(6, 6), (8, 6), (12, 6), (16, 7), (16, 5), (2, 1)]:
        A, b = rng.normal(size=(m, n)), rng.normal(size=m)
        found, x = solve(A, b)
        assert found
        assert x == pytest.approx(np.linalg.lstsq(A, b, rcond=None)[0], abs=1e-12 * np.linalg.cond(A))


def test_least_squares_refuses_dependent_columns_and_too_few_rows(rng):
    A = rng.normal(size=(8, 6))
    A[:, 4] = A[:, 1] - 2 * A[:, 2]
    assert not solve(A, np.ones(8))[0]
    assert not solve(np.zeros((8, 6)), np.ones(8))[0]
    found, x = solve(rng.normal(size=(5, 6)), np.ones(5))
    assert not found
    assert not x.any()
