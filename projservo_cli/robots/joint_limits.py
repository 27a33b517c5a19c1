"""Joints of a robot, and their limits."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.detections import per_rad
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.records import FloatArray, JointLimits, WorkFailed
from projservo_cli.robots.contract import Bounds


class Joints(NamedTuple):
    """Knowledge of the joints of a robot."""

    types: str  # one letter a joint, R or P
    limits: JointLimits  # infinite if none is set; accelerations of the profile joint_space alone
    units: tuple[str, ...]  # units of readings in messages: deg, rad or m

    def length_of(self, degrees: float) -> FloatArray:
        """An angle as (n,) rad, for prismatic joints the length, m, that makes as much of a difference."""
        return math.radians(degrees) * per_rad(np.array([*self.types]) == "P")

    def limit_passed(self, q: FloatArray) -> Finding | None:
        """Return which of the readings (n,), rad or m, lies beyond its limits; None if none does."""
        return limit_passed(q, self.limits, self.types)


def limit_passed(q: FloatArray, limits: JointLimits, types: str) -> Finding | None:
    """Return which of the readings (n,), rad or m, lies beyond its limits; None if none does."""
    for i in np.flatnonzero((q < limits.lower) | (q > limits.upper)).tolist():
        unit, joint = "m" if types[i] == "P" else "rad", Subject(joints=(i + 1,))
        ends = (Finding("range", amount=limits.lower[i], limit=limits.upper[i], unit=unit),)
        return Finding("limit_passed", REFUSES, joint, q[i], unit=unit, others=ends)
    return None


def require_no_turn_off(bounds: Bounds, q: FloatArray) -> None:
    """Refuse joints (n,) of which one reads a whole turn off: it would turn back by that, with its cables."""
    lower, upper = bounds.limits.lower, bounds.limits.upper
    beyond = ((q < lower) | (q > upper)) & np.isfinite(upper - lower)
    for i in np.flatnonzero(beyond).tolist():
        turns = np.round((q[i] - 0.5 * (lower[i] + upper[i])) / (2.0 * np.pi))
        if bounds.units[i] == "m" or not lower[i] <= q[i] - 2.0 * np.pi * turns <= upper[i]:
            continue
        limits = f"{bounds.text(i, lower[i])} to {bounds.text(i, upper[i])}"
        raise WorkFailed(
            f"nothing was moved: joint {i + 1} reads {bounds.text(i, q[i])}, a whole turn beyond its limits "
            f"{limits}: home it again where it stands"
        )
