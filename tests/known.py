"""Scenarios whose model is known: what plan and servo do without a calibration."""

from dataclasses import replace

from projservo_cli.config import load_config
from projservo_cli.stages import servo
from projservo_cli.stages.plan import Profile, demands_of, plan_task
from projservo_cli.stages.scenario import Scenario, gains_of, limits_of, start_and_goal
from projservo_cli.stages.trace import trace_of
from projservo_cli.stages.world import joints_of, truth_of
from tests.conftest import ROOT


def configured(name, *overrides):
    """A shipped configuration."""
    return load_config(ROOT / "configs" / f"{name}.yaml", list(overrides))


def known_scenario(config):
    """The scenario of a configuration whose face is measured point by point; nothing is calibrated."""
    truth, joints = truth_of(config), joints_of(config)
    exact, ends = start_and_goal(config, truth)
    gains, limits = gains_of(config, joints), limits_of(config, joints, config.noise.servo_px)
    return Scenario(config, None, truth, joints, config.markers.face, exact, ends, gains, limits)


def planned(scenario, model, profile="linear", samples=11, **more):
    """Plan of a scenario with a model of it."""
    asked = Profile(profile, scenario.config.trajectory.delta, samples, **more)
    return plan_task(model, scenario.ends, asked, demands_of(scenario.config))


def driven(scenario, plan, name, model, **limits):
    """Trace of the run of a name with a model; ``limits`` replace those of the scenario."""
    scenario = replace(scenario, limits=scenario.limits._replace(**limits))
    return trace_of(scenario, servo.drive(scenario, plan, name, model))
