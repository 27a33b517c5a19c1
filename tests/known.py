"""Scenarios whose model is known: what plan and servo do without a calibration."""

from dataclasses import replace

from projservo_cli.config import load_config
from projservo_cli.planning.goal_configurations import GoalFeatures
from projservo_cli.planning.joint_constraints import constraints_of
from projservo_cli.planning.keep_out import NO_KEEP_OUT
from projservo_cli.settings.sections import JointVector
from projservo_cli.stages.plan import plan_task
from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.servo import drive
from projservo_cli.task.target import TargetGoal, TaskImages
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


def true_search(truth, ends, demands, *, pins=(), keep_out=NO_KEEP_OUT):
    """Constraints of a motion of face and pins from joints (n,) to others, and its aim, by the true model."""
    s_start, s_star = (truth.images(q, truth.M_face) for q in ends)
    task = TaskImages(ends[0], s_start, TargetGoal.at(s_star), truth.center).task(truth.model)
    A = truth.M[[*truth.face, *pins]] @ truth.displacement(ends[0]).T
    c = constraints_of(truth.model, A, task, ends[0], demands, keep_out)
    return c, GoalFeatures(task.A_star, s_star, 0.0)
