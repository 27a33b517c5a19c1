"""Sides of a dark square drawn exactly: shares of pixels, no OpenCV."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from projservo_cli.detection import refine_corners

FACTOR = 10


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
    found = refine_corners(dark_square(CORNERS, blur=blur), guess, 6)
    # sampling at a tenth of a pixel leaves about 0.005 px on a side; corners blend in at wide blur
    np.testing.assert_allclose(found, CORNERS, atol=0.03)


def test_turning_around_the_tag_turns_the_answer():
    image = dark_square(CORNERS)
    found = refine_corners(image, CORNERS, 6)
    np.testing.assert_allclose(
        refine_corners(image, np.roll(CORNERS, 1, axis=0), 6), np.roll(found, 1, axis=0)
    )
    np.testing.assert_allclose(refine_corners(image, CORNERS[::-1], 6), found[::-1], atol=1e-6)


@pytest.mark.parametrize("grey", [40.0, 120.0, 200.0])
def test_a_side_that_is_covered_costs_its_two_corners_unless_it_is_a_little(grey):
    image = dark_square(CORNERS)
    image[20:36, 56:60] = grey  # over the upper side
    np.testing.assert_allclose(refine_corners(image, CORNERS, 6), CORNERS, atol=0.03)
    image[20:36, 50:70] = grey
    found = refine_corners(image, CORNERS, 6)
    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2:], CORNERS[2:], atol=0.03)


UNCLEAN = {
    "bright on dark": (lambda image: 240.0 - image, CORNERS),
    "no contrast": (lambda image: np.full_like(image, 90.0), CORNERS),
    "at the border": (lambda image: image[:, 31:], CORNERS - [31, 0]),
    "too small": (lambda image: image, 40.0 + np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])),
    "narrow": (lambda image: image, np.array([[30, 40], [90, 40], [90, 44], [30, 44.0]])),
}


@pytest.mark.parametrize("name", UNCLEAN)
def test_no_corner_without_clean_edges(name):
    change, guess = UNCLEAN[name]
    found = refine_corners(change(dark_square(CORNERS)), guess, 6)
    assert np.isnan(found[[0, 3]]).all()  # both ends of the left side
    assert np.isnan(found).all() or name == "at the border"


def test_an_edge_far_from_the_guess_is_not_taken_for_it():
    found = refine_corners(dark_square(CORNERS), CORNERS + np.array([6.0, 0.0]), 6)
    assert np.isnan(found).all()
