"""Radial distortion: there and back, its derivatives, where it turns, and as OpenCV bends."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projservo_cli.geometry.lens import bend, bent, bent_derivative, straighten, through, turning, within
from projservo_cli.records import NO_LENS

COEFFICIENTS = [(-0.2, 0.05), (-0.2, 0.0), (0.15, -0.02), (0.1, 0.1), (0.0, -0.05), (-0.3, 0.2)]


def lens(k1, k2):
    return np.array([640.0, 500.0, 650.0, k1, k2])


@pytest.mark.parametrize(("k1", "k2"), COEFFICIENTS)
def test_straightening_undoes_bending(k1, k2, rng):
    directions = rng.standard_normal((200, 2))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # Up to 99 % of the radius at which it turns: the bent radius is flat there, which costs digits.
    most = min(0.99 * np.sqrt(turning(k1, k2)), 2.0)
    pixels = lens(k1, k2)[:2] + 650.0 * rng.uniform(0.0, most, (200, 1)) * directions
    for u, v in pixels:
        there = bend(lens(k1, k2), u, v)
        # Newton stops at a step of 1e-9 of the radius, whose square is left: far below 1e-9 px.
        assert np.abs(np.array(straighten(lens(k1, k2), *there)) - (u, v)).max() < 1e-9
        assert np.array(there) == pytest.approx(bent(lens(k1, k2), np.array([u, v])), abs=1e-12 * 2000)


def test_a_bent_pixel_is_that_of_opencv(rng):
    cv2 = pytest.importorskip("cv2")
    points = np.c_[rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)]
    K = np.array([[650.0, 0.0, 640.0], [0.0, 650.0, 500.0], [0.0, 0.0, 1.0]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([-0.2, 0.05, 0.0, 0.0]))[0]
    straight = points @ K[:2].T
    assert bent(lens(-0.2, 0.05), straight) == pytest.approx(expected[:, 0], abs=1e-9)


@pytest.mark.parametrize(("k1", "k2"), COEFFICIENTS)
def test_derivatives_agree_with_differences(k1, k2, rng):
    pixels = lens(k1, k2)[:2] + rng.uniform(-400.0, 400.0, (20, 2))
    by_pixel, by_lens = bent_derivative(lens(k1, k2), pixels)
    for c in range(2):
        # Central differences: 1e-3 px of 650 leave (1e-3/650)² of truncation and 1e-13/1e-3 of round-off.
        step = 1e-3 * np.eye(2)[c]
        numeric = (bent(lens(k1, k2), pixels + step) - bent(lens(k1, k2), pixels - step)) / 2e-3
        assert np.abs(numeric - by_pixel[..., c]).max() < 1e-8
        k = 1e-3 * np.eye(2)[c]
        numeric = (bent(lens(k1 + k[0], k2 + k[1]), pixels) - bent(lens(k1, k2), pixels)) / 1e-3
        # Pixels are linear in k: differences are exact but for round-off, 1e-13 of 1e3 over 1e-3.
        assert np.abs(numeric - by_lens[..., c]).max() < 1e-6


@settings(deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_bent_radius_grows_up_to_the_turn_and_not_beyond(k1, k2):
    limit = np.sqrt(turning(k1, k2))
    rho = np.linspace(0.0, min(limit, 3.0), 1001)[1:-1]
    slope = 1.0 + 3.0 * k1 * rho**2 + 5.0 * k2 * rho**4
    assert (slope > 0.0).all()
    if np.isfinite(limit) and limit < 1e3:
        terms = np.abs([1.0, 3.0 * k1 * limit**2, 5.0 * k2 * limit**4])
        # A zero of the slope, as far as round-off in its largest term tells.
        assert abs(1.0 + 3.0 * k1 * limit**2 + 5.0 * k2 * limit**4) < 1e-6 * terms.max()


def test_what_lies_beyond_the_turn_has_no_image():
    barrel = lens(-0.2, 0.0)  # turns at ρ² = 1/0.6, where the bent radius is 2/3 of it: 559.4 px
    edge = 650.0 / np.sqrt(0.6)
    assert turning(-0.2, 0.0) == pytest.approx(1.0 / 0.6, rel=1e-12)
    pixels = np.array([[640.0 + edge - 1.0, 500.0], [640.0 + edge + 1.0, 500.0], [np.nan, 500.0]])
    assert within(barrel, pixels).tolist() == [True, False, False]
    seen = through(barrel, pixels)
    assert np.isfinite(seen[0]).all()
    assert np.isnan(seen[1:]).all()
    assert np.isnan(bend(barrel, *pixels[1])).all()
    reach = 2.0 / 3.0 * edge
    assert np.isfinite(straighten(barrel, 640.0 + reach - 0.01, 500.0)).all()
    assert np.isnan(straighten(barrel, 640.0 + reach + 0.01, 500.0)).all()
    assert np.isnan(straighten(barrel, np.nan, 500.0)).all()


def test_without_distortion_pixels_are_the_same_to_the_bit(rng):
    pixels = rng.uniform(-1e3, 1e3, (2, 30, 2))
    assert through(NO_LENS[:, None], pixels) is pixels
    u, v = pixels[0, 0]
    assert straighten(NO_LENS[0], u, v) == (u, v)
    assert bend(NO_LENS[0], u, v) == (u, v)
    centre = lens(-0.2, 0.05)[:2]
    assert straighten(lens(-0.2, 0.05), *centre) == tuple(centre)
