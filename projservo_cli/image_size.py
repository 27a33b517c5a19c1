"""Sizes of images: one of both cameras, or one of each."""

import math
from typing import Any

import numpy as np

from projservo_cli.records import FloatArray

ImageSize = tuple[int, int] | tuple[tuple[int, int], tuple[int, int]]
"""Width and height of the images, px: of both, or of the left and of the right."""


def image_sizes(size: Any) -> FloatArray:
    """Width and height (2, 2) of each image, px, by those of both or of one each; infinite for None."""
    return np.broadcast_to(np.array(math.inf if size is None else size, dtype=np.float64), (2, 2)).copy()
