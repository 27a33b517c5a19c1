"""What the paper claims of the direct laws, with true operators: decay, frames, drift, occlusion."""

import math

import numpy as np
import pytest

from tests.samples import frame, in_frame
from tests.stages.cases import case

DIRECT = ("direct_three", "direct_two")
GAINS_A_STEP = (0.5, 0.3, 0.1, 0.05, 0.02)


@pytest.mark.parametrize("name", ["paper", "paper_perturbed", "ur5", "stanford"])
@pytest.mark.parametrize("law", DIRECT)
def test_direct_laws_do_the_task_in_sight_of_both_cameras(name, law):
    trace = case(name).trace(law)
    assert trace.verdict == "converged"
    assert (trace.self_occluded_steps_left, trace.self_occluded_steps_right) == (0, 0)
    assert trace.position_error_mm < 0.1
    assert trace.rotation_error_deg < 0.05
    assert trace.first_beyond_limit == -1
    assert trace.first_outside_image == -1


@pytest.mark.parametrize("name", ["paper", "ur5"])
@pytest.mark.parametrize("law", DIRECT)
def test_errors_decay_exponentially(name, law):
    """Within 1 % of 1 − gain·period a step, from 20 steps after the last saturated one to 0.1 mm or 0.05°."""
    example = case(name)
    trace = example.trace(law)
    wanted = 1.0 - example.config.control.gain_t * trace.period
    distance = np.linalg.norm(trace.center - example.goal_center, axis=1)
    saturated = np.flatnonzero(trace.speed_factor < 1.0)
    first = (saturated[-1] if len(saturated) else 0) + 20
    last = int(np.argmax((distance < 1e-4) | (trace.theta_s < math.radians(0.05))))
    assert last - first >= 10
    for error in (distance[first:last], trace.theta_s[first:last]):
        assert error[1:] / error[:-1] == pytest.approx(np.full(last - first - 1, wanted), rel=0.01)


@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_projective_and_euclidean_models_give_the_same_angles(name):
    """To 1e-6 degrees at every instant, in an ordinary and in a mirrored frame."""
    example = case(name)
    bounds = {"max_steps": 60}
    euclidean = example.servo("direct_three", **bounds)
    for seed in (1, 2):
        model = in_frame(example.truth.model, frame(seed, mirrored=seed == 2))
        projective = example.servo("direct_three", model, **bounds)
        for field in ("theta_r", "theta_p", "theta_s"):
            difference = np.degrees(getattr(projective, field) - getattr(euclidean, field))
            assert np.abs(difference).max() < 1e-6
    # The translation differs by the scale of its kernel alone, not at all once that is fixed.
    assert projective.tau_affine[0] != pytest.approx(euclidean.tau_affine[0], rel=1e-3)
    ratio = projective.tau_affine / euclidean.tau_affine
    assert ratio == pytest.approx(np.full(len(ratio), ratio[0]), rel=0.5)
    assert projective.tau == pytest.approx(euclidean.tau, rel=1e-8)


def deviations(example, law, limit_deg):
    found = []
    for share in GAINS_A_STEP:
        rate = share / example.gains.period
        gains = example.gains._replace(gain_t=rate, gain_r=rate, gain_p=rate, gain_s=rate)
        speed = np.full(6, math.radians(limit_deg) / gains.period)
        trace = example.servo(law, gains=gains, speed=speed)
        assert trace.verdict == "converged"
        found.append(trace.center_deviation_mm)
    return np.array(found)


@pytest.mark.volume
@pytest.mark.parametrize("name", ["paper", "ur5"])
@pytest.mark.parametrize("law", DIRECT)
def test_drift_falls_with_the_gain_and_with_the_limit(name, law):
    """Strictly over gains of 0.5 … 0.02 a step; with 5° a step nowhere larger.

    0.1 % of tolerance: on the second robot at gain 0.02 the limit scales a single command, which
    moves the largest deviation by one micrometre in 4.2 mm.
    """
    free = deviations(case(name), law, math.inf)
    limited = deviations(case(name), law, 5.0)
    assert (np.diff(free) < 0).all()
    assert (limited <= free * 1.001).all()
    assert limited[0] < 0.5 * free[0]


@pytest.mark.parametrize("law", ["stacked", "euclidean_points"])
def test_classical_laws_turn_the_face_through_occlusion(law):
    trace = case("paper").trace(law)
    assert trace.self_occluded_steps_left > 0
    assert trace.self_occluded_steps_right > 0


def test_blockwise_does_not_converge():
    assert case("paper").servo("blockwise", max_steps=150).verdict != "converged"


def test_image_error_is_neither_exponential_nor_monotone():
    """Some coordinate moves away from its goal for a while, and no single factor describes the decay."""
    trace = case("paper").trace("direct_three")
    errors = np.abs(trace.s - trace.s_star).reshape(len(trace.s), -1)
    assert (np.diff(errors, axis=0).max(axis=0) > 1.0).any()  # px in one step
    factors = trace.image_error[1:] / trace.image_error[:-1]
    assert factors.max() - factors.min() > 0.05


def test_rotation_error_starts_at_half_a_turn():
    trace = case("paper").servo("direct_three", max_steps=2)
    assert math.degrees(trace.theta_s[0]) == pytest.approx(180.0, abs=1e-6)
