"""What figures are made from: the records of a run, the truth behind it, and the extra runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from projservo_cli.control.law import Gains
from projservo_cli.records import (
    IMAGE_TRACK,
    REPLAN,
    TRACK,
    Calibration,
    CrossValidation,
    FloatArray,
    Model,
    Observation,
    Plan,
    Trace,
    law_and_mode,
)
from projservo_cli.robots.simulated import Plant
from projservo_cli.robots.truth import Robot

Data = dict[str, npt.NDArray[Any]]
"""Named arrays behind one figure."""

DIRECT = ("direct_three", "direct_two")
CLASSICAL = ("stacked", "blockwise", "euclidean_points")
TITLES = {
    "direct_three": "directTHREE",
    "direct_two": "directTWO",
    "stacked": "stacked Jacobians",
    "blockwise": "block-wise",
    "euclidean_points": "Euclidean points",
}
VIEWS = ("left", "right")


def title(name: str) -> str:
    """Name of a run as the figures write it: that of its law, and whether it follows the plan."""
    law, mode = law_and_mode(name)
    follows = {TRACK: ", following the plan", IMAGE_TRACK: ", following planned images"}
    return TITLES.get(law, law) + follows.get(mode, "")


@dataclass(frozen=True, eq=False)
class Studies:
    """Closed-loop runs beside those of the run file, all without noise.

    Operators are ``true`` (metric), ``twin`` (the same in a projective frame) or ``calibrated``.

    Attributes
    ----------
    gains : gains per step that are swept.
    periods : periods, s, that are swept at the configured gains.
    gains_of_laws : the configured gains.
    step_limit_deg : joint motion per step of the limited runs, deg.
    sweep : runs by (law, operators, limited, gain per step).
    own : runs with the configured gains by (law, operators, limited).
    rate : runs with true operators by (law, period).
    """

    gains: tuple[float, ...]
    periods: tuple[float, ...]
    gains_of_laws: Gains
    step_limit_deg: float
    sweep: Mapping[tuple[str, str, bool, float], Trace]
    own: Mapping[tuple[str, str, bool], Trace]
    rate: Mapping[tuple[str, float], Trace]


@dataclass(frozen=True, eq=False)
class Fit:
    """What the figures of a calibration show; a recorded run may hold no more.

    Attributes
    ----------
    calibration : the calibration.
    observation : what it was made from.
    held_out : its cross-validation, if there is one.
    """

    calibration: Calibration
    observation: Observation
    held_out: CrossValidation | None = field(default=None, kw_only=True)


@dataclass(frozen=True, eq=False)
class Material(Fit):
    """All that the figures of a run may show.

    Attributes
    ----------
    calibrated : model the laws use.
    robot, plant : the truth.
    plan : the plan.
    numbers : numbers of the face markers.
    traces : runs of the laws by name.
    studies : extra runs; None where they could not be made.
    no_studies : why not.
    noisy : runs with noise that has been drawn anew in each, of equal length, by name.
    noise_px : standard deviation of that noise, per coordinate.
    """

    calibrated: Model
    robot: Robot
    plant: Plant
    plan: Plan
    numbers: tuple[int, ...]
    traces: Mapping[str, Trace] = field(default_factory=dict)
    studies: Studies | None = None
    no_studies: str = ""
    noisy: Mapping[str, Sequence[Trace]] = field(default_factory=dict)
    noise_px: float = 0.0

    def compared(self) -> list[str]:
        """Names of the runs of laws that follow the plan, each after that in which the law plans anew."""
        modes = {name: law_and_mode(name) for name, trace in self.traces.items() if trace.steps > 0}
        laws = [law for law, mode in modes.values() if mode != REPLAN]
        return [name for name, (law, _) in modes.items() if law in laws]

    @property
    def middle(self) -> FloatArray:
        """Centre of the face (4,) at the robot's reference, m."""
        M = self.plant.M
        return np.asarray(M.mean(axis=0) if self.plant.center < 0 else M[self.plant.center])

    def goal_center(self, trace: Trace) -> FloatArray:
        """True centre (3,) of the face at the goal, m; NaN where the goal pose is unknown."""
        goal: FloatArray = (trace.goal_pose @ np.linalg.solve(self.robot.base_tool, self.middle))[:3]
        return goal
