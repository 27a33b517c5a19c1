"""Speed of a control step and of a whole run, beside one SVD of NumPy in the same process.

Ratios are reported (``extra_info``); the bound asserted is several times what an idle machine
measures, so that only a lost optimisation fails, not a busy machine.
"""

import time

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from projservo_cli.control import CODES, command
from projservo_cli.control.law import ERRORS, new_state
from projservo_cli.geometry.jit import njit
from projservo_cli.loop.compiled import new_log, run
from projservo_cli.loop.step import limit_speed
from projservo_cli.records import LAWS
from projservo_cli.task.face import task_from_images
from tests.stages.cases import case

pytestmark = pytest.mark.volume
STATES = 256
STEPS = 20 * STATES


@njit
def many_steps(code, model, task, gains, S, Q, state, speed, count):
    """Measure, partition, command and limit, cycled through recorded states."""
    total = 0.0
    for i in range(count):
        k = i % S.shape[0]
        command(code, model, task, gains, S[k], Q[k], state)
        total += limit_speed(state.q_dot, speed)
    return total


class Prepared:
    """A noisy 180° run of the second robot and everything a step of it needs."""

    def __init__(self):
        example = case("ur5")
        self.example, self.model = example, example.truth.model
        reach = example.reach
        self.task = task_from_images(self.model, reach.s_start, reach.s_star, example.truth.center)
        self.noise = 0.5 * np.random.default_rng(0).standard_normal((STATES, 2, 4, 2))
        self.bounds = example.limits._replace(image_px=1e-9, max_steps=STATES - 1)
        self.log = self.drive("direct_three")
        self.state = new_state(6, 4)

    def drive(self, law):
        log = new_log(6, 4, STATES - 1, len(ERRORS))
        state = new_state(6, 4)
        state.memory.rotation[:] = self.example.plan.rotation_sense()
        start = self.example.reach.q_start.copy()
        run(
            CODES[law], self.model, self.task, self.example.gains, self.bounds, self.example.plant,
            self.noise, start, state, log,
        )  # fmt: skip
        return log

    def steps(self, law):
        return many_steps(
            CODES[law], self.model, self.task, self.example.gains, self.log.s, self.log.q, self.state,
            self.bounds.speed, STEPS,
        )  # fmt: skip


@pytest.fixture(scope="module")
def prepared():
    ready = Prepared()
    assert ready.log.q.shape == (STATES, 6)
    assert np.isfinite(ready.log.s).all()
    ready.steps("direct_three")
    return ready


def seconds(function):
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


@pytest.mark.parametrize("law", LAWS)
def test_a_control_step_costs_less_than_an_svd(benchmark, prepared, law):
    """One matrix of 8×6 per step; both timed in turn, the least of 15 rounds each, one thread."""
    matrices = np.random.default_rng(1).standard_normal((STATES, 8, 6))

    def decompositions():
        for A in matrices:
            np.linalg.svd(A)

    with threadpool_limits(1):
        prepared.steps(law)
        rounds = [(seconds(lambda: prepared.steps(law)), seconds(decompositions)) for _ in range(15)]
        benchmark.pedantic(prepared.steps, args=(law,), rounds=5)
    step, svd = (
        1e6 * least / count for least, count in zip(np.min(rounds, axis=0), (STEPS, STATES), strict=True)
    )
    benchmark.extra_info.update(step_us=step, svd_us=svd, step_over_svd=step / svd)
    assert step < 3 * svd


def test_a_whole_run(benchmark, prepared):
    """150 steps of direct_three with noise, logged; milliseconds a run."""
    example = prepared.example
    bounds = prepared.bounds._replace(max_steps=150)
    state, log = new_state(6, 4), new_log(6, 4, 150, len(ERRORS))

    def whole():
        return run(
            CODES["direct_three"], prepared.model, prepared.task, example.gains, bounds, example.plant,
            prepared.noise, example.reach.q_start, state, log,
        )  # fmt: skip

    assert whole()[1] == 150
    benchmark.pedantic(whole, rounds=20)
    least = min(seconds(whole) for _ in range(10))
    benchmark.extra_info["run_150_ms"] = 1e3 * least
    assert least < 0.05
