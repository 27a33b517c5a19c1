"""Types of arrays, and how a record declares its fields."""

from dataclasses import field
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


def array(*dims: str, units: str = "1", about: str = "", **default: Any) -> Any:
    """Declare an array field: the names of its dimensions, its unit and what it holds."""
    return field(metadata={"dims": dims, "units": units, "about": about}, **default)


def scalar(units: str = "1", about: str = "", **default: Any) -> Any:
    """Declare a scalar or text field with its unit and what it holds."""
    return field(metadata={"units": units, "about": about}, **default)
