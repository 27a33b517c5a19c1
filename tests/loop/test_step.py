"""What one period does beside the law: verdicts and their order, limits, counting."""

import math

import numpy as np
import pytest

from projservo_cli.control.law import LOST, OK, SINGULAR
from projservo_cli.geometry.kinematics import beyond_limits
from projservo_cli.loop.verdicts import (
    BEHIND_CAMERA,
    CONVERGED,
    DIVERGED,
    JOINT_LIMIT,
    MARKERS_LOST,
    MAX_STEPS,
    NO_PROGRESS,
    OUT_OF_VIEW,
    RUNNING,
    SINGULAR_VERDICT,
    WAITING,
    Command,
    Instant,
    bounded,
    new_log,
    note,
    verdict_at,
)
from projservo_cli.records import position_limits
from tests.scene import limits, scene

# Each verdict with what brings it about, in the order of precedence.
CAUSES = [
    (BEHIND_CAMERA, {"in_front": False}),
    (OUT_OF_VIEW, {"left": True}),
    (MARKERS_LOST, {"status": LOST}),
    (CONVERGED, {"error": 1e-4}),
    (DIVERGED, {"distance": 21.0}),
    (SINGULAR_VERDICT, {"status": SINGULAR}),
]
CALM = {"in_front": True, "left": False, "distance": 1.5, "status": OK, "q_dot": np.zeros(6)}


def verdict(error=50.0, border_stops=True, **given):
    """Verdict at the second instant of a run that began 40 px and 2 m from its goal."""
    log, bounds = new_log(6, 4, 9, 5), limits(stop_at_border=border_stops, image_error_px=0.01)
    for k, now in ((0, {"distance": 2.0, "error": 40.0}), (1, {"error": error, **given})):
        log.judged[k] = now.pop("error")
        found = verdict_at(log, k, Instant(**{**CALM, **now}), bounds)
    return found


def test_each_verdict_has_its_cause_and_the_first_of_several_decides():
    """Every pair, and each tail of the table, in the order the module documents."""
    assert verdict() == RUNNING
    for i, (code, cause) in enumerate(CAUSES):
        assert verdict(**cause) == code
        for later, other in CAUSES[i + 1 :]:
            assert code < later
            assert verdict(**{**other, **cause}) == code
        assert verdict(**{k: v for _, tail in CAUSES[:i:-1] for k, v in tail.items()} | cause) == code


def test_each_way_to_diverge():
    for cause in (
        {"error": 401.0},
        {"distance": 20.1},
        {"q_dot": np.r_[0, 0, math.inf]},
        {"q_dot": np.r_[math.nan]},
    ):
        assert verdict(**cause) == DIVERGED
    assert verdict(error=399.9, distance=19.9) == RUNNING


def test_lost_markers_are_waited_for_so_often_in_a_row():
    log, bounds = new_log(6, 4, 9, 5), limits(max_lost_periods=2, max_steps=8)
    log.judged[:] = 50.0
    seen = [LOST, LOST, OK, LOST, LOST, LOST]
    found = [verdict_at(log, k, Instant(**{**CALM, "status": it}), bounds) for k, it in enumerate(seen)]
    assert found == [WAITING, WAITING, RUNNING, WAITING, WAITING, MARKERS_LOST]
    assert verdict_at(log, 8, Instant(**{**CALM, "status": LOST}), bounds) == MARKERS_LOST  # no step is left


def test_plateau_is_a_fall_below_one_per_cent():
    log = new_log(6, 4, 60, 5)
    log.judged[:60] = 100 * 0.9996 ** np.arange(60)  # 0.8 % in 20 steps, 1.2 % in 30
    for k, window, code in (
        (40, 20, NO_PROGRESS),
        (40, 30, MAX_STEPS),
        (19, 20, MAX_STEPS),
        (20, 20, NO_PROGRESS),
    ):
        log.begun[:2] = 2.0, 100.0
        assert verdict_at(log, k, Instant(**CALM), limits(stall_periods=window, max_steps=k)) == code


def command(q_dot, q=None, share=-1.0, blocked=-1, plant=None, **given):
    """A command of a period of 1 s at the joints q, bounded: verdict, factor and step."""
    n = len(q_dot)
    log, q_dot = new_log(n, 4, 2, 5), np.array(q_dot)
    log.read[1] = np.zeros(n) if q is None else q
    plant = scene().plant if plant is None else plant
    code = bounded(log, 1, Command(q_dot, share, blocked, 1.0, 1.0), plant, limits(n, **given))
    assert (log.q_dot[1] == (q_dot if code == RUNNING else 0.0)).all()
    return code, log.factor[1], log.scratch[0, :n].copy()


def test_speed_is_limited_by_uniform_scaling(rng):
    """The direction stays, no joint exceeds its limit, the fastest is at its own."""
    speed = np.array([1.0, 2.0, 0.5, 1.0, 3.0, 0.1])
    for _ in range(50):
        given = rng.normal(size=6) * 10.0 ** rng.integers(-2, 3)
        code, factor, q_dot = command(given, speed=speed)
        assert code == RUNNING
        assert q_dot == pytest.approx(factor * given, rel=1e-15)
        assert (np.abs(q_dot) <= speed * (1 + 1e-15)).all()
        assert factor == pytest.approx(min(1.0, (speed / np.abs(given)).min()), rel=1e-15)
    # Slow commands, endless limits, and laws that applied the limit themselves, or say so.
    slow = ([0.1, -1e9], -1.0, 1.0), ([0.0, 0.0], -1.0, 1.0), ([0.1, 0.0], 0.3, 0.3), ([0.2, 0.0], 0.3, 0.15)
    for given, share, expected in slow:
        _, factor, q_dot = command(given, share=share, speed=np.array([0.1, math.inf]))
        assert (factor, q_dot.tolist()) == (expected, [min(given[0], 0.1), given[1]])


def test_a_step_is_shortened_to_the_first_limit():
    plant = scene().plant._replace(
        limits=position_limits(np.array([-1.0, -2.0, -np.inf]), np.array([1.0, 2.0, np.inf]))
    )
    stop = {"plant": plant, "stop_at_joint_limit": True}
    code, factor, dq = command([0.5, -1.0, 40.0], [0.8, 0.0, 0.0], **stop)
    assert (code, factor) == (RUNNING, 1.0)
    np.testing.assert_allclose(dq, [0.2, -0.4, 16.0], rtol=1e-11)
    beyond = [1.1, 0.0, 0.0]
    assert command([-0.3, 0.0, 0.0], beyond, **stop)[2][0] == -0.3  # it may return
    assert command([0.3, 0.1, 0.0], beyond, **stop)[0] == JOINT_LIMIT
    assert command([0.0, 0.0, 0.0], **stop)[0] == RUNNING
    assert command([0.0, 0.0, 0.0], blocked=2, **stop)[0] == JOINT_LIMIT
    assert command([0.3, 0.1, 0.0], beyond, plant=plant)[0] == RUNNING


def noted(s, s_star, size=(math.inf, math.inf), **given):
    """A log with the images of its second instant, and whether one was left."""
    log, plant = new_log(6, s.shape[1], 2, 5), scene().plant
    log.s[1] = s
    log.read[1] = given.pop("read", np.zeros(6))
    return log, note(log, 1, s_star, plant._replace(image_size=np.full((2, 2), size)), limits(**given))


def test_image_error_is_the_rms_over_markers_and_views():
    s, s_star = np.zeros((2, 3, 2)), np.zeros((2, 3, 2))
    s[0, 1] = [3.0, 4.0]
    assert noted(s, s_star)[0].error[1] == pytest.approx(5.0 / math.sqrt(6.0))
    s[1, 2, 0] = math.nan  # unseen: it does not count
    log, _ = noted(s, s_star)
    assert log.judged[1] == log.error[1] == pytest.approx(5.0 / math.sqrt(5.0))
    further = np.concatenate([s, np.full((2, 2, 2), 1e3)], axis=1)
    assert noted(further, s_star)[0].error[1] == log.error[1]
    assert math.isnan(noted(np.full((2, 3, 2), math.nan), s_star)[0].error[1])


@pytest.mark.parametrize(
    ("place", "value"), [((0, 0, 0), -0.51), ((1, 2, 0), 639.51), ((1, 1, 1), 479.51), ((0, 2, 1), -0.51)]
)
def test_markers_outside_an_image(place, value):
    s, size = np.full((2, 3, 2), 100.0), (640.0, 480.0)
    for it, left in (
        (100.0, False),
        (value, True),
        (value - math.copysign(0.02, value), False),
        (np.nan, False),
    ):
        s[place] = it
        log, found = noted(s, s, size)
        assert found == left
        assert log.events[0] == (1 if left else -1)
    s[place] = value
    assert noted(s, s)[1] == (value < 0)


def test_first_joint_beyond_its_limits():
    lower, upper = np.array([-1.0, -2.0, 0.0]), np.array([1.0, 2.0, 0.5])
    bounds = position_limits(lower, upper)
    assert beyond_limits(bounds, np.array([1.0, -2.0, 0.5]), 0.0) == -1
    assert beyond_limits(bounds, np.array([0.0, 2.1, 0.6]), 0.0) == 1
    assert beyond_limits(bounds, np.array([math.nan, 0.0, 0.0]), 0.0) == 0
    s, read = np.zeros((2, 3, 2)), np.array([0, 0, 9.1, 9.2, 0, 0])
    assert noted(s, s, read=read)[0].events.tolist() == [-1, 1, 2]
    assert noted(s, s, read=read, stop_at_joint_limit=True)[0].events.tolist() == [-1, -1, -1]
