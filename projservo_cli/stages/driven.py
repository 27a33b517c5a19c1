"""Stage servo in the Python loop: laws of others, and robots that are not simulated."""

import math
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.calibration.innovation import WINDOW, Innovation
from projservo_cli.control.law import Gains
from projservo_cli.loop.python import BuiltInLaw, LoopLaw
from projservo_cli.loop.python import run as run_loop
from projservo_cli.loop.step import VERDICTS, Limits
from projservo_cli.modes import law_and_mode
from projservo_cli.plants.analytic import AnalyticPlant
from projservo_cli.plants.driven import DrivenRobot
from projservo_cli.plants.foreign import at_rest_after
from projservo_cli.plants.plant import Plant
from projservo_cli.records import BODY_LAWS, Calibration, Plan, WorkFailed
from projservo_cli.stages.laws import law_for
from projservo_cli.stages.motion import Joints, drive, foreign_robot, joints_of
from projservo_cli.stages.reach import face_of, observed, sight_for, watched
from projservo_cli.stages.traces import Outcome
from projservo_cli.stages.truth import Reach, center_index, face_numbers
from projservo_cli.task.face import task_from_images

if TYPE_CHECKING:
    from projservo_cli.config import Config


def run_law(
    law: LoopLaw, plant: AnalyticPlant | DrivenRobot, reach: Reach, gains: Gains, limits: Limits, scale: float
) -> Outcome:
    """Run any law on any plant, every command scaled."""
    code, steps, log = run_loop(law, plant, reach.s_star, gains.period, limits, scale)
    limited = float(law.state.limited[0]) if isinstance(law, BuiltInLaw) else 0.0
    return Outcome(VERDICTS[code], plant.disturbance, steps, log, limited)


def run(
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
        drive(plant, reach.q_start, joints.speed * gains.period * scale, gains.period, "servo")
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
