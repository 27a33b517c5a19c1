"""Markers lost for a while: held, resumed, given up; scaled commands; parts of a step; disturbances."""

import numpy as np
import pytest

from projservo_cli.laws import CODES
from projservo_cli.loop.python import BuiltInLaw, run_in_python
from projservo_cli.loop.verdicts import VERDICTS
from projservo_cli.simulation.analytic_plant import AnalyticPlant
from tests.loop.test_python_loop import Towards, in_python, same_logs
from tests.scene import GAINS, Run, limits, scene


def unseen(gone, steps=60):
    """Noise that hides all markers at the instants ``gone``."""
    noise = np.zeros((steps + 1, 2, 4, 2))
    noise[list(gone)] = np.nan
    return noise


@pytest.mark.parametrize(
    ("gone", "waits", "verdict", "steps"),
    [
        (range(5, 9), 4, "max steps", 60),
        (range(5, 9), 3, "markers lost", 8),
        ([0, 1], 2, "max steps", 60),
        ([2, 3, 5, 6, 8, 9], 2, "max steps", 60),  # only those in a row count
        (range(58, 61), 9, "markers lost", 60),
    ],
)
def test_both_loops_wait_alike(gone, waits, verdict, steps):
    sc, noise = scene(), unseen(gone)
    bounds = limits(max_steps=60, image_error_px=1e-12, max_lost_periods=waits, stall_periods=100)
    compiled = Run(sc, "direct_three", bounds=bounds, noise=noise)
    code, sent, log = in_python(sc, "direct_three", bounds, noise)
    assert (VERDICTS[code], sent) == (compiled.verdict, compiled.steps) == (verdict, steps)
    same_logs(log, compiled.full, sent)


def test_held_joints_stand_still_and_the_run_goes_on_as_it_would_have():
    sc = scene()
    bounds = limits(max_steps=60, image_error_px=1e-12, max_lost_periods=4, stall_periods=100)
    whole = Run(sc, "direct_three", bounds=bounds, noise=unseen([]))
    held = Run(sc, "direct_three", bounds=bounds, noise=unseen(range(5, 9)))
    assert (held.log.q_dot[5:9] == 0.0).all()
    for k in range(5, 9):
        np.testing.assert_array_equal(held.log.q[k + 1], held.log.q[5])
    np.testing.assert_array_equal(np.delete(held.log.q, range(5, 9), axis=0), whole.log.q[:-4])


class Noted(AnalyticPlant):
    """Notes what it is sent."""

    def __init__(self, sc, steps=200, takes_parts=False, bumped=None):
        super().__init__(sc.plant, sc.q_start, np.zeros((steps + 1, 2, 4, 2)))
        self.takes_parts, self.bumped = takes_parts, bumped
        self.sent = []

    def observe(self):
        s = super().observe()
        self.disturbance = "bumped" if self.observations - 1 == self.bumped else ""
        return s

    def command(self, step, period):
        self.sent.append((step, period))
        super().command(step, period)


def test_every_command_is_scaled():
    sc = scene()
    # The law takes a fifth of the joint error a step; scaled, a twentieth.
    for scale, share in ((1.0, 0.2), (0.25, 0.05)):
        plant, ends = Noted(sc), limits(max_steps=30)
        _, steps, log = run_in_python(Towards(sc.q_goal), plant, sc.s_star, 0.04, ends, scale)
        sent = np.array([step for step, _ in plant.sent])
        np.testing.assert_array_equal(sent, log.q_dot[:steps] * 0.04)
        error = np.abs(sc.q_goal - sc.q_start)
        np.testing.assert_allclose(np.abs(sent[3]), share * (1.0 - share) ** 3 * error, rtol=1e-9)


def test_a_disturbance_ends_the_run_before_any_other_verdict():
    sc = scene()
    for bumped, verdict in ((7, "converged"), (0, "fault detected")):
        plant, ends = Noted(sc, bumped=bumped), limits(max_steps=199, image_error_px=1e9)
        code, steps, _ = run_in_python(Towards(sc.q_goal), plant, sc.s_star, 0.04, ends)
        assert (VERDICTS[code], steps, plant.sent) == (verdict, 0, [])


def test_a_long_step_is_sent_in_its_parts_and_arrives_where_it_would_have():
    sc = scene()
    ends = {}
    for takes_parts in (False, True):
        plant = Noted(sc, takes_parts=takes_parts)
        gains = GAINS._replace(gain_t=12.0, gain_s=12.0, substeps=True)
        law = BuiltInLaw(CODES["exact"], sc.seen(), sc.task(), gains)
        run_in_python(law, plant, sc.s_star, GAINS.period, limits(max_steps=1))
        ends[takes_parts] = plant.q
        assert sum(period for _, period in plant.sent) == pytest.approx(GAINS.period)
        assert (len(plant.sent) > 1) == takes_parts
    np.testing.assert_allclose(ends[True], ends[False], atol=1e-14)


def test_a_step_that_is_too_fast_takes_longer():
    """A law that keeps the limit itself exceeds it by second-order terms, which cost time."""
    sc, plant = scene(), Noted(scene())
    law = Towards(sc.q_goal)
    law.share = np.ones(1)
    speed = 0.25 * np.abs(5.0 * (sc.q_goal - sc.q_start)).max()
    run_in_python(law, plant, sc.s_star, 0.04, limits(speed=np.full(6, speed), max_steps=30))
    periods = [period for _, period in plant.sent]
    assert periods[0] == pytest.approx(0.16)
    assert periods[-1] == 0.04


def test_a_law_that_waits_is_held():
    sc = scene()
    law = Towards(sc.q_goal, status=1)
    plant = Noted(sc)
    code, steps, _ = run_in_python(law, plant, sc.s_star, 0.04, limits(max_steps=50, max_lost_periods=6))
    assert (VERDICTS[code], steps) == ("markers lost", 6)
    assert all((step == 0.0).all() and period == 0.04 for step, period in plant.sent)
