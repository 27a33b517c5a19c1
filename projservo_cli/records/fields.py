"""Types of arrays, and how a record declares its fields."""

from dataclasses import field
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


# Dimensions that have the same size in every record.
SIZES = {
    "view": 2,
    "xy": 2,
    "image_row": 3,
    "row": 4,
    "coordinate": 4,
    "axis": 3,
    "part": 3,
    "solution": 2,
    "lens_term": 5,
    "outlier_column": 3,
    "suspect_column": 2,
    "swap_column": 3,
    "law": 2,
    "operators": 2,
    "limit": 2,
}


def array(*dims: str, units: str = "1", about: str = "", **default: Any) -> Any:
    """Declare an array field: the names of its dimensions, its unit and what it holds."""
    return field(metadata={"dims": dims, "units": units, "about": about}, **default)


def scalar(units: str = "1", about: str = "", **default: Any) -> Any:
    """Declare a scalar or text field with its unit and what it holds."""
    return field(metadata={"units": units, "about": about}, **default)
