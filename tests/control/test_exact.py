"""The law without drift, with the true operators."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.stages import plan, servo
from projservo_cli.stages.scenario import plant_of, reach_of, servo_noise, truth_of
from projservo_cli.task.margins import within

CONFIGS = Path(__file__).parents[2] / "configs"


@lru_cache(maxsize=32)
def exact_run(arm, gain, limit, *overrides):
    gains = [f"control.gain_{part}={gain / 0.04}" for part in "ts"]
    config = load_config(
        CONFIGS / f"{arm}.yaml", [*gains, f"control.joint_speed_limit_deg_s={limit}", *overrides]
    )
    truth = truth_of(config)
    reach = reach_of(config, truth)
    bounds = within(truth.robot.lower, truth.robot.upper)
    sense = plan.plan_task(
        truth.model, reach.q_start, reach.s_start, reach.s_star, truth.center, "linear", 0.9, 3, bounds
    ).rotation_sense()
    return servo.drive(
        "exact",
        truth.model,
        plant_of(config, truth, reach.q_start),
        truth,
        reach,
        servo.gains_of(config),
        servo.limits_of(config),
        servo_noise(config, len(truth.face)),
        sense,
    )


@pytest.mark.volume
@pytest.mark.parametrize("limit", ["null", "125"])
@pytest.mark.parametrize("gain", [0.02, 0.05, 0.1, 0.3, 0.5])
@pytest.mark.parametrize("arm", ["paper", "ur5"])
def test_the_centre_keeps_to_its_line(arm, gain, limit):
    trace = exact_run(arm, gain, limit)
    assert trace.verdict == "converged"
    assert not trace.self_occluded.any()
    # A joint step solved to 1e-8 rad, once more: round-off of products over a metre.
    assert trace.center_deviation_at_samples_mm < 1e-7
    assert trace.center_deviation_mm < 0.2


def test_the_limit_shortens_the_way_and_never_bends_it():
    # Fewer steps than to the goal: only the deviation from the line is looked at.
    trace = exact_run("paper", 0.5, "125", "stop.max_steps=6")
    assert trace.speed_limited_steps == 6
    assert trace.center_deviation_at_samples_mm < 1e-7
    # The limit holds for the first-order step; the exact one differs by its second order.
    assert np.degrees(np.abs(np.diff(trace.q, axis=0)).max()) < 6.0


def test_parts_of_a_step_are_sent_only_when_asked_for():
    sent = exact_run("paper", 0.3, "null", "stop.max_steps=1")
    straight = exact_run("paper", 0.3, "null", "stop.max_steps=1", "control.substeps=none")
    np.testing.assert_array_equal(sent.q, straight.q)
    assert sent.center_deviation_mm < 0.2 < straight.center_deviation_mm
