"""Radial distortion: there and back, its derivatives, where it turns, and as OpenCV bends."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from projservo_cli.geometry.lens import (
    distort,
    distort_derivative,
    distort_pixel,
    distort_visible,
    undistort_pixel,
)
from projservo_cli.records import no_lenses

COEFFICIENTS = [(-0.2, 0.05), (-0.2, 0.0), (0.15, -0.02), (0.1, 0.1), (0.0, -0.05), (-0.3, 0.2)]


def lens(k1, k2):
    return np.array([640.0, 500.0, 650.0, k1, k2])


def turn(k1, k2):
    """Least radius at which the slope 1 + 3 k1 ρ² + 5 k2 ρ⁴ of the bent radius is zero; 100 for none."""
    squares = np.roots([5.0 * k2, 3.0 * k1, 1.0])
    real = squares.real[(np.abs(squares.imag) < 1e-9) & (squares.real > 0.0)]
    return np.sqrt(min([1e4, *real]))


@pytest.mark.parametrize(("k1", "k2"), COEFFICIENTS)
def test_straightening_undoes_bending(k1, k2, rng):
    directions = rng.standard_normal((200, 2))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # Up to 99 % of the radius at which it turns: the bent radius is flat there, which costs digits.
    most = min(0.99 * turn(k1, k2), 2.0)
    pixels = lens(k1, k2)[:2] + 650.0 * rng.uniform(0.0, most, (200, 1)) * directions
    for u, v in pixels:
        there = distort_pixel(lens(k1, k2), u, v)
        # Newton stops at a step of 1e-9 of the radius, whose square is left: far below 1e-9 px.
        assert np.abs(np.array(undistort_pixel(lens(k1, k2), *there)) - (u, v)).max() < 1e-9
        assert np.array(there) == pytest.approx(distort(lens(k1, k2), np.array([u, v])), abs=1e-12 * 2000)


def test_a_bent_pixel_is_that_of_opencv(rng):
    cv2 = pytest.importorskip("cv2")
    points = np.c_[rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)]
    K = np.array([[650.0, 0.0, 640.0], [0.0, 650.0, 500.0], [0.0, 0.0, 1.0]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([-0.2, 0.05, 0.0, 0.0]))[0]
    straight = points @ K[:2].T
    assert distort(lens(-0.2, 0.05), straight) == pytest.approx(expected[:, 0], abs=1e-9)


@pytest.mark.parametrize(("k1", "k2"), COEFFICIENTS)
def test_derivatives_agree_with_differences(k1, k2, rng):
    pixels = lens(k1, k2)[:2] + rng.uniform(-400.0, 400.0, (20, 2))
    by_pixel, by_lens = distort_derivative(lens(k1, k2), pixels)
    # Central differences: 1e-3 px of 650 leave (1e-3/650)² of truncation and 1e-13/1e-3 of round-off. Pixels
    # are linear in k: those differences are exact but for round-off, 1e-13 of 1e3 over 1e-3.
    for c, step in enumerate(1e-3 * np.eye(2)):
        numeric = distort(lens(k1, k2), pixels + step) - distort(lens(k1, k2), pixels - step)
        assert np.abs(numeric / 2e-3 - by_pixel[..., c]).max() < 1e-8
        numeric = distort(lens(k1 + step[0], k2 + step[1]), pixels) - distort(lens(k1, k2), pixels)
        assert np.abs(numeric / 1e-3 - by_lens[..., c]).max() < 1e-6


@given(st.integers(-1000, 1000), st.integers(-1000, 1000))
def test_pixels_are_bent_up_to_where_the_bent_radius_turns(k1, k2):
    k1, k2 = k1 / 1000, k2 / 1000
    assume(abs(9.0 * k1**2 - 20.0 * k2) > 1e-9)  # the radius all but turns
    rho = np.linspace(0.0, 3.0, 1001)[1:]
    pixels = lens(k1, k2)[:2] + 650.0 * rho[:, None] * [0.6, 0.8]
    seen = np.isfinite(distort_visible(lens(k1, k2), pixels)).all(axis=1)
    near = np.abs(rho - turn(k1, k2)) < 1e-6
    assert (seen | near).tolist() == ((rho < turn(k1, k2)) | near).tolist()


def test_what_lies_beyond_the_turn_has_no_image():
    barrel = lens(-0.2, 0.0)  # turns at ρ² = 1/0.6, where the bent radius is 2/3 of it
    edge = 650.0 / np.sqrt(0.6)
    for straight in (640.0 + edge + 1.0, np.nan):
        assert np.isnan(distort_pixel(barrel, straight, 500.0)).all()
    for bent, known in ((edge / 1.5 - 0.01, True), (edge / 1.5 + 0.01, False), (np.nan, False)):
        assert np.isfinite(undistort_pixel(barrel, 640.0 + bent, 500.0)).all() == known


def test_without_distortion_pixels_are_the_same_to_the_bit(rng):
    pixels = rng.uniform(-1e3, 1e3, (2, 30, 2))
    assert distort_visible(no_lenses(2)[:, None], pixels) is pixels
    u, v = pixels[0, 0]
    assert undistort_pixel(no_lenses(1)[0], u, v) == (u, v)
    assert distort_pixel(no_lenses(1)[0], u, v) == (u, v)
    centre = lens(-0.2, 0.05)[:2]
    assert undistort_pixel(lens(-0.2, 0.05), *centre) == tuple(centre)
