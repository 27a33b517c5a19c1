"""Stage servo: one control law in closed loop with a robot, from the start of the task to its verdict."""

from dataclasses import replace
from typing import Any

import numpy as np

from projservo_cli.laws import CODES, INCIDENCES, REGULATE, law_and_mode
from projservo_cli.records import (
    Calibration,
    FloatArray,
    InputError,
    Model,
    Plan,
    Trace,
    WorkFailed,
)
from projservo_cli.simulation.analytic_plant import AnalyticPlant
from projservo_cli.stages.runs.law_run import Brought, LawRun, PlannedCourse
from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.scenario import RunScenario, run_scenario
from projservo_cli.stages.stage_inputs import ServoInputs

# A plan is of a task where its start, rad or m, and its goal images, px, are the same but for rounding and
# another calibration of the same rig.
_SAME_START, _SAME_GOAL_PX = 1e-6, 10.0


def run(inputs: ServoInputs, calibration: Calibration, plan: Plan, name: str, **brought: Any) -> Trace:
    """Drive one law in one mode from the start of the task to its verdict.

    name : of the run: the law's, with the mode if it follows the plan, such as ``exact_track``.
    brought : by a caller: ``factory``, ``robot``, ``blind`` and ``session`` of ``Brought``.
    Raises InputError if a part of the simulation is missing, the plan is of another task, or the plan to
    follow has no time; WorkFailed if the goal cannot be reached, or the joints cannot follow the plan and
    ``refuses`` is set.
    """
    task = inputs.plan.task
    if task is not None and task.start_joints is None and inputs.plan.q_current is None:
        # joints of the arm when it was planned
        inputs = replace(inputs, plan=replace(inputs.plan, q_current=plan.q_start))
    scenario = run_scenario(inputs, calibration)
    _require_its_task(scenario.towards(plan), plan)
    return trace_of(drive(scenario, plan, name, **brought))


def _require_its_task(scenario: RunScenario, plan: Plan) -> None:
    """Refuse a plan from another start, or to other goal images, with an InputError."""
    ends = scenario.ends.by_points()
    if ends.s_star.shape != plan.s_star.shape or ends.q_start.shape != plan.q_start.shape:
        what = "it has other joints or markers"
    elif (away := float(np.abs(ends.q_start - plan.q_start).max())) > _SAME_START:
        what = f"it starts {away:.3g} rad or m from task.start"
    elif (off := float(np.nanmax(np.abs(ends.s_star - plan.s_star), initial=0.0))) > _SAME_GOAL_PX:
        what = f"its goal images are {off:.3g} px from task.goal"
    else:
        return
    raise InputError(f"the plan is of another task than the configuration: {what}; plan this task first")


def drive(
    scenario: RunScenario, plan: Plan | FloatArray, name: str, believed: Model | None = None, **brought: Any
) -> LawRun:
    """Drive the run of a name to its verdict.

    plan : of the task; a built-in law that does not follow it needs but the joint motions (2, n) of its
        rotations, which give the sense of the turn.
    believed : robot and rig as the law has them; None for those that a law of its kind is given.
    Raises InputError, WorkFailed as of ``run``.
    """
    law, mode = law_and_mode(name)
    unplanned, planned_s = "", None
    if isinstance(plan, Plan):
        scenario = scenario.towards(plan)
    if scenario.world.inputs.trajectory.keep_out and not (isinstance(plan, Plan) and plan.feasible):
        raise WorkFailed("the plan is not feasible, and with trajectory.keep_out no law runs without one")
    if mode != REGULATE and isinstance(plan, Plan):
        if not np.isfinite(plan.q).all() and scenario.servo.laws.on_plan_failure == "regulate":
            unplanned = f"no joints can follow the plan: {plan.reason}"
        elif plan.duration is not None:
            planned_s = plan.duration / scenario.gains.scale
    course = PlannedCourse(mode, planned_s, unplanned)
    run = LawRun(scenario, plan, law, course, believed, Brought(**brought))
    if scenario.servo.contract is not None:
        run.by_contract()
    elif isinstance(plan, Plan) and (not _in_compiled_loop(scenario.servo, law) or run.is_guided):
        run.in_python(run.controller(), AnalyticPlant(*run.simulated()))
    else:
        run.compiled()
    return run


def _in_compiled_loop(inputs: ServoInputs, law: str) -> bool:
    """Whether the compiled loop runs a law; the others run in Python with the whole plan."""
    return law in CODES and inputs.conditions.speed_scale == 1.0 and inputs.contract is None


def sense_is_enough(inputs: ServoInputs, name: str) -> bool:
    """Whether a run needs no more of the plan than the sense of its rotations."""
    law, mode = law_and_mode(name)
    asked = inputs.plan
    # Any other goal than a pose needs the goal of the plan.
    pose = law != INCIDENCES and not asked.incidences and not asked.carriers
    return mode == REGULATE and _in_compiled_loop(inputs, law) and pose
