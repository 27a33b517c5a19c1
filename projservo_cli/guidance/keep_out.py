"""Regions of both images that the body keeps out of: polygons that somebody drew around an obstacle.

A point in space lies in front of, behind or in an obstacle where both cameras show it within the outline;
where one camera sees it beside the outline, it is beside the obstacle. No metre is needed for that.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from projservo_cli.geometry.jit import internal, merged
from projservo_cli.records import FloatArray, IntArray

BOTH = 2


class KeepOut(NamedTuple):
    """Polygons, in the order of their regions."""

    corners: FloatArray  # (k, 2) of all polygons, px
    first: IntArray  # (p + 1,) the first corner of each polygon, and how many there are
    image: IntArray  # (p,) in which of both it is drawn
    region: IntArray  # (p,) of which region it is
    hides: IntArray  # (r,) 1 where markers of the face stay outside in both images
    views: IntArray  # (r,) the only image in which a region is drawn, or ``BOTH``


NO_KEEP_OUT = KeepOut(np.zeros((0, 2)), np.zeros(1, np.int64), *(np.zeros(0, np.int64) for _ in range(4)))


def keep_out_of(regions: Sequence[tuple[ArrayLike | None, ArrayLike | None, bool]]) -> KeepOut:
    """Regions, each of polygons (k, 2) in the left and the right image, None for none, and if it hides."""
    polygons = [
        (r, view, np.asarray(drawn, dtype=np.float64))
        for r, region in enumerate(regions)
        for view, drawn in enumerate(region[:2])
        if drawn is not None
    ]
    if not polygons:
        return NO_KEEP_OUT
    views = [int(left is None) if left is None or right is None else BOTH for left, right, _ in regions]
    return KeepOut(
        np.ascontiguousarray(np.vstack([corners for _, _, corners in polygons])),
        np.cumsum([0, *(len(corners) for _, _, corners in polygons)]),
        np.array([view for _, view, _ in polygons]),
        np.array([r for r, _, _ in polygons]),
        np.array([int(hides) for _, _, hides in regions]),
        np.array(views),
    )


def only(keep: KeepOut, region: int) -> KeepOut:
    """The polygons of one region alone."""
    drawn = np.where(keep.region == region, 0, -1)
    here = slice(region, region + 1)
    return keep._replace(region=drawn, hides=keep.hides[here], views=keep.views[here])


@internal
def outside_polygon(corners: FloatArray, first: int, last: int, u: float, v: float) -> float:
    """Distance of a pixel from a polygon of corners first … last − 1, px; negative within."""
    least = math.inf
    within = False
    j = last - 1
    for i in range(first, last):
        x, y, x_j, y_j = corners[i, 0], corners[i, 1], corners[j, 0], corners[j, 1]
        dx, dy = x_j - x, y_j - y
        length = dx * dx + dy * dy
        t = ((u - x) * dx + (v - y) * dy) / length if length > 0.0 else 0.0
        t = min(1.0, max(0.0, t))
        off_x, off_y = u - x - t * dx, v - y - t * dy
        least = min(least, off_x * off_x + off_y * off_y)
        if (y > v) != (y_j > v) and u < x + (v - y) * dx / dy:
            within = not within
        j = i
    return -math.sqrt(least) if within else math.sqrt(least)


@merged
def clearance(keep: KeepOut, region: int, view: int, u: float, v: float) -> float:
    """Distance of a pixel of one image from the polygon of a region, px; infinite where none is drawn."""
    for p in range(keep.image.shape[0]):
        if keep.region[p] == region and keep.image[p] == view:
            return outside_polygon(keep.corners, keep.first[p], keep.first[p + 1], u, v)
    return math.inf
