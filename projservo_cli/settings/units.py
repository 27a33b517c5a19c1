"""Units of values in configurations: those that look like another one are told."""

import math
import re
from typing import Any

import numpy as np

from projservo_cli.records import FARTHEST_M

# Largest value of a key by its name: of lengths such as those on the tool, m, and of short times, s.
_LARGEST = (
    (re.compile(r"(tag_)?size_m|positions_m"), 2.0, "millimetres"),
    (re.compile(r"\w+_m"), FARTHEST_M, "millimetres"),
    (re.compile(r"(period|settle|time_offset|camera_latency|max_servo_lag|max_age)_s"), 10.0, "milliseconds"),
)


def of_another_unit(key: str, value: Any) -> str:
    """Tell that lengths or times of a key look like those in another unit; empty if not."""
    most, unit = next(((most, unit) for name, most, unit in _LARGEST if name.fullmatch(key)), (math.inf, ""))
    largest = max((abs(x) for x in np.ravel(value) if isinstance(x, float)), default=0.0) if unit else 0.0
    return (
        f"{largest:g} is more than {most:g}: it looks like {unit}; divide by 1000" if largest > most else ""
    )
