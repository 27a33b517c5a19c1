"""The law without drift, with the true operators."""

from functools import lru_cache

import numpy as np
import pytest

from tests.known import configured, driven, known_scenario, planned


@lru_cache(maxsize=32)
def exact_run(arm, gain, limit, *overrides):
    gains = [f"control.gain_{part}={gain / 0.04}" for part in "ts"]
    scenario = known_scenario(configured(arm, *gains, f"control.joint_speed_limit_deg_s={limit}", *overrides))
    model = scenario.simulated.truth.model
    return driven(scenario, planned(scenario, model, samples=3), "exact", model)


@pytest.mark.volume
@pytest.mark.parametrize("limit", ["null", "125"])
@pytest.mark.parametrize("gain", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("arm", ["paper", "ur5"])
def test_the_centre_keeps_to_its_line(arm, gain, limit):
    trace = exact_run(arm, gain, limit)
    assert trace.verdict == "converged"
    assert not trace.self_occluded.any()
    # A joint step solved to 1e-8 rad, once more: round-off of products over a metre.
    assert trace.center_deviation_at_samples_mm < 1e-7
    assert trace.center_deviation_mm < 0.2


def test_a_scaled_command_keeps_to_the_line():
    # Long steps, which a straight way between the joints of their ends would leave by millimetres.
    trace = exact_run("paper", 0.5, "null", "plant.speed_scale=0.5", "stop.max_steps=15")
    assert trace.center_deviation_at_samples_mm < 1e-7
    assert np.abs(trace.q[1] - trace.q[0]).max() > 0.04


def test_the_limit_shortens_the_way_and_never_bends_it():
    # Fewer steps than to the goal: only the deviation from the line is looked at.
    trace = exact_run("paper", 0.5, "125", "stop.max_steps=6")
    assert trace.speed_limited_steps == 6
    assert trace.center_deviation_at_samples_mm < 1e-7
    # It is kept by the step as it is solved, and all but used up.
    assert 4.99 < np.degrees(np.abs(np.diff(trace.q, axis=0)).max()) <= 5.0 * (1.0 + 1e-9)


def test_parts_of_a_step_are_sent_only_when_asked_for():
    sent = exact_run("paper", 0.3, "null", "stop.max_steps=1")
    straight = exact_run("paper", 0.3, "null", "stop.max_steps=1", "control.substeps=none")
    np.testing.assert_array_equal(sent.q, straight.q)
    assert sent.center_deviation_mm < 0.2 < straight.center_deviation_mm
