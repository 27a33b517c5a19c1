"""What the paper claims of the direct laws, with true operators: decay, frames, drift, occlusion."""

import math

import numpy as np
import pytest

from tests.samples import frame, in_frame
from tests.stages.cases import case

DIRECT = ("direct_three", "direct_two")


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
