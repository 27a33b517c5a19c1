"""Highest share of the joint-speed limit that each law commands in each of its modes."""

from dataclasses import replace

import numpy as np

from projservo_cli.laws import IMAGE_TRACK, LAWS, REGULATE, TRACK, law_and_mode, run_names
from projservo_cli.records import InputError, WorkFailed
from projservo_cli.stages.plan import plan_task
from projservo_cli.stages.plan_motion import search_of
from projservo_cli.stages.runs.law_run import LawRun, PlannedCourse
from tests.configured import scenario_of
from tests.known import asked

RUNS = run_names(LAWS, (REGULATE, TRACK, IMAGE_TRACK))


def highest_shares(config, profiles=("linear",), max_steps=40):
    """Highest share by run and profile of its plan, in the compiled loop with the true model.

    profiles : of plans; one that cannot be made, or that joints cannot follow, is left out.
    """
    control = config.control.model_copy(update={"features": "body"})
    scenario = scenario_of(config.model_copy(update={"control": control}))
    limits, servo = scenario.termination._replace(max_steps=max_steps), scenario.servo
    scenario = replace(scenario, termination=limits, servo=replace(servo, contract=None))
    found = {}
    for profile in profiles:
        motion, search = asked(profile, samples=11), search_of(scenario)
        try:
            plan = plan_task(scenario.world.model, scenario.ends, motion, scenario.demands, search)
        except (InputError, WorkFailed):
            continue
        for name in RUNS:
            law, mode = law_and_mode(name)
            if (mode == REGULATE and (name, profiles[0]) not in found) or np.isfinite(plan.q).all():
                run = LawRun(scenario, plan, law, PlannedCourse(mode))
                run.compiled()
                q = run.log.q[: run.steps + 1]
                found[name, profile] = highest_share(q, scenario.gains.period, limits.speed)
    return found


def highest_share(q, seconds, speed):
    """Highest share of the joint-speed limits (n,) in steps of so many s between joints (k, n)."""
    return float((np.abs(np.diff(q, axis=0)) / (seconds * speed)).max(initial=0.0))
