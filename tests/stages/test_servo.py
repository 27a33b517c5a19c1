"""Traces: what is recorded of a run against the truth, and every way it may be told to end."""

import math

import numpy as np
import pytest

from tests.stages.cases import case


def test_trace_is_the_run_as_it_was():
    example = case("ur5")
    trace = example.trace("direct_three")
    k = trace.steps
    assert len(trace.q) == len(trace.s) == len(trace.theta_r) == k + 1
    assert len(trace.q_dot) == len(trace.speed_factor) == k
    for i in (0, k // 2, k):
        assert trace.pose[i] == pytest.approx(example.truth.robot.pose(trace.q[i]), abs=1e-12)
        body = np.linalg.solve(example.truth.robot.base_tool, example.truth.M_face.mean(axis=0))
        assert trace.center[i] == pytest.approx((trace.pose[i] @ body)[:3], abs=1e-12)
        assert trace.s[i] == pytest.approx(example.truth.images(trace.q[i], example.truth.M_face), abs=1e-8)
    gap = 1e3 * np.linalg.norm(trace.center[-1] - example.goal_center)
    assert trace.position_error_mm == pytest.approx(gap, abs=1e-9)
    assert trace.tau_affine[-1] == pytest.approx(gap * 1e-3, abs=1e-9)  # a metric model
    assert trace.rotation_error_deg == pytest.approx(math.degrees(trace.theta_s[-1]), abs=1e-7)
    assert trace.speed_limited_steps == int((trace.speed_factor < 1).sum()) > 0
    fastest = np.abs(trace.q_dot).max(axis=1)
    assert fastest.max() == pytest.approx(math.radians(125), rel=1e-12)
    assert fastest[trace.speed_factor < 1] == pytest.approx(math.radians(125), rel=1e-12)


@pytest.mark.parametrize("name", ["paper_perturbed", "stanford"])
@pytest.mark.parametrize("law", ["direct_three", "direct_two"])
def test_direct_laws_do_the_task_in_sight_of_both_cameras(name, law):
    trace = case(name).trace(law)
    assert trace.verdict == "converged"
    assert (trace.self_occluded_steps_left, trace.self_occluded_steps_right) == (0, 0)
    assert trace.position_error_mm < 0.1
    assert trace.rotation_error_deg < 0.05
    assert (trace.first_beyond_limit, trace.first_outside_image) == (-1, -1)
