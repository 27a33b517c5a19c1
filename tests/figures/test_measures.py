import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projservo_cli.control.law import OK
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.loop.step import PLATEAU, Instant, new_log, plateau_stretch, verdict_at
from projservo_cli.report import material as measures
from projservo_cli.report.claims import claims_of
from tests.figures.cases import SPECS, case, geometric
from tests.scene import limits


def test_decay_factors_of_a_geometric_sequence_end_above_the_least_value():
    values = geometric(8.0, 0.5, 10)
    ratios = measures.decay_factors(values, 2, 0.3)  # 2, 1, 0.5 stay above 0.3
    np.testing.assert_array_equal(ratios, [0.5, 0.5])


def test_fitted_rate_is_the_gain_of_a_loop_that_takes_its_share_each_period():
    # exact but for the rounding of logarithms
    assert measures.fitted_rate(geometric(3.0, 1 - 2.5 * 0.04, 60), 5, 1e-4, 0.04) == pytest.approx(2.5, 1e-9)
    assert np.isnan(measures.fitted_rate(geometric(3.0, 0.5, 3), 2, 1e-4, 0.04))


def test_a_run_is_settled_twenty_steps_after_its_last_limited_command():
    trace = case()[2].traces["direct_three"]
    factor = np.ones(60)
    factor[[3, 17]] = 0.5
    assert measures.settled_at(dataclasses.replace(trace, speed_factor=factor)) == 37
    assert measures.settled_at(dataclasses.replace(trace, speed_factor=np.ones(60))) == 20


def test_gap_of_parallel_paths_is_their_distance_whatever_their_sampling():
    u = np.linspace(0, 10, 7)
    first = np.stack([u, np.zeros(7)], axis=1)[:, None]
    v = np.linspace(0, 10, 101)
    second = np.stack([v, np.full(101, 3.0)], axis=1)[:, None]
    np.testing.assert_allclose(measures.path_gap(first, second), [3.0], rtol=1e-14)
    np.testing.assert_allclose(measures.path_gap(second, first), [3.0], rtol=1e-14)
    straight = np.array([[0.0, 0.0], [10.0, 0.0]])
    detour = np.array([[0.0, 0.0], [5.0, 4.0], [10.0, 0.0]])
    assert measures.path_gap(straight, detour) == pytest.approx(4.0, 1e-14)


def on_plateau(error, k, window):
    """Whether a run whose last instant is k ends so."""
    log = new_log(6, 4, len(error), 5)
    log.judged[: len(error)], log.begun[:2] = error, 1.0
    now = Instant(True, False, 1.0, OK, np.zeros(6))
    bounds = limits(image_px=0.0, diverged_factor=1e9, plateau_steps=window, max_steps=k)
    return verdict_at(log, k, now, bounds) == PLATEAU


@given(st.lists(st.sampled_from([0.5, 0.95, 0.9999, 1.0, 1.01]), min_size=0, max_size=60), st.integers(1, 20))
@settings(deadline=None)
def test_a_plateau_is_the_longest_stretch_on_which_the_verdict_would_be_one(factors, window):
    error = np.cumprod([100.0, *factors])
    stretch = plateau_stretch(error, window)
    still = "".join("x" if on_plateau(error, k, window) else " " for k in range(len(error)))
    longest = max(still.split(), key=len, default="")
    if stretch is None:
        assert not longest
    else:
        first, last = stretch
        assert last - first == len(longest) + window - 1
        assert all(on_plateau(error, k, window) for k in range(first + window, last + 1))


def test_the_plateau_that_is_drawn_and_claimed_is_that_of_the_verdict():
    """By the configured steps and the error that the run is judged by, which need not be the image error."""
    material = case()[2]
    count = 40
    judged = np.r_[100.0 * 0.9 ** np.arange(10), np.full(20, 30.0), 30.0 * 0.9 ** np.arange(1, 11)]
    trace = material.traces["stacked"]
    s = np.repeat(trace.s[:1], count, axis=0)
    hidden = np.zeros((count, 2), dtype=bool)
    steep = 100.0 * 0.9 ** np.arange(count)
    still = dataclasses.replace(trace, stop_error=judged, image_error=steep, s=s, self_occluded=hidden)
    given = dataclasses.replace(material, traces={"stacked": still}, plateau_steps=5)
    assert SPECS["fig04_classical"].data(given)["plateau_stacked"].tolist() == [10, 29]
    (claim,) = [claim for claim in claims_of(given, None) if "local minimum" in claim.claim]
    assert claim.measured.startswith("19 steps from step 10 at 30 px")
    assert claim.criterion.startswith("image error falls < 1 % in 5 steps")


def test_way_along_a_line_and_distance_from_it():
    points = np.array([[0.0, 0, 0], [3.0, 4.0, 0], [5.0, 0, 2.0]])
    way, off = measures.along_line(points, np.zeros(3), np.array([10.0, 0, 0]))
    np.testing.assert_allclose(way, [0, 3, 5], atol=1e-15)
    np.testing.assert_allclose(off, [0, 4, 2], atol=1e-15)


def test_rise_counts_from_the_least_value_before():
    e = np.array([[4.0, -3.0], [1.0, -2.0], [-2.5, -1.0], [0.0, 0.0]])
    np.testing.assert_allclose(measures.coordinate_rise(e), [1.5, 0.0])


def test_distance_from_an_exponential():
    e = np.stack([geometric(8.0, 0.5, 5), geometric(8.0, 0.5, 5)], axis=1)
    e[2, 1] += 0.7
    np.testing.assert_allclose(measures.off_exponential(e, 0.5), [0.0, 0.7], atol=1e-15)


def test_curves_that_differ_by_the_sense_of_a_half_turn_are_compared_by_size():
    curve = geometric(np.pi, 0.9, 20)
    difference, mirrored = measures.curve_difference(curve, -curve[:15] + 1e-3)
    assert mirrored
    np.testing.assert_allclose(difference, np.full(15, 1e-3), rtol=1e-9)
    difference, mirrored = measures.curve_difference(curve, curve)
    assert not mirrored
    assert difference.max() == 0


def test_second_order_contributions_add_up_to_the_deviation_of_a_small_step():
    _, bench, material = case()
    model, q = material.plant.model, bench.scenario.ends.q_start
    center = forward_kinematics(model, q) @ material.middle
    H_hat = joint_operators(model, q)
    rng = np.random.default_rng(1)
    velocity = rng.normal(size=len(q))
    line = (np.einsum("i,ijk,k->j", velocity, H_hat, center))[:3]
    line /= np.linalg.norm(line)
    for size, tolerance in ((1e-2, 2e-2), (1e-3, 2e-3)):  # the third order is left out: the error is ∝ size
        step = size * velocity
        moved = forward_kinematics(model, q + step) @ material.middle
        _, off = measures.along_line(moved[None, :3], center[:3], center[:3] + line)
        parts = measures.second_order_drift(H_hat, step, center, line)
        assert parts.sum() == pytest.approx(off[0], rel=tolerance)


def test_center_path_runs_through_the_instants_and_finds_the_deviation_of_the_trace():
    material = case()[2]
    trace = material.studies.sweep["direct_three", "true", False, 0.5]
    path = measures.center_path(material, trace)
    assert len(path) > 5 * len(trace.center)
    for center in trace.center:
        assert np.linalg.norm(path - center, axis=1).min() < 1e-12
    _, off = measures.along_line(path, trace.center[0], material.goal_center(trace))
    # both sample the same curve, at different points
    assert 1e3 * off.max() == pytest.approx(trace.center_deviation_mm, rel=1e-2)


def test_rotation_of_the_task_is_the_half_turn_of_its_configuration():
    trace = case()[2].traces["direct_two"]
    assert np.degrees(measures.true_rotation(trace)) == pytest.approx(180.0, abs=1e-6)


def test_center_image_is_the_projection_of_the_true_centre():
    material = case()[2]
    trace = material.traces["direct_three"]
    image = measures.center_image(material, trace)
    P = material.plant.model.P
    m = P[1] @ np.append(trace.center[2], 1.0)
    np.testing.assert_allclose(image[2, 1], m[:2] / m[2], rtol=1e-14)
