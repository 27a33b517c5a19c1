"""Values of projective space: products against NumPy, incidences of points, lines and planes."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from projservo_cli.geometry.algebra import (
    apply,
    apply_transposed,
    as_array,
    axpy,
    combine,
    dot,
    dual_pencil,
    inner,
    mat,
    mat_into,
    meet,
    mul,
    multiple,
    unit,
    vec,
    vec_into,
)
from projservo_cli.geometry.displacements import invariant_rotations, twist_exponential
from projservo_cli.records import WorkFailed
from tests.samples import hat

EPS = np.finfo(float).eps
# Zeros and ones make special positions (axes, planes through the origin) common.
entries = st.one_of(st.sampled_from([0.0, 1.0, -1.0]), st.floats(-1, 1, width=32))
vectors = st.tuples(entries, entries, entries, entries)


def test_products_agree_with_numpy(rng):
    A, B = rng.normal(size=(2, 4, 4))
    x, y = rng.normal(size=(2, 4))
    A_v, B_v, x_v, y_v = mat(A), mat(B), tuple(x.tolist()), tuple(y.tolist())
    assert as_array(mul(A_v, B_v)) == pytest.approx(A @ B, abs=1e-14)
    assert apply(A_v, x_v) == pytest.approx(A @ x, abs=1e-14)
    assert apply_transposed(A_v, x_v) == pytest.approx(A.T @ x, abs=1e-14)
    assert as_array(combine(2.0, A_v, -3.0, B_v)) == pytest.approx(2 * A - 3 * B, abs=1e-14)
    assert as_array(multiple(-0.5, A_v)) == pytest.approx(-0.5 * A, abs=1e-15)
    assert inner(A_v, B_v) == pytest.approx(np.sum(A * B), abs=1e-14)
    assert dot(x_v, y_v) == pytest.approx(x @ y, abs=1e-15)
    assert axpy(2.0, x_v, y_v) == pytest.approx(2 * x + y, abs=1e-15)
    assert unit((0.0, 3.0, 0.0, -4.0)) == pytest.approx((0.0, 0.6, 0.0, -0.8))
    assert unit((0.0, 0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0, 0.0)
    mat_into(B, A_v)
    vec_into(y, vec(x))
    assert np.array_equal(A, B)
    assert np.array_equal(x, y)


@given(vectors, vectors, vectors, vectors)
def test_meet_is_the_determinant_with_one_row_open(a, b, c, x):
    """x·meet(a, b, c) = det[x; a; b; c]: incidence with all three, and the sign of an orientation."""
    size = np.prod([max(np.linalg.norm(y), 1e-300) for y in (a, b, c, x)])
    wanted = np.linalg.det(np.array([x, a, b, c]))
    assert abs(dot(meet(a, b, c), x) - wanted) <= 32 * EPS * max(size, 1e-30)


@given(vectors, vectors, st.integers(-13, 0))
def test_dual_pencil_is_orthonormal_and_incident(A, D, exponent):
    """Two orthonormal planes through A and A + D, also where D is thirteen orders smaller than A."""
    A, D = np.array(A), 10.0**exponent * np.array(D)
    sizes = np.linalg.norm(A), np.linalg.norm(D)
    if min(sizes[0], sizes[1] / 10.0**exponent) < 1e-3:
        return
    across = D - A * (A @ D) / (A @ A)
    if np.linalg.norm(across) < 1e-3 * sizes[1]:
        return
    a_1, a_2 = (np.array(a) for a in dual_pencil(tuple(A.tolist()), tuple(D.tolist())))
    products = np.array([[a_1 @ a_1, a_1 @ a_2], [a_1 @ a_2, a_2 @ a_2]])
    assert products == pytest.approx(np.eye(2), abs=1e-14)
    for a in (a_1, a_2):
        assert abs(a @ A) <= 1e-14 * sizes[0]
        # Removing the part of D along A leaves an error of 1000 EPS at the angle allowed above.
        assert abs(a @ D) <= 1e-12 * sizes[1]


@given(st.sampled_from([0.0, 1e-9, 0.99e-4, 1.01e-4, 1e-2, 1.0, math.pi, 6.0]), st.integers(0, 10**6))
def test_exponential_of_any_twist_is_that_of_scipy(size, seed):
    """Both branches at the switch from series to closed form; rotation and translation together."""
    w, v = np.random.default_rng(seed).normal(size=(2, 3))
    X = size * hat(w / np.linalg.norm(w), v)
    # Round-off of the entries, which grow with the translation.
    assert as_array(twist_exponential(mat(X))) == pytest.approx(expm(X), abs=1e-13 * (1.0 + size * 5.0))


@given(st.integers(2, 6), st.integers(0, 10**6))
def test_rotations_are_those_of_the_metric_that_all_joints_keep(joints, seed):
    """Of joints that turn about random directions, in a random affine frame; some keep none."""
    rng = np.random.default_rng(seed)
    C = np.linalg.qr(rng.normal(size=(3, 3)))[0] * rng.uniform(0.5, 2.0, 3)
    Q = C.T @ C
    w = rng.normal(size=(joints, 3))
    actions = np.array([np.linalg.solve(C, np.cross(np.eye(3), one) @ C) for one in w])
    for R in invariant_rotations(actions):
        assert pytest.approx(0.0, abs=1e-9) == R.T @ Q + Q @ R
        assert np.sort(np.linalg.eigvals(R).imag) == pytest.approx([-1.0, 0.0, 1.0], abs=1e-9)
    with pytest.raises(WorkFailed, match="preserve no metric"):
        invariant_rotations(rng.normal(size=(5, 3, 3)))
