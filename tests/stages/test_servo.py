"""Traces: what is recorded of a run against the truth, and every way it may be told to end."""

import math
import re

import numpy as np
import pytest

from tests.configured import calibrate, plan, servo, truth_of
from tests.known import configured
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


def test_a_run_that_diverges_by_distance_says_so():
    config = configured("paper", "stop.diverged_factor=1.01", "control.mode=[regulate]")
    calibration = calibrate.run(config)[1]
    trace = servo.run(config, calibration, plan.run(config, calibration), "stacked")
    assert trace.verdict == "diverged"
    assert re.match("the face is 1.4. m from the cameras, over 1.01 times the 1.42 m at first", trace.reason)


UNTESTED = "stop.innovation_threshold=0"


@pytest.fixture(scope="module")
def driven():
    """Function that drives the hobby arm, without noise unless told, on one calibration of noisy trials."""
    calibration = calibrate.run(configured("hobby"))[1]
    undisturbed = configured("hobby", "noise.servo_px=0")
    whole = plan.run(undisturbed, calibration)

    def run(*overrides):
        given = configured("hobby", "noise.servo_px=0", *overrides)
        return servo.run(given, calibration, whole, "exact_track")

    return run


def true_images(trace):
    truth = truth_of(configured("hobby"))
    return np.array([truth.images(q, truth.M_face) for q in trace.q])


@pytest.mark.volume
def test_a_robot_that_is_struck_by_nothing_goes_as_the_ideal_one_does(driven):
    """An event beyond the end of the run takes the loop of robots of the contract, which looks for delays."""
    late = "disturbance.camera_moved={at_step: 100000, view: left, by_px: 1}"
    ideal, other = driven(), driven(late)
    assert (other.verdict, other.success, other.overruns) == (ideal.verdict, ideal.success, 0)
    assert other.steps == pytest.approx(ideal.steps, abs=5)
    assert other.position_error_mm == pytest.approx(ideal.position_error_mm, abs=0.1)
    assert other.center_deviation_mm == pytest.approx(ideal.center_deviation_mm, abs=1.0)
    assert np.abs(other.latency[-1]).max() < 0.005


@pytest.mark.volume
def test_the_trace_holds_the_truth(driven):
    """Of a slip, of play and of a link that flexes; and the true images where they are shown at once."""
    slip = driven("disturbance.joint_moved={at_step: 10, joint: 2, by_deg: 3, encoder_slip: true}", UNTESTED)
    assert np.degrees(slip.q - slip.q_read)[10:, 1] == pytest.approx(np.full(slip.steps - 9, 3.0))
    assert np.abs(slip.s[-1] - true_images(slip)[-1]).max() < 0.5  # carried, on the way
    loose = driven("disturbance.backlash_deg=0.5", "disturbance.link_deflection_deg=0.2", UNTESTED)
    off = np.degrees(np.abs(loose.q - loose.q_read))
    assert 0.2 < off.max() <= 0.25 + 0.2 + 1e-9
