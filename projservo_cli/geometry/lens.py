"""Radial lens distortion: maps between undistorted and distorted pixels.

Source: D. C. Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971, the
first two radial terms. A view's lens is (5,): image centre u, v and a radius, px, then k1 and k2 in units of
that radius; both zero means none. The projective cameras of [RH00] have undistorted pixels, and cameras
report distorted ones. Beyond some radius the model may fold back; pixels there have no counterpart.
"""

import math
from typing import TypeVar

import numpy as np

from projservo_cli.geometry.jit import merged, njit
from projservo_cli.records import BoolArray, FloatArray

# Index of k1 in a lens; k2 follows.
K1 = 3
# Indices of the terms of a lens that an adjustment may estimate, in this order: k1, k2, u, v.
TERMS = (3, 4, 0, 1)
# Maximum number of Newton steps for an undistorted radius.
_MAX_STEPS = 50
# Newton step, over the radius, that is the last: the next would be its square, below round-off.
_SETTLED = 1e-9

_Number = TypeVar("_Number", float, FloatArray)


def _factor(k1: _Number, k2: _Number, square: _Number) -> _Number:
    """Factor 1 + k1 ρ² + k2 ρ⁴ of a radius, from its square."""
    return 1.0 + square * (k1 + square * k2)


def _factor_rate(k1: _Number, k2: _Number, square: _Number) -> _Number:
    """Derivative k1 + 2 k2 ρ² of the factor by the square of the radius."""
    return k1 + 2.0 * (square * k2)


def _fold_limit(k1: float, k2: float) -> float:
    """Square of the radius at which ρ (1 + k1 ρ² + k2 ρ⁴) folds back, infinite if it does not."""
    inner = 9.0 * (k1 * k1) - 20.0 * k2
    if not inner >= 0.0:
        return math.inf
    root = math.sqrt(inner) - 3.0 * k1
    return 2.0 / root if root > 0.0 else math.inf


# Compiled versions for the kernels, which call compiled functions only.
_compiled_factor = njit(_factor)
_compiled_rate = njit(_factor_rate)
_compiled_limit = njit(_fold_limit)


@merged
def _scaled_from_center(lens: FloatArray, factor: float, u: float, v: float) -> tuple[float, float]:
    """Scale the distance of a pixel from the image centre."""
    u0, v0 = float(lens[0]), float(lens[1])
    return u0 + factor * (u - u0), v0 + factor * (v - v0)


@merged
def _undistorted_radius(k1: float, k2: float, radius: float) -> float:
    """Undistorted radius of a distorted one, by Newton steps within a bracket; NaN if there is none."""
    low = 0.0
    limit = _compiled_limit(k1, k2)
    if limit < math.inf:
        high = math.sqrt(limit)
        if not radius < high * _compiled_factor(k1, k2, limit):
            return math.nan
    else:
        high = radius
        while high * _compiled_factor(k1, k2, high * high) < radius:
            high *= 2.0
    rho = min(radius, high)
    for _ in range(_MAX_STEPS):
        square = rho * rho
        factor = _compiled_factor(k1, k2, square)
        slope = factor + 2.0 * (square * _compiled_rate(k1, k2, square))
        excess = rho * factor - radius
        if excess > 0.0:
            high = rho
        else:
            low = rho
        step = -excess / slope if slope > 0.0 else math.inf
        if abs(step) <= _SETTLED * radius:
            return rho + step
        rho = rho + step if low < rho + step < high else 0.5 * (low + high)
    return math.nan


@njit
def undistort_pixel(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Undistort a pixel; NaN if no pixel before the fold distorts to it."""
    k1, k2 = float(lens[3]), float(lens[4])
    if k1 == 0.0 and k2 == 0.0:
        return u, v
    x = (u - float(lens[0])) / float(lens[2])
    y = (v - float(lens[1])) / float(lens[2])
    radius = math.sqrt(x * x + y * y)
    if radius == 0.0:
        return u, v
    if not radius < math.inf:
        return math.nan, math.nan
    return _scaled_from_center(lens, _undistorted_radius(k1, k2, radius) / radius, u, v)


@merged
def distorts(lens: FloatArray) -> bool:
    """Whether any of the lenses (V, 5) distorts."""
    for view in range(lens.shape[0]):
        if float(lens[view, 3]) != 0.0 or float(lens[view, 4]) != 0.0:
            return True
    return False


@merged
def undistort_into(lens: FloatArray, s: FloatArray, straight: FloatArray) -> None:
    """Undistort pixels (V, N, 2) by lenses (V, 5) into ``straight``; NaN as for ``undistort_pixel``."""
    for view in range(s.shape[0]):
        for k in range(s.shape[1]):
            pixel = undistort_pixel(lens[view], float(s[view, k, 0]), float(s[view, k, 1]))
            straight[view, k, 0] = pixel[0]
            straight[view, k, 1] = pixel[1]


@njit
def distort_pixel(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Distort a pixel; NaN beyond the fold."""
    k1, k2 = float(lens[3]), float(lens[4])
    if k1 == 0.0 and k2 == 0.0:
        return u, v
    x = (u - float(lens[0])) / float(lens[2])
    y = (v - float(lens[1])) / float(lens[2])
    square = x * x + y * y
    if not square < _compiled_limit(k1, k2):
        return math.nan, math.nan
    return _scaled_from_center(lens, _compiled_factor(k1, k2, square), u, v)


def _offsets(lens: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (..., 2) from the centre in units of the radius, and the squares of their length (...)."""
    x = (pixels - lens[..., :2]) / lens[..., 2:3]
    return x, np.asarray((x**2).sum(axis=-1))


def distort(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """Distort pixels (..., 2) by lenses (..., 5), beyond the fold too; the vectorised ``distort_pixel``."""
    _, square = _offsets(lens, pixels)
    factor = _factor(lens[..., 3], lens[..., 4], square)[..., None]
    result: FloatArray = lens[..., :2] + factor * (pixels - lens[..., :2])
    return result


def undistort(lens: FloatArray, s: FloatArray) -> FloatArray:
    """Undistort pixels (V, N, 2), NaN if unseen, by lenses (V, 5); the pixels themselves without a lens."""
    s = np.ascontiguousarray(s, dtype=np.float64)
    if not distorts(lens):
        return s
    straight = np.empty_like(s)
    undistort_into(lens, s, straight)
    return straight


def before_fold(lens: FloatArray, pixels: FloatArray) -> BoolArray:
    """Mask (...) of undistorted pixels (..., 2) before the fold of a lens (..., 5)."""
    _, square = _offsets(lens, pixels)
    limit = np.vectorize(_fold_limit, otypes=[np.float64])(lens[..., 3], lens[..., 4])
    return np.asarray(square < limit)


def distort_visible(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """Distort pixels as cameras report them, NaN beyond the fold; the pixels themselves without a lens."""
    if not lens[..., K1:].any():
        return pixels
    return np.where(before_fold(lens, pixels)[..., None], distort(lens, pixels), np.nan)


def distort_derivative(lens: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of distorted pixels by undistorted ones (..., 2, 2), and by k1, k2, u, v (..., 2, 4).

    A common shift of the image centre and of the undistorted pixel shifts the distorted one alike.
    """
    x, square = _offsets(lens, pixels)
    k1, k2 = lens[..., 3], lens[..., 4]
    rate = 2.0 * _factor_rate(k1, k2, square)
    by_pixel = rate[..., None, None] * (x[..., :, None] * x[..., None, :])
    by_pixel = by_pixel + _factor(k1, k2, square)[..., None, None] * np.eye(2)
    powers = np.stack([square, square**2], axis=-1)
    by_terms = (lens[..., 2:3] * x)[..., :, None] * powers[..., None, :]
    return by_pixel, np.concatenate([by_terms, np.eye(2) - by_pixel], axis=-1)
