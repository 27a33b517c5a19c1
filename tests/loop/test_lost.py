"""Markers lost for a while: held, resumed, given up; scaled commands; parts of a step; disturbances."""

import numpy as np
import pytest

from projservo_cli.loop.python import run_in_python
from projservo_cli.loop.verdicts import VERDICTS
from projservo_cli.simulation.analytic_plant import AnalyticPlant
from tests.loop.test_python_loop import Towards, in_python, same_logs
from tests.scene import Run, limits, scene


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


def test_a_disturbance_ends_the_run_before_any_other_verdict():
    sc = scene()
    for bumped, verdict in ((7, "converged"), (0, "fault detected")):
        plant, ends = Noted(sc, bumped=bumped), limits(max_steps=199, image_error_px=1e9)
        code, steps, _ = run_in_python(Towards(sc.q_goal), plant, sc.s_star, 0.04, ends)
        assert (VERDICTS[code], steps, plant.sent) == (verdict, 0, [])
