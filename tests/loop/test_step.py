"""What one period does beside the law: verdicts and their order, limits, counting."""

import math
from itertools import pairwise

import numpy as np
import pytest

from projservo_cli.geometry.kinematics import beyond_limits
from projservo_cli.loop.step import (
    BEHIND_CAMERA,
    CONVERGED,
    DIVERGED,
    LEFT_IMAGE,
    MARKERS_LOST,
    RUNNING,
    SINGULAR_VERDICT,
    VERDICTS,
    Instant,
    finite,
    image_error,
    limit_speed,
    on_plateau,
    outside,
    verdict_at,
)
from tests.scene import limits

# Each verdict with what brings it about, in the order of precedence.
CAUSES = [
    (BEHIND_CAMERA, {"in_front": False}),
    (LEFT_IMAGE, {"left": True}),
    (MARKERS_LOST, {"seen": False}),
    (CONVERGED, {"error": 1e-4}),
    (DIVERGED, {"distance": 21.0}),
    (SINGULAR_VERDICT, {"singular": True}),
]
CALM = {
    "in_front": True,
    "seen": True,
    "left": False,
    "error": 50.0,
    "first_error": 40.0,
    "tolerance": 0.01,
    "distance": 1.5,
    "first_distance": 2.0,
    "finite_command": True,
    "singular": False,
}


def verdict(border_stops=True, **given):
    state = {**CALM, **given}
    return verdict_at(Instant(**state), limits(stop_at_border=border_stops))


def test_a_calm_instant_goes_on():
    assert verdict() == RUNNING


@pytest.mark.parametrize(("code", "cause"), CAUSES)
def test_each_verdict_has_its_cause(code, cause):
    assert verdict(**cause) == code


def test_the_first_of_several_causes_decides():
    """Every pair, and each tail of the table, in the order the module documents."""
    for i, (code, cause) in enumerate(CAUSES):
        for _, other in CAUSES[i + 1 :]:
            assert verdict(**other, **cause) == code
        assert verdict(**{k: v for _, tail in CAUSES[i:] for k, v in tail.items()}) == code
    for (code, _), (following, _) in pairwise(CAUSES):
        assert code < following


def test_the_border_stops_only_where_it_is_told_to():
    assert verdict(border_stops=False, left=True) == RUNNING
    assert verdict(border_stops=False, left=True, seen=False) == MARKERS_LOST


@pytest.mark.parametrize(
    "cause",
    [{"error": 401.0}, {"distance": 20.1}, {"finite_command": False}],
    ids=["image error tenfold", "distance tenfold", "command not finite"],
)
def test_each_way_to_diverge(cause):
    assert verdict(**cause) == DIVERGED


def test_just_short_of_diverging_goes_on():
    assert verdict(error=399.9, distance=19.9) == RUNNING


def test_verdicts_have_the_promised_names():
    assert set(VERDICTS) == {
        "converged", "plateau", "diverged", "left image", "behind camera", "joint limit", "singular",
        "max steps", "markers lost", "disturbed", "failed",
    }  # fmt: skip


def test_speed_is_limited_by_uniform_scaling(rng):
    """The direction stays, no joint exceeds its limit, the fastest is at its own."""
    speed = np.array([1.0, 2.0, 0.5, 1.0, 3.0, 0.1])
    for _ in range(50):
        q_dot = rng.normal(size=6) * 10.0 ** rng.integers(-2, 3)
        given = q_dot.copy()
        factor = limit_speed(q_dot, speed)
        assert 0 < factor <= 1
        assert q_dot == pytest.approx(factor * given, rel=1e-15)
        assert (np.abs(q_dot) <= speed * (1 + 1e-15)).all()
        wanted = min(1.0, (speed / np.abs(given)).min())
        assert factor == pytest.approx(wanted, rel=1e-15)


def test_slow_commands_and_endless_limits_change_nothing():
    q_dot = np.array([0.1, -1e9])
    assert limit_speed(q_dot, np.array([0.1, math.inf])) == 1.0
    assert q_dot.tolist() == [0.1, -1e9]
    assert limit_speed(np.zeros(2), np.full(2, 1.0)) == 1.0


def test_image_error_is_the_rms_over_markers_and_views():
    s, s_star = np.zeros((2, 3, 2)), np.zeros((2, 3, 2))
    s[0, 1] = [3.0, 4.0]
    assert image_error(s, s_star) == pytest.approx(5.0 / math.sqrt(6.0))
    s[1, 2, 0] = math.nan  # unseen: it does not count
    assert image_error(s, s_star) == pytest.approx(5.0 / math.sqrt(5.0))
    further = np.concatenate([s, np.full((2, 2, 2), 1e3)], axis=1)
    assert image_error(further, s_star) == image_error(s, s_star)
    assert math.isnan(image_error(np.full((2, 3, 2), math.nan), s_star))


def test_outside_and_finite():
    s = np.full((2, 3, 2), 100.0)
    size = np.array([640.0, 480.0])
    assert not outside(s, 3, size)
    for place, value in [((0, 0, 0), -0.51), ((1, 2, 0), 639.51), ((1, 1, 1), 479.51), ((0, 2, 1), -0.51)]:
        there = s.copy()
        there[place] = value
        assert outside(there, 3, size)
        there[place] = np.sign(value) * (abs(value) - 0.02)
        assert not outside(there, 3, size)
        assert not outside(there, 3, np.full(2, math.inf)) or value < 0
        there[place] = math.nan
        assert not outside(there, 3, size)
    assert finite(np.zeros(3))
    assert not finite(np.array([0.0, math.nan]))
    assert not finite(np.array([math.inf, 0.0]))


def test_first_joint_beyond_its_limits():
    lower, upper = np.array([-1.0, -2.0, 0.0]), np.array([1.0, 2.0, 0.5])
    assert beyond_limits(np.array([1.0, -2.0, 0.5]), lower, upper) == -1
    assert beyond_limits(np.array([0.0, 2.1, 0.6]), lower, upper) == 1
    assert beyond_limits(np.array([0.0, 0.0, -1e-9]), lower, upper) == 2
    assert beyond_limits(np.array([math.nan, 0.0, 0.0]), lower, upper) == 0


def test_plateau_is_a_fall_below_one_per_cent():
    errors = 100 * 0.9996 ** np.arange(60)  # 0.8 % in 20 steps, 1.2 % in 30
    assert on_plateau(errors, 40, 20)
    assert not on_plateau(errors, 40, 30)
    assert not on_plateau(errors, 19, 20)
    assert on_plateau(errors, 20, 20)
