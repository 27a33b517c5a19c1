"""What figures and claims are made from: records of a run, the truth behind it, and numbers read off both."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from projservo_cli.control.law import Gains
from projservo_cli.geometry.kinematics import forward_kinematics, project
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
from projservo_cli.robots.simulated import Arm, Plant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    """

    gains: tuple[float, ...]  # gains per step that are swept
    periods: tuple[float, ...]  # periods, s, that are swept at the configured gains
    gains_of_laws: Gains  # the configured gains
    step_limit_deg: float  # joint motion per step of the limited runs, deg
    sweep: Mapping[tuple[str, str, bool, float], Trace]  # runs by (law, operators, limited, gain per step)
    own: Mapping[tuple[str, str, bool], Trace]  # runs with the configured gains by (law, operators, limited)
    rate: Mapping[tuple[str, float], Trace]  # runs with true operators by (law, period)


@dataclass(frozen=True, eq=False)
class Fit:
    """What the figures of a calibration show; a recorded run may hold no more."""

    calibration: Calibration  # the calibration
    observation: Observation  # what it was made from
    # its cross-validation, if there is one
    held_out: CrossValidation | None = field(default=None, kw_only=True)


@dataclass(frozen=True, eq=False)
class Material(Fit):
    """All that the figures of a run may show."""

    calibrated: Model  # model the laws use
    robot: Arm
    plant: Plant  # robot, plant: the truth
    plan: Plan  # the plan
    numbers: tuple[int, ...]  # numbers of the face markers
    traces: Mapping[str, Trace] = field(default_factory=dict)  # runs of the laws by name
    studies: Studies | None = None  # extra runs; None where they could not be made
    no_studies: str = ""  # why not
    plateau_steps: int = 20  # steps in which the error of a run that stands still falls by less than 1 %

    def compared(self) -> list[str]:
        """Names of the runs of laws that follow the plan, each after that in which the law plans anew."""
        modes = {name: law_and_mode(name) for name, trace in self.traces.items() if trace.steps > 0}
        laws = [law for law, mode in modes.values() if mode != REPLAN]
        return [name for name, (law, _) in modes.items() if law in laws]

    def goal_known(self) -> bool:
        """Whether all runs know the pose of the goal."""
        own = self.studies.own.values() if self.studies is not None else ()
        traces = [*self.traces.values(), *own]
        return bool(traces) and all(np.isfinite(trace.goal_pose).all() for trace in traces)

    @property
    def middle(self) -> FloatArray:
        """Centre of the face (4,) at the robot's reference, m."""
        M = self.plant.M
        return np.asarray(M.mean(axis=0) if self.plant.center < 0 else M[self.plant.center])

    def goal_center(self, trace: Trace) -> FloatArray:
        """True centre (3,) of the face at the goal, m; NaN where the goal pose is unknown."""
        goal: FloatArray = (trace.goal_pose @ np.linalg.solve(self.robot.base_tool, self.middle))[:3]
        return goal


@dataclass(frozen=True)
class FigureSpec:
    """One figure, and what it needs."""

    name: str  # of its files
    title: str  # what it shows, in a phrase
    paper: str  # the figure of the paper it follows, and its section
    height: float  # inches
    # data, draw: what makes it, from a ``Material``; from a ``Fit`` where it needs no task
    data: Callable[[Any], Data]
    draw: Callable[[Data, "Figure"], None]
    alt: str = ""  # what can be seen, for those who do not see it; by default the title
    laws: tuple[str, ...] = ()  # whose traces it shows: all of them, or any of them where ``any_law`` is set
    any_law: bool = False
    studies: bool = False  # whether it shows the extra runs
    modes: bool = False  # whether it compares runs that follow the plan with others
    goal: bool = False  # whether it needs a known goal pose
    task: bool = True  # whether it needs a task; without, a calibration and what it was made from will do

    def lacking(self, material: Fit) -> str:
        """Why the figure cannot be drawn; empty where it can."""
        if not self.task:
            return ""
        if not isinstance(material, Material):
            return "the run holds a calibration and no task: set robot, rig, markers and task"
        missing = self._without_run(material)
        if missing and (not self.any_law or len(missing) == len(self.laws)):
            return f"no run of {', '.join(missing)} with a step to show; make it: projservo servo report"
        if self.studies and material.studies is None:
            return f"the extra runs could not be made: {material.no_studies}"
        if self.modes and not material.compared():
            return "no run follows the plan: set control.mode, such as [replan, track], and run servo report"
        if self.goal and not material.goal_known():
            return "the pose of the goal is unknown, only its images are"
        return ""

    def partly(self, material: Fit) -> str:
        """What a figure that can be drawn is without; empty where it is whole."""
        missing = self._without_run(material) if isinstance(material, Material) else []
        return f"without {', '.join(missing)}: no run of it with a step to show" if missing else ""

    def _without_run(self, material: Material) -> list[str]:
        return [law for law in self.laws if law not in material.traces or material.traces[law].steps < 1]


REGISTER: dict[str, FigureSpec] = {}
_Draw = Callable[[Data, "Figure"], None]


def registered(
    name: str, title: str, paper: str, height: float, data: Callable[[Any], Data], **needs: Any
) -> Callable[[_Draw], _Draw]:
    """Decorator that registers what a function draws as a figure; arguments are those of ``FigureSpec``."""

    def register(draw: _Draw) -> _Draw:
        REGISTER[name] = FigureSpec(name, title, paper, height, data, draw, **needs)
        return draw

    return register


# A run counts as settled this many steps after its last command at the joint-speed limit.
SETTLING_STEPS = 20
# Where the must-decay ends: errors that nothing but the calibration explains, m and rad.
LEAST_DISTANCE = 1e-4
LEAST_ANGLE = np.radians(0.05)
# Longest joint motion, rad or m, between two points of a drawn path.
PATH_RESOLUTION = np.radians(1.0)


def percent(values: FloatArray) -> FloatArray:
    """Values normalised to 100 at their start; NaN throughout where they start at 0."""
    return np.asarray(100.0 * values / values[0]) if values[0] != 0 else np.full_like(values, np.nan)


def settled_at(trace: Trace) -> int:
    """First instant that lies ``SETTLING_STEPS`` after the last speed-limited command, or the start."""
    limited = np.flatnonzero(trace.speed_factor < 1.0)
    return SETTLING_STEPS + (int(limited[-1]) if len(limited) else 0)


def decay_factors(values: FloatArray, first: int, least: float) -> FloatArray:
    """Ratios of successive values, from instant ``first`` to the last value above ``least``.

    values : (k,) positive errors.
    first : instant of the first value.
    least : value below which nothing is counted.
    Returns (j,) ratios, possibly none.
    """
    small = np.flatnonzero(values[first:] <= least)
    used = values[first : first + int(small[0])] if len(small) else values[first:]
    return used[1:] / used[:-1]


def fitted_rate(values: FloatArray, first: int, least: float, period: float) -> float:
    """Rate, 1/s, of the geometric decay fitted to the logarithm of values; NaN below three values.

    A loop that takes the share λ T of the error in each period T has the rate λ.
    """
    ratios = decay_factors(values, first, least)
    if len(ratios) < 2:
        return float("nan")
    used = np.log(values[first : first + len(ratios) + 1])
    slope = np.polyfit(np.arange(len(used)), used, 1)[0]
    return float(1.0 - np.exp(slope)) / period


def center_distance(material: Material, trace: Trace) -> FloatArray:
    """True distance (k,) of the centre from its goal, m."""
    return np.asarray(np.linalg.norm(trace.center - material.goal_center(trace), axis=1))


def true_rotation(trace: Trace) -> float:
    """Angle between the rotations of the first pose and the goal, rad; NaN where that is unknown."""
    R = trace.pose[0, :3, :3].T @ trace.goal_pose[:3, :3]
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(sine, np.trace(R) - 1.0))


def center_path(material: Material, trace: Trace) -> FloatArray:
    """True centre (k, 3) along a run, m, between the instants too, where the joints move linearly."""
    amount = np.abs(np.diff(trace.q, axis=0)).max(axis=1, initial=0.0)
    points = [trace.center[0]]
    for k, most in enumerate(amount):
        parts = max(1, int(np.ceil(most / PATH_RESOLUTION)))
        for share in np.arange(1, parts) / parts:
            q = trace.q[k] + share * (trace.q[k + 1] - trace.q[k])
            points.append((forward_kinematics(material.plant.model, q) @ material.middle)[:3])
        points.append(trace.center[k + 1])
    return np.array(points)


def along_line(points: FloatArray, start: FloatArray, goal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Way (k,) along the straight line from start to goal and distance (k,) from it, m."""
    length = np.linalg.norm(goal - start)
    direction = (goal - start) / length if length > 0 else np.zeros(3)
    way = (points - start) @ direction
    off = points - start - way[:, None] * direction
    return way, np.asarray(np.linalg.norm(off, axis=1))


def path_gap(first: FloatArray, second: FloatArray) -> FloatArray:
    """Largest distance between two polylines, each point to the nearest of the other path.

    first, second : (k, ..., 2) and (l, ..., 2) points of the paths, px.
    Returns (...) Hausdorff distance of the vertices of either path from the other, px.
    """
    shape = first.shape[1:-1]
    a = first.reshape(len(first), -1, 2)
    b = second.reshape(len(second), -1, 2)
    gaps = [
        max(_to_polyline(a[:, i], b[:, i]).max(), _to_polyline(b[:, i], a[:, i]).max())
        for i in range(a.shape[1])
    ]
    return np.array(gaps).reshape(shape)


def _to_polyline(points: FloatArray, path: FloatArray) -> FloatArray:
    """Distance (k,) of points (k, 2) from a polyline (l, 2)."""
    start, way = path[:-1], np.diff(path, axis=0)
    if not len(way):
        return np.asarray(np.linalg.norm(points - path[0], axis=1))
    square = np.maximum((way**2).sum(axis=1), np.finfo(float).tiny)
    offset = points[:, None] - start
    share = np.clip((offset * way).sum(axis=2) / square, 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * way, axis=2).min(axis=1))


def coordinate_rise(e: FloatArray) -> FloatArray:
    """How far each error rises in size above the least it had before; 0 where it only falls.

    e : (k, ...) errors over time.
    """
    size = np.abs(e)
    return np.asarray((size - np.minimum.accumulate(size, axis=0)).max(axis=0))


def off_exponential(e: FloatArray, factor: float) -> FloatArray:
    """Largest difference of errors (k, ...) from a decay of their first value by a factor a step."""
    shape = (-1,) + (1,) * (e.ndim - 1)
    expected = e[0] * (factor ** np.arange(len(e))).reshape(shape)
    return np.asarray(np.abs(e - expected).max(axis=0))


def center_image(material: Material, trace: Trace) -> FloatArray:
    """Pixels (k, 2, 2) of the true centre in both views."""
    points = np.c_[trace.center, np.ones(len(trace.center))]
    return np.asarray(project(material.plant.model.P, points).swapaxes(0, 1))


def curve_difference(first: FloatArray, second: FloatArray) -> tuple[FloatArray, bool]:
    """Difference of two angle curves over their common instants, rad, and whether they mirror.

    Half a turn may be made in either sense; curves that differ by the sense are compared by size.
    """
    k = min(len(first), len(second))
    straight = np.abs(first[:k] - second[:k])
    mirrored = np.abs(first[:k] + second[:k])
    if mirrored.max() < straight.max():
        return mirrored, True
    return straight, False


def second_order_drift(
    H_hat: FloatArray, joint_step: FloatArray, center: FloatArray, line: FloatArray
) -> FloatArray:
    """Contribution of each joint to the centre's second-order deviation from its line in one step, m.

    Under the product of exponentials of [RH00] eq. (6) a point M has the second derivatives
    Ĥ_i Ĥ_j M, i ≤ j. Joint i is given its own term and half of each term it shares with another
    joint; contributions are counted along the direction of their sum, so that they add up to its
    length.

    H_hat : (n, 4, 4) metric operators at the current joints.
    joint_step : (n,) joint step, rad or m.
    center : (4,) centre, m.
    line : (3,) unit direction of the line.
    Returns (n,) signed contributions, m.
    """
    n = len(joint_step)
    parts = np.zeros((n, 3))
    for i in range(n):
        for j in range(n):
            acceleration = H_hat[min(i, j)] @ H_hat[max(i, j)] @ center
            parts[i] += 0.5 * joint_step[i] * joint_step[j] * acceleration[:3]
    parts -= np.outer(parts @ line, line)
    total = parts.sum(axis=0)
    size = float(np.linalg.norm(total))
    return np.asarray(parts @ total / size) if size > 0 else np.zeros(n)
