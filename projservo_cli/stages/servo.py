"""Stage servo: one control law in closed loop with the simulated robot, to its verdict."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from projservo_cli.control import CODES
from projservo_cli.control.law import ERRORS, MOST_PARTS, Gains, new_state
from projservo_cli.geometry.span import in_span, span_of
from projservo_cli.loop.compiled import new_log
from projservo_cli.loop.compiled import run as run_loop
from projservo_cli.loop.step import VERDICTS, Limits
from projservo_cli.modes import REPLAN, following_mode, law_and_mode
from projservo_cli.plants.analytic import AnalyticPlant
from projservo_cli.plants.plant import Plant
from projservo_cli.records import BODY_LAWS, METRIC_LAWS, Calibration, FloatArray, Model, Plan, Trace
from projservo_cli.stages import driven
from projservo_cli.stages.disturbed import disturbance_of, lose_markers, servo_noise
from projservo_cli.stages.following import followed, name_driven, planned_time, unplanned
from projservo_cli.stages.laws import law_for
from projservo_cli.stages.motion import joints_of
from projservo_cli.stages.reach import reach_for
from projservo_cli.stages.sense import Sense
from projservo_cli.stages.sight import Sight, known_pins, measured_task, sight_of
from projservo_cli.stages.traces import Known, Outcome, known, record_of, unknown
from projservo_cli.stages.truth import (
    Reach,
    Truth,
    plant_of,
    reach_of,
    truth_of,
)
from projservo_cli.task.face import Task

if TYPE_CHECKING:
    from projservo_cli.config import Config

DEPENDS_ON = (
    "seed",
    "robot",
    "rig",
    "markers",
    "noise.servo_px",
    "noise.shown_frames",
    "task",
    "trajectory.delta",
    "control",
    "plant",
    "disturbance",
    "stop",
)


def gains_of(config: "Config") -> Gains:
    """Gains and limits of the laws."""
    c, joints = config.control, joints_of(config)
    endless = np.full(len(joints.types), math.inf)
    stop = config.plant.joint_limits == "stop"
    return Gains(
        c.gain_t,
        c.gain_r,
        c.gain_p,
        c.gain_s,
        c.ratio_rp,
        c.gain,
        c.period_s,
        config.trajectory.delta,
        joints.speed,
        c.substeps == "auto",
        joints.lower if stop else -endless,
        joints.upper if stop else endless,
    )


def limits_of(config: "Config") -> Limits:
    """When a run ends and what bounds its commands; noise widens the tolerance of the image error."""
    noise_px = config.stop.noise_factor * config.noise.servo_px
    return Limits(
        joints_of(config).speed,
        config.stop.image_px + noise_px,
        config.stop.diverged_factor,
        config.stop.plateau_steps,
        config.stop.max_steps,
        config.plant.joint_limits == "stop",
        config.plant.image_border == "stop",
        config.stop.lost_steps,
        noise_px,
    )


def run(
    config: "Config", calibration: Calibration, plan: Plan, name: str, *, progress: object = None
) -> Trace:
    """Drive one law in one mode from the start of the task to its verdict.

    Parameters
    ----------
    name : of the run: that of the law, with the mode where it follows the plan, such as ``exact_track``.

    Raises
    ------
    InputError
        If the configuration lacks a part of the simulation, or the plan to follow has no time.
    WorkFailed
        If the goal cannot be reached, or the joints cannot follow the plan and ``control.without_plan``
        refuses to go without.
    """
    if config.plant.use is None:
        return record(config, name, plan, simulate(config, calibration, plan, name))
    gains, limits = gains_of(config), limits_of(config)
    reach = reach_for(config, calibration)
    gains, limits = driven.adapted(config, calibration, gains, limits)
    outcome = driven.run(config, calibration, plan, name_driven(config, plan, name), reach, gains, limits)
    trace = _record(config, name, plan, outcome, reach, gains, limits, unknown(outcome.steps + 1))
    return replace(trace, untested=driven.untested(config, calibration))


def _record(
    config: "Config",
    name: str,
    plan: Plan | Sense,
    outcome: Outcome,
    reach: Reach,
    gains: Gains,
    limits: Limits,
    found: Known,
) -> Trace:
    """Trace of a run of a name, and why it went without the plan if it did."""
    law, mode = law_and_mode(name)
    why = unplanned(config, plan, name)
    planned_s = None if why else planned_time(config, mode, plan)
    trace = record_of(law, outcome, reach, gains, limits, found, mode, planned_s)
    return replace(trace, unplanned=why)


class Scene(NamedTuple):
    """What a run of the simulated robot takes place in: all that laws compared on one task share."""

    truth: Truth
    reach: Reach
    sight: Sight | None


def scene_of(config: "Config", calibration: Calibration) -> Scene:
    """Robot, rig and markers as they are, the ends of the task, and the body that laws may measure with.

    Raises
    ------
    InputError
        If the configuration lacks a part of the simulation.
    WorkFailed
        If the goal cannot be reached, or the body not be measured with.
    """
    truth = truth_of(config)
    reach = reach_of(config, truth)
    return Scene(truth, reach, sight_of(config, calibration, truth, reach))


class Simulated(NamedTuple):
    """A run of the simulated robot: how it ended, and what it was made with."""

    outcome: Outcome
    plant: Plant
    truth: Truth
    reach: Reach


def simulate(
    config: "Config", calibration: Calibration, plan: Plan | Sense, name: str, scene: Scene | None = None
) -> Simulated:
    """Drive the simulated robot from the start of the task to the verdict of one run.

    Parameters
    ----------
    plan : of the task; the sense of its rotations is enough for a built-in law that does not follow it.
    name : as of ``run``.
    scene : where it was made already.

    Raises
    ------
    InputError
        If the configuration lacks a part of the simulation, or the plan to follow has no time.
    WorkFailed
        If the goal cannot be reached, or the joints cannot follow the plan and ``control.without_plan``
        refuses to go without.
    """
    name = name_driven(config, plan, name)
    law, mode = law_and_mode(name)
    gains, limits = gains_of(config), limits_of(config)
    truth, reach, sight = scene_of(config, calibration) if scene is None else scene
    if law not in BODY_LAWS:
        sight = None
    plant = plant_of(config, truth, reach.q_start)
    plant = plant._replace(disturbance=disturbance_of(config, len(reach.q_start)))
    noise = servo_noise(config, len(truth.face), 0 if sight is None else len(sight.pins))
    pins = [] if sight is None else known_pins(calibration, truth)
    lose_markers(config, noise, [truth.number[i] for i in (*truth.face, *pins)])
    if isinstance(plan, Plan) and not in_compiled_loop(config, law):
        controller = law_for(config, calibration, plan, name, reach, gains, sight)
        seen = plant if sight is None else plant._replace(pins=sight.pins)
        simulated = AnalyticPlant(seen, reach.q_start, noise)
        outcome = driven.run_law(controller, simulated, reach, gains, limits, config.plant.speed_scale)
    else:
        model = truth.model if law in METRIC_LAWS else calibration.model()
        sense = plan.rotation_sense()
        reference = plan if isinstance(plan, Plan) and mode != REPLAN else None
        # Of the same model and images, the task of the plan is that of a law that measures as the plan does.
        task = plan.task if isinstance(plan, Sense) and law in BODY_LAWS else None
        outcome = outcome_of(
            law, model, plant, truth, reach, gains, limits, noise, sense, sight, reference, task
        )
    return Simulated(outcome, plant, truth, reach)


def record(config: "Config", name: str, plan: Plan | Sense, made: Simulated) -> Trace:
    """Trace of a run of the simulated robot."""
    gains, limits = gains_of(config), limits_of(config)
    found = known(made.outcome, made.plant, made.truth, made.reach, gains)
    return _record(config, name, plan, made.outcome, made.reach, gains, limits, found)


def in_compiled_loop(config: "Config", law: str) -> bool:
    """Whether the compiled loop runs a law; the others are run in Python and are given the whole plan."""
    return law in CODES and config.plant.speed_scale == 1.0


def sense_is_enough(config: "Config", name: str) -> bool:
    """Whether a run needs no more of the plan than the sense of its rotations."""
    law, mode = law_and_mode(name)
    return mode == REPLAN and in_compiled_loop(config, law)


def drive(
    law: str,
    model: Model,
    plant: Plant,
    truth: Truth,
    reach: Reach,
    gains: Gains,
    limits: Limits,
    noise: FloatArray,
    sense: FloatArray | None = None,
    sight: Sight | None = None,
    plan: Plan | None = None,
) -> Trace:
    """Trace of one law with one model on the simulated robot; the arguments are those of ``outcome_of``."""
    outcome = outcome_of(law, model, plant, truth, reach, gains, limits, noise, sense, sight, plan)
    found = known(outcome, plant, truth, reach, gains)
    mode, planned_s = (REPLAN, None) if plan is None else (following_mode(law), plan.duration)
    return record_of(law, outcome, reach, gains, limits, found, mode, planned_s)


def outcome_of(
    law: str,
    model: Model,
    plant: Plant,
    truth: Truth,
    reach: Reach,
    gains: Gains,
    limits: Limits,
    noise: FloatArray,
    sense: FloatArray | None = None,
    sight: Sight | None = None,
    plan: Plan | None = None,
    task: Task | None = None,
) -> Outcome:
    """Run one law with one model on the simulated robot.

    Parameters
    ----------
    law : name of the law.
    model : what the law believes.
    noise : (≥ max_steps + 1, 2, m, 2) px, with a sight m + p markers.
    sense : (2, n) joint motions of the planned rotations r and p, which decide the sense of a half turn.
    sight : the body to measure with; without it the face is measured point by point.
    plan : what to follow, in the frame of the model; without it every step plans anew.
    task : where it was measured already.
    """
    n, m, observed = len(reach.q_start), len(truth.face), len(truth.face)
    if task is None:
        task = measured_task(model, reach.q_start, reach.s_start, reach.s_star, truth.center, sight)
    if sight is not None:
        plant = plant._replace(pins=sight.pins)
        observed += len(sight.pins)
    if plan is not None:
        task = followed(model, task, plan, gains.period, 1.0)
    span = span_of(model, task.A_star)
    state = new_state(n, m, observed, span)
    if sense is not None:
        state.memory.rotation[:] = in_span(span, model, reach.q_start, sense)
    log = new_log(n, observed, limits.max_steps, len(ERRORS), MOST_PARTS if gains.substeps else 0)
    code, steps = run_loop(
        CODES[law], model, task, gains, limits, plant, noise, reach.q_start.copy(), state, log
    )
    return Outcome(VERDICTS[code], "", steps, log, float(state.limited[0]))
