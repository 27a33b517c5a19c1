"""Sizes of images, one of all cameras or one of each, and their borders.

The centres of pixels have whole coordinates, so an image reaches from −½ to its size − ½. Kernels have the
same rule in ``geometry.kinematics.from_border``.
"""

import math
from typing import Any

import numpy as np

from projservo_cli.records import BoolArray, FloatArray

BEHIND = -1e9
"""Distance, px, from the border of an image of what no camera shows."""
ImageSize = tuple[int, int] | tuple[tuple[int, int], ...]
"""Width and height of the images, px: of all views, or of one each."""


def image_sizes(size: Any, views: int) -> FloatArray:
    """Width and height (V, 2) of each image, px, by those of all views or of one each; infinite for None."""
    sizes = np.array(math.inf if size is None else size, dtype=np.float64)
    return np.broadcast_to(sizes, (views, 2)).copy()


def image_corners(sizes: FloatArray) -> FloatArray:
    """Upper left and lower right corner (…, 2, 2) of images of sizes (…, 2), px."""
    return np.stack([np.full_like(sizes, -0.5), sizes - 0.5], axis=-2)


def border_distance(pixels: FloatArray, sizes: FloatArray) -> FloatArray:
    """Distances (…) of pixels (…, 2) from the borders of images of sizes (…, 2), px; negative outside."""
    inner = np.minimum(pixels + 0.5, sizes - 0.5 - pixels)
    return np.asarray(np.minimum(inner[..., 0], inner[..., 1]))


def within_images(pixels: FloatArray, sizes: FloatArray) -> BoolArray:
    """Whether pixels (…, 2) lie within images of sizes (…, 2); none that is NaN does."""
    return np.asarray(border_distance(pixels, sizes) >= 0.0)
