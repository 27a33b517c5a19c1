"""Stage servo: one control law in closed loop with the simulated robot, to its verdict."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from projservo_cli.calibration.innovation import WINDOW, Innovation
from projservo_cli.control import CODES
from projservo_cli.control.law import ERRORS, LOST, MOST_PARTS, OK, Gains, new_state
from projservo_cli.geometry.kinematics import project
from projservo_cli.geometry.lens import straight_views
from projservo_cli.geometry.mechanisms import in_span, span_of
from projservo_cli.loop.compiled import new_log
from projservo_cli.loop.compiled import run as run_loop
from projservo_cli.loop.python import BuiltInLaw, LoopLaw
from projservo_cli.loop.python import run as run_in_python
from projservo_cli.loop.step import VERDICTS, Limits
from projservo_cli.records import (
    BODY_LAWS,
    METRIC_LAWS,
    REPLAN,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    Model,
    Plan,
    Trace,
    WorkFailed,
    following_mode,
    law_and_mode,
)
from projservo_cli.results import ImageModel, image_model
from projservo_cli.robots import plugins
from projservo_cli.robots.plugins import what_failed
from projservo_cli.robots.simulated import AnalyticPlant, Plant
from projservo_cli.robots.yours import DrivenRobot, at_rest_after
from projservo_cli.stages.motion import Joints, drive_to, foreign_robot, joints_of
from projservo_cli.stages.plan import Sense
from projservo_cli.stages.scenario import (
    Reach,
    Sight,
    Truth,
    center_index,
    disturbance_of,
    face_numbers,
    face_of,
    known_pins,
    lose_markers,
    measured_task,
    observed,
    plant_of,
    reach_for,
    reach_of,
    servo_noise,
    sight_for,
    sight_of,
    truth_of,
    watched,
)
from projservo_cli.stages.traces import Known, Outcome, known, record_of, unknown
from projservo_cli.task.face import Task, task_from_images
from projservo_cli.task.trajectory import Reference, trajectory_displacement

if TYPE_CHECKING:
    from projservo_cli.config import Config

# A last period that is shorter than this share of one is none.
ROUND_OFF = 1e-9
# Share of a period over which image velocities are differences: what it leaves is the curvature of the
# image paths in so much of a period, a millionth of a pixel, far above round-off.
DIFFERENCE = 1e-4


def followed(model: Model, task: Task, plan: Plan, period: float, rate: float) -> Task:
    """The task with the plan to follow, [RH00] section 4.

    Parameters
    ----------
    model : calibrated model, in whose frame the plan was made.
    period : control period, s.
    rate : factor of every command.

    Raises
    ------
    InputError
        If the plan has no time.
    WorkFailed
        If the joints cannot follow it.
    """
    times = instants(plan, period)
    mu, q, A, s = followed_at(model, task, plan, times)
    until_next = np.append(np.diff(times), 0.0)
    _, _, _, s_next = followed_at(model, task, plan, times + DIFFERENCE * until_next)
    reference = Reference(
        plan.H_hat,
        np.array([plan.tau, plan.theta_r, plan.theta_p]),
        mu,
        q,
        np.ascontiguousarray(A),
        np.ascontiguousarray(s),
        np.ascontiguousarray((s_next - s) / DIFFERENCE),
        rate,
    )
    return task._replace(reference=reference)


def planned_time(config: "Config", mode: str, plan: Plan | Sense) -> float | None:
    """When a run that follows a plan arrives by it, s; None where it follows none or that has no time."""
    if mode == REPLAN or not isinstance(plan, Plan) or plan.duration is None:
        return None
    return plan.duration / config.plant.speed_scale


def unplanned(config: "Config", plan: Plan | Sense, name: str) -> str:
    """Why a run that was to follow the plan goes without it; empty where it follows, or never was to."""
    mode = law_and_mode(name)[1]
    if mode == REPLAN or not isinstance(plan, Plan) or np.isfinite(plan.q).all():
        return ""
    return "" if config.control.without_plan == "refuse" else f"no joints can follow the plan: {plan.reason}"


def name_driven(config: "Config", plan: Plan | Sense, name: str) -> str:
    """Name of the run that is driven: where no joints can follow the plan the law's own, which replans."""
    return law_and_mode(name)[0] if unplanned(config, plan, name) else name


def instants(plan: Plan, period: float) -> FloatArray:
    """Times (k,), k ≥ 2, one control period apart, the last that at which the plan arrives, s.

    Raises
    ------
    InputError, WorkFailed
        As of ``followed``.
    """
    if not np.isfinite(plan.q).all():
        raise WorkFailed(
            "the joints cannot follow the planned motion to its end, so that there is nothing to track: "
            "choose another trajectory.profile, or control.without_plan replan to drive without a plan"
        )
    if plan.duration is None:
        raise InputError(
            "no joint that the plan moves has a speed limit that gives it a time in which to follow it: set "
            "trajectory.duration_s"
        )
    count = max(1, math.ceil(plan.duration / period - ROUND_OFF))
    return np.asarray(np.minimum(np.arange(count + 1) * period, plan.duration))


def followed_at(
    model: Model, task: Task, plan: Plan, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Shares (k, 3), joints (k, n), points (k, m, 4) and straight pixels (k, 2, m, 2) at times (k,), s.

    The points are those that the planned displacement carries to where the face should be. What the plan
    is off at the goal is taken back along the path: points where they were measured one by one, and
    images by what the calibration is off there, so that both arrive where the goal was shown.
    """
    sigma = np.interp(times, plan.time, plan.sigma) if plan.time[-1] > 0.0 else np.ones(len(times))
    mu, q = (
        np.stack([np.interp(sigma, plan.sigma, row) for row in rows.T], axis=1) for rows in (plan.mu, plan.q)
    )
    H_d = np.array(
        [
            trajectory_displacement(plan.H_hat, (plan.tau, plan.theta_r, plan.theta_p), share)
            for share in (*mu, np.ones(3))
        ]
    )
    H_d, H_goal = np.swapaxes(H_d[:-1], 1, 2), H_d[-1].T
    A = plan.A @ H_d + sigma[:, None, None] * (task.A_star - plan.A @ H_goal)
    off = straight_views(model.lens, task.s_star) - project(model.P, task.A_star)
    s = np.moveaxis(project(model.P, A), 0, 1) + sigma[:, None, None, None] * off
    return mu, q, A @ np.linalg.inv(H_d), s


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


def law_for(
    config: "Config",
    calibration: Calibration,
    plan: Plan,
    name: str,
    reach: Reach,
    gains: Gains,
    sight: Sight | None = None,
) -> LoopLaw:
    """The law of the run of a name, ready for the Python loop; with a sight it measures with the body.

    Raises
    ------
    InputError
        If there is no such law, it needs a model of the robot that the configuration lacks, or the plan to
        follow has no time.
    WorkFailed
        If it cannot be made, or the joints cannot follow the plan.
    """
    law, mode = law_and_mode(name)
    if law not in CODES:
        face = face_of(config, calibration)
        model = image_model(calibration)
        setup = LawSetup(model, face, reach.s_start, reach.s_star, plan, gains, gains.period)
        return ForeignLaw(plugins.make("law", law, ("__call__",), (setup,), {}), f"law {law}")
    if law in METRIC_LAWS and None in (config.robot, config.rig):
        raise InputError(
            f"{law} is given the metric model of robot and rig: set robot and rig, or leave it out of "
            "control.laws"
        )
    believed = truth_of(config).model if law in METRIC_LAWS else calibration.model()
    task = measured_task(believed, reach.q_start, reach.s_start, reach.s_star, center_index(config), sight)
    if mode != REPLAN:
        task = followed(believed, task, plan, gains.period, config.plant.speed_scale)
    built_in = BuiltInLaw(CODES[law], believed, task, gains)
    span, sense = built_in.state.work.span, plan.rotation_sense()
    built_in.state.memory.rotation[:] = in_span(span, believed, reach.q_start, sense)
    return built_in


def run_law(
    law: LoopLaw, plant: AnalyticPlant | DrivenRobot, reach: Reach, gains: Gains, limits: Limits, scale: float
) -> Outcome:
    """Run any law on any plant, every command scaled."""
    code, steps, log = run_in_python(law, plant, reach.s_star, gains.period, limits, scale)
    limited = float(law.state.limited[0]) if isinstance(law, BuiltInLaw) else 0.0
    return Outcome(VERDICTS[code], plant.disturbance, steps, log, limited)


def run_on_robot(
    config: "Config",
    calibration: Calibration,
    plan: Plan,
    name: str,
    reach: Reach,
    gains: Gains,
    limits: Limits,
) -> Outcome:
    """Drive the robot of ``plant.use`` to the start of the task and from there under the law of a run.

    Before the first motion, what the robot sees must agree with the calibration where it stands. The
    robot is stopped on every way out.

    Raises
    ------
    InputError
        If the law or the robot cannot be imported, or the configuration lacks something.
    WorkFailed
        If the robot or the law fails, or the images do not agree before the first motion.
    """
    if not calibration.usable:
        raise WorkFailed("no robot is driven with a calibration that is not usable: calibrate anew")
    joints = joints_of(config, calibration.joint_types)
    numbers = observed(config, calibration)
    sight = sight_for(config, calibration, reach) if law_and_mode(name)[0] in BODY_LAWS else None
    controller = law_for(config, calibration, plan, name, reach, gains, sight)
    believed = believed_plant(config, calibration, reach, joints)
    shown = face_numbers(config) if sight is None else watched(config, calibration)
    robot = foreign_robot(config, joints, len(numbers))
    with at_rest_after(robot):
        plant = DrivenRobot(
            robot,
            believed,
            np.array([numbers.index(number) for number in shown]),
            np.array([numbers.index(k) if k in numbers else -1 for k in calibration.marker.tolist()]),
            innovation_of(config, calibration, limits.max_steps),
        )
        wrong = plant.fits()
        if wrong:
            raise WorkFailed(f"nothing was moved, since where the robot stands {wrong}")
        scale = config.plant.speed_scale
        drive_to(plant, reach.q_start, joints.speed * gains.period * scale, gains.period, "servo")
        return run_law(controller, plant, reach, gains, limits, scale)


def adapted(config: "Config", calibration: Calibration, gains: Gains, limits: Limits) -> tuple[Gains, Limits]:
    """Gains and limits for a robot that is not simulated: its joints, its noise, never beyond its limits."""
    joints = joints_of(config, calibration.joint_types)
    noise = config.stop.noise_factor * noise_px(config, calibration)
    return gains._replace(speed=joints.speed, lower=joints.lower, upper=joints.upper), limits._replace(
        speed=joints.speed,
        image_px=config.stop.image_px + noise,
        noise_px=noise,
        stop_at_joint_limit=True,
    )


def noise_px(config: "Config", calibration: Calibration) -> float:
    """Pixel noise per coordinate: what is configured, but no less than the calibration was left with."""
    return max(config.noise.servo_px, calibration.sigma_fitted_px)


def believed_plant(config: "Config", calibration: Calibration, reach: Reach, joints: Joints) -> Plant:
    """The calibrated robot and face as the plant that the loop takes it for."""
    model = calibration.model()
    task = task_from_images(model, reach.s_start, reach.s_star, center_index(config))
    size = config.rig.image_size_px if config.rig is not None else (math.inf, math.inf)
    return Plant(
        model,
        np.ascontiguousarray(calibration.M[face_of(config, calibration)]),
        task.order,
        task.center,
        task.O,
        task.visible,
        np.array(size, dtype=np.float64),
        joints.lower,
        joints.upper,
        False,
    )


def untested(config: "Config", calibration: Calibration) -> str:
    """Why images in the loop are not tested against the calibration; empty where they are."""
    if config.stop.innovation_factor == 0.0:
        return "stop.innovation_factor is 0"
    if not np.isfinite(calibration.covariance).all():
        return "the calibration has no covariance, which the method refined gives"
    return ""


def innovation_of(config: "Config", calibration: Calibration, max_steps: int) -> Innovation | None:
    """Test of the images in the loop; None where it is switched off or the calibration has no covariance."""
    factor = config.stop.innovation_factor
    if untested(config, calibration):
        return None
    return Innovation(calibration, factor * noise_px(config, calibration), max_steps + 1 + WINDOW)


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
    gains, limits = adapted(config, calibration, gains, limits)
    outcome = run_on_robot(config, calibration, plan, name_driven(config, plan, name), reach, gains, limits)
    trace = _record(config, name, plan, outcome, reach, gains, limits, unknown(outcome.steps + 1))
    return replace(trace, untested=untested(config, calibration))


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
        outcome = run_law(controller, simulated, reach, gains, limits, config.plant.speed_scale)
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
