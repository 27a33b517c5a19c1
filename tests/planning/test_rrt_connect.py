"""Paths from start to goal: valid, timed within the limits, the same whoever searches beside."""

import numpy as np
import pytest

from projservo_cli.planning.joint_constraints import new_trial
from projservo_cli.planning.rrt_connect import SearchLimits, find_path, margins_at
from projservo_cli.planning.time_parameterization import ROOM, joints_at, time_parameterized
from tests.planning.columns import JOINTS, VISIBILITY, WIDTH
from tests.planning.joint_space_cases import COUNT, case

SEARCH = SearchLimits()


def way_of(found, search=SEARCH):
    """The way of a case."""
    nothing = np.empty((0, len(found.q_start)))
    return find_path(found.c, found.aim, found.q_start, nothing, search)


@pytest.mark.parametrize("name", ["paper", "stanford", "seven"])
def test_every_task_has_a_valid_way_within_the_limits_of_the_joints(name):
    straight = 0
    for k in range(COUNT):
        found = case(name, k)
        path = way_of(found)
        straight += len(path.corners) == 2
        assert (path.corners[0] == found.q_start).all()
        assert np.abs(path.goals - path.corners[-1]).max(axis=1).min() == 0.0
        timed, period = path.timing, 1e-3
        q = joints_at(timed, np.arange(0.0, timed.time[-1] + 2 * period, period))
        margins = np.array([margins_at(found.c, row)[0] for row in q[::5]])
        assert margins[:, [JOINTS, VISIBILITY, VISIBILITY + 1, WIDTH, WIDTH + 1]].min() > 0.0
        assert ((q >= found.c.limits.lower) & (q <= found.c.limits.upper)).all()
        # Difference quotients are means of what they approximate: they exceed no bound of it. Between two
        # points of the grid the speed may by the round of a corner, by less than a hundredth.
        speed, acceleration = np.diff(q, axis=0) / period, np.diff(q, n=2, axis=0) / period**2
        assert (np.abs(speed) / found.c.limits.speed).max() <= ROOM * 1.01
        assert (np.abs(acceleration) / found.c.limits.acceleration).max() <= ROOM * (1.0 + 1e-6)
        np.testing.assert_allclose(q[-1], path.corners[-1], atol=1e-12)
        assert np.isfinite(acceleration).all()
    assert straight > 0


def test_a_straight_way_takes_the_time_of_its_slowest_joint():
    # At constant acceleration up to the limit of speed and down again, as any textbook has it.
    found = case("paper", 0)
    for q_goal in (found.q_start + 0.02, found.q_start + np.array([0.0, 0.0, -1.0, 0.2, 0.3, 0.1])):
        timed = time_parameterized(found.c, np.stack([found.q_start, q_goal]), new_trial(found.c))
        d, v, a = (
            np.abs(q_goal - found.q_start),
            ROOM * found.c.limits.speed,
            ROOM * found.c.limits.acceleration,
        )
        least = np.where(d < v * v / a, 2.0 * np.sqrt(d / a), d / v + v / a).max()
        assert timed.time[-1] == pytest.approx(least, rel=2e-3)
        assert timed.time[-1] >= least * (1.0 - 1e-9)


def test_the_pace_is_nearly_the_quickest_there_is():
    toppra = pytest.importorskip("toppra", reason="compares with toppra where it is installed")
    found = case("stanford", next(k for k in range(COUNT) if len(way_of(case("stanford", k)).corners) > 2))
    path = way_of(found)
    timed = path.timing
    path = toppra.interpolator.SplineInterpolator(timed.s, timed.q)
    limits = [
        toppra.constraint.JointVelocityConstraint(np.c_[-1, 1] * ROOM * found.c.limits.speed[:, None]),
        toppra.constraint.JointAccelerationConstraint(
            np.c_[-1, 1] * ROOM * found.c.limits.acceleration[:, None]
        ),
    ]
    quickest = toppra.algorithm.TOPPRA(limits, path).compute_trajectory(0, 0).duration
    assert timed.time[-1] <= 1.05 * quickest


def test_no_way_is_told_with_what_stands_in_it():
    # A width that the face keeps nowhere but at its ends: the trees end at it.
    found = case("paper", 0)
    full = found.c.full.copy()
    full[WIDTH : WIDTH + 2] = 1e4
    path = way_of(found._replace(c=found.c._replace(full=full)), SearchLimits(max_samples=500))
    assert len(path.goals) > 0
    assert len(path.corners) == 0
    assert path.timing is None
    assert path.draws == 500
    assert path.failures.argmax() in (WIDTH, WIDTH + 1)
