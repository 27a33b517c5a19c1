"""Exponentials against SciPy and rigid displacements, and the scale of a homography that is one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.algebra import as_array, mat
from projservo_cli.geometry.displacements import (
    aligned,
    cross_matrix,
    exp_rotation,
    normalize_displacement,
    rigid_inverse,
    rotation_and_inverse,
    rotation_vectors,
    screw_displacements,
    screws,
    tangent_operator,
    translation,
    twists,
)
from projservo_cli.records import WorkFailed
from tests.samples import displacement, frame, prismatic, revolute

ANGLES = st.one_of(st.sampled_from([0.0, 1e-12, 1e-4, math.pi, -math.pi, 2 * math.pi]), st.floats(-17, 17))


def conjugate(operator, seed):
    G = frame(seed)
    return G @ operator @ np.linalg.inv(G)


@given(ANGLES, st.integers(0, 100))
def test_rotation_is_the_matrix_exponential(theta, seed):
    H_hat = conjugate(revolute([0.3, -0.2, 1.5], [1, 2, -3]), seed)
    # Round-off of entries of size 10 through the powers of the series.
    assert exp_rotation(H_hat, theta) == pytest.approx(expm(theta * H_hat), abs=2e-12)
    for H, angle in zip(rotation_and_inverse(mat(H_hat), theta), (theta, -theta), strict=True):
        assert as_array(H) == pytest.approx(expm(angle * H_hat), abs=2e-12)


@given(st.floats(-3.0, 3.0), st.integers(0, 100))
def test_translation_is_the_matrix_exponential(tau, seed):
    H_hat = conjugate(prismatic([1, 2, -3]), seed)
    assert as_array(translation(mat(H_hat), tau)) == pytest.approx(expm(tau * H_hat), abs=1e-12)


def test_cross_matrices_are_those_of_numpy_in_its_memory_layout(rng):
    w = rng.standard_normal((4, 5, 3))
    W = cross_matrix(w)
    np.testing.assert_array_equal(W, np.cross(w[..., None, :], np.eye(3)).swapaxes(-1, -2))
    assert W.swapaxes(-1, -2).flags.c_contiguous  # products of matrices sum in the order of their layout


def test_rotation_vectors_are_those_of_scipy_from_none_to_a_half_turn(rng):
    axes, angles = rng.standard_normal((40, 3)), np.tile([0.0, 1e-9, 0.3, 3.1, np.pi - 1e-6], 8)
    R = Rotation.from_rotvec(angles[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    np.testing.assert_allclose(rotation_vectors(R.as_matrix()), R.as_rotvec(), atol=1e-11)
    flipped = np.array([np.diag(signs) for signs in ([1.0, -1.0, -1.0], [-1.0, 1.0, -1.0])])
    np.testing.assert_allclose(np.abs(rotation_vectors(flipped)), np.pi * np.eye(3)[:2], atol=1e-15)


def test_exponentials_of_screws_are_rigid_and_those_of_scipy(rng):
    axes, slides = rng.standard_normal((6, 6)), np.array([False, True] * 3)
    axes[:, :3] /= np.linalg.norm(axes[:, :3], axis=1, keepdims=True)
    axes[slides, :3] = 0.0
    # A pure rotation has no velocity along its axis.
    axes[~slides, 3:] = np.cross(axes[~slides, :3], axes[~slides, 3:])
    q = rng.uniform(-3.0, 3.0, 6)
    T = screw_displacements(axes, slides, q)
    np.testing.assert_allclose(T, [expm(x * H) for x, H in zip(q, twists(axes), strict=True)], atol=1e-12)
    np.testing.assert_allclose(T @ rigid_inverse(T), np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
    np.testing.assert_allclose(screws(twists(axes)), axes, atol=1e-15)


@given(st.integers(0, 10**6), st.integers(3, 8))
def test_alignment_of_weighted_points_is_that_of_scipy(seed, m):
    rng = np.random.default_rng(seed)
    body, points, weight = (rng.standard_normal(shape) for shape in ((m, 3), (2, m, 3), (2, m)))
    weight = np.exp(weight)
    for k, (R, t) in enumerate(zip(*aligned(body, points, weight), strict=True)):
        centers = [np.average(each, axis=0, weights=weight[k]) for each in (points[k], body)]
        wanted, _ = Rotation.align_vectors(points[k] - centers[0], body - centers[1], weight[k])
        residuals = [(points[k] - centers[0] - (body - centers[1]) @ S.T) for S in (R, wanted.as_matrix())]
        least = [float(np.sum(weight[k][:, None] * r**2)) for r in residuals]
        assert least[0] == pytest.approx(least[1], rel=1e-9)
        np.testing.assert_allclose(R @ centers[1] + t, centers[0], atol=1e-12)


def test_scale_of_a_homography_keeps_points_on_their_side_of_infinity():
    """Either sign and any scale, also half a turn, whose trace is 0 and tells nothing."""
    G = frame(3)
    a_inf = np.array([0, 0, 0, 1.0]) @ np.linalg.inv(G)
    M = np.array([[0.1, 0.2, 1.4, 1], [-0.1, 0.3, 1.2, 1]]) @ G.T
    for T in (displacement([0.2, 0.3, -0.1], [0.1, 0.2, 0.3]), displacement([0, math.pi, 0], [0, 0, 2.8])):
        H = G @ T @ np.linalg.inv(G)
        for k in (1.0, -1.0, 3.7, -0.02):
            result = normalize_displacement(k * H, M, a_inf)
            assert result == pytest.approx(H, abs=1e-12)
            assert np.linalg.det(result) == pytest.approx(1.0, abs=1e-12)


def test_operators_of_trial_motions_are_those_of_the_joints():
    """In any projective frame and by homographies of any scale, [RH00] eqs. (2), (4), (5)."""
    a_inf = np.array([0, 0, 0, 1.0]) @ np.linalg.inv(frame(3))
    A = np.random.default_rng(2).uniform(-1.0, 1.0, (5, 4))
    points = A / (A @ a_inf)[:, None]
    turns, slides = conjugate(revolute([0.3, -0.2, 1.5], [1, 2, -3]), 3), conjugate(prismatic([1, 2, -3]), 3)
    for H_hat, amplitude, of_slide in ((turns, 0.7, False), (turns, -2.9, False), (slides, 0.2, True)):
        H = normalize_displacement(-2.3 * expm(amplitude * H_hat), points, a_inf)
        found = tangent_operator(H, amplitude, prismatic=of_slide)
        np.testing.assert_allclose(found, H_hat, atol=1e-11 * np.linalg.norm(H_hat))
    for amplitude, of_slide in ((0.0, False), (math.pi, False), (0.0, True)):
        with pytest.raises(ValueError, match="open"):
            tangent_operator(np.eye(4), amplitude, prismatic=of_slide)


def test_a_homography_that_reflects_or_is_singular_is_refused():
    for H in (np.diag([1.0, 1, -1, 1]), np.diag([1.0, 1, 0, 1]), np.zeros((4, 4))):
        with pytest.raises(WorkFailed, match="no displacement"):
            normalize_displacement(H, np.ones((1, 4)), np.array([0, 0, 0, 1.0]))
