"""Marker detection in images: corners of ArUco and AprilTag tags, and of boards, to a fraction of a pixel.

OpenCV finds tags and boards; edges refine their corners.
"""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr

from projservo_cli.detection.images import StoredImage, opencv
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.geometry.least_squares import Equations, levenberg_marquardt
from projservo_cli.records import (
    CORNERS,
    BoolArray,
    ByteArray,
    FloatArray,
    InputError,
    StatedBoard,
    board_numberings,
)

DICTIONARY = "4X4_50"
"""Of tags, if none is given."""


def cells_of(dictionary: str) -> int:
    """Cells along a side of a tag, border included, by the name of its dictionary."""
    code = re.search(r"(\d+)([XH])\d", dictionary.upper())
    if code is None:  # ARUCO_ORIGINAL
        return 7
    return 2 + (int(code[1]) if code[2] == "X" else math.isqrt(int(code[1])))


# Kinds of boards, and their minimum rows and columns.
_BOARDS, LEAST_ROWS = ("chessboard", "charuco", "circles", "acircles"), 3
# Radius within which pixels are of a circle, and from which they are ground, over half of the least distance.
_INSIDE, _GROUND = 0.2, 0.9
# Error of the middle of a circle besides noise, px, fitted to drawn boards.
_CIRCLE_FLOOR = 0.005
# Share of a square that a tag takes up on a ChArUco board: as OpenCV draws it; the edges decide on corners.
_TAG_SHARE = 0.75
# Minimum number of corners of a board in an image, not of one line, for the directions of its edges.
_LEAST_CORNERS = 6
# Distance from a corner up to which pixels count, in squares, and at most, px.
_REACH, _MAX_REACH_SADDLE = 0.6, 10.0
# That from the edges on a ChArUco board, in squares, within the margin of its tags, and at least, px.
_CROSS, _MIN_CROSS = 0.1, 1.5
# Minimum side of a square to fit edges, px, and deviation of a corner of OpenCV in a smaller one, px.
_MIN_SQUARE, _UNREFINED_SADDLE = 5.0, 0.3
# Number of parameters of a corner, steps of their fit, and error of the model, px.
_SADDLE, _SADDLE_STEPS, _SADDLE_FLOOR = 7, 12, 0.001
# Blur of an image before the search of saddles, px, their number over the number of corners, and of starts.
_SEED_BLUR, _SADDLES, _STARTS = 1.5, 4, 40
# Depth of the next saddle, as a share, at least, and slope of the line to it against an edge, at most.
_FAINT, _SLOPE = 0.1, 0.2
# Difference of a contrast, as a share, deviation, in squares, and squares beyond the known ones, at most.
_UNLIKE, _VAGUE, _GAP = 0.6, 0.01, 3
# Deviations from the smooth map of the others above which a corner is rejected, and the degree of the map.
_OUTLYING, _DEGREE = 3.5, 4
# Error by the next corners, as a share of a square, and their distance, likewise, fitted to drawn boards.
_LEAK_SADDLE = (0.3, 0.6)
# Parts of a pixel across an edge of a saddle, and its minimum blur, px, of which the box of a pixel is none.
_PARTS, _MIN_BLUR_SADDLE = 3, 0.05
# Rms residual beyond noise, in contrasts, and distance from the guess, in squares, above which a corner is
# rejected; standard errors that the noise may be estimated too low by chance.
_MISFIT, _FAR_SADDLE, _CHANCE = 0.25, 0.3, 3.0
# Minimum width of a cell, px, to fit edges of a tag, whose border is one cell wide.
MIN_CELL = 1.8
# Minimum length of a side to fit, px.
_MIN_SIDE = 6.0
# Minimum extent of a profile on either side of an edge, px.
_MIN_REACH = 1.5
# Maximum extent of a profile on either side of an edge, px.
_MAX_REACH = 6.0
# Minimum blur of an edge, px: pixels do not resolve a sharper one.
_MIN_BLUR = 0.2
# Maximum blur of an edge, px.
_MAX_BLUR = 10.0
# Rms residuals of occluded profiles, in contrasts, rejected in this order; clean profiles have some 0.02.
_SPOILT = (0.2, 0.14, 0.1, 0.07, 0.05)
# Maximum share of occluded profiles of a side.
_SPOILT_SHARE = 0.25
# Number of cells of border along a side of a tag, besides the cells of its code.
_BORDER = 2
# Maximum number of profiles in the first fit of a side.
_ROUGH_PROFILES = 16
# Minimum number of profiles of a side.
_MIN_PROFILES = 3
# Numbers of steps of the first and of the second fit.
_STEPS = (6, 3)
# Maximum distance of a corner from its guess, px, and as a share of the longest side, besides the blur.
_FAR = (2.0, 0.05)
# Number of parameters of an edge.
_EDGE = 6
# Standard deviation of the height of the arc that a lens makes of a side, px.
_BOW = 0.01
# Minimum noise of grey values.
_MIN_NOISE = 0.3
# Noise of grey values that suppresses the arc in the first fit.
_RIGID = 1e3
# Error of the model of an edge, px.
_FLOOR = 0.002
# Error by the next edge, as a share of a cell, and its distance, as a share of a cell.
_LEAK = (0.5, 0.6)
# Cell width below which profiles reach into the next cell, px, and power of its ratio by which the error
# grows, fitted to drawn tags with cells of 1.7 to 2.3 px, blurred by 0.4 to 1.3 px.
_NARROW, _BY_NARROWNESS = 2.3, 3
# Grey value from which white is clipped, less noise and JPEG artefacts.
_CLIPPED = 252.0
# Rms error of an edge fitted to min(k Φ, 1), as a share of the blur, for exposures k from 1 to 1½.
_OVEREXPOSED = 0.42
# Deviation of a corner of OpenCV for a blur and a cell of one pixel, px, fitted to rendered tags.
_UNREFINED = 1.2
# Exponent of the cell width in that deviation, fitted likewise.
_BY_CELL = -0.75
# Blur if no edge shows it, in cells.
_BLURRED = 0.4
# Cell width below which the deviation grows no more, px.
_MIN_UNREFINED = 1.25


class _Sides(NamedTuple):
    """Sides of quadrilaterals, four of each one after the other, all arrays (S, …)."""

    start: FloatArray  # (S, 2) corner at which each begins, px
    along: FloatArray  # (S, 2) unit vector to the next corner
    normal: FloatArray  # (S, 2) unit vector across, outwards
    length: FloatArray  # (S,) px
    cell: FloatArray  # (S,) width of a cell of the tag across the side, px

    @classmethod
    def of(cls, corners: FloatArray, cells: int) -> "_Sides":
        """Sides of tags with corners (Q, 4, 2) and a number of cells along a side."""
        start, end = corners.reshape(-1, 2), np.roll(corners, -1, axis=1).reshape(-1, 2)
        length = np.linalg.norm(end - start, axis=1)
        along = (end - start) / np.maximum(length, 1e-9)[:, None]
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
        depth = ((start - np.repeat(corners.mean(axis=1), 4, axis=0)) * normal).sum(axis=1)
        outwards = np.where(depth < 0.0, -1.0, 1.0)[:, None] * normal
        return cls(start, along, outwards, length, 2.0 * np.abs(depth) / cells)


class _Strips(NamedTuple):
    """Pixels along sides, profile by profile: rows or columns of the image, whichever cross the side."""

    grey: FloatArray  # (S, C, R) grey values
    t: FloatArray  # (S, C, R) coordinate along the side, −½ to ½
    n: FloatArray  # (S, C, R) coordinate across, px
    weight: FloatArray  # (S, C, R) one for pixels that count, otherwise zero

    @classmethod
    def of(
        cls, image: FloatArray, sides: _Sides, reach: FloatArray, margin: FloatArray, max_profiles: int
    ) -> "_Strips":
        """Pixels within reach (S,) of sides, less a margin (S,) at either end, in up to ``max_profiles``.

        A side with too few profiles, or with a pixel outside the image, has none.
        """
        s = np.arange(len(reach))
        main = np.argmax(np.abs(sides.along), axis=1)  # the coordinate that counts the profiles
        slope = sides.along[s, main]
        ends = sides.start[s, main] + slope * np.stack([margin, sides.length - margin])
        first, last = np.ceil(ends.min(axis=0)), np.floor(ends.max(axis=0))
        stride = np.maximum(1.0, np.ceil((last - first + 1.0) / max_profiles))
        profiles = int(max(2.0, ((last - first) // stride).max() + 1.0))
        half = int(np.ceil((reach / np.abs(slope)).max())) + 1
        place = np.empty((2, len(s), profiles, 2 * half + 1))  # indexed by main and other coordinate
        place[0] = (first[:, None] + stride[:, None] * np.arange(profiles))[..., None]
        t = (place[0] - sides.start[s, main][:, None, None]) / slope[:, None, None]
        crossing = sides.start[s, 1 - main][:, None, None] + sides.along[s, 1 - main][:, None, None] * t
        place[1] = np.rint(crossing) + np.arange(-half, half + 1)
        u, v = np.where((main == 0)[:, None, None], place, place[::-1])
        du, dv = u - sides.start[:, 0, None, None], v - sides.start[:, 1, None, None]
        t = sides.along[:, 0, None, None] * du + sides.along[:, 1, None, None] * dv
        n = sides.normal[:, 0, None, None] * du + sides.normal[:, 1, None, None] * dv
        counts = (np.abs(n) <= reach[:, None, None]) & (place[0] <= last[:, None, None])
        height, width = image.shape
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        whole = (inside | ~counts).all(axis=(1, 2)) & (last - first + 1.0 >= _MIN_PROFILES)
        grey = image[np.clip(v, 0, height - 1).astype(int), np.clip(u, 0, width - 1).astype(int)]
        weight = (counts & whole[:, None, None]).astype(np.float64)
        return cls(grey, t / sides.length[:, None, None] - 0.5, n, weight)


def _edge_model(x: FloatArray, strips: _Strips) -> tuple[FloatArray, FloatArray]:
    """Weighted residual (S, C, R) of edges x = (b, a, n_0, k, σ, c) (S, 6), and derivative (S, 6, C R).

    An edge is b + a Φ((n − n_0 − k t − c (4 t² − ⅓))/σ), Φ the normal distribution: blurred by σ, and in t a
    straight line with an arc of height c by lens distortion.
    """
    b, a, n_0, k, sigma, c = x.T[:, :, None, None]
    arc = 4.0 * strips.t**2 - 1.0 / 3.0
    z = (strips.n - n_0 - k * strips.t - c * arc) / sigma
    phi = ndtr(z)
    bell = strips.weight * np.exp(-0.5 * z * z) * (-a / (np.sqrt(2.0 * np.pi) * sigma))
    J = np.stack([strips.weight, strips.weight * phi, bell, bell * strips.t, bell * z, bell * arc], axis=1)
    return strips.weight * (b + a * phi - strips.grey), J.reshape(
        len(x), _EDGE, strips.t.shape[1] * strips.t.shape[2]
    )


def _fitted(x: FloatArray, strips: _Strips, noise: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
    """Edges (S, 6) of least squares, all of a frame together, and their normal matrices.

    The noise (S,) of grey values sets the weight of a prior on the arcs.
    """
    stiff = np.zeros((len(x), _EDGE))
    stiff[:, -1] = np.square(np.clip(noise, _MIN_NOISE, _RIGID) / _BOW)

    def equations(x: FloatArray) -> Equations:
        r, J = _edge_model(x, strips)
        A = J @ J.swapaxes(1, 2) + stiff[:, :, None] * np.eye(_EDGE)
        cost = (r * r).sum(axis=(1, 2)) + (stiff * x * x).sum(axis=1)
        return Equations(A, (J @ r.reshape(len(r), -1, 1))[..., 0] + stiff * x, cost)

    (x,), there = levenberg_marquardt((x,), equations, partial(_blurred, _MIN_BLUR), steps)
    return x, there.A


def _blurred(min_blur: float, step: FloatArray, x: FloatArray) -> tuple[FloatArray]:
    """Parameters (S, p) after a step; the fifth is a blur, which has limits."""
    x = x + step
    x[:, 4] = np.clip(np.abs(x[:, 4]), min_blur, _MAX_BLUR)
    return (x,)


def _first_edges(strips: _Strips) -> FloatArray:
    """Initial edges (S, 6) by the grey values at the inner and at the outer end of the strips."""
    far = np.abs(strips.n) > 0.5 * np.where(strips.weight > 0.0, np.abs(strips.n), 0.0).max(
        axis=(1, 2), keepdims=True
    )
    inner, outer = strips.weight * (far & (strips.n < 0.0)), strips.weight * (far & (strips.n > 0.0))
    low, high = (
        (part * strips.grey).sum(axis=(1, 2)) / np.maximum(part.sum(axis=(1, 2)), 1.0)
        for part in (inner, outer)
    )
    zero = np.zeros_like(low)
    return np.stack([low, high - low, zero, zero, zero + 1.0, zero], axis=1)


class _Edges(NamedTuple):
    """Edges through the sides of tags, four of each in a row; NaN if one is not clean."""

    line: FloatArray  # (S, 3) l·(u, v, 1) = 0, normals of unit length
    variance: FloatArray  # (S, 2) of the distance from the true edge, at the start and at the end, px²
    x: FloatArray  # (S, 6) b, a, n_0, k, σ, c
    spoilt: BoolArray  # (S,) whether one is not clean despite enough pixels


def _edges_along(image: FloatArray, all_sides: _Sides, before: FloatArray, *, rough: bool) -> _Edges:
    """Fit edges about approximate sides, from earlier edges (S, 6) or NaN.

    rough : use few profiles; otherwise all but occluded ones, if these are few.
    The variance has the independent errors of grey values, as of the residuals of the side, and errors of the
    model: blur from the next edge, one cell away, which depends on the code, and clipped white.
    """
    line, variance, edge = (np.full((len(before), size), np.nan) for size in (3, 2, _EDGE))
    edges = _Edges(line, variance, edge, np.zeros(len(before), dtype=np.bool_))
    fits = np.flatnonzero((all_sides.length > _MIN_SIDE) & (all_sides.cell > MIN_CELL))
    if fits.size == 0:
        return edges
    sides, blur = _Sides(*(part[fits] for part in all_sides)), before[fits, 4]
    has_blur = np.isfinite(blur)
    reach = np.clip(0.5 * sides.cell, _MIN_REACH, np.where(has_blur, 3.0 * blur + 1.0, _MAX_REACH))
    margin = np.where(has_blur, np.maximum(0.08 * sides.length, 2.0 * blur) + 1.0, 0.12 * sides.length + 1.0)
    strips = _Strips.of(image, sides, reach, margin, _ROUGH_PROFILES if rough else image.size)
    x = _first_edges(strips)
    x[has_blur, 4] = blur[has_blur]
    noise = np.full(len(x), _RIGID) if rough else _noise(strips)
    x, A = _fitted(x, strips, noise, _STEPS[0 if rough else 1])
    clean = tried = strips.weight.any(axis=(1, 2))
    if not rough:
        strips, x, A, clean = _uncovered(strips, noise, x, A)
    count = strips.weight.sum(axis=(1, 2))
    good = clean & (count > 5.0) & (x[:, 1] > 0.0) & (np.abs(x[:, 2]) + 0.5 * np.abs(x[:, 3]) < reach)
    edges.spoilt[fits] = tried & ~good
    sides, x, A, fits = _Sides(*(part[good] for part in sides)), x[good], A[good], fits[good]
    strips = _Strips(*(part[good] for part in strips))
    residual = _edge_model(x, strips)[0]
    C = np.linalg.inv(A) * ((residual**2).sum(axis=(1, 2)) / (count[good] - 5.0))[:, None, None]
    leak = _LEAK[0] * sides.cell * ndtr(-_LEAK[1] * sides.cell / x[:, 4])
    leak *= np.maximum(1.0, _NARROW / sides.cell) ** _BY_NARROWNESS
    left_out = _FLOOR**2 + leak**2 + (_OVEREXPOSED * _clipped(strips) * x[:, 4]) ** 2
    # derivatives of n at both ends by n_0, k, c
    by_place = np.array([[1.0, -0.5, 2.0 / 3.0], [1.0, 0.5, 2.0 / 3.0]])
    C = C[:, [2, 3, 5]][:, :, [2, 3, 5]]
    ends = (by_place @ C * by_place).sum(axis=2)
    chord = x[:, 2:3] + by_place[0, 2] * x[:, 5:6]
    middle = sides.start + sides.along * (0.5 * sides.length)[:, None] + sides.normal * chord
    direction = sides.along * sides.length[:, None] + sides.normal * x[:, 3:4]
    across = np.stack([direction[:, 1], -direction[:, 0]], axis=1)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    edges.line[fits] = np.column_stack([across, -(across * middle).sum(axis=1)])
    edges.variance[fits], edges.x[fits] = ends + left_out[:, None], x
    return edges


def _clipped(strips: _Strips) -> FloatArray:
    """Share (S,) of clipped white pixels outside of edges."""
    outside = strips.weight * (strips.n > 0.0)
    clipped = outside * (strips.grey >= _CLIPPED)
    return np.asarray(clipped.sum(axis=(1, 2)) / np.maximum(outside.sum(axis=(1, 2)), 1.0))


def _uncovered(
    strips: _Strips, noise: FloatArray, x: FloatArray, A: FloatArray
) -> tuple[_Strips, FloatArray, FloatArray, BoolArray]:
    """Remove occluded profiles and fit again; strips, edges, and a mask (S,) of sides with few of them."""
    whole, rms = strips.weight.any(axis=2), _rms_of_profiles(x, strips)
    for share in _SPOILT:
        spoilt = rms > np.maximum(share * x[:, 1], 3.0 * noise)[:, None]
        touched = spoilt.any(axis=1)
        if not touched.any():
            continue
        strips = strips._replace(weight=strips.weight * ~spoilt[:, :, None])
        some = _Strips(*(part[touched] for part in strips))
        x, A = x.copy(), A.copy()
        x[touched], A[touched] = _fitted(x[touched], some, noise[touched], _STEPS[1])
        rms[touched] = _rms_of_profiles(x[touched], some)
    left = strips.weight.any(axis=2).sum(axis=1)
    return strips, x, A, left >= (1.0 - _SPOILT_SHARE) * np.maximum(whole.sum(axis=1), 1)


def _rms_of_profiles(x: FloatArray, strips: _Strips) -> FloatArray:
    """Root mean square residual (S, C) of each profile of a side by a model (S, 6)."""
    residual, _ = _edge_model(x, strips)
    return np.asarray(np.sqrt((residual**2).sum(axis=2) / np.maximum(strips.weight.sum(axis=2), 1.0)))


def _noise(strips: _Strips) -> FloatArray:
    """Noise (S,) of a pixel, about the median difference of neighbours along the sides."""
    pairs = (strips.weight[:, 1:] * strips.weight[:, :-1]).reshape(len(strips.t), -1) > 0.0
    steps = np.abs(np.diff(strips.grey, axis=1)).reshape(pairs.shape)
    middle = pairs.sum(axis=1, keepdims=True) // 2
    ordered = np.sort(np.where(pairs, steps, np.inf), axis=1)
    return np.take_along_axis(ordered, np.minimum(middle, pairs.shape[1] - 1), axis=1)[:, 0]


class Corners(NamedTuple):
    """Corners of tags."""

    pixels: FloatArray  # (…, 4, 2) px, in order around the tag; NaN if occluded or the guess is wrong
    sigma: FloatArray  # (…, 4) standard deviation of either coordinate, px; NaN likewise
    clean: BoolArray  # (…, 4) whether both edges of a corner are clean; otherwise it stays at its guess


def refine_corners(image: FloatArray, guess: FloatArray, cells: int) -> Corners:
    """Refine corners of tags by the edges between their black border and the bright ground around them.

    A corner is the crossing of two edges, whose errors add up over the sine of the angle between them. With
    too few pixels for an edge the guess stays, with its own deviation. A corner is rejected if an edge is
    occluded, or passes far from the guess.

    image : (height, width) grey values; pixel centres have whole coordinates.
    guess : (Q, 4, 2) u, v of corners as of OpenCV, within about two pixels.
    cells : number of cells of a tag along a side, border included; the border is one cell wide.
    """
    corners = np.asarray(guess, dtype=np.float64)
    x = np.full((4 * len(corners), _EDGE), np.nan)
    for rough in (True, False):
        sides = _Sides.of(corners, cells)
        edges = _edges_along(image, sides, x, rough=rough)
        x = edges.x
        line, variance = edges.line.reshape(-1, 4, 3), edges.variance.reshape(-1, 4, 2)
        last = np.roll(line, 1, axis=1)
        sine = last[..., 0] * line[..., 1] - last[..., 1] * line[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = np.cross(last, line)[..., :2] / sine[..., None]
            sigma = np.sqrt(0.5 * (np.roll(variance[..., 1], 1, axis=1) + variance[..., 0])) / np.abs(sine)
        corners = np.where(np.isfinite(crossing), crossing, guess)
    blur, longest = x[:, 4].reshape(-1, 4), sides.length.reshape(-1, 4).max(axis=1, keepdims=True)
    far = _FAR[0] + _FAR[1] * longest + np.nan_to_num(np.fmax(blur, np.roll(blur, 1, axis=1)))
    offsets = [np.abs((edge[..., :2] * guess).sum(axis=2) + edge[..., 2]) for edge in (line, last)]
    away = np.fmax(np.fmax(*offsets), np.linalg.norm(crossing - guess, axis=2))
    spoilt = edges.spoilt.reshape(-1, 4)
    away[spoilt | np.roll(spoilt, 1, axis=1)] = np.inf
    clean = np.isfinite(crossing).all(axis=2) & (away <= far)
    pixels = np.where(clean[..., None], crossing, np.where((away > far)[..., None], np.nan, guess))
    # A crossing that near to the corner of OpenCV is as good at least.
    unrefined = _unrefined(sides.cell, blur)
    deviation = np.where(away > far, np.nan, np.where(clean, np.fmin(sigma, unrefined), unrefined))
    return Corners(pixels, deviation, clean)


def _unrefined(cell: FloatArray, blur: FloatArray) -> FloatArray:
    """Deviation (Q, 4) of corners of OpenCV, px, by cells (4 Q,) across sides and blurs (Q, 4).

    The formula is a fit to drawn and rendered tags of all sizes, tilts and blurs.
    """
    cell = np.maximum(cell, _MIN_UNREFINED).reshape(-1, 4)
    cell = np.minimum(cell, np.roll(cell, 1, axis=1))
    blurs = blur[np.isfinite(blur)]
    typical = float(np.median(blurs)) if blurs.size else _BLURRED * cell
    return np.asarray(_UNREFINED * np.sqrt(np.where(np.isfinite(blur), blur, typical)) * cell**_BY_CELL)


class Finder(ABC):
    """Detector of the carrier of the markers: tags, or a board.

    ``cv``: the module of OpenCV. ``corners``: number k of markers of each; corner i of tag t is k t + i.
    Raises InputError if OpenCV is not installed.
    """

    corners: int

    def __init__(self) -> None:
        self.cv = opencv()

    @abstractmethod
    def find(self, image: FloatArray) -> tuple[dict[int, Corners], tuple[int, ...]]:
        """Corners (k, …) of each tag in an image, and the numbers of tags that occur more than once.

        image : (height, width) grey values from 0 to 255.
        """

    def like(self, tags: dict[int, Corners], before: dict[int, Corners] | None) -> dict[int, Corners]:
        """Return tags numbered as in the frame before, if a board looks the same from several ends."""
        return tags

    def absent(self, shown: Sequence[StoredImage]) -> Finding:
        """Return that there is nothing in images of files."""
        return Finding("no_tags", REFUSES, amount=len(shown), unit="1")

    def mirrored(self, shown: Sequence[StoredImage]) -> int:
        """Number of images of files that show something when they are mirrored."""
        return sum(bool(self.find(np.fliplr(one.grey()))[0]) for one in shown)


class TagFinder(Finder):
    """Detector of the tags of one dictionary.

    dictionary : name of OpenCV, with or without ``DICT_``, any case: ``4X4_50``, ``APRILTAG_36H11``.
    ``cells``: along a side of a tag, its border included.
    Raises InputError if OpenCV is not installed or has no such dictionary.
    """

    corners = CORNERS

    def __init__(self, dictionary: str) -> None:
        super().__init__()
        self._tags = tags = _dictionary(dictionary)
        self._detector = self.cv.aruco.ArucoDetector(tags, _parameters())
        self.cells = int(tags.markerSize) + _BORDER

    @property
    def known(self) -> int:
        """Number of tags in the dictionary."""
        return len(self._tags.bytesList)

    def picture(self, number: int, cell_px: int) -> ByteArray:
        """Grey values of a tag with a bright margin of one cell, in cells of ``cell_px``.

        Raises InputError if the dictionary has no such tag.
        """
        if number >= self.known:
            raise InputError(
                f"there is no tag {number} in the dictionary, which has tags 0 to {self.known - 1}"
            )
        tag = self.cv.aruco.generateImageMarker(self._tags, number, self.cells * cell_px)
        return np.pad(tag, cell_px, constant_values=255)

    def find(self, image: FloatArray) -> tuple[dict[int, Corners], tuple[int, ...]]:
        """Corners (4, …) of each tag in an image, and the numbers of tags that occur more than once.

        A tag that occurs more than once is ambiguous and rejected.

        image : (height, width) grey values from 0 to 255.
        """
        quads, numbers, _ = self._detector.detectMarkers(image.astype(np.uint8))
        if numbers is None:
            return {}, ()
        occurring = [int(number) for number in np.ravel(numbers)]
        ambiguous = {number for number in occurring if occurring.count(number) > 1}
        corners = refine_corners(image, np.reshape(quads, (-1, 4, 2)).astype(np.float64), self.cells)
        each = (Corners(*tag) for tag in zip(*corners, strict=True))
        tags = dict(zip(occurring, each, strict=True))
        return {number: tag for number, tag in tags.items() if number not in ambiguous}, tuple(
            sorted(ambiguous)
        )


class Board(NamedTuple):
    """A board of chessboard or ChArUco corners, or a grid of circles, counted as OpenCV does."""

    kind: str  # chessboard, charuco, circles or acircles, whose odd rows are moved by half of a step
    rows: int  # inner corners of a chessboard, squares of a ChArUco board, circles
    columns: int
    first: int = 0  # number of the first tag on a ChArUco board
    pitch_mm: float | None = None  # distance of neighbouring corners, or of rows of acircles, mm, if stated

    @classmethod
    def of(cls, text: str) -> "Board":
        """Read such as ``chessboard:9x7``, 9 columns and 7 rows. Raises InputError for other texts."""
        side, first = r"(?::(\d{1,4}(?:\.\d{1,6})?)mm)?", r"(?::first=(\d{1,4}))?"
        parts = re.fullmatch(rf"({'|'.join(_BOARDS)}):(\d{{1,3}})x(\d{{1,3}}){side}{first}", text)
        if parts is None or min(int(parts[2]), int(parts[3])) < LEAST_ROWS:
            raise InputError(
                f"--board {text}: write kind:columnsxrows, of {LEAST_ROWS} or more, such as chessboard:9x7 "
                "(inner corners), charuco:11x8 (squares), charuco:11x8:25mm with the side of a square, "
                "charuco:11x8:first=20 if its first tag is 20, circles:9x7 or acircles:4x11"
            )
        if parts[5] and parts[1] != "charuco":
            raise InputError(f"--board {text}: a {parts[1]} has no tags: leave out first={parts[5]}")
        if parts[1] == "acircles" and int(parts[3]) % 2 == 0:
            raise InputError(f"--board {text}: take an odd number of rows, as 4x11: OpenCV mixes up others")
        pitch_mm = None if parts[4] is None else float(parts[4])
        if pitch_mm == 0.0:
            raise InputError(f"--board {text}: {parts[4]}mm is no side of a square: write such as 25mm")
        return cls(parts[1], int(parts[3]), int(parts[2]), int(parts[5] or 0), pitch_mm)

    def __str__(self) -> str:
        """Kind, columns, rows, the side of a square if it is stated, and the first tag unless it is 0."""
        pitch = "" if self.pitch_mm is None else f":{self.pitch_mm:g}mm"
        first = f":first={self.first}" if self.first else ""
        return f"{self.kind}:{self.columns}x{self.rows}{pitch}{first}"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of inner corners, which are the markers."""
        less = int(self.kind == "charuco")
        return self.rows - less, self.columns - less

    @property
    def symmetric(self) -> bool:
        """Whether it looks the same turned by half a turn."""
        return self.kind == "circles" or (self.kind == "chessboard" and (self.rows + self.columns) % 2 == 0)

    @property
    def staggered(self) -> bool:
        """Whether odd rows are moved by half of a step."""
        return self.kind == "acircles"

    @property
    def grid_points(self) -> FloatArray:
        """Places (N, 2) of the corners on the board, in squares, or in rows of circles."""
        rows, columns = self.shape
        return StatedBoard(0, columns, rows, None, self.staggered).positions_of(np.arange(rows * columns))


class BoardFinder(Finder):
    """Detector of one board, which is tag 0.

    dictionary : of the tags on a ChArUco board.
    Raises InputError if OpenCV is not installed, has no such dictionary, or the board more tags than it.
    """

    def __init__(self, board: Board, dictionary: str) -> None:
        super().__init__()
        self.board, self.corners = board, math.prod(board.shape)
        self._detectors, self._numbers = [], np.empty(0, dtype=np.int64)
        if board.kind == "charuco":
            tags, needed = _dictionary(dictionary), board.rows * board.columns // 2
            if board.first + needed > len(tags.bytesList):
                after = f" from tag {board.first} on" if board.first else ""
                raise InputError(
                    f"a board {board} has {needed} tags{after}, and dictionary {dictionary} "
                    f"{len(tags.bytesList)}: set the dictionary that it was printed with"
                )
            self._numbers = board.first + np.arange(needed)
            size = board.columns, board.rows
            for legacy in (False, True):  # boards of even rows printed before OpenCV 4.6 begin otherwise
                printed = self.cv.aruco.CharucoBoard(size, 1.0, _TAG_SHARE, tags, self._numbers)
                printed.setLegacyPattern(legacy)
                aruco = self.cv.aruco
                self._detectors.append(
                    aruco.CharucoDetector(printed, aruco.CharucoParameters(), _parameters())
                )

    def mirrored(self, shown: Sequence[StoredImage]) -> int:
        """Number of images of files that show the board when they are mirrored, if it has tags."""
        return super().mirrored(shown) if self._detectors else 0

    def absent(self, shown: Sequence[StoredImage]) -> Finding:
        """Return that the board is in no image, and which other tags of its dictionary are."""
        seen = set[int]()
        if self._detectors:
            finder = self.cv.aruco.ArucoDetector(self._detectors[0].getBoard().getDictionary(), _parameters())
            for one in shown:
                numbers = finder.detectMarkers(one.grey().astype(np.uint8))[1]
                seen |= set() if numbers is None else {*np.ravel(numbers).tolist()}
        if seen <= {*self._numbers.tolist()}:
            return Finding("no_board", REFUSES, Subject(name=str(self.board)), len(shown), unit="1")
        low, high = self._numbers[[0, -1]].tolist()
        tags = Finding("tags", amount=min(seen), limit=max(seen), unit="1")
        board = Finding("board", subject=Subject(name=str(self.board._replace(first=min(seen)))))
        own = Subject(name=str(self.board), markers=(low, high))
        return Finding("other_board", REFUSES, own, len(shown), unit="1", others=(tags, board))

    def find(self, image: FloatArray) -> tuple[dict[int, Corners], tuple[int, ...]]:
        """Corners (N, …) of the board in an image as tag 0, NaN where unseen; none without it.

        image : (height, width) grey values from 0 to 255.
        """
        for guess in self._guesses(image.astype(np.uint8)):
            seen = self.board.grid_points[np.isfinite(guess[:, 0])]
            if len(seen) < _LEAST_CORNERS or np.linalg.matrix_rank(seen - seen[0]) < 2:
                continue
            _, steps = self._grid(self.board.grid_points, guess)
            corners, light = _refine_saddles(image, guess, steps, _CROSS if self._detectors else np.inf)
            corners = self._smooth(self.board.grid_points, corners)
            light *= (-1.0) ** self.board.grid_points.sum(axis=1)
            contrast = np.median(light[corners.clean]) if corners.clean.any() else 1.0
            usual = (np.abs(light / contrast - 1.0) < _UNLIKE) | ~corners.clean
            shows = (usual & np.isfinite(corners.sigma)).reshape(self.board.shape)
            # OpenCV makes up a side that is covered, and then all numbers are wrong.
            if self._detectors or min(s.sum() for s in (*shows[[0, -1]], *shows.T[[0, -1]])) > 1:
                return {0: corners}, ()
        return {}, ()

    def _smooth(self, positions: FloatArray, corners: Corners) -> Corners:
        """Reject, one by one, corners off the smooth map of the others, as if a cover took an edge.

        The map is a homography, and a polynomial as of a lens. It may err as it does at most corners.
        """
        left = np.isfinite(corners.sigma)
        while left.sum() > 2 * _LEAST_CORNERS:
            plane = self._grid(positions, np.where(left[:, None], corners.pixels, np.nan))[0][left]
            x, y = ((plane - plane.mean(axis=0)) / np.ptp(plane)).T
            degree, sigma = min(_DEGREE, math.isqrt(left.sum() // 4)), corners.sigma[left, None]
            terms = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
            basis = np.linalg.qr(np.transpose(terms) / sigma)[0]
            r = (corners.pixels[left] - plane) / sigma
            free = np.maximum(1.0 - (basis**2).sum(axis=1), 1e-9)
            off = np.linalg.norm(r - basis @ (basis.T @ r), axis=1) / np.sqrt(free)
            if off.max() < _OUTLYING * max(1.0, float(np.median(off))):
                break
            left[np.flatnonzero(left)[np.argmax(off)]] = False
        pixels, sigma = (np.where(left, part.T, np.nan).T for part in corners[:2])
        return Corners(pixels, sigma, corners.clean & left)

    def _grid(self, positions: FloatArray, guess: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Corners (N, 2) of a plane grid, and steps (2, N, 2) to the next ones, px, by those seen."""
        known = np.isfinite(guess[:, 0])
        H = self.cv.findHomography(positions[known], guess[known])[0]
        if H is None:
            H = np.full((3, 3), np.nan)
        here, *there = (
            self.cv.perspectiveTransform((positions + step)[None], H)[0] for step in ((0, 0), (1, 0), (0, 1))
        )
        return here, np.stack(there) - here

    def like(self, tags: dict[int, Corners], before: dict[int, Corners] | None) -> dict[int, Corners]:
        """Return the board numbered from the end that moved by the smaller distance since the last frame."""
        if not tags or not before or not self.board.symmetric:
            return tags
        found, numberings = tags[0], board_numberings(*self.board.shape)
        ends = [Corners(found.pixels[k], found.sigma[k], found.clean[k]) for k in numberings]
        far = [np.nanmedian(np.linalg.norm(end.pixels - before[0].pixels, axis=1)) for end in ends]
        return {0: ends[int(np.argmin(far))]}

    def _guesses(self, grey: ByteArray) -> Iterator[FloatArray]:
        """Corners (N, 2), px, NaN where unseen: as of OpenCV, then corners of a covered chessboard."""
        if not self._detectors:
            size = self.board.shape[::-1]
            found, corners = self.cv.findChessboardCornersSB(grey, size, flags=self.cv.CALIB_CB_EXHAUSTIVE)
            if found:
                yield self._turned(corners.reshape(*self.board.shape, 2).astype(np.float64), grey)
            yield self._turned(self._part(grey), grey)
            return
        guess = np.full((self.corners, 2), np.nan)
        found = [detector.detectBoard(grey)[:2] for detector in self._detectors]
        corners, numbers = max(found, key=lambda one: 0 if one[1] is None else len(one[1]))
        if numbers is not None:
            guess[np.ravel(numbers)] = np.reshape(corners, (-1, 2))
        yield guess

    def _turned(self, seen: FloatArray, grey: ByteArray) -> FloatArray:
        """Corners (N, 2) of a grid (r, c, 2) of a chessboard, px; NaN if it has another shape.

        As OpenCV numbers them, the square after the first corner is bright, if a turn of the board makes it.
        """
        grids = [grid for grid in (np.rot90(seen, k) for k in range(4)) if grid.shape[:2] == self.board.shape]

        def lightness(grid: FloatArray) -> float:
            """Sum of grey values of the squares alike the first, less the sum of the others."""
            middles = 0.25 * (grid[1:, 1:] + grid[1:, :-1] + grid[:-1, 1:] + grid[:-1, :-1])
            known = np.isfinite(middles[..., 0])
            u, v = np.rint(middles[known]).astype(np.int64).T
            even = np.indices(known.shape).sum(axis=0)[known] % 2 == 0
            return float(np.where(even, 1.0, -1.0) @ grey[v, u])

        nothing = np.full((*self.board.shape, 2), np.nan)
        return np.asarray(max(grids, key=lightness, default=nothing).reshape(-1, 2))

    def _part(self, grey: ByteArray) -> FloatArray:
        """Grid (r, c, 2) of the corners of a chessboard that is partly covered, px, NaN where covered.

        It grows from a square. Each side of the board must show by two corners: otherwise the numbers are not
        known, and the grid is empty.
        """
        image, most = grey.astype(np.float64), 3 * max(self.board.shape)
        positions = np.indices((most, most))[::-1].reshape(2, -1).T.astype(np.float64)
        even, seen = (-1.0) ** positions.sum(axis=1), np.empty((0, 2))
        start = np.isin(np.arange(most**2), (most + 1) * (most // 3) + np.array([0, 1, most, most + 1]))
        for square in self._squares(image):
            if (np.linalg.norm(seen - square[0], axis=1) < _MIN_SQUARE).any():
                continue
            pixels, sigma = np.full((most**2, 2), np.nan), np.full(most**2, np.nan)
            pixels[start], near, usual, reach = square, start, 0.0, 1
            known = tried = np.zeros_like(start)
            while reach <= _GAP and (near is start or known.sum() >= len(square)):
                guess, steps = self._grid(positions, pixels)
                fitted, light = _refine_saddles(image, np.where(near[:, None], guess, np.nan), steps, np.inf)
                usual = usual or float(np.median((light * even)[near]))
                new = fitted.clean & (np.abs(light * even / usual - 1.0) < _UNLIKE)
                new &= fitted.sigma < _VAGUE * np.linalg.norm(steps, axis=2).min(axis=0)
                pixels[new], sigma[new] = fitted.pixels[new], fitted.sigma[new]
                known, reach = known | new, 1 if new.any() else reach + 1
                tried = tried | near & (known.sum() > 2 * _LEAST_CORNERS)
                grown = known.reshape(most, most).astype(np.uint8)
                grown = self.cv.dilate(grown, np.ones((2 * reach + 1, 2 * reach + 1)))
                near = grown.ravel() > tried | known
            seen = np.concatenate([seen, pixels[known]])
            grid = self._smooth(positions, Corners(pixels, sigma, known)).pixels.reshape(most, most, 2)
            for _ in range(2):  # rows, then columns
                lines = np.flatnonzero(np.isfinite(grid[..., 0]).sum(axis=1) > 1)
                grid = grid[min(lines, default=0) : max(lines, default=-1) + 1].swapaxes(0, 1)
            if sorted(grid.shape[:2]) == sorted(self.board.shape):
                return grid
        return np.empty((0, 0, 2))

    def _squares(self, image: FloatArray) -> Iterator[FloatArray]:
        """Corners (4, 2) of squares that may be of a chessboard, px, the clearest first.

        They are saddles of the grey values. The next one is where an edge leads, and has the other sign.
        """
        smooth = self.cv.GaussianBlur(image, (0, 0), _SEED_BLUR)
        xx, xy, yy = (self.cv.Sobel(smooth, -1, *order) for order in ((2, 0), (1, 1), (0, 2)))
        depth = xy**2 - xx * yy
        depth[depth < self.cv.dilate(depth, np.ones((5, 5)))] = 0.0
        v, u = np.unravel_index(np.argsort(-depth, axis=None)[: _SADDLES * self.corners], depth.shape)
        at, H = np.stack([u, v], axis=1).astype(np.float64), np.array([[xx, xy], [xy, yy]])[..., v, u].T
        for k, (bends, axes) in enumerate(zip(*np.linalg.eigh(H[:_STARTS]), strict=True)):
            way, deep = at - at[k], depth[v, u] > _FAINT * depth[v[k], u[k]]
            other = deep & (axes[:, 1] @ H @ axes[:, 1] < 0.0) & (np.abs(way).max(axis=1) > _MIN_SQUARE)
            # Along an edge the grey value does not bend.
            edges = np.sqrt(np.abs(bends[::-1])) * [[1.0, 1.0], [-1.0, 1.0]] @ axes.T
            along, across = np.abs(edges @ way.T), np.abs(edges[:, ::-1] * [1.0, -1.0] @ way.T)
            length = np.where(other & (across < _SLOPE * along), along, np.inf)
            if np.isfinite(length.min(axis=1)).all():
                a, b = way[length.argmin(axis=1)]
                a, b = (a, b) if a[0] * b[1] > a[1] * b[0] else (b, a)
                yield at[k] + [0.0 * a, a, b, a + b]


class CircleFinder(BoardFinder):
    """Detector of a grid of circles, all of which show: dark on bright ground, or bright on dark."""

    def find(self, image: FloatArray) -> tuple[dict[int, Corners], tuple[int, ...]]:
        """Middles (N, …) of the circles in an image as tag 0; none without all of them.

        image : (height, width) grey values from 0 to 255.
        """
        cv, (rows, columns), grey = self.cv, self.board.shape, image.astype(np.uint8)
        blobs = cv.SimpleBlobDetector_Params()
        blobs.maxArea, blobs.minDistBetweenBlobs = float(image.size) / self.corners, 1.0
        grid = cv.CALIB_CB_ASYMMETRIC_GRID if self.board.staggered else cv.CALIB_CB_SYMMETRIC_GRID
        for shade, more in product((grey, 255 - grey), (0, cv.CALIB_CB_CLUSTERING)):
            blob = cv.SimpleBlobDetector_create(blobs)
            found, guess = cv.findCirclesGrid(shade, (columns, rows), flags=grid | more, blobDetector=blob)
            if found:
                guess = guess.reshape(-1, 2).astype(np.float64)
                if np.linalg.det(self._grid(self.board.grid_points, guess)[1][:, 0]) < 0.0:  # from behind
                    guess = guess.reshape(rows, columns, 2)[::-1].reshape(-1, 2)
                corners = self._smooth(self.board.grid_points, self._middles(image, guess))
                return ({0: corners} if 2 * corners.clean.sum() > self.corners else {}), ()
        return {}, ()

    def _middles(self, image: FloatArray, guess: FloatArray) -> Corners:
        """Middles of circles: those of grey values over the ground, carried from ellipses to circles."""
        positions, pixels, sigma = self.board.grid_points, guess.copy(), np.full(self.corners, np.nan)
        half, radii = np.sqrt(0.25 + 0.25 * self.board.staggered), [0.0]
        light = np.full(self.corners, np.nan)
        for k, J in enumerate(self._grid(positions, guess)[1].transpose(1, 2, 0)):
            reach = half * np.linalg.norm(J, axis=1)
            low, high = np.floor(guess[k] - reach).astype(int), np.ceil(guess[k] + reach).astype(int) + 1
            at = np.indices(high - low).reshape(2, -1).T + low
            far = np.linalg.norm(np.linalg.solve(J, (at - guess[k]).T), axis=0) / half
            if (low < 0).any() or (high > image.shape[::-1]).any():
                continue
            at, far, grey = at[far < 1.0], far[far < 1.0], image[at[:, 1], at[:, 0]][far < 1.0]
            plane, ground = np.column_stack([np.ones(len(at)), at - guess[k]]), far > _GROUND
            w = grey - plane @ np.linalg.lstsq(plane[ground], grey[ground])[0]
            light[k] = np.median(w[far <= max(_INSIDE, far.min())])
            if not (area := w.sum() / light[k]) > 0.0:
                continue
            pixels[k], spread = w @ at / w.sum(), np.square(at - guess[k]).sum(axis=1) / 2.0
            # Pixels of the ground take part in its slope, which errs too.
            error = w[ground].std() * np.sqrt(spread.sum() * (spread.sum() / spread[ground].sum() - 1.0))
            sigma[k] = np.hypot(_CIRCLE_FLOOR, error / abs(w.sum()))
            radii.append(np.sqrt(area / (np.pi * abs(np.linalg.det(J)))))
        H = self.cv.findHomography(positions, guess)[0]
        ends = np.column_stack([positions, np.ones(self.corners)]) @ H.T
        ellipse = ends[:, :, None] * ends[:, None] - np.median(radii) ** 2 * (H[:, :2] @ H[:, :2].T)
        pixels -= ellipse[:, :2, 2] / ellipse[:, 2:, 2] - ends[:, :2] / ends[:, 2:]
        sigma[np.abs(light / np.nanmedian([*light, 1.0]) - 1.0) > _UNLIKE] = np.nan
        return Corners(pixels, sigma, np.isfinite(sigma))


def _refine_saddles(
    image: FloatArray, guess: FloatArray, steps: FloatArray, cross: float
) -> tuple[Corners, FloatArray]:
    """Refine corners at which four squares meet: two crossing edges of one blur.

    The grey value is b + a (2 Φ(z_1) − 1)(2 Φ(z_2) − 1), z the distance from either edge over the blur. A
    corner is rejected if an edge is occluded or the crossing is far from the guess.

    image : (height, width) grey values.
    guess : (N, 2) corners, px, NaN where unseen.
    steps : (2, N, 2) to the next corners along a row and a column, px.
    cross : distance from the edges up to which pixels count, in squares.
    """
    seen, (height, width) = np.isfinite(guess[:, 0]), image.shape
    length = np.linalg.norm(steps, axis=2)
    side = np.abs(steps[0, :, 0] * steps[1, :, 1] - steps[0, :, 1] * steps[1, :, 0]) / length.max(axis=0)
    reach = np.minimum(_REACH * side, _MAX_REACH_SADDLE)[:, None]
    middle = np.rint(np.where(seen[:, None], guess, -1.0))
    inside = ((middle >= reach) & (middle + reach <= [width - 1, height - 1])).all(axis=1)
    at = np.flatnonzero(seen & inside & (side > _MIN_SQUARE))
    found = Corners(
        guess.copy(), np.where(seen, _UNREFINED_SADDLE, np.nan), np.zeros(len(guess), dtype=np.bool_)
    )
    contrast = np.full(len(guess), np.nan)
    if not at.size:
        return found, contrast
    half = int(reach[at].max())
    dv, du = np.indices((2 * half + 1, 2 * half + 1)).reshape(2, 1, -1) - half
    rows, columns = (middle[at, k, None].astype(int) + shift for k, shift in ((1, dv), (0, du)))
    grey = image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    u, v = columns - guess[at, :1], rows - guess[at, 1:]
    angles = np.arctan2(steps[:, at, 1], steps[:, at, 0])
    off = np.abs(u * np.sin(angles[..., None]) - v * np.cos(angles[..., None])).min(axis=0)
    near = off <= np.maximum(cross * side[at, None], _MIN_CROSS)
    weight = ((du**2 + dv**2 <= reach[at] ** 2) & near).astype(np.float64)
    x = np.zeros((len(at), _SADDLE))
    x[:, 4], x[:, 5:], count = 1.0, angles.T, weight.sum(axis=1)
    # Both grey levels by the product of the edges as they are guessed.
    product = _saddle_model(x, u, v, grey, weight)[1][:, 1]
    x[:, 0] = (weight * grey).sum(axis=1) / count
    x[:, 1] = (product * (grey - x[:, :1])).sum(axis=1) / np.maximum((product**2).sum(axis=1), 1e-9)

    def equations(x: FloatArray) -> Equations:
        r, J = _saddle_model(x, u, v, grey, weight)
        there = Equations.of(r, J.swapaxes(1, 2))
        return there._replace(A=there.A + 1e-9 * np.eye(_SADDLE))

    (x,), there = levenberg_marquardt((x,), equations, partial(_blurred, _MIN_BLUR_SADDLE), _SADDLE_STEPS)
    residual = _saddle_model(x, u, v, grey, weight)[0]
    square = (residual**2).sum(axis=1) / np.maximum(count - _SADDLE, 1.0)
    # Neighbours differ by noise alone: the rest of the residual is of something before the corner.
    grid = len(at), 2 * half + 1, -1
    r, both = residual.reshape(grid), weight.reshape(grid)
    both = both[:, :, 1:] * both[:, :, :-1]
    noise = 0.5 * (both * np.diff(r, axis=2) ** 2).sum(axis=(1, 2)) / np.maximum(both.sum(axis=(1, 2)), 1.0)
    noise *= 1.0 + _CHANCE * np.sqrt(2.0 / count)
    leak = _LEAK_SADDLE[0] * side[at] * ndtr(-_LEAK_SADDLE[1] * side[at] / x[:, 4])
    variance = np.linalg.inv(there.A)[:, [2, 3], [2, 3]].mean(axis=1) * square + _SADDLE_FLOOR**2 + leak**2
    good = (count > _SADDLE) & (square - noise < np.square(_MISFIT * x[:, 1])) & (square < x[:, 1] ** 2)
    good &= np.linalg.norm(x[:, 2:4], axis=1) < _FAR_SADDLE * side[at]
    found.pixels[at] += np.where(good[:, None], x[:, 2:4], np.nan)
    found.sigma[at], found.clean[at] = np.where(good, np.sqrt(variance), np.nan), good
    contrast[at] = x[:, 1]
    return found, contrast


def _saddle_model(
    x: FloatArray, u: FloatArray, v: FloatArray, grey: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Weighted residual (Q, P) of saddles x = (b, a, u_0, v_0, σ, α, β) (Q, 7), and derivative (Q, 7, P)."""
    b, a, u_0, v_0, sigma, *angles = x.T[:, :, None]
    du, dv, edges = u - u_0, v - v_0, []
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        # A pixel is a box. Its extent across the edge counts in full, the other one by its variance.
        wide, narrow = np.maximum(np.abs(c), np.abs(s)), np.minimum(np.abs(c), np.abs(s))
        blur = np.sqrt(sigma**2 + (narrow**2 + (wide / _PARTS) ** 2) / 12.0)
        shares = (np.arange(_PARTS) - 0.5 * (_PARTS - 1)) / _PARTS
        z = (c * dv - s * du + wide * shares[:, None, None]) / blur
        bell = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * z * z) / blur
        wider = (bell * z).mean(axis=0) * sigma / blur
        bell = bell.mean(axis=0)
        # The edge, and its derivatives by u_0, v_0, σ and its angle.
        edge = (2.0 * ndtr(z) - 1.0).mean(axis=0)
        edges.append((edge, np.stack([bell * s, -bell * c, -wider, -bell * (s * dv + c * du)])))
    (g, dg), (h, dh) = edges
    dg, dh = a * h * dg, a * g * dh
    J = np.stack([np.ones_like(g), g * h, *(dg[:3] + dh[:3]), dg[3], dh[3]], axis=1)
    return weight * (b + a * g * h - grey), J * weight[:, None]


def finder_of(board: Board | None, dictionary: str | None) -> Finder:
    """Detector of a board, or of tags if there is none; of the tags of ``DICTIONARY`` without a name."""
    name = dictionary or DICTIONARY
    if board is None or "circles" not in board.kind:
        return TagFinder(name) if board is None else BoardFinder(board, name)
    return CircleFinder(board, name)


def _dictionary(name: str) -> Any:
    """Return a dictionary of OpenCV; an InputError lists the valid names."""
    known, aruco = dictionaries(), opencv().aruco
    given = known.get(name.upper().removeprefix("DICT_"))
    if given is None:
        raise InputError(f"--dictionary {name}: unknown; valid: {', '.join(sorted(known))}")
    return aruco.getPredefinedDictionary(getattr(aruco, given))


def _parameters() -> Any:
    """Parameters of the detector of tags."""
    aruco = opencv().aruco
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    # Shaded tags before brighter ground need windows of more sizes, and less contrast.
    parameters.adaptiveThreshWinSizeStep, parameters.adaptiveThreshConstant = 4, 5
    return parameters


def dictionaries() -> dict[str, str]:
    """Names of all dictionaries of tags, and as OpenCV names them."""
    names = [name for name in dir(opencv().aruco) if name.startswith("DICT_")]
    return {name.upper().removeprefix("DICT_"): name for name in names}
