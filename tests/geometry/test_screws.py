"""Rigid displacements as arrays, against NumPy's cross product and SciPy's matrix exponential."""

import numpy as np
from scipy.linalg import expm

from projservo_cli.geometry.displacements import (
    cross_matrix,
    rigid_inverse,
    screw_displacements,
    screws,
    twists,
)

RNG = np.random.default_rng(5)


def test_cross_matrices_are_those_of_numpy_in_its_memory_layout():
    w = RNG.standard_normal((4, 5, 3))
    W = cross_matrix(w)
    np.testing.assert_array_equal(W, np.cross(w[..., None, :], np.eye(3)).swapaxes(-1, -2))
    assert W.swapaxes(-1, -2).flags.c_contiguous  # products of matrices sum in the order of their layout


def test_exponentials_of_screws_are_rigid_and_those_of_scipy():
    axes, prismatic = RNG.standard_normal((6, 6)), np.array([False, True] * 3)
    axes[:, :3] /= np.linalg.norm(axes[:, :3], axis=1, keepdims=True)
    axes[prismatic, :3] = 0.0
    # A pure rotation has no velocity along its axis.
    axes[~prismatic, 3:] = np.cross(axes[~prismatic, :3], axes[~prismatic, 3:])
    q = RNG.uniform(-3.0, 3.0, 6)
    T = screw_displacements(axes, prismatic, q)
    np.testing.assert_allclose(T, [expm(x * H) for x, H in zip(q, twists(axes), strict=True)], atol=1e-12)
    np.testing.assert_allclose(T @ rigid_inverse(T), np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
    np.testing.assert_allclose(screws(twists(axes)), axes, atol=1e-15)
