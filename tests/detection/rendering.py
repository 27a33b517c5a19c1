"""Images of tags in perspective, each pixel the mean of many samples."""

import numpy as np

FACTOR = 8  # samples a pixel, along u and along v
CELL = 20  # samples a cell of a tag's picture


def picture(cv, dictionary, number):
    """A tag with a bright margin of one cell, and its four corners in samples."""
    cells = dictionary.markerSize + 2
    tag = np.full(((cells + 2) * CELL,) * 2, 255, dtype=np.uint8)
    tag[CELL:-CELL, CELL:-CELL] = cv.aruco.generateImageMarker(dictionary, number, cells * CELL)
    near, far = CELL - 0.5, (cells + 1) * CELL - 0.5
    return tag, np.array([[near, near], [far, near], [far, far], [near, far]], dtype=np.float32)


def render(cv, dictionary, size, tags, *, blur=0.0, noise=0.0, rng=None, cover=()):
    """Image (height, width) of tags.

    Parameters
    ----------
    size : width and height, px.
    tags : (number, corners (4, 2) px) of each, pixel centres at whole coordinates.
    blur, noise : standard deviation of both, px and grey values.
    cover : rectangles (u, v, width, height), px, in front of all.
    """
    width, height = size
    fine = np.full((height * FACTOR, width * FACTOR), 200, dtype=np.uint8)
    for number, corners in tags:
        tag, source = picture(cv, dictionary, number)
        target = ((np.asarray(corners) + 0.5) * FACTOR - 0.5).astype(np.float32)
        H = cv.getPerspectiveTransform(source, target)
        seen = cv.warpPerspective(np.full_like(tag, 255), H, fine.shape[::-1], flags=cv.INTER_NEAREST)
        fine = np.where(seen > 0, cv.warpPerspective(tag, H, fine.shape[::-1]), fine)
    for u, v, wide, high in cover:
        fine[v * FACTOR : (v + high) * FACTOR, u * FACTOR : (u + wide) * FACTOR] = 130
    image = fine.reshape(height, FACTOR, width, FACTOR).mean(axis=(1, 3))
    if blur:
        image = cv.GaussianBlur(image, (0, 0), blur)
    image = 20 + 0.8 * image + (noise * rng.standard_normal(image.shape) if noise else 0.0)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def square(center, side, angle, tilt=(1.0, 1.0), skew=None):
    """Corners (4, 2) of a turned, foreshortened square around a centre, px."""
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * side
    c, s = np.cos(angle), np.sin(angle)
    corners = corners @ np.array([[c, s], [-s, c]]) * np.asarray(tilt) + np.asarray(center)
    return corners if skew is None else corners + skew
