"""Speed of a control step and of a whole run, beside one SVD of NumPy in the same process.

What is timed is what ``projservo bench`` times. Ratios are reported (``extra_info``); the bounds
asserted are several times what an idle machine measures, so that only a lost optimisation fails, not
a busy machine.
"""

import json
from timeit import timeit

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import projservo_cli as ps
from projservo_cli.config.inputs import servo_inputs
from projservo_cli.laws import LAWS
from projservo_cli.loop.compiled_loop import run_compiled
from projservo_cli.stages import bench
from tests.known import configured

pytestmark = pytest.mark.volume


@pytest.fixture(scope="module")
def case():
    return bench.Case(servo_inputs(configured("paper")))


@pytest.mark.parametrize("law", LAWS)
def test_a_control_step_costs_less_than_an_svd(benchmark, case, law):
    matrices = np.random.default_rng(0).standard_normal((bench.STATES, 8, 6))
    with threadpool_limits(1):
        case.steps(law)
        rounds = [
            (
                timeit(lambda: case.steps(law), number=1),
                timeit(lambda: [np.linalg.svd(A) for A in matrices], number=1),
            )
            for _ in range(20)
        ]
        benchmark.pedantic(case.steps, args=(law,), rounds=5)
    step, svd = 1e6 * np.min(rounds, axis=0) / bench.STATES
    benchmark.extra_info.update(step_us=step, svd_us=svd, step_over_svd=step / svd)
    assert step < (2.5 if law == "exact" else 0.8) * svd


def test_a_whole_run(benchmark, case):
    """150 steps of direct_three with noise, logged; milliseconds a run."""
    job = case.whole_run()
    assert run_compiled(*job)[1] == bench.STEPS
    benchmark.pedantic(run_compiled, args=job, rounds=20)
    least = min(timeit(lambda: run_compiled(*job), number=1) for _ in range(20))
    benchmark.extra_info["run_150_ms"] = 1e3 * least
    assert least < 0.01


def test_derivatives_of_many_poses_cost_a_few_times_their_predictions(benchmark):
    config = ps.Config.load("ur5")
    calibration = ps.calibrate(ps.simulate(config))
    turns = np.random.default_rng(0).uniform(-0.3, 0.3, (10_000, 6))
    q = calibration.q_reference + turns
    benchmark.pedantic(calibration.jacobian, args=(q,), rounds=3)
    rounds = [
        (timeit(lambda: calibration.jacobian(q), number=1), timeit(lambda: calibration.predict(q), number=1))
        for _ in range(5)
    ]
    jacobian, predict = np.min(rounds, axis=0)
    benchmark.extra_info["jacobian_over_predict"] = jacobian / predict
    assert jacobian < 30.0 * predict


def test_the_table_holds_every_law_and_ratios_to_the_svd(case):
    result = bench.timings(case, rounds=2)
    times = result["times_us"]
    assert set(LAWS) | {bench.BODY, "numpy.linalg.svd"} <= set(times)
    svd = times["numpy.linalg.svd"]
    assert svd["over_svd"] == 1.0
    for value in times.values():
        assert 0.0 < value["least"] <= value["lower"] <= value["median"] <= value["upper"]
        assert value["over_svd"] == pytest.approx(value["least"] / svd["least"])
    worst = max(times[law]["over_svd"] for law in ("direct_three", "direct_two"))
    assert result["step_over_svd"] == worst
    assert result["exact_over_svd"] == times[bench.BODY]["over_svd"]
    json.dumps(result, allow_nan=False)
