"""Scenarios whose model is known: what plan and servo do without a calibration."""

from dataclasses import replace

from projservo_cli.config import load_config
from projservo_cli.stages import servo
from projservo_cli.stages.plan import Profile, Shown, demands_of, plan_task
from projservo_cli.stages.scenario import Scenario, Watched, gains_of, limits_of, start_and_goal
from projservo_cli.stages.world import joints_of, truth_of
from tests.conftest import ROOT


def configured(name, *overrides):
    """A shipped configuration."""
    return load_config(ROOT / "configs" / f"{name}.yaml", list(overrides))


def known_scenario(config):
    """The scenario of a configuration whose face is measured point by point; nothing is calibrated."""
    truth = truth_of(config)
    numbers = tuple(truth.number[i] for i in truth.face)
    exact = start_and_goal(config, truth)
    joints, watched = joints_of(config), Watched(len(numbers), numbers)
    scenario = Scenario(
        config, None, truth, joints, watched, exact, exact, gains_of(config), limits_of(config)
    )
    return replace(scenario, ends=scenario.shown_at(config.seed))


def shown(scenario):
    """Start and goal of a scenario as a plan has them."""
    ends = scenario.ends
    return Shown(ends.q_start, *ends.first(scenario.watched.face), scenario.truth.center)


def planned(scenario, model, profile="linear", samples=11, **more):
    """Plan of a scenario with a model of it."""
    asked = Profile(profile, scenario.config.trajectory.delta, samples, **more)
    return plan_task(model, shown(scenario), asked, demands_of(scenario.config))


def driven(scenario, plan, name, model, **limits):
    """Trace of the run of a name with a model; ``limits`` replace those of the scenario."""
    scenario = replace(scenario, limits=scenario.limits._replace(**limits))
    return servo.recorded(scenario, plan, name, servo.drive(scenario, plan, name, model))
