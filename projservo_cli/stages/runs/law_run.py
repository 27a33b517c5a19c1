"""The run of a law: made, and driven to its verdict."""

import copy
import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from projservo_cli import plugins
from projservo_cli.control.law import ERRORS, MAX_PARTS
from projservo_cli.findings import Finding
from projservo_cli.geometry.mechanisms import in_span
from projservo_cli.laws import CODES, INCIDENCES, REGULATE
from projservo_cli.loop.compiled_loop import Course, run_compiled
from projservo_cli.loop.goal_monitor import GoalMonitor
from projservo_cli.loop.python_loop import BuiltInLaw, LoopLaw, run_in_python
from projservo_cli.loop.replanning import ExecutionMonitor
from projservo_cli.loop.run_metrics import Ended, Summary, path_deviation, summarize
from projservo_cli.loop.stall_monitor import StallMonitor
from projservo_cli.loop.verdicts import (
    CONVERGED,
    FAULT_DETECTED,
    MAX_STEPS,
    OBJECT_MOVED,
    VERDICT_NAMES,
    Log,
    new_log,
)
from projservo_cli.messages import failed
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.records import (
    MM,
    FloatArray,
    InputError,
    Model,
    Plan,
    WorkFailed,
    changed,
)
from projservo_cli.results import ImageModel
from projservo_cli.robots.latency_compensation import DrivenRobot
from projservo_cli.robots.session import FollowedObject, Session
from projservo_cli.simulation.analytic_plant import AnalyticPlant, Ends, Plant
from projservo_cli.stages import plan as planning
from projservo_cli.stages.plan_motion import PathReplanner, search_of, why_closed
from projservo_cli.stages.runs.followed_goal import followed_goal
from projservo_cli.stages.runs.plugin_law import LawSetup, PluginLaw
from projservo_cli.stages.runs.robot_with_monitors import connected_robot
from projservo_cli.stages.scenario import RunScenario
from projservo_cli.task.face import Task, center_of
from projservo_cli.task.incidences import whole_pose
from projservo_cli.task.objects.moving_goal import MovingGoal
from projservo_cli.task.target import TaskImages, followed

_RETREAT = 10  # periods by which an arm goes back if the object of its goal moves
# Plans to where a goal will be, at most, until their durations differ by less than this, s.
_PLANS, _ALIKE_S = 4, 0.1
_NOT_DRIVEN: Any = None  # replaces the results of a run


class PlannedCourse(NamedTuple):
    """Mode of a run, and its plan."""

    mode: str = REGULATE  # of the run
    planned_s: float | None = None  # when the plan that it follows arrives, s
    unplanned: str = ""  # why it goes without the plan that it was to follow


class Brought(NamedTuple):
    """Objects of the caller of a run."""

    factory: Callable[[Any], Any] | None = None  # makes the law of its setup; None for the law of its name
    robot: Any = None  # an object of the contract; None for the configured one
    blind: bool = False  # whether a robot may move although cameras show no marker of the calibration
    session: Session | None = None  # connection to the robot; None to open one


@dataclass(eq=False)
class LawRun:
    """A run of a law: made, driven to its verdict, and summed up."""

    scenario: RunScenario
    # plan of the task, or the joint motions (2, n) of its rotations if that is enough
    plan: Plan | FloatArray
    law: str
    course: PlannedCourse = field(default_factory=PlannedCourse)
    believed: Model | None = None  # robot and rig as the law has them; None for the default of its kind
    brought: Brought = field(default_factory=Brought)
    # As it ended.
    verdict: str = ""
    why: Finding | None = None  # reason why it was held, disturbed or failed, if it was
    steps: int = 0  # commands sent
    log: Log = _NOT_DRIVEN  # the recorded run, once it was driven
    limited: float = 0.0  # how often visibility limited the translation
    plant: Plant = _NOT_DRIVEN  # that was driven; of an external robot the calibrated model
    replannings: tuple[Finding, ...] = ()
    goal: GoalMonitor | None = None  # of a goal that moves
    driven: DrivenRobot | None = None  # client of a robot of the contract
    unseen: Finding | None = None  # cameras that showed nothing before the run, though they were compared
    noise_ratio: float = 1.0  # stated noise of pixels at the end over the noise of the run; at least 1
    own_tolerance: float | None = None  # tolerance of an error that a user's law states

    @property
    def own_unit(self) -> float:
        """Factor of errors that decide convergence, in px, to their reported unit."""
        own = self.own_tolerance
        return 1.0 if own is None else own / self.scenario.termination.image_error_px

    @property
    def setup(self) -> Setup:
        """Return the arm and the cameras for words."""
        return self.scenario.world.setup

    @property
    def judged(self) -> tuple[str, str]:
        """Name and unit of the error that decides convergence, as words have them."""
        if self.own_tolerance is not None:
            return "error of the law", ""
        if self.scenario.exact.goal.incidences and not math.isnan(float(self.log.fit[self.steps, 2])):
            return "error of the incidences", "px"
        return "image error", "px"

    @property
    def replans(self) -> bool:
        """Whether the law goes its own way instead of following the plan."""
        return self.course.mode == REGULATE or bool(self.course.unplanned)

    @property
    def is_guided(self) -> bool:
        """Whether the run follows a plan which gives way to another one if it fails."""
        scenario = self.scenario
        searched = scenario.world.inputs.trajectory.profile in ("joint_space", "auto")
        if self.replans or self.law not in CODES or not searched:
            return False
        return not why_closed(scenario.world.model, scenario.demands, search_of(scenario))

    def simulated(self) -> tuple[Plant, FloatArray, FloatArray]:
        """The simulated robot as the law sees it, its first joints (n,), and the noise of its images."""
        scenario = self.scenario
        numbers, times = scenario.numbers_of(self.law), scenario.termination.max_steps + 1
        noise = scenario.simulated.noise(numbers, scenario.world.inputs.seed, times)
        return scenario.plant_of(self.law), scenario.ends.q_start, noise

    def compiled(self) -> None:
        """Drive a built-in law on the simulated robot in the compiled loop."""
        scenario, controller = self.scenario, self._built_in()
        limits, observed = scenario.termination, len(scenario.numbers_of(self.law))
        self.plant, q_start, noise = self.simulated()
        parts = MAX_PARTS if scenario.gains.substeps else 0
        V = len(scenario.world.view)
        self.log = new_log(len(q_start), observed, limits.max_steps, len(ERRORS), parts, V)
        course = Course(self.plant, limits, q_start.copy())
        code, self.steps = run_compiled(controller.law, course, noise, controller.state, self.log)
        self.verdict, self.limited = VERDICT_NAMES[code], float(controller.state.limited[0])

    def by_contract(self) -> None:
        """Drive a robot of the contract from the start of the task, where a simulated one stands.

        The robot of ``plant.use`` is driven there, unless it starts in its current pose. Before its first
        motion, its images must agree with the calibration there. The robot is always stopped and closed
        out, in a shared session at its end.
        """
        scenario, contract = self.scenario, self.scenario.servo.required_contract
        scenario.world.require_ready()
        shared, plan = self.brought.session, self.plan if isinstance(self.plan, Plan) else None
        # The matrices of a frame are small: a second thread costs more than it gives.
        with threadpool_limits(limits=1), nullcontext(shared) if shared else Session() as session:
            followed = followed_goal(scenario, self.law, self._images, plan, session)
            tracked = None if followed is None else followed.tracked
            controller = self.controller(moving=followed is not None)
            driven = connected_robot(scenario, self.law, session, self.brought.robot, plan, tracked)
            driven.stops = shared is None
            self.unseen = scenario.world.begin(
                driven, contract, scenario.ends.q_start, blind=self.brought.blind
            )
            driven.begin()
            driven.retreats = _RETREAT
            stall: StallMonitor | None = StallMonitor(driven, scenario.termination)
            if followed is not None and isinstance(controller, BuiltInLaw):
                limits, stall = scenario.termination, None
                plans = plan is not None and plan.carried and not self.replans  # else a retreat
                ahead = partial(self._plan_ahead, followed.goal) if plans else None
                self.goal = GoalMonitor(controller, followed, driven, limits, ahead)
            self.in_python(controller, driven, stall)
            if followed is not None and self.goal is not None and self.verdict == "followed":
                go_on = partial(self._go_on, controller, driven, self.goal)
                session.followed = FollowedObject(followed.tracked.name, go_on, followed)

    def _plan_ahead(self, goal: MovingGoal, displaced: Callable[[float], FloatArray], q: FloatArray) -> Task:
        """Task with a plan from joints (n,) to where its goal will be when the plan arrives.

        displaced : displacement (4, 4) of the goal after a time, s.
        Raises WorkFailed if no feasible plan leads there.
        """
        assert isinstance(self.plan, Plan)
        scenario, plan, seconds = self.scenario, self.plan, self.plan.duration or 0.0
        inputs, calibration = replace(scenario.world.inputs, q_current=q), scenario.world.calibration
        (carried,) = plan.carried
        for _ in range(_PLANS):
            images = goal.at(displaced(seconds / scenario.gains.scale))
            there = replace(carried, s_carried=images.s_star)
            plan = planning.run(inputs, calibration, changed(plan, carried=(there,)))
            if not plan.feasible:
                raise WorkFailed(f"no plan leads to where the goal will be: {plan.reason}")
            before, seconds = seconds, plan.duration or 0.0
            if abs(seconds - before) < _ALIKE_S:
                break
        return self._to(images, plan)

    def _go_on(self, law: LoopLaw, driven: DrivenRobot, goal: GoalMonitor, seconds: float) -> None:
        """Follow the goal for a further time, s; raises WorkFailed if that fails."""
        scenario = self.scenario
        period, limits = scenario.gains.period, scenario.termination
        limits = limits._replace(max_steps=max(1, math.ceil(seconds / period)))
        goal.goes_on(limits)
        code, _, _ = run_in_python(law, driven, self.s_star, period, limits, scenario.gains.scale, goal=goal)
        if code != MAX_STEPS:
            why = driven.disturbance or goal.reason
            raise failed([] if why is None else [why], self.setup, begin=f"{VERDICT_NAMES[code]}: ")

    def in_python(
        self, law: LoopLaw, plant: AnalyticPlant | DrivenRobot, stall: StallMonitor | None = None
    ) -> None:
        """Drive a law on a plant, every command scaled; a run that is guided is watched."""
        scenario, execution = self.scenario, None
        if self.is_guided and isinstance(law, BuiltInLaw) and self.goal is None:
            assert isinstance(self.plan, Plan)
            follow = partial(self._to, scenario.images_for(self.law))
            searches = scenario.servo.laws.max_replan_attempts
            replanner = PathReplanner(scenario, self.plan)
            blind, limits = self.brought.blind or scenario.world.moves_unseen, scenario.termination
            execution = ExecutionMonitor(law, follow, replanner, searches, limits, stall, blind=blind)
        code, self.steps, self.log = run_in_python(
            law,
            plant,
            scenario.ends.by_points().s_star,
            scenario.gains.period,
            scenario.termination,
            scenario.gains.scale,
            goal=self.goal,
            stall=stall,
            execution=execution,
        )
        self.noise_ratio = plant.noise_ratio
        if isinstance(law, PluginLaw) and law.states_error:
            self.own_tolerance = law.tolerance
        if isinstance(plant, DrivenRobot):
            self.driven = plant
            if code == CONVERGED and plant.at_rest():
                code = FAULT_DETECTED
            if code == FAULT_DETECTED and plant.object_moved:
                code = OBJECT_MOVED
            # It moves from sample to sample, in any mode.
            path = np.stack([self.log.q, np.roll(self.log.q, -1, axis=0)], axis=1)
            self.log = self.log._replace(path=path, parts=np.ones_like(self.log.parts))
        self.verdict, self.plant = VERDICT_NAMES[code], plant.plant
        self.limited = float(law.state.limited[0]) if isinstance(law, BuiltInLaw) else 0.0
        self.why = plant.disturbance or (None if stall is None else stall.reason)
        if self.goal is not None:
            self.why = plant.disturbance or self.goal.reason
        self.replannings = () if execution is None else tuple(execution.attempts)
        if self.goal is not None:
            self.replannings = tuple(self.goal.replannings)

    @property
    def _model(self) -> Model:
        """Robot and rig as a built-in law has them."""
        return self.believed or self.scenario.believed_by(self.law)

    def _to(self, images: TaskImages, plan: Plan) -> Task:
        """The task to a goal in images as a built-in law is given it, with the plan that it follows."""
        gains = self.scenario.gains
        return followed(self._model, images.task(self._model), plan, gains.period, gains.scale)

    def _images(self) -> TaskImages:
        """Start and goal as the law measures them, with the whole pose for a law of incidences without any.

        Raises InputError for such a law without a body.
        """
        images = self.scenario.images_for(self.law)
        if self.law != INCIDENCES or images.goal.incidences:
            return images
        if not len(images.body.M):
            raise InputError(
                f"{self.law} measures with the body: leave control.features: points out, and calibrate well"
            )
        # Its incidences are of the scene, so that the scene is where the goal was carried.
        return images.to(images.s_star).asking(whole_pose(images.body.M[: self.scenario.world.m]))

    def _built_in(self, *, moving: bool = False) -> BuiltInLaw:
        """The built-in law with the model that it is given, and the sense of its rotations.

        moving : whether its goal moves, so that a plan to it is made later.
        """
        scenario, plan = self.scenario, self.plan
        model = self._model
        if self.replans or moving:
            task = self._images().task(model)
        else:
            assert isinstance(plan, Plan)
            task = self._to(scenario.images_for(self.law), plan)
        found = BuiltInLaw(CODES[self.law], model, task, scenario.gains)
        sense = plan.rotation_sense() if isinstance(plan, Plan) else plan
        found.state.driven[:] = in_span(found.state.work.span, model, scenario.ends.q_start, sense)
        return found

    def controller(self, *, moving: bool = False) -> LoopLaw:
        """The law, ready for the Python loop.

        moving : whether its goal moves.

        Raises InputError if there is no such law, it needs a model of the robot that the configuration lacks,
        or the plan to follow has no time; WorkFailed if it cannot be made, or the joints cannot follow the
        plan.
        """
        if self.law in CODES:
            return self._built_in(moving=moving)
        scenario, gains, ends = self.scenario, self.scenario.gains, self.scenario.ends.by_points()
        assert isinstance(self.plan, Plan)
        face = np.array(scenario.world.calibration.indices_of(scenario.world.numbers[: scenario.world.m]))
        model, shown = ImageModel.of(scenario.world.calibration), (ends.s_start, ends.s_star)
        # A copy: no law may write to the arrays of another.
        setup = copy.deepcopy(LawSetup(model, face, *shown, self.plan, gains, gains.period))
        factory = self.brought.factory or plugins.find("law", self.law)
        law = plugins.called("law", self.law, factory, (setup,), {})
        return PluginLaw(
            law, f"law {self.law}", scenario.world.min_views, scenario.termination.image_error_px
        )

    @cached_property
    def summary(self) -> Summary:
        """Numbers of the run; NaN if they need an unknown truth."""
        ended = Ended(VERDICT_NAMES.index(self.verdict), self.steps, self.limited)
        found = summarize(self.plant, self.log, ended, self.scenario.gains.period, self.true_ends)
        return self.scenario.world.judged(found)

    @property
    def s_star(self) -> FloatArray:
        """Images (V, m, 2) of the face at the goal, where it was at the end if it moved, px."""
        return self.scenario.ends.by_points().s_star if self.goal is None else self.goal.s_star

    @property
    def images_at_end(self) -> TaskImages:
        """Start and goal as the law measures them, the goal where it was at the end if it moved."""
        return self.scenario.images_for(self.law) if self.goal is None else self.goal.here

    @property
    def self_occluded_steps(self) -> tuple[int, ...]:
        """Number of times (V,) at which each camera is behind the face."""
        return tuple(np.count_nonzero(self.log.hidden[: self.steps + 1], axis=0).tolist())

    def deviation_mm(self) -> float:
        """Largest distance of the true centre from its line, between the samples too, mm; NaN if unknown."""
        goal, period = self.true_ends.goal, self.scenario.gains.period
        if not np.isfinite(goal).all():
            return math.nan
        start = self.log.H[0] @ np.array(center_of(self.plant.M, self.plant.center))
        between = path_deviation(self.plant, self.log, self.steps, period, start, goal)
        return max(MM * between, self.summary.center_deviation_at_samples_mm)

    @cached_property
    def true_ends(self) -> Ends:
        """True poses of the tool, with the nearest goal to where it ended where incidences leave it open."""
        scenario, H = self.scenario, self.log.H[self.steps]
        if self.goal is None or not self.goal.periods:
            return scenario.world.nearest_ends(scenario.exact, scenario.true_ends, self.plant, H)
        (T,), _ = self.goal.true_motion(np.array([self.goal.periods[-1].t]))
        H = np.linalg.inv(T) @ H
        found = scenario.world.nearest_ends(scenario.exact, scenario.true_ends, self.plant, H)
        return found._replace(goal_pose=T @ found.goal_pose, goal=T @ found.goal)
