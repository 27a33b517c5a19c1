"""Stage servo: one control law in closed loop with a robot, from the start of the task to its verdict."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from projservo_cli.control import CODES
from projservo_cli.control.law import ERRORS, LOST, MOST_PARTS, OK, Gains, new_state
from projservo_cli.geometry.mechanisms import in_span, span_of
from projservo_cli.loop.compiled import run as run_compiled
from projservo_cli.loop.python import BuiltInLaw, LoopLaw
from projservo_cli.loop.python import run as run_in_python
from projservo_cli.loop.step import VERDICTS, new_log
from projservo_cli.records import (
    REPLAN,
    Calibration,
    FloatArray,
    IntArray,
    Model,
    Plan,
    Trace,
    WorkFailed,
    law_and_mode,
)
from projservo_cli.results import ImageModel
from projservo_cli.robots import plugins
from projservo_cli.robots.plugins import what_failed
from projservo_cli.robots.simulated import AnalyticPlant
from projservo_cli.robots.yours import DrivenRobot, at_rest_after
from projservo_cli.stages import own_robot
from projservo_cli.stages.scenario import Scenario, scenario_of
from projservo_cli.stages.trace import Run, trace_of
from projservo_cli.task.following import followed

if TYPE_CHECKING:
    from projservo_cli.config import Config


def run(
    config: "Config", calibration: Calibration, plan: Plan, name: str, *, progress: object = None
) -> Trace:
    """Drive one law in one mode from the start of the task to its verdict.

    name : of the run: that of the law, with the mode where it follows the plan, such as ``exact_track``.
    Raises InputError if the configuration lacks a part of the simulation, or the plan to follow has no time;
    WorkFailed if the goal cannot be reached, or the joints cannot follow the plan and
    ``control.without_plan`` refuses to go without.
    """
    scenario = scenario_of(config, calibration)
    return trace_of(scenario, drive(scenario, plan, name))


def drive(scenario: Scenario, plan: Plan | FloatArray, name: str, believed: Model | None = None) -> Run:
    """Drive the run of a name to its verdict.

    plan : of the task; a built-in law that does not follow it needs but the joint motions (2, n) of its
        rotations, which tell which way to turn.
    believed : what the law takes for robot and rig; None for what a law of its kind is given.
    Raises InputError, WorkFailed as of ``run``.
    """
    law, mode = law_and_mode(name)
    unplanned, planned_s = "", None
    if mode != REPLAN and isinstance(plan, Plan):
        if not np.isfinite(plan.q).all() and scenario.config.control.without_plan != "refuse":
            unplanned = f"no joints can follow the plan: {plan.reason}"
        elif plan.duration is not None:
            planned_s = plan.duration / scenario.config.plant.speed_scale
    replans = mode == REPLAN or bool(unplanned)
    if scenario.truth is None:
        assert isinstance(plan, Plan)
        run = _drive_own_robot(scenario, plan, law, replans)
    elif isinstance(plan, Plan) and not _in_compiled_loop(scenario.config, law):
        controller = _law_for(scenario, plan, law, replans)
        noise = scenario.noise_of(law, scenario.config.seed, scenario.limits.max_steps + 1)
        simulated = AnalyticPlant(scenario.plant_of(law), scenario.ends.q_start, noise)
        run = _driven_in_python(scenario, controller, simulated)
    else:
        run = _drive_compiled(scenario, plan, law, replans, believed)
    return run._replace(law=law, mode=mode, planned_s=planned_s, unplanned=unplanned)


def _in_compiled_loop(config: "Config", law: str) -> bool:
    """Whether the compiled loop runs a law; the others are run in Python and are given the whole plan."""
    return law in CODES and config.plant.speed_scale == 1.0


def sense_is_enough(config: "Config", name: str) -> bool:
    """Whether a run needs no more of the plan than the sense of its rotations."""
    law, mode = law_and_mode(name)
    return mode == REPLAN and _in_compiled_loop(config, law)


def _drive_compiled(
    scenario: Scenario, plan: Plan | FloatArray, law: str, replans: bool, believed: Model | None
) -> Run:
    """Drive a built-in law on the simulated robot in the compiled loop."""
    model = scenario.believed_by(law) if believed is None else believed
    ends, gains, limits = scenario.ends, scenario.gains, scenario.limits
    task = scenario.shown_to(law).task(model)
    if not replans:
        assert isinstance(plan, Plan)
        task = followed(model, task, plan, gains.period, 1.0)
    n, m, observed = len(ends.q_start), scenario.m, len(scenario.numbers_of(law))
    span = span_of(model, task.A_star)
    state = new_state(n, m, observed, span)
    sense = plan.rotation_sense() if isinstance(plan, Plan) else plan
    state.memory.rotation[:] = in_span(span, model, ends.q_start, sense)
    log = new_log(n, observed, limits.max_steps, len(ERRORS), MOST_PARTS if gains.substeps else 0)
    plant = scenario.plant_of(law)
    noise = scenario.noise_of(law, scenario.config.seed, limits.max_steps + 1)
    code, steps = run_compiled(
        CODES[law], model, task, gains, limits, plant, noise, ends.q_start.copy(), state, log
    )
    return Run(VERDICTS[code], "", steps, log, float(state.limited[0]), plant)


def _driven_in_python(scenario: Scenario, law: LoopLaw, plant: AnalyticPlant | DrivenRobot) -> Run:
    """Drive any law on any plant, every command scaled."""
    gains, scale = scenario.gains, scenario.config.plant.speed_scale
    s_star = scenario.ends.by_points().s_star
    code, steps, log = run_in_python(law, plant, s_star, gains.period, scenario.limits, scale)
    limited = float(law.state.limited[0]) if isinstance(law, BuiltInLaw) else 0.0
    return Run(VERDICTS[code], plant.disturbance, steps, log, limited, plant.plant)


def _drive_own_robot(scenario: Scenario, plan: Plan, law: str, replans: bool) -> Run:
    """Drive the robot of ``plant.use`` to the start of the task and from there under a law.

    Before the first motion, what the robot sees must agree with the calibration where it stands. The
    robot is stopped on every way out.
    """
    if not scenario.calibration.usable:
        raise WorkFailed("no robot is driven with a calibration that is not usable: calibrate anew")
    controller = _law_for(scenario, plan, law, replans)
    robot, driven = own_robot.connected(scenario, law)
    with at_rest_after(robot):
        wrong = driven.fits()
        if wrong:
            raise WorkFailed(f"nothing was moved, since where the robot stands {wrong}")
        own_robot.drive_to(
            driven,
            scenario.ends.q_start,
            own_robot.step_limit(scenario.config, scenario.joints),
            scenario.gains.period,
            "servo",
        )
        return _driven_in_python(scenario, controller, driven)


@dataclass(frozen=True, eq=False)
class LawSetup:
    """What a law of somebody else is made with.

    Attributes
    ----------
    calibration : with ``predict(q)`` and ``jacobian(q)``.
    face : (k,) indices of the face markers among those of the calibration.
    s_start, s_star : (2, k, 2) pixels of the face at the start and at the goal.
    plan : the planned motion.
    gains : configured gains, limits and period.
    period : control period, s.
    """

    calibration: ImageModel
    face: IntArray
    s_start: FloatArray
    s_star: FloatArray
    plan: Plan
    gains: Gains
    period: float


class ForeignLaw:
    """A law ``law(s, q) -> q_dot`` whose answers are checked; None holds the robot for a period.

    Parameters
    ----------
    law : pixels (2, k, 2) of the face and joint readings (n,) to joint velocities (n,), rad/s or m/s.
    name : of it, for messages.
    """

    def __init__(self, law: Callable[[FloatArray, FloatArray], Any], name: str) -> None:
        self.law, self.name = law, name
        self.errors = np.full(len(ERRORS), np.nan)

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity of one instant; the law is asked where the whole face was seen."""
        if np.isnan(s).any():
            return LOST, np.zeros_like(q)
        try:
            answer = self.law(s.copy(), q.copy())
            if answer is None:
                return LOST, np.zeros_like(q)
            q_dot = np.array(answer, dtype=np.float64)
        except Exception as error:
            raise WorkFailed(f"{self.name}: failed: {what_failed(error)}") from error
        if q_dot.shape != q.shape or not np.isfinite(q_dot).all():
            raise WorkFailed(
                f"{self.name}: gave {answer!r:.80}: expected {len(q)} finite joint velocities, or None"
            )
        return OK, q_dot


def _law_for(scenario: Scenario, plan: Plan, law: str, replans: bool) -> LoopLaw:
    """A law, ready for the Python loop.

    Raises InputError if there is no such law, it needs a model of the robot that the configuration lacks, or
    the plan to follow has no time; WorkFailed if it cannot be made, or the joints cannot follow the plan.
    """
    gains, ends = scenario.gains, scenario.ends.by_points()
    if law not in CODES:
        known = scenario.calibration.marker.tolist()
        face = np.array([known.index(number) for number in scenario.numbers[: scenario.m]])
        model = ImageModel(**vars(scenario.calibration))
        setup = LawSetup(model, face, ends.s_start, ends.s_star, plan, gains, gains.period)
        # What a law writes to must not be what other laws are given.
        own = copy.deepcopy(setup)
        return ForeignLaw(plugins.make("law", law, ("__call__",), (own,), {}), f"law {law}")
    believed = scenario.believed_by(law)
    task = scenario.shown_to(law).task(believed)
    if not replans:
        task = followed(believed, task, plan, gains.period, scenario.config.plant.speed_scale)
    built_in = BuiltInLaw(CODES[law], believed, task, gains)
    span, sense = built_in.state.work.span, plan.rotation_sense()
    built_in.state.memory.rotation[:] = in_span(span, believed, ends.q_start, sense)
    return built_in
