"""Regions of the images that the body keeps out of: polygons that the user drew around an obstacle.

A point in space lies in front of, behind or in an obstacle if all cameras show it within the outline;
if one camera sees it outside the outline, it is outside the obstacle. This needs no metric.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from projservo_cli.geometry.jit import internal, merged
from projservo_cli.records import FloatArray, IntArray

SEVERAL = -1  # replaces the view if several images have a region
_Pixel = tuple[float, float]


class KeepOut(NamedTuple):
    """Polygons, in the order of their regions."""

    corners: FloatArray  # (k, 2) of all polygons, px
    first: IntArray  # (p + 1,) the first corner of each polygon, and how many there are
    image: IntArray  # (p,) in which image it is drawn
    region: IntArray  # (p,) of which region it is
    occludes: IntArray  # (r,) 1 where markers of the face stay outside in all images
    views: IntArray  # (r,) the only image in which a region is drawn, or ``SEVERAL``


NO_KEEP_OUT = KeepOut(np.zeros((0, 2)), np.zeros(1, np.int64), *(np.zeros(0, np.int64) for _ in range(4)))


def keep_out_of(regions: Sequence[tuple[Sequence[ArrayLike | None], bool]]) -> KeepOut:
    """Regions, each of a polygon (k, 2) in each image, None for none, and whether it hides."""
    polygons = [
        (r, view, np.asarray(drawn, dtype=np.float64))
        for r, region in enumerate(regions)
        for view, drawn in enumerate(region[0])
        if drawn is not None
    ]
    if not polygons:
        return NO_KEEP_OUT
    drawn_in = [[view for view, drawn in enumerate(region[0]) if drawn is not None] for region in regions]
    return KeepOut(
        corners=np.ascontiguousarray(np.vstack([corners for _, _, corners in polygons])),
        first=np.cumsum([0, *(len(corners) for _, _, corners in polygons)]),
        image=np.array([view for _, view, _ in polygons]),
        region=np.array([r for r, _, _ in polygons]),
        occludes=np.array([int(hides) for _, hides in regions]),
        views=np.array([views[0] if len(views) == 1 else SEVERAL for views in drawn_in]),
    )


def only(keep: KeepOut, region: int) -> KeepOut:
    """The polygons of one region alone."""
    drawn = np.where(keep.region == region, 0, -1)
    here = slice(region, region + 1)
    return keep._replace(region=drawn, occludes=keep.occludes[here], views=keep.views[here])


@merged
def squared(s: _Pixel, t: _Pixel) -> float:
    """Squared distance of two pixels."""
    du, dv = s[0] - t[0], s[1] - t[1]
    return du * du + dv * dv


@merged
def _away(s: _Pixel, a: _Pixel, b: _Pixel) -> float:
    """Squared distance of a pixel from the segment between two."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = dx * dx + dy * dy
    x = ((s[0] - a[0]) * dx + (s[1] - a[1]) * dy) / length if length > 0.0 else 0.0
    x = min(1.0, max(0.0, x))
    return squared(s, (a[0] + x * dx, a[1] + x * dy))


@internal
def outside_polygon(corners: FloatArray, first: int, last: int, s: _Pixel) -> float:
    """Distance of a pixel from a polygon of corners first … last − 1, px; negative within."""
    minimum, within = math.inf, False
    b = (float(corners[last - 1, 0]), float(corners[last - 1, 1]))
    for i in range(first, last):
        a, b = b, (float(corners[i, 0]), float(corners[i, 1]))
        minimum = min(minimum, _away(s, a, b))
        if (a[1] > s[1]) != (b[1] > s[1]) and s[0] < a[0] + (s[1] - a[1]) * (b[0] - a[0]) / (b[1] - a[1]):
            within = not within
    return -math.sqrt(minimum) if within else math.sqrt(minimum)


@merged
def draws(keep: KeepOut, region: int, view: int) -> bool:
    """Whether a region is drawn in an image."""
    for p in range(keep.image.shape[0]):
        if keep.region[p] == region and keep.image[p] == view:
            return True
    return False


@merged
def clearance(keep: KeepOut, region: int, view: int, s: _Pixel) -> float:
    """Distance of a pixel of one image from the polygon of a region, px; infinite if none is drawn."""
    for p in range(keep.image.shape[0]):
        if keep.region[p] == region and keep.image[p] == view:
            return outside_polygon(keep.corners, keep.first[p], keep.first[p + 1], s)
    return math.inf
