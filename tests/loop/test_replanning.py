"""What becomes of a run that follows a way, with ways that are made up."""

from types import SimpleNamespace

import numpy as np
import pytest

from projservo_cli.loop.replanning import ExecutionMonitor
from projservo_cli.loop.verdicts import (
    BEHIND_CAMERA,
    CONVERGED,
    DIVERGED,
    JOINT_LIMIT,
    MARKERS_LOST,
    RUNNING,
    WAITING,
    new_log,
)
from tests.scene import limits

WAY = np.linspace([0.0, 0.0], [1.0, -2.0], 21)
SEEN = np.arange(12.0).reshape(2, 3, 2)


class PathReplanner:
    """Paths that lead on as often as they are asked to, and tell what they were asked."""

    def __init__(self, count=1, leaves=False):
        self.count, self.out, self.asked = count, leaves, []

    def predicted(self, q):
        return SEEN

    def leaves(self, q, off):
        self.ahead = q, off
        return self.out

    def replan(self, q, excluded, off):
        self.asked.append((q, excluded, off))
        self.count -= 1
        return "another way" if self.count >= 0 else None


def watched(ways, clock=0.0, searches=3, blind=True, **bounds):
    """A watch over a law on the way, that law's tasks and a log whose images are 1 px off."""
    step = SimpleNamespace(parts=np.ones(1, int), share=np.zeros(1), blocked=np.zeros(1))
    state = SimpleNamespace(plan=SimpleNamespace(clock=np.array([clock])), step=step)
    task = SimpleNamespace(reference=SimpleNamespace(q=WAY), s_star=SEEN)
    followed = []
    law = SimpleNamespace(
        law=SimpleNamespace(task=task), state=state, gains=SimpleNamespace(period=0.5), follow=followed.append
    )
    log = new_log(2, 3, 100, 5)
    log.s[:] = SEEN + 1.0
    log.read[:] = 0.25
    return (
        ExecutionMonitor(
            law, lambda plan: plan, ways, searches, limits(max_steps=100, **bounds), blind=blind
        ),
        followed,
        log,
    )


def told(attempt):
    """Code, reason and step of an attempt."""
    return attempt.code, attempt.subject.name, attempt.amount


@pytest.mark.parametrize("verdict", [CONVERGED, BEHIND_CAMERA, WAITING, RUNNING])
def test_most_verdicts_stay(verdict):
    ways = PathReplanner()
    watch, followed, log = watched(ways, clock=3.0)
    assert watch.ruled(log, 20, verdict, np.zeros(2)) == verdict
    assert (followed, watch.attempts, ways.asked) == ([], [], [])


def test_what_stops_the_law_at_the_goal_has_it_shunned():
    ways = PathReplanner(count=2)
    watch, followed, log = watched(ways, clock=20.0)
    assert watch.ruled(log, 30, JOINT_LIMIT, np.zeros(2)) == WAITING
    q, excluded, off = ways.asked[0]
    assert followed == ["another way"]
    np.testing.assert_array_equal(q, log.read[30])
    np.testing.assert_array_equal(excluded, [WAY[-1], log.read[30]])
    np.testing.assert_allclose(off, np.ones((2, 2)))
    assert [told(one) for one in watch.attempts] == [("replanned", "joint limit", 30)]
    # Another goal that fails is excluded beside it; where there is no other way, the verdict stays.
    assert watch.ruled(log, 31, DIVERGED, np.zeros(2)) == WAITING
    assert watch.ruled(log, 32, JOINT_LIMIT, np.zeros(2)) == JOINT_LIMIT
    assert [len(excluded) for _, excluded, _ in ways.asked] == [2, 4, 6]
    assert told(watch.attempts[-1]) == ("replanned_in_vain", "joint limit", 32)


def test_a_law_that_comes_no_nearer_at_the_goal_is_given_another_way():
    ways = PathReplanner()
    watch, _, log = watched(ways, clock=20.0, stall_periods=4)
    log.judged[:] = 3.0
    verdicts = [watch.ruled(log, k, RUNNING, np.zeros(2)) for k in range(40, 46)]
    assert verdicts == [RUNNING] * 4 + [WAITING, RUNNING]
    assert [told(one) for one in watch.attempts] == [("replanned", "no progress", 44)]


def test_what_is_ahead_is_looked_at_with_what_images_are_off():
    ways = PathReplanner(leaves=True)
    watch, _, log = watched(ways, clock=16.0)
    assert watch.ruled(log, 9, RUNNING, np.zeros(2)) == RUNNING
    assert watch.ruled(log, 10, RUNNING, np.zeros(2)) == WAITING
    ahead, off = ways.ahead
    np.testing.assert_array_equal(ahead, WAY[16:])
    np.testing.assert_allclose(off[:, 0, 0], [1.0, 0.75, 0.5, 0.25, 0.0])  # at the goal they agree
    assert ways.asked[0][1].shape == (0, 2)


def test_a_lost_face_is_sought_back_along_the_path():
    ways = PathReplanner()
    watch, followed, log = watched(ways, clock=3.0)
    q_dot = np.zeros(2)
    for k, place in enumerate((2, 1)):
        assert watch.ruled(log, 50 + k, MARKERS_LOST if k == 0 else WAITING, q_dot) == RUNNING
        np.testing.assert_allclose(q_dot, (WAY[place] - 0.25) / 0.5)
        assert watch.law.state.step.parts[0] == 0  # what the law split its last step into is not sent
    assert watch.ruled(log, 52, RUNNING, q_dot) == WAITING
    assert followed == ["another way"]
    assert told(watch.attempts[0]) == ("replanned", "face_back", 52)


def test_a_face_that_is_nowhere_on_the_way_back_is_lost():
    watch, _, log = watched(PathReplanner(), clock=1.5)
    verdicts = [watch.ruled(log, k, MARKERS_LOST, np.zeros(2)) for k in range(3)]
    assert verdicts == [RUNNING, MARKERS_LOST, MARKERS_LOST]


def lost_again(watch, log, ways):
    """Lose the face a first time, see it again on the way back, and follow another way from there."""
    watch.ruled(log, 50, MARKERS_LOST, np.zeros(2))
    assert watch.ruled(log, 51, RUNNING, np.zeros(2)) == WAITING
    watch.law.state.plan.clock[0] = 17.5


@pytest.mark.parametrize(("blind", "first"), [(True, 18), (False, 16)])
def test_a_face_that_is_lost_again_is_passed_over_but_by_an_arm_that_must_not_move_blind(blind, first):
    ways = PathReplanner()
    watch, followed, log = watched(ways, clock=3.0, blind=blind)
    lost_again(watch, log, ways)
    q_dot = np.zeros(2)
    assert watch.ruled(log, 60, MARKERS_LOST, q_dot) == RUNNING
    np.testing.assert_allclose(q_dot, ((WAY[first] + WAY[first + 1]) / 2 - 0.25) / 0.5)
    if blind:
        assert watch.ruled(log, 61, RUNNING, q_dot) == RUNNING
        assert told(watch.attempts[-1]) == ("passed_over", "", 61)
        assert followed == ["another way"]


@pytest.mark.parametrize("count", [1, 2])
def test_joints_that_hide_the_face_at_the_end_are_excluded(count):
    ways = PathReplanner(count)
    watch, followed, log = watched(ways, clock=3.0, max_lost_periods=4)
    lost_again(watch, log, ways)
    q_dot = np.zeros(2)
    verdicts = [watch.ruled(log, 60, MARKERS_LOST, q_dot)]
    verdicts += [watch.ruled(log, k, WAITING, q_dot) for k in range(61, 67)]
    np.testing.assert_allclose(q_dot, (WAY[-1] - 0.25) / 0.5)
    np.testing.assert_array_equal(ways.asked[-1][1], WAY[-1:])
    assert verdicts == [RUNNING] * 6 + [WAITING if count == 2 else MARKERS_LOST]
    assert len(followed) == count
    assert watch.attempts[-1].subject.name == "goal_hidden"
