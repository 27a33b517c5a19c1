"""Joints at which a calibration predicts given images."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from projservo_cli.calibration.prediction import predict
from projservo_cli.records import Calibration, FloatArray

# Starts from which joints are sought; how near they must come, and the error of points behind cameras, px.
_TRIALS, NEAR_PX, _FAR_PX = 60, 1.0, 1e3


def joints_showing(
    calibration: Calibration,
    numbers: Sequence[int],
    s: FloatArray,
    q_start: FloatArray,
    near_px: float = NEAR_PX,
) -> tuple[FloatArray, float]:
    """Joints (n,) at which markers are predicted where images (V, b, 2) show them, and the median error, px.

    Least squares from joints (n,) and from others about them, until a start leads near enough; otherwise the
    nearest. s : NaN where unseen.
    """
    places, seen, rng = calibration.indices_of(numbers), np.isfinite(s), np.random.default_rng(0)

    def off(q: FloatArray) -> FloatArray:
        """Return the prediction errors, px; large behind a camera."""
        return np.asarray(np.nan_to_num(predict(calibration, q[None])[0][:, places] - s, nan=_FAR_PX)[seen])

    best, least = q_start, math.inf
    for trial in range(_TRIALS):
        q = q_start + (trial > 0) * rng.uniform(-np.pi, np.pi, len(q_start))
        found = least_squares(off, q, loss="soft_l1", f_scale=near_px).x
        median = float(np.median(np.abs(off(found))))
        if median < least:
            best, least = found, median
        if median <= near_px:
            break
    return best, least
