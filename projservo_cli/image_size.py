"""Sizes of images, one of all cameras or one of each, and their borders.

The centres of pixels have whole coordinates, so an image reaches from −½ to its size − ½. Kernels have the
same rule in ``geometry.kinematics.from_border``.
"""

import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from projservo_cli.records import VIEWS, BoolArray, FloatArray, InputError

BEHIND = -1e9
"""Distance, px, from the border of an image of an unseen point."""
FACTORS = (0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.75, 0.8, 1.25, 4.0 / 3.0, 1.5, 2.0, 3.0, 4.0)
"""Ratios of the sizes that cameras have."""
ImageSize = tuple[int, int] | tuple[tuple[int, int], ...] | Mapping[str, tuple[int, int]]
"""Width and height of the images, px: of all views, or of one each, in order or by name."""


def image_sizes(size: Any, view: Sequence[str]) -> FloatArray:
    """Width and height (V, 2) of each image, px, from one size or one per view; infinite for None.

    Raises InputError for sizes of unnamed views.
    """
    if isinstance(size, Mapping):
        if {*size} != {*view}:
            raise InputError(
                f"image sizes of {', '.join(size)}, but the views are {', '.join(view)}: give one size, or "
                "one of each view"
            )
        size = [size[name] for name in view]
    sizes = np.array(math.inf if size is None else size, dtype=np.float64)
    if sizes.ndim == 2 and len(sizes) != len(view):
        raise InputError(
            f"{len(sizes)} image sizes for the views {', '.join(view)}: give one, or one per view, in order"
        )
    return np.broadcast_to(sizes, (len(view), 2)).copy()


def view_named(camera: str) -> str:
    """Name of the view of a camera, which may be a number, in small letters of one encoding."""
    name = unicodedata.normalize("NFC", camera.strip().lower())
    return f"cam{name}" if name.isdecimal() else name


def views_in_order(names: Iterable[str]) -> list[str]:
    """Names of views: left, right, then all others by their words and numbers, c2 before c10."""
    return sorted(names, key=lambda name: (name not in VIEWS, natural(name)))


def natural(name: str) -> list[tuple[int, str]]:
    """Key that sorts names by their words and numbers, 2 before 10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in parts]


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
