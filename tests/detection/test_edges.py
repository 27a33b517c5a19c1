"""Sides of a dark square drawn exactly: shares of pixels, no OpenCV."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from projservo_cli.detection.finders import refine_corners

FACTOR = 10


def found_in(image, guess, cells=6):
    """Corners (4, 2) of one tag that have clean edges, else NaN."""
    found = refine_corners(image, guess[None], cells)
    return np.where(found.clean[0, :, None], found.pixels[0], np.nan)


def dark_square(corners, size=(120, 100), blur=0.8):
    """Image of a dark convex quadrilateral on a bright ground, and its four corners, px."""
    width, height = size
    v, u = (np.mgrid[0 : height * FACTOR, 0 : width * FACTOR] + 0.5) / FACTOR - 0.5
    inside = np.ones_like(u, dtype=bool)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        inside &= (end[0] - start[0]) * (v - start[1]) - (end[1] - start[1]) * (u - start[0]) > 0
    image = 200.0 - 160.0 * inside.reshape(height, FACTOR, width, FACTOR).mean(axis=(1, 3))
    return gaussian_filter(image, blur)


CORNERS = np.array([[30.3, 25.8], [85.1, 31.2], [80.7, 75.4], [27.9, 70.0]])


@pytest.mark.parametrize("blur", [0.5, 0.8, 1.5])
def test_blur_does_not_move_the_corners(rng, blur):
    guess = CORNERS + rng.uniform(-1, 1, (4, 2))
    found = found_in(dark_square(CORNERS, blur=blur), guess)
    # sampling at a tenth of a pixel leaves about 0.005 px on a side; corners blend in at wide blur
    np.testing.assert_allclose(found, CORNERS, atol=0.03)


@pytest.mark.parametrize("exposure", [0.8, 0.95, 1.1, 1.2, 1.4])
def test_white_that_is_clipped_is_known_to_move_the_corners(rng, exposure):
    """By up to 0.3 px a coordinate here; without clipping a thousandth of the blur is stated, and true."""
    bright = exposure * 255.0 / 200.0 * dark_square(CORNERS) + rng.normal(0, 1, (100, 120))
    found = refine_corners(np.clip(np.rint(bright), 0, 255), CORNERS[None], 6)
    off = np.abs(found.pixels[0] - CORNERS).max(axis=1)
    assert (off < 3.0 * found.sigma[0] + 0.02).all()
    assert (found.sigma[0] > 0.1).all() == (exposure > 1.0)
    assert (found.sigma[0] < 0.02).all() == (exposure < 1.0)


@pytest.mark.parametrize("grey", [40.0, 120.0, 200.0])
def test_a_side_that_is_covered_costs_its_two_corners_unless_it_is_a_little(grey):
    image = dark_square(CORNERS)
    image[20:36, 56:60] = grey  # over the upper side
    np.testing.assert_allclose(found_in(image, CORNERS), CORNERS, atol=0.03)
    image[20:36, 50:70] = grey
    found = found_in(image, CORNERS)
    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2:], CORNERS[2:], atol=0.03)


@pytest.mark.parametrize(("side", "height", "blur"), [(15.0, 9.0, 2.0), (18.0, 6.3, 1.0)])
def test_a_tag_alone_whose_sides_are_too_short_for_neighbours_is_left(side, height, blur):
    corners = 20.0 + np.array([[0.0, 0.0], [side, 0.0], [1.02 * side, height], [0.03 * side, height]])
    assert np.isnan(found_in(dark_square(corners, (60, 60), blur), corners)).all()
