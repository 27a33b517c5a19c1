"""Robust statistics of residuals: deviations by medians, and the weights of the Cauchy loss.

Fits by reweighting solve other equations in each round, in closed form and many at once, so that each keeps
its own loop: two-view geometry, rigid motions, axis points and the adjustment.
"""

import numpy as np

from projservo_cli.records import FloatArray

# Median of |x| over the standard deviation of a normal variable.
MAD = 0.6744897501960817
# Median of the length of a two-dimensional normal vector of unit deviation.
RAYLEIGH = 1.1774100225154747


def deviation(residual: FloatArray, floor: float) -> float:
    """Robust standard deviation of residuals about zero, at least ``floor``."""
    return max(float(np.median(np.abs(residual))) / MAD, floor)


def cauchy_weights(square: FloatArray) -> FloatArray:
    """Weights (…) of the Cauchy loss log(1 + x²), by the squares x² of residuals over its width."""
    return np.asarray(1.0 / (1.0 + square))
