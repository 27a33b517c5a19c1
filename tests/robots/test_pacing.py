"""Set-points: integrated, bounded, and where an arm that lags and sags comes to rest behind them."""

import math

import numpy as np
import pytest

from projservo_cli.records import JointLimits
from projservo_cli.robots.contract import Bounds
from projservo_cli.robots.pacing import SetPoint

PERIOD = 0.04
SAG = np.full(2, math.radians(1.0))
BOUNDS = Bounds(
    JointLimits(np.full(2, -1.5), np.full(2, 1.5), *np.full((2, 2), 2.0)), np.full(2, 0.4), PERIOD, 0.15, SAG
)


def test_an_arm_that_follows_rests_where_it_is_read_to_the_bit():
    rng, point = np.random.default_rng(0), SetPoint(BOUNDS, np.array([0.1, -0.3]))
    q = np.array([0.1, -0.3])
    for _ in range(50):
        step = rng.uniform(-0.07, 0.07, 2)
        target, speed = point.step(step, PERIOD)
        np.testing.assert_array_equal(target, q + step)
        np.testing.assert_allclose(speed, step / PERIOD, atol=1e-12)
        q = target
        point.read(q, PERIOD)
        np.testing.assert_array_equal(point.at_rest, q)


@pytest.mark.parametrize("lag", [0.0, 0.05, 0.15])
def test_sag_is_learnt_at_rest_and_lag_is_not_taken_for_it(lag):
    sag, q = np.array([0.008, -0.004]), np.zeros(2)
    point = SetPoint(BOUNDS, q)
    worst = 0.0
    for k in range(80):
        target, _ = point.step(np.full(2, 0.03 if k < 30 else 0.0), PERIOD)
        q = q + (target - sag - q) * (1.0 if lag == 0.0 else -math.expm1(-PERIOD / lag))
        point.read(q, PERIOD)
        worst = max(worst, float(np.abs(target - point.at_rest).max()))
    assert worst < 0.02  # far less than the 0.11 rad by which a lag of 0.15 s is behind
    np.testing.assert_allclose(point.at_rest, q, atol=1e-4)
    np.testing.assert_allclose(point.target - q, sag, atol=1e-4)


def test_a_set_point_leads_no_farther_than_it_may_and_stays_within_the_limits():
    point = SetPoint(BOUNDS, np.zeros(2))
    for _ in range(20):
        point.step(np.array([0.08, 0.0]), PERIOD)  # and nothing moves
    np.testing.assert_array_equal(point.target, [0.4, 0.0])
    assert point.short.tolist() == [True, False]
    point.read(np.array([1.4, 0.0]), PERIOD)
    target, _ = point.step(np.array([0.05, 0.0]), PERIOD)
    assert target[0] == pytest.approx(1.0)  # no farther behind than it may lead
    point.read(np.array([1.45, 0.0]), PERIOD)
    for _ in range(20):
        point.step(np.array([0.08, 0.0]), PERIOD)
    assert point.target[0] == 1.5
