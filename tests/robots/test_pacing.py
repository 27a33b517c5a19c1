"""Set-points, where an arm that lags and sags rests behind them, and when images were taken."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from projservo_cli.records import VIEWS, JointLimits, WorkFailed
from projservo_cli.robots.contract import Bounds, PluginRobot, at_rest_after
from projservo_cli.robots.latency_estimation import DelayPrior, Delays, History
from projservo_cli.robots.pacing import SetPoint, Steered

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
    point.read(np.array([1.1, 0.0]), PERIOD)
    target, _ = point.step(np.array([0.05, 0.0]), PERIOD)
    assert target[0] == pytest.approx(0.7)  # no farther behind than it may lead
    point.read(np.array([1.45, 0.0]), PERIOD)
    for _ in range(20):
        point.step(np.array([0.08, 0.0]), PERIOD)
    assert point.target[0] == 1.5


class Hasty:
    """A robot whose clock a test sets, and which lags; joints (2,) as they are read."""

    def __init__(self):
        self.q, self.time = np.zeros(2), 0.0

    def open(self): ...
    def stop(self): ...
    def close(self): ...

    def now(self):
        return self.time

    def read(self):
        return self.q, np.zeros((2, 1, 2))

    def command(self, target, speed, due):
        self.q = self.q + 0.6 * (target - self.q)
        # A wait may end a little before it is due.
        self.time = due - 0.09 * PERIOD * np.random.default_rng(int(1e4 * due)).random()


def test_what_is_sent_is_what_the_contract_allows_however_the_clock_and_the_steps_are():
    rng, cut = np.random.default_rng(2), 0
    robot = PluginRobot(Hasty(), "hasty", 1, BOUNDS, 10.0, 10.0)
    with at_rest_after(robot):
        steered = Steered(robot)
        for k in range(400):
            steered.observe()
            steered.command(rng.uniform(-0.2, 0.2, 2), PERIOD)  # up to 2.5 times the speed limit
            cut += bool(steered.set_point.short.any())
            if k % 3 == 0:
                steered.resume()
    assert cut > 100


NOISE = 0.5
EXACT, PLAY = np.zeros(2), 0.04  # of readings; rad
RNG = np.random.default_rng(0)
FAR = RNG.uniform(300.0, 900.0, (2, 5, 2))
PULL = 300.0 * RNG.standard_normal((2, 2, 5, 2))  # px per rad of two joints


def predicted(q):
    """Images of two joints, linear in both."""
    return FAR + np.einsum("kn,nvmc->kvmc", q, PULL)


def motion(t):
    """At rest, then to and fro."""
    t = np.maximum(t, 0.0)
    return np.stack([1.0 - np.cos(2.0 * t), np.sin(1.3 * t) * np.sin(0.4 * t)], axis=-1)


def looks(delays, late, steps=60, stamped=None, noise=NOISE, first=-4, views=(0, 1), shift=0.0):
    """What comes of looking at a motion with images of views so late (V,); errors of the instants, s."""
    rng, history, off = np.random.default_rng(1), History(), []
    for k in range(first, steps):
        now = k * PERIOD
        history.add(now, motion(now))
        taken = now - np.asarray(late)
        s = np.stack([predicted(motion(t)[None])[0, view] for view, t in zip(views, taken, strict=True)])
        s += noise * rng.standard_normal(s.shape) + shift
        stamps = np.full(len(views), np.nan) if stamped is None else taken + stamped
        off.append(delays.update(stamps, s, history).t - taken)
    return np.array(off)


@pytest.mark.parametrize("late", [(0.0, 0.0), (0.04, 0.12), (0.3, 0.25)])
@pytest.mark.parametrize("clock", [None, 0.003, 5e4])
def test_an_unknown_delay_is_found_as_soon_as_joints_move(late, clock):
    delays = Delays(VIEWS, predicted, DelayPrior.unknown(2), NOISE, 1.0, EXACT)
    off = looks(delays, late, stamped=clock)
    assert np.abs(off[20:]).max() < 0.01
    if clock is None:
        np.testing.assert_allclose(delays.mean, late, atol=0.004)


@pytest.mark.parametrize("even", [True, False])
def test_errors_of_the_model_tell_no_other_instant_where_there_is_none_and_are_stated_elsewhere(even):
    """Images that are off by 5 px seem late or early by some milliseconds."""
    exact = SimpleNamespace(view=VIEWS, time_offset=None)
    delays = Delays(VIEWS, predicted, DelayPrior.of(exact, [0.0, 0.0], even=even), NOISE, 1.0, EXACT)
    off = looks(delays, (0.0, 0.0), shift=5.0)
    sigma_shared = np.array([view.sigma_shared for view in delays._views])
    if even:
        np.testing.assert_allclose(off, 0.0, atol=1e-15)
        np.testing.assert_array_equal(sigma_shared, 0.0)
    else:
        assert 0.003 < np.abs(off).max() < 0.03
        assert (np.abs(off[-1]) < 3.0 * sigma_shared).all()


def test_at_rest_the_deviation_of_instants_is_that_of_the_unknown_delay():
    delays, history = Delays(VIEWS, predicted, DelayPrior.unknown(2), NOISE, 1.0, EXACT), History()
    for k in range(3):
        history.add(k * PERIOD, motion(0.0))
        frames = delays.update(np.full(2, np.nan), predicted(motion(0.0)[None])[0] + 0.1 * k, history)
        assert ((frames.sigma_shared > 0.15) & (frames.sigma_shared < 0.4)).all()


@pytest.mark.parametrize("late", [0.0, 0.08])
def test_play_in_the_joints_is_no_delay(late):
    """While joints go through it readings move and images do not; by 12 px here, 24 times the noise."""
    delays = Delays(VIEWS, predicted, DelayPrior.unknown(2), NOISE, 1.0, np.full(2, PLAY / np.sqrt(12.0)))
    history, rng, links, off = History(), np.random.default_rng(4), [np.zeros(2)], []
    for k in range(-10, 60):
        now = k * PERIOD
        history.add(now, motion(now))
        # What is driven follows at the end of its play, which it went to before.
        links.append(np.clip(links[-1], motion(now) - PLAY, motion(now)))
        times = PERIOD * np.arange(-11, k + 1)
        link = [np.interp(now - late, times, [q[i] for q in links]) for i in range(2)]
        s = predicted(np.array(link)[None])[0]
        off.append(
            delays.update(np.full(2, np.nan), s + NOISE * rng.standard_normal(s.shape), history).t - now
        )
    assert np.abs(np.array(off)[10:] + late).max() < 0.15
    assert np.abs(np.array(off)[30:] + late).max() < 0.06


def test_a_delay_that_changes_is_followed():
    delays = Delays(VIEWS, predicted, DelayPrior.unknown(2), NOISE, 1.0, EXACT)
    history, rng = History(), np.random.default_rng(3)
    for k in range(120):
        now, late = k * PERIOD, 0.05 if k < 50 else 0.2
        history.add(now, motion(now))
        s = predicted(motion(now - late)[None])[0]
        delays.update(np.full(2, np.nan), s + NOISE * rng.standard_normal(s.shape), history)
    np.testing.assert_allclose(delays.mean, 0.2, atol=0.01)


def test_an_image_that_comes_twice_keeps_its_instant():
    delays = Delays(VIEWS, predicted, DelayPrior.unknown(2)._replace(sigma=np.zeros(2)), NOISE, 1.0, EXACT)
    history, unstamped = History(), np.full(2, np.nan)
    history.add(0.0, motion(0.0))
    s = predicted(motion(0.0)[None])[0]
    assert delays.update(unstamped, s, history).fresh.all()
    history.add(PERIOD, motion(PERIOD))
    other = np.stack([s[0], s[1] + 1.0])
    frames = delays.update(unstamped, other, history)
    assert frames.fresh.tolist() == [False, True]
    assert frames.t[0] == 0.0
    assert not delays.update(unstamped, np.full(s.shape, np.nan), history).fresh.any()


def test_a_camera_that_stands_still_while_joints_move_is_named():
    delays = Delays(VIEWS, predicted, DelayPrior.unknown(2), NOISE, 1.0, EXACT)
    history, rng = History(), np.random.default_rng(0)
    still = predicted(np.zeros((1, 2)))[0, 1]

    def look(now, q):
        history.add(now, q)
        s = predicted(q[None])[0, 0] + NOISE * rng.standard_normal(still.shape)
        delays.update(np.full(2, np.nan), np.stack([s, still]), history)

    for k in range(26):
        look(k * PERIOD, motion(k * PERIOD))
    with pytest.raises(WorkFailed, match="right image has stood still"):
        look(40 * PERIOD, motion(40 * PERIOD))
    for k in range(41, 100):  # at rest it may
        look(k * PERIOD, np.zeros(2))
