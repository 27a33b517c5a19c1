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
    image = np.full(size[::-1], 200.0)
    for number, corners in tags:
        reach = 0.5 * np.ptp(corners, axis=0)  # the bright margin is less than half a tag wide
        first = np.maximum(np.floor(corners.min(axis=0) - reach), 0).astype(int)
        last = np.minimum(np.ceil(corners.max(axis=0) + reach), np.array(size)).astype(int)
        width, height = last - first
        tag, source = picture(cv, dictionary, number)
        target = ((corners - first + 0.5) * FACTOR - 0.5).astype(np.float32)
        H = cv.getPerspectiveTransform(source, target)
        fine = (int(width) * FACTOR, int(height) * FACTOR)
        seen = cv.warpPerspective(np.full_like(tag, 255), H, fine, flags=cv.INTER_NEAREST) > 0
        shares = np.where(seen, cv.warpPerspective(tag, H, fine), 0).reshape(height, FACTOR, width, FACTOR)
        inside = seen.reshape(height, FACTOR, width, FACTOR).mean(axis=(1, 3))
        patch = image[first[1] : last[1], first[0] : last[0]]
        patch *= 1.0 - inside
        patch += shares.mean(axis=(1, 3))
    for u, v, wide, high in cover:
        image[v : v + high, u : u + wide] = 130
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
