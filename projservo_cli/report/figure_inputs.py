"""Inputs of figures and claims, and the register of figures with what each needs.

Figures and claims are made from records of the run, the truth behind it, and numbers read off both.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from projservo_cli.geometry.kinematics import project
from projservo_cli.laws import IMAGE_TRACK, REGULATE, TRACK, law_and_mode, title_of
from projservo_cli.metric.frame import Metric
from projservo_cli.records import (
    MM,
    BoolArray,
    Calibration,
    CrossValidation,
    FloatArray,
    Model,
    Observation,
    Plan,
    Trace,
)
from projservo_cli.report import style
from projservo_cli.settings.task import Trajectory
from projservo_cli.simulation.analytic_plant import Plant
from projservo_cli.simulation.arm import SerialArm

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from projservo_cli.control.law import Gains

Data = dict[str, npt.NDArray[Any]]
"""Named arrays behind one figure."""

PAGE_FILE, VIEW_FILE, ANIMATION_FILE = "report.html", "view.html", "animation.gif"
CLAIMS_FILE = "claims.json"
DIRECT = ("direct_three", "direct_two")


def title(name: str) -> str:
    """Name of a run as the figures write it: the name of its law, and whether it follows the plan."""
    *step, run = name.split("/")
    law, mode = law_and_mode(run)
    follows = {TRACK: ", following the plan", IMAGE_TRACK: ", following planned images"}
    return "".join(f"{part}: " for part in step) + title_of(law) + follows.get(mode, "")


@dataclass(frozen=True, eq=False)
class Studies:
    """Closed-loop runs that are not in the run file, all without noise.

    Operators are ``true`` (metric), ``twin`` (the same in a projective frame) or ``calibrated``.
    """

    gains: tuple[float, ...]  # gains per step that are swept
    periods: tuple[float, ...]  # periods, s, that are swept at the configured gains
    gains_of_laws: "Gains"  # the configured gains
    step_limit_deg: float  # joint motion per step of the limited runs, deg
    sweep: Mapping[tuple[str, str, bool, float], Trace]  # runs by (law, operators, limited, gain per step)
    own: Mapping[tuple[str, str, bool], Trace]  # runs with the configured gains by (law, operators, limited)
    rate: Mapping[tuple[str, float], Trace]  # runs with true operators by (law, period)
    # directTHREE ``fast``, 0.9 of the translation a step with true operators, and ``tracked``, along the plan
    # with calibrated ones, within the limit, if it can be followed
    further: Mapping[str, Trace]


class Composition(NamedTuple):
    """The parts of the task put together, from its true partition."""

    share: FloatArray  # (k,) shares λ of the task
    distance: FloatArray  # (k,) how far apart both sides of (22) put the centre, m
    axis_angle: float  # between the translation and the axis of the single rotation, rad
    bias: FloatArray  # (2,) farthest that the laws ``DIRECT`` turn the face off its planned rotation, rad


@dataclass(frozen=True, eq=False)
class Fit:
    """Data of the figures of a calibration; a recorded run may have no more."""

    calibration: Calibration  # the calibration
    observation: Observation  # observation of the calibration
    held_out: CrossValidation | None = field(default=None, kw_only=True)  # its cross-validation, if any
    metric: Metric | None = field(default=None, kw_only=True)  # metric in metres; None if unknown
    no_metric: str = field(default="", kw_only=True)  # why not

    @property
    def view(self) -> tuple[str, ...]:
        """Names of the views."""
        return self.calibration.view


@dataclass(frozen=True, eq=False)
class Driven(Fit):
    """The runs of a robot of which no model is known, nor of its cameras; or of a sequence."""

    plan: Plan  # the plan; for a sequence, of its last motion
    traces: Mapping[str, Trace]  # runs of the laws by name
    lacks: str = "no model of robot and cameras is known that could be drawn: set robot, rig and markers"


@dataclass(frozen=True, eq=False)
class ReportData(Fit):
    """All that the figures of a run may show."""

    calibrated: Model  # model the laws use
    robot: SerialArm
    plant: Plant  # robot, plant: the truth
    plan: Plan  # the plan
    numbers: tuple[int, ...]  # numbers of the face markers
    traces: Mapping[str, Trace] = field(default_factory=dict)  # runs of the laws by name
    studies: Studies | None = None  # extra runs; None if they could not be made
    no_studies: str = ""  # why not
    trajectory: Trajectory = field(kw_only=True)  # requested motion of the plan
    stall_periods: int = 20  # steps in which the error of a stalled run falls by less than 1 %

    def compared(self) -> list[str]:
        """Names of the runs of laws that follow the plan, each after that in which the law regulates."""
        modes = {name: law_and_mode(name) for name, trace in self.traces.items() if trace.steps > 0}
        laws = [law for law, mode in modes.values() if mode != REGULATE]
        return [name for name, (law, _) in modes.items() if law in laws]

    def goal_known(self) -> bool:
        """Whether all runs know the pose of the goal."""
        extra = self.studies.own.values() if self.studies is not None else ()
        traces = [*self.traces.values(), *extra]
        return bool(traces) and all(np.isfinite(trace.goal_pose).all() for trace in traces)

    @property
    def extra(self) -> Studies:
        """The extra runs, for figures that are drawn only if there are some."""
        assert self.studies is not None
        return self.studies

    @property
    def middle(self) -> FloatArray:
        """Centre of the face (4,) at the robot's reference, m."""
        M = self.plant.M
        return np.asarray(M.mean(axis=0) if self.plant.center < 0 else M[self.plant.center])

    def goal_center(self, trace: Trace) -> FloatArray:
        """True centre (3,) of the face before the cameras at the goal, m; NaN if its pose is unknown."""
        before, after = self.robot.base_tool, trace.goal_pose
        if self.plant.model.on_tool:  # from which the face moves the other way
            before, after = after, before
        return np.asarray((after @ np.linalg.solve(before, self.middle))[:3])

    def center_distance(self, trace: Trace) -> FloatArray:
        """True distance (k,) of the centre from its goal, m."""
        return np.asarray(np.linalg.norm(trace.center - self.goal_center(trace), axis=1))

    def center_image(self, trace: Trace) -> FloatArray:
        """Pixels (k, V, 2) of the true centre in the views."""
        points = np.c_[trace.center, np.ones(len(trace.center))]
        return project(self.plant.model.P, points).swapaxes(0, 1)


def moved(report_data: Driven | ReportData) -> list[str]:
    """Names of the runs that made a step."""
    return [name for name, trace in report_data.traces.items() if trace.steps > 0]


@dataclass(frozen=True)
class FigureSpec:
    """One figure and its requirements."""

    name: str  # stem of its files
    title: str  # title, in a phrase
    paper: str  # the figure of the paper it follows, and its section
    data: Callable[[Any], Data]  # from a ``Material``; from a ``Fit`` if it needs no task
    draw: Callable[[Data, "Figure"], None]
    height: float = 4.0  # inches; a drawing may choose another
    alt: str = ""  # description for readers who cannot see it; by default the title
    laws: tuple[str, ...] = ()  # whose traces it shows: all of them, or any of them where ``any_law`` is set
    any_law: bool = False
    studies: bool = False  # whether it shows the extra runs
    shares: bool = False  # whether it shows shares of translation and rotations
    modes: bool = False  # whether it compares runs that follow the plan with others
    goal: bool = False  # whether it needs a known goal pose
    # Whether a run has the optional data that is shown here, and otherwise the reason to omit the figure.
    shows: tuple[Callable[[Any], bool], str] | None = None
    task: bool = True  # whether it needs a task; otherwise a calibration with its observations is enough
    metric: bool = False  # whether it needs the calibration in metres

    @property
    def section(self) -> str:
        """Its section on the page: calibration, metric, plan or control."""
        if not self.task:
            return "metric" if self.metric else "calibration"
        return "control" if self.laws or self.studies or self.modes or self.optional else "plan"

    @property
    def optional(self) -> bool:
        """Whether it is left out without a word if a run has nothing to show in it."""
        return self.shows is not None

    def drawn(self, data: Data) -> "Figure":
        """The figure of its data."""
        return style.drawn(self.draw, data, self.height)

    def lacking(self, report_data: Fit) -> str:
        """Return the reason why the figure cannot be drawn; empty if it can."""
        if not self.task:
            return report_data.no_metric if self.metric else ""
        if self.shows is not None and isinstance(report_data, Driven | ReportData):
            shown, why = self.shows
            return "" if shown(report_data) else why
        if isinstance(report_data, Driven):
            return report_data.lacks
        if len(report_data.calibration.joint_types) == 1:
            return "one joint cannot reach a pose"
        if not isinstance(report_data, ReportData):
            return "the run holds a calibration and no task: set robot, rig, markers and task"
        missing = self._without_run(report_data)
        if missing and (not self.any_law or len(missing) == len(self.laws)):
            displayed = {law: None for spec in REGISTER.values() for law in spec._without_run(report_data)}
            return (
                f"runs to compare are missing, of {', '.join(displayed)}; make them: projservo servo report"
            )
        if self.studies and report_data.studies is None:
            return report_data.no_studies
        if self.shares and np.isnan(report_data.plan.mu).all():
            return "a joint-space path has no fractions of translation and rotations: see figure 16"
        if self.modes and not report_data.compared():
            return (
                "no run follows the plan: set control.mode, such as [regulate, track], and run servo report"
            )
        if self.goal and not report_data.goal_known():
            return "the pose of the goal is unknown, only its images are"
        return ""

    def partly(self, report_data: Fit) -> str:
        """Return the missing part of a figure that can be drawn; empty if it is complete."""
        missing = self._without_run(report_data) if isinstance(report_data, ReportData) else []
        return f"without {', '.join(missing)}: no run of it with a step to show" if missing else ""

    def _without_run(self, report_data: ReportData) -> list[str]:
        return [
            law for law in self.laws if law not in report_data.traces or report_data.traces[law].steps < 1
        ]


REGISTER: dict[str, FigureSpec] = {}
_Draw = Callable[[Data, "Figure"], None]


def registered(
    name: str, title: str, paper: str, data: Callable[[Any], Data], **needs: Any
) -> Callable[[_Draw], _Draw]:
    """Decorator that registers a drawing function as a figure; arguments as of ``FigureSpec``."""

    def register(draw: _Draw) -> _Draw:
        REGISTER[name] = FigureSpec(name, title, paper, data, draw, **needs)
        return draw

    return register


def percent(values: FloatArray) -> FloatArray:
    """Values normalised to 100 at their start; NaN throughout if they start at 0."""
    return np.asarray(100.0 * values / values[0]) if values[0] != 0 else np.full_like(values, np.nan)


def joint_units(prismatic: BoolArray) -> FloatArray:
    """Factors (n,) from rad or m to the units in which joints are drawn, deg or mm."""
    return np.where(prismatic, MM, np.degrees(1.0))


def joint_kinds(prismatic: BoolArray) -> list[tuple[list[int], str]]:
    """Numbers of the revolute and of the prismatic joints, if there are some, with their unit."""
    kinds = [(np.flatnonzero(prismatic == kind).tolist(), "mm" if kind else "deg") for kind in (False, True)]
    return [(numbers, unit) for numbers, unit in kinds if numbers]


def along_line(points: FloatArray, start: FloatArray, goal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Way (k,) along the straight line from start to goal and distance (k,) from it, m."""
    length = np.linalg.norm(goal - start)
    direction = (goal - start) / length if length > 0 else np.zeros(3)
    along = (points - start) @ direction
    off = points - start - along[:, None] * direction
    return along, np.asarray(np.linalg.norm(off, axis=1))


def curve_difference(first: FloatArray, second: FloatArray) -> FloatArray:
    """Difference of two angle curves over their common instants, rad.

    Half a turn may be made in either sense; curves that differ by the sense are compared by size.
    """
    k = min(len(first), len(second))
    return min(np.abs(first[:k] - second[:k]), np.abs(first[:k] + second[:k]), key=np.max)
