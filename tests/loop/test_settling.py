"""A robot that stands still away from its goal is judged while it runs; one at its goal is waited for."""

from types import SimpleNamespace

import numpy as np
import pytest

from projservo_cli.loop.stall_monitor import StallMonitor
from projservo_cli.loop.verdicts import (
    CONVERGED,
    FOLLOWING_ERROR,
    MARKERS_LOST,
    NO_PROGRESS,
    RUNNING,
    WAITING,
    new_log,
    tolerance,
)
from projservo_cli.records import JointLimits
from projservo_cli.robots.contract import Bounds
from projservo_cli.robots.latency_estimation import DelayPrior
from tests.scene import limits

PERIOD, TICK = 0.1, 1.5e-3
BOUNDS = Bounds(JointLimits(*np.zeros((4, 2))), np.zeros(2), PERIOD, 0.15, np.full(2, 0.017), ("rad", "deg"))
LIMITS = limits(2, image_error_px=1.0, max_steps=1000)


class Robot:
    """Readings, set-points and what is carried, as a test says."""

    def __init__(self):
        self.known = SimpleNamespace(delays=DelayPrior.unknown(2), sigma_q=np.full(2, TICK / 12**0.5))
        self.robot = SimpleNamespace(bounds=BOUNDS)
        point = SimpleNamespace(short=np.zeros(2, dtype=bool))
        self.steered = SimpleNamespace(reading=None, target=None, set_point=point)
        self.carried_px, self.noise_ratio = 0.0, 1.0

    def settled(self, within_px):
        return self.carried_px <= within_px


def judged(error, read, sent, *, short=(False, False), verdict=RUNNING, carried=lambda k: 0.0, most=900):
    """Verdict of a run, why, and when; of what is a function of the instant."""
    robot, log = Robot(), new_log(2, 4, 1000, 5)
    stall = StallMonitor(robot, LIMITS)
    for k in range(most):
        log.judged[k] = error(k)
        robot.steered.reading = SimpleNamespace(q=np.array(read(k), dtype=float))
        robot.steered.target = np.array(sent(k), dtype=float)
        robot.steered.set_point.short = np.array(short)
        robot.carried_px = carried(k)
        given = verdict[k] if isinstance(verdict, list) else verdict
        told = CONVERGED if log.judged[k] <= LIMITS.image_error_px else given
        ruled = stall.ruled(log, k, told, np.zeros(2))
        if ruled not in (RUNNING, WAITING):
            return ruled, stall, k
    return RUNNING, stall, most


def test_a_law_that_asks_for_nothing_is_at_a_local_minimum():
    ruled, stall, k = judged(lambda k: 30.0 + 20.0 * 0.9**k, lambda k: (0.5, 0.1), lambda k: (0.5, 0.1))
    assert (ruled, stall.minimum) == (NO_PROGRESS, True)
    assert stall.reason.code == "local_minimum"
    assert k < 100


def test_beside_the_goal_the_joints_hide_what_is_left():
    """An image error of up to three tolerances, that of joints within their ticks."""
    ruled, stall, _ = judged(
        lambda k: 1.5 + (k % 7) / 7, lambda k: (TICK * (k % 2), 0.0), lambda k: (1e-4 * (k % 3), 0.0)
    )
    assert ruled == NO_PROGRESS
    assert (stall.reason.code, stall.reason.amount) == ("coarse_motion", pytest.approx(2e-4))


def test_a_joint_that_stays_at_the_end_of_its_lead_is_not_following():
    ruled, stall, k = judged(
        lambda k: 50.0, lambda k: (0.5, 0.1), lambda k: (0.9, min(0.1 + 0.01 * k, 0.4)), short=(True, False)
    )
    assert ruled == FOLLOWING_ERROR
    assert (stall.reason.code, stall.reason.subject.joints) == ("joint_stays", (1,))
    assert (stall.reason.amount, stall.reason.limit) == (0.5, pytest.approx(0.4))
    assert k < 60


@pytest.mark.parametrize(
    ("read", "what"),
    [(lambda k: 0.2, "small_steps"), (lambda k: 0.2 + 0.004 * (k % 20 > 9), "no_gain")],
)
def test_a_robot_that_gains_nothing_is_given_up_with_a_cause(read, what):
    ruled, stall, k = judged(
        lambda k: 5.0 + (k % 7) / 7, lambda k: (read(k), 0.0), lambda k: (0.2 + 0.005 * (k % 20 > 9), 0.0)
    )
    assert (ruled, stall.minimum) == (NO_PROGRESS, False)
    assert stall.reason.code == what
    assert k < 300


def test_markers_that_flicker_are_lost_and_no_local_minimum():
    """The robot is held, but for a frame now and then; a law that has images mostly is at fault itself."""
    for lost, told in ((0.9, MARKERS_LOST), (0.2, NO_PROGRESS)):
        seen = np.random.default_rng(3).random(900) > lost
        verdicts = np.where(seen, RUNNING, WAITING).tolist()
        ruled, stall, k = judged(
            lambda k: 400.0, lambda k: (0.5, 0.1), lambda k: (0.5, 0.1), verdict=verdicts
        )
        assert ruled == told
        assert stall.minimum == (told == NO_PROGRESS)
        assert (stall.reason.code == "marker_flickers") == (told == MARKERS_LOST)
        assert k < 100


STILL, FAR = (lambda k: (0.1, 0.0)), (lambda k: (0.01 * k, 0.0))  # joints that stand, and one that moves on


def test_a_robot_that_moves_or_comes_nearer_or_sees_nothing_goes_on():
    assert judged(lambda k: 50.0, FAR, FAR)[0] == RUNNING
    assert judged(lambda k: 5.0 + 900.0 * 0.995**k, STILL, STILL, most=800)[0] == RUNNING
    assert judged(lambda k: np.nan, STILL, STILL, verdict=WAITING)[0] == RUNNING


def test_arrival_is_believed_once_the_robot_stands():
    ruled, _, k = judged(lambda k: 0.4, STILL, STILL, carried=lambda k: 8.0 * 0.8**k)
    assert ruled == CONVERGED
    assert k == 13  # 8 px fall below half a pixel
    assert judged(lambda k: 0.4, STILL, STILL)[2] == 0
    # An arm that is off once it stands is driven on.
    ruled, _, k = judged(
        lambda k: 0.9 if k < 20 else 1.5 * 0.9 ** (k - 20), STILL, STILL, carried=lambda k: 8.0 * (k < 20)
    )
    assert ruled == CONVERGED
    assert k == 24


@pytest.mark.parametrize("views", [np.nan, 4.0, 16.0])
def test_the_tolerance_is_by_the_noise_that_pixels_state(views):
    """As in a run of that noise from the beginning."""
    limits_of = (LIMITS._replace(image_error_px=0.01 + noise, noise_px=noise) for noise in (0.02, 0.8))
    assert tolerance(next(limits_of), views, 40.0) == pytest.approx(tolerance(next(limits_of), views, 1.0))


def test_steps_without_progress_near_the_goal_become_shorter_and_not_away_from_it():
    for error, shorter in ((5.0, True), (50.0, False)):
        robot, log = Robot(), new_log(2, 4, 1000, 5)
        stall, sent = StallMonitor(robot, LIMITS), []
        for k in range(60):
            log.judged[k], q_dot = error, np.ones(2)
            robot.steered.reading, robot.steered.target = SimpleNamespace(q=np.full(2, 0.1 * k)), np.zeros(2)
            stall.ruled(log, k, RUNNING, q_dot)
            sent.append(q_dot[0])
        assert (np.diff(sent) <= 0.0).all()
        assert (sent[-1] < 0.5) == shorter
        assert sent[10] == 1.0
