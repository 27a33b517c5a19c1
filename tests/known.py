"""Scenarios whose model is known: what plan and servo do without a calibration."""

from dataclasses import replace

from projservo_cli.config import load_config
from projservo_cli.settings.sections import JointVector
from projservo_cli.stages.plan import plan_task
from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.servo import drive
from tests.configured import scenario_of, trajectory_of
from tests.conftest import ROOT


def configured(name, *overrides):
    """A shipped configuration."""
    return load_config(ROOT / "configs" / f"{name}.yaml", list(overrides))


def with_task(config, ends, aim=None, **more):
    """A configuration with joints (n,), rad or m, as start and goal, or another goal, and with other keys."""
    start, goal = (JointVector(joints=tuple(q.tolist()), unit="rad") for q in ends)
    aim = type(config.task.goal)(joints=goal) if aim is None else aim
    task = config.task.model_copy(update={"start": start, "goal": aim})
    return config.model_copy(update={"task": task, **more})


def known_scenario(config):
    """The scenario of a configuration whose face is measured point by point; nothing is calibrated."""
    control = config.control.model_copy(update={"features": "points"})
    return scenario_of(config.model_copy(update={"control": control}))


def asked(profile="linear", samples=101, duration=None, ramp=0.0, **more):
    """A motion that is asked for."""
    return trajectory_of(
        profile=profile, n_samples=samples, duration_s=duration, acceleration_time_s=ramp, **more
    )


def planned(scenario, model, profile="linear", samples=11, **more):
    """Plan of a scenario with a model of it."""
    delta = scenario.world.inputs.trajectory.visibility_fraction
    return plan_task(
        model, scenario.ends, asked(profile, samples, visibility_fraction=delta, **more), scenario.demands
    )


def driven(scenario, plan, name, model, **limits):
    """Trace of the run of a name with a model; ``limits`` replace those of the scenario."""
    scenario = replace(scenario, termination=scenario.termination._replace(**limits))
    return trace_of(drive(scenario, plan, name, model))
