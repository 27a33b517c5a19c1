"""Angles that reach a plane (13)–(15) and two rotations as one (24), (25)."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import expm

from projservo_cli.geometry.algebra import as_array, incidence_angles, mat
from projservo_cli.geometry.displacements import composed_angle, composed_operator
from tests.samples import frame, revolute

angles = st.one_of(st.sampled_from([0.0, math.pi]), st.floats(-2 * math.pi, 2 * math.pi))


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2))
def test_solutions_are_all_zeros_of_the_equation(p_0, p_s, p_c):
    amplitude = math.hypot(p_s, p_c)
    assume(amplitude > 1e-6)
    found, plus, minus = incidence_angles(p_0, p_s, p_c)
    assume(abs(abs(p_0) - amplitude) > 1e-9)
    assert found == (abs(p_0) <= amplitude)
    if not found:
        return
    for theta in (plus, minus):
        assert -math.pi < theta <= math.pi
        rest = p_0 + p_s * math.sin(theta) + p_c * math.cos(theta)
        assert abs(rest) < 8e-14 * (1 + abs(p_0) + amplitude)
    # Two different zeros, as many as a cosine has in one turn: none is missed.
    if abs(p_0) < 0.999 * amplitude:
        assert abs(math.remainder(plus - minus, 2 * math.pi)) > 1e-3


def test_the_printed_second_solution_holds_only_without_a_cosine():
    """Erratum of (15): π − θ⁺ solves the equation where p_c = 0 and nowhere else."""
    _, plus, minus = incidence_angles(0.4, 1.0, 0.0)
    assert math.remainder(math.pi - plus, 2 * math.pi) == pytest.approx(minus, abs=1e-15)
    _, plus, _ = incidence_angles(0.4, 1.0, 0.5)
    printed = math.pi - plus
    assert abs(0.4 + math.sin(printed) + 0.5 * math.cos(printed)) > 0.5


def perpendicular_pair(seed):
    """Two revolute operators about perpendicular axes through one point, in a projective frame."""
    generator = np.random.default_rng(seed)
    basis = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    point = generator.normal(size=3)
    G = frame(seed)
    return tuple(G @ revolute(point, basis[i]) @ np.linalg.inv(G) for i in range(2))


@given(angles, angles, st.integers(0, 5))
def test_one_rotation_equals_two(theta_r, theta_p, seed):
    """Also of exactly half a turn and beyond, where θ_s exceeds π or the axis changes sides."""
    H_r, H_p = perpendicular_pair(seed)
    product = expm(theta_r * H_r) @ expm(theta_p * H_p)
    assume(math.hypot(math.sin(theta_r / 2), math.sin(theta_p / 2)) > 1e-6)
    theta_s, *coefficients = composed_angle(theta_r, theta_p)
    found, H_s = composed_operator(mat(H_r), mat(H_p), *coefficients)
    assert found
    assert 0.0 <= theta_s < 2 * math.pi
    # Ĥ_s divides by sin(θ_s/2), which both angles together keep above 1e-6 … round-off 1e-9.
    sine = math.sin(theta_s / 2)
    assert expm(theta_s * as_array(H_s)) == pytest.approx(product, abs=1e-12 + 1e-14 / max(sine, 1e-9))
    assert math.cos(theta_s / 2) == pytest.approx(math.cos(theta_r / 2) * math.cos(theta_p / 2), abs=1e-14)


def test_the_printed_factor_two_is_wrong():
    """Erratum of (25): c = 2 sin sin leaves an error of order one."""
    H_r, H_p = perpendicular_pair(2)
    theta_r, theta_p = 1.0, 1.4
    theta_s, a, b, c = composed_angle(theta_r, theta_p)
    printed = (a * H_r + b * H_p + 2 * c * (H_r @ H_p - H_p @ H_r)) / math.sin(theta_s / 2)
    assert np.abs(expm(theta_s * printed) - expm(theta_r * H_r) @ expm(theta_p * H_p)).max() > 0.1
