"""Traces: what is recorded of a run against the truth, and every way it may be told to end."""

import math
from dataclasses import replace

import numpy as np
import pytest

from projservo_cli.loop.verdicts import plateau_stretch
from projservo_cli.stages.servo import drive
from tests.stages.cases import Case, case


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


def test_deviation_is_that_from_the_line_between_true_start_and_goal():
    trace, goal = case("ur5").trace("direct_two"), case("ur5").goal_center
    way = (goal - trace.center[0]) / np.linalg.norm(goal - trace.center[0])
    off = trace.center - trace.center[0]
    at_samples = 1e3 * np.linalg.norm(off - np.outer(off @ way, way), axis=1).max()
    assert trace.center_deviation_at_samples_mm == pytest.approx(at_samples, abs=1e-9)
    assert trace.center_deviation_mm >= at_samples - 1e-9


@pytest.mark.parametrize("name", ["paper", "paper_perturbed", "ur5", "stanford"])
@pytest.mark.parametrize("law", ["direct_three", "direct_two"])
def test_direct_laws_do_the_task_in_sight_of_both_cameras(name, law):
    trace = case(name).trace(law)
    assert trace.verdict == "converged"
    assert (trace.self_occluded_steps_left, trace.self_occluded_steps_right) == (0, 0)
    assert trace.position_error_mm < 0.1
    assert trace.rotation_error_deg < 0.05
    assert (trace.first_beyond_limit, trace.first_outside_image) == (-1, -1)


def test_opaque_face_loses_its_markers():
    example = Case("paper", ["plant.self_occlusion=opaque"])
    trace = example.trace("stacked")
    assert trace.verdict == "markers lost"
    assert trace.self_occluded[-1].any()
    waited = example.config.stop.max_lost_periods
    assert not trace.self_occluded[: -1 - waited].any()
    assert (trace.q_dot[-waited:] == 0.0).all()
    assert str(trace.steps) in trace.reason


def test_joint_limit_stops_where_it_is_told_to():
    """The stacked law passes a joint limit on this task; told to stop it ends there."""
    passed = case("paper").trace("stacked")
    assert passed.first_beyond_limit > 0
    example = Case("paper", ["plant.joint_limits=stop"])
    trace = example.trace("stacked")
    assert trace.verdict == "joint limit"
    assert trace.steps == passed.first_beyond_limit
    assert trace.limit_joint == passed.limit_joint
    assert trace.reason.endswith(" px is left")
    bounds = example.plant.limits.lower, example.plant.limits.upper
    assert np.abs(np.subtract(bounds, trace.q[-1]))[:, trace.limit_joint].min() < 1e-10
    assert (trace.remaining_translation, trace.remaining_rotation_deg) == (None, None)  # it measures neither


def test_noise_widens_the_tolerance():
    assert Case("ur5", ["noise.servo_px=0.5"]).limits.image_error_px == pytest.approx(0.01 + 2.0 * 0.5)


def test_plateau_is_the_longest_stretch_without_a_fall():
    """20 flat steps in the middle of a steep fall; the window of 5 steps must fall by 1 % to count."""
    error = np.r_[100 * 0.9 ** np.arange(10), np.full(20, 30.0), 30 * 0.9 ** np.arange(1, 10)]
    assert np.diff(plateau_stretch(error, 5)) == 19
    assert plateau_stretch(100 * 0.9 ** np.arange(30), 5) is None
    assert plateau_stretch(np.ones(3), 5) is None
    assert np.diff(plateau_stretch(np.ones(30), 5)) == 29


@pytest.mark.parametrize("steps", [10, 25])
def test_the_size_of_the_face_tells_about_how_far_it_is_off(steps):
    """The error in the images holds the rotation that is left too: it is compared once that is small."""
    trace = case("stanford").servo("direct_three", max_steps=steps)
    assert trace.image_error_px == trace.image_error[-1]
    moved = np.linalg.norm(_corners(trace, trace.pose[-1]) - _corners(trace, trace.goal_pose), axis=1)
    assert trace.estimated_position_error_mm == pytest.approx(1e3 * np.sqrt(np.mean(moved**2)), rel=0.4)


def _corners(trace, pose):
    """Corners (k, 3) of the face of the case at a pose of the tool."""
    truth = case("stanford").truth
    return (truth.M_face @ np.linalg.inv(truth.robot.base_tool).T @ pose.T)[:, :3]


def test_no_size_and_no_images_that_agree_are_no_measure():
    example = case("ur5")
    run = drive(
        replace(example.scenario, termination=example.limits._replace(max_steps=5)), example.plan, "exact"
    )
    assert run.trace().estimated_position_error_mm > 0.0
    assert replace(run, verdict="fault detected").trace().estimated_position_error_mm is None
    for left_px, agrees in ((0.03, True), (0.05, False)):  # of 8 markers, with 10 coordinates to spare
        fit = np.full_like(run.log.fit, np.nan)
        fit[run.steps] = 0.0, 10.0 * left_px**2, 8.0
        told = replace(run, log=run.log._replace(fit=fit)).trace()
        assert told.fit_px[-1] == pytest.approx(left_px)
        assert (told.estimated_position_error_mm is not None) == agrees
    unsized = example.settings.markers.model_copy(update={"positions_m": None})
    for markers, size in ((unsized, None), (unsized.model_copy(update={"tag_size_m": 0.1}), 0.1)):
        given = replace(run.scenario.servo, lengths=markers.lengths(example.config.face_numbers))
        told = replace(run, scenario=replace(run.scenario, servo=given)).trace()
        assert (told.estimated_position_error_mm is None) == (size is None)
