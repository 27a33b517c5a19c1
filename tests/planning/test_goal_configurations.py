"""All joints that show a goal: each does, all that closed forms know of are found, nearest in time first."""

import numpy as np
import pytest

from projservo_cli.planning.goal_configurations import UNSURE, goals_of
from projservo_cli.planning.rrt_connect import SearchLimits, find_path
from tests.planning.joint_space_cases import case

NONE = np.empty((0, 7))


def goals_in(found, seed=0):
    """Goals of a case, their rank, and what was counted."""
    c, n = found.c, len(found.q_start)
    draws = np.random.default_rng(seed).random((400, n))
    starts = np.vstack([found.q_start, c.limits.lower + (c.limits.upper - c.limits.lower) * draws])
    return goals_of(c, found.aim, found.q_start, NONE[:, :n], starts)


@pytest.mark.parametrize("name", ["paper", "ur5", "stanford", "seven"])
@pytest.mark.parametrize("k", [0, 5, 11])
def test_every_goal_shows_the_goal_within_the_limits(name, k):
    found = case(name, k)
    goals, times, (solutions, hidden, _) = goals_in(found)
    goals, times = goals[:64], times[:64]
    assert len(goals) > 0
    assert solutions > hidden
    truth = found.truth
    for q in goals[times < UNSURE]:  # others may have been brought to the limit they lie beyond
        assert np.abs(truth.images(q, truth.M_face) - found.aim.s_star).max() < 1e-4
    for q in goals:
        assert ((q >= found.c.limits.lower) & (q <= found.c.limits.upper)).all()
    assert (np.diff(times) >= 0.0).all()
    wanted = (np.abs(goals - found.q_start) / found.c.limits.speed).max(axis=1)
    np.testing.assert_allclose(times[times < UNSURE], wanted[times < UNSURE])
    apart = np.abs(goals[:, None] - goals[None]).max(axis=2) + 9.0 * np.eye(len(goals))
    assert apart.min() > np.radians(1.0)


def test_an_arm_with_a_spherical_wrist_has_eight_solutions():
    # D. Pieper, "The kinematics of manipulators under computer control", 1968: four places of the wrist, and
    # two turns of it each, wherever limits let them.
    counts = [goals_in(case("paper", k))[2][0] for k in range(6)]
    assert max(counts) == 8
    assert all(count % 2 == 0 for count in counts)


def test_a_goal_beyond_the_limits_is_told():
    found = case("paper", 0)
    # Limits around the start that none of the solutions lies within.
    near = found.c.limits._replace(lower=found.q_start - 1e-3, upper=found.q_start + 1e-3)
    c = found.c._replace(limits=near)
    way = find_path(c, found.aim, found.q_start, NONE[:, :6], SearchLimits())
    assert len(way.goals) == len(way.corners) == way.n_goals == 0
    assert way.solutions == way.hidden > 0
