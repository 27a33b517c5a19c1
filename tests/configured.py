"""Stages and what they are given, by a configuration: what the chain does, in one call."""

import json
from dataclasses import replace
from types import ModuleType
from typing import Any

from projservo_cli.config import inputs as given
from projservo_cli.config import load_config, settings_and_rules
from projservo_cli.report import page
from projservo_cli.settings.sections import JointVector
from projservo_cli.simulation import ground_truth, random_streams, robot_with_faults
from projservo_cli.simulation.rendering import Frames, rendered_model
from projservo_cli.stages import calibrate as calibrating
from projservo_cli.stages import plan as planning
from projservo_cli.stages import record as recording
from projservo_cli.stages import report as reporting
from projservo_cli.stages import scenario
from projservo_cli.stages import servo as driving
from projservo_cli.stages import teach as teaching

truth_of = settings_and_rules.truth_of


class _Stage:
    """A module of a stage, of which some functions take a configuration."""

    def __init__(self, module: ModuleType, **functions: Any) -> None:
        self.__dict__ |= {**vars(module), **functions}


def trials_of(config):
    """Trials of a configuration, simulated or of a robot of somebody's."""
    if config.markers is not None and config.markers.known is not None:
        return given.recording_inputs(config).trials
    return given.calibration_inputs(config.model_copy(update={"data": None})).source


def trial_motions(config):
    return recording.trial_motions(trials_of(config))


def simulate(config, truth, q=None, drawn=None):
    q = trial_motions(config) if q is None else q
    drawn = drawn or (trials_of(config).motions.seed, random_streams.CALIBRATION_NOISE)
    return recording.noisy_observation(truth, q, config.noise.calibration_px, drawn)


def plan_inputs(config):
    """The inputs of a plan; of images of an unknown size the border is far away."""
    inputs = given.plan_inputs(config)
    return inputs if inputs.image_size else replace(inputs, seen_px=(4096, 4096))


def servo_inputs(config):
    """The inputs of a run, with those of its plan."""
    return replace(given.servo_inputs(config), plan=plan_inputs(config))


def scenario_of(config, calibration=None):
    """The scenario of the runs of a configuration, by a calibration or by one without errors."""
    inputs = servo_inputs(config)
    return scenario.run_scenario(inputs, calibration or inputs.plan.described.truth.calibration)


def under(scenario, config, **more):
    """A scenario with other parts, under what another configuration gives its runs."""
    inputs = servo_inputs(config)
    return replace(scenario, world=replace(scenario.world, inputs=inputs.plan), servo=inputs, **more)


def trajectory_of(**asked):
    """A motion that is asked for, else as by default."""
    values = [f"trajectory.{key}={json.dumps(x)}" for key, x in asked.items()]
    values += ["control.mode=track"] if asked.get("keep_out") else []
    return load_config(None, ["data.table=none", *values]).trajectory


def joints_of(config, types="", calibration=None):
    return given.joints_of(config).joints(types, calibration)


def bounds_of(config, joints):
    return given._drive(config, None).following.bounds(joints)


def robot_by_itself(config, truth, q, sigma_px, seed, stream):
    robot = given._drive(config, truth).robot
    return robot_with_faults.robot_by_itself(robot, q, sigma_px, (seed, stream))


def rendered_of(config):
    """The compiled model of a rendered configuration."""
    return rendered_model(given.scene_of(config))


def observed_in_frames(config, truth, q, drawn):
    scene = given.scene_of(config)
    return robot_with_faults.observed_in_frames(scene, config.noise.averaged_frames, q, drawn)


def eyes_of(config):
    """The cameras of a rendered configuration, not open."""
    return Frames(rendered_of(config))


def plant_of(config, truth, q):
    return ground_truth.plant_of(truth, q, opaque=config.plant.self_occlusion == "opaque")


def checked(config, calibration, taught):
    return teaching.checked(given.plan_inputs(config), calibration, taught)


def teach(config, frames, at=None, *more):
    readings = None if at is None else JointVector.model_construct(joints=tuple(at), unit="rad")
    return teaching.teach(given.teach_inputs(config), frames, readings, *more)


def require_face(config, taught):
    teaching.require_face(config.face_numbers, taught)


def report_on(run, directory, **options):
    """Write the report of a run into a folder."""
    return reporting.run(given.report_inputs(config_of(run)), run, directory, **options)


def config_of(run):
    """The configuration of a run."""
    return load_config(run.path, text=run.configuration)


def page_of(run):
    """Write the page of a run; its path."""
    return page.write_page(run, given.about_of(config_of(run)))


def draw_only(patch, *names):
    """Let reports draw some figures alone; all are drawn by the first chain and by tests/report."""
    patch.setattr(reporting, "FIGURES", [spec for spec in reporting.FIGURES if spec.name in names])


def compared(runs, path):
    """Write a page that shows runs side by side."""
    configs = [config_of(run) for run in runs]
    abouts = [(run, given.about_of(config)) for run, config in zip(runs, configs, strict=True)]
    page.write_comparison(
        abouts, [config.model_dump(mode="json", exclude_none=True) for config in configs], path
    )


def view_of(run, *more):
    return reporting.view(given.scenery_of(config_of(run)), run, *more)


def animation_of(run, *more):
    return reporting.animation(config_of(run).image_size_px, run, *more)


calibrate = _Stage(
    calibrating,
    run=lambda config, **options: calibrating.run(given.calibration_inputs(config), **options),
    suggest_motions=lambda config, *more: calibrating.suggest_motions(given.suggestion_inputs(config), *more),
)
plan = _Stage(planning, run=lambda config, calibration: planning.run(plan_inputs(config), calibration))
servo = _Stage(
    driving, run=lambda config, *more, **brought: driving.run(servo_inputs(config), *more, **brought)
)
record = _Stage(
    recording,
    trial_motions=trial_motions,
    simulate=simulate,
    observed=lambda config: recording.observed(given.calibration_inputs(config).source),
    new_recording=lambda config, *more, **named: recording.new_recording(
        given.recording_inputs(config), *more, **named
    ),
    record=lambda config, *more, **named: recording.record_poses(
        given.recording_inputs(config), *more, **named
    ),
)
