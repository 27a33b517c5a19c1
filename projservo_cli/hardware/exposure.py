"""Brightness and blur of a camera image, and whether they do for markers."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.records import ByteArray

# Mean grey value, of 255, below which an image is dark, and share of clipped pixels that is too much.
_DARK, _CLIPPED_SHARE = 20.0, 0.2
# Grey value from which white is clipped.
_WHITE = 252
# Blur of the sharpest edges of an image, px, from which it is blurred: corners then lose half their accuracy.
_BLURRED = 2.5
# Number of edges that show the blur, and half the width within which their contrast is taken, px.
_EDGES, _REACH = 300, 6


class _Exposure(NamedTuple):
    """Exposure and sharpness of a frame."""

    mean: float  # grey value
    brightest: float  # grey value
    clipped: float  # share of pixels that are white
    blur_px: float  # standard deviation of the blur of its sharpest edges; NaN if it has none

    def faults(self, view: str) -> Iterator[Finding]:
        """Yield the errors of the frame of a view; none for a sound one."""
        where = Subject(views=(view,))
        if self.brightest < _DARK:
            yield Finding("black_image", REFUSES, where, self.brightest, limit=_DARK)
        elif self.mean < _DARK:
            yield Finding("dark_image", LIMITS, where, self.mean, limit=_DARK)
        if self.clipped > _CLIPPED_SHARE:
            yield Finding("saturated_image", LIMITS, where, self.clipped, limit=_CLIPPED_SHARE, unit="1")
        if self.blur_px > _BLURRED:
            yield Finding("blurred_image", LIMITS, where, self.blur_px, limit=_BLURRED, unit="px")


def exposure_of(grey: ByteArray) -> _Exposure:
    """Measure a frame (height, width).

    An edge of contrast c, blurred by a normal distribution of deviation σ, has the slope c/(σ √(2π)).
    """
    import cv2

    level = cv2.GaussianBlur(grey, (3, 3), 0).astype(np.float32)
    slope = np.hypot(cv2.Sobel(level, cv2.CV_32F, 1, 0) / 8.0, cv2.Sobel(level, cv2.CV_32F, 0, 1) / 8.0)
    kernel = np.ones((2 * _REACH + 1, 2 * _REACH + 1), dtype=np.uint8)
    contrast = cv2.dilate(level, kernel) - cv2.erode(level, kernel)
    steepest = np.argpartition(slope.ravel(), -_EDGES)[-_EDGES:]
    c, s = contrast.ravel()[steepest], slope.ravel()[steepest]
    edges = c > _DARK
    blur = float(np.median(c[edges] / s[edges])) / math.sqrt(2.0 * math.pi) if edges.sum() > 20 else math.nan
    return _Exposure(float(grey.mean()), float(grey.max()), float((grey >= _WHITE).mean()), blur)
