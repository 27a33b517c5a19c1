"""Speed of a control step and of a whole run beside one SVD of NumPy, as ``projservo bench`` times them.

The bounds are several times what an idle machine measures, so that only a lost optimisation fails, not a
busy machine.
"""

import json

import pytest

from projservo_cli.loop.compiled import run
from projservo_cli.records import LAWS
from projservo_cli.stages import bench
from tests.known import configured

pytestmark = pytest.mark.volume


@pytest.fixture(scope="module")
def case():
    return bench.Case(configured("paper"))


@pytest.fixture(scope="module")
def measured(case):
    return bench.measure(case, rounds=20)


@pytest.mark.parametrize("law", LAWS)
def test_a_control_step_costs_less_than_an_svd(measured, law):
    assert measured["times_us"][law]["over_svd"] < (2.5 if law == "exact" else 0.8)


def test_a_whole_run_takes_less_than_10_ms(case, measured):
    assert run(*case.whole_run())[1] == bench.STEPS
    assert 0.0 < measured["run_150_ms"] < 10.0


def test_the_table_holds_every_law_and_ratios_to_the_svd(measured):
    times = measured["times_us"]
    assert set(LAWS) | {bench.BODY, "numpy.linalg.svd"} <= set(times)
    svd = times["numpy.linalg.svd"]
    assert svd["over_svd"] == 1.0
    for value in times.values():
        assert 0.0 < value["least"] <= value["lower"] <= value["median"] <= value["upper"]
        assert value["over_svd"] == pytest.approx(value["least"] / svd["least"])
    worst = max(times[law]["over_svd"] for law in ("direct_three", "direct_two"))
    assert measured["step_over_svd"] == worst
    assert measured["exact_over_svd"] == times[bench.BODY]["over_svd"]
    json.dumps(measured, allow_nan=False)
