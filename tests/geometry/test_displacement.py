"""Exponentials against SciPy, and the scale of a homography that is a displacement."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.geometry.algebra import as_array, mat
from projservo_cli.geometry.displacements import (
    exp_rotation,
    normalize_displacement,
    translation,
)
from projservo_cli.records import WorkFailed
from tests.samples import displacement, frame, prismatic, revolute

ANGLES = [0.0, 1e-12, 1e-4, 0.3, math.pi / 2, 3.0, math.pi, 4.0, 2 * math.pi, -0.7, -math.pi, 17.0]


def conjugate(operator, seed):
    G = frame(seed)
    return G @ operator @ np.linalg.inv(G)


@pytest.mark.parametrize("theta", ANGLES)
def test_rotation_is_the_matrix_exponential(theta):
    for seed in range(4):
        H_hat = conjugate(revolute([0.3, -0.2, 1.5], [1, 2, -3]), seed)
        # Round-off of entries of size 10 through the powers of the series.
        assert exp_rotation(H_hat, theta) == pytest.approx(expm(theta * H_hat), abs=1e-12)


@pytest.mark.parametrize("tau", [0.0, 1e-9, 0.2, -3.0])
def test_translation_is_the_matrix_exponential(tau):
    for seed in range(4):
        H_hat = conjugate(prismatic([1, 2, -3]), seed)
        assert as_array(translation(mat(H_hat), tau)) == pytest.approx(expm(tau * H_hat), abs=1e-13)


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


def test_a_homography_that_reflects_or_is_singular_is_refused():
    for H in (np.diag([1.0, 1, -1, 1]), np.diag([1.0, 1, 0, 1]), np.zeros((4, 4))):
        with pytest.raises(WorkFailed, match="no displacement"):
            normalize_displacement(H, np.ones((1, 4)), np.array([0, 0, 0, 1.0]))
