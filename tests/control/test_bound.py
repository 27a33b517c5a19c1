"""A bound law gives what the law gives, to the bit, and shares its arrays."""

from pathlib import Path

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.control import CODES, command
from projservo_cli.control.law import new_state
from projservo_cli.loop.python import bind, bound_command
from projservo_cli.records import LAWS
from projservo_cli.stages.bench import Case

CONFIG = Path(__file__).parents[2] / "configs" / "paper.yaml"


@pytest.fixture(scope="module")
def bench_case():
    return Case(load_config(CONFIG))


@pytest.mark.parametrize("law", LAWS)
def test_a_bound_law_gives_what_the_law_gives(bench_case, law):
    case = bench_case
    S, Q = case.points.log.s, case.points.log.q
    bound_state, state = (new_state(len(case.q_start), case.m) for _ in range(2))
    bound = bind(CODES[law], case.model, case.task, case.gains, bound_state)
    for k in (0, 7, 40):
        status = command(CODES[law], case.model, case.task, case.gains, S[k], Q[k], state)
        assert bound_command(bound, S[k], Q[k]) == status
        assert bound_state.q_dot.any()
        assert bound_state.q_dot.tobytes() == state.q_dot.tobytes()
        assert bound_state.errors.tobytes() == state.errors.tobytes()


def test_a_bound_law_keeps_its_arrays_alive_and_sees_their_changes(bench_case):
    case = bench_case
    S, Q = case.points.log.s, case.points.log.q
    state = new_state(len(case.q_start), case.m)
    task = case.task._replace(s_star=case.task.s_star.copy())
    bound = bind(CODES["stacked"], case.model, task, case.gains, state)
    bound_command(bound, S[0], Q[0])
    before = state.q_dot.copy()
    task.s_star[:] += 5.0
    del task
    bound_command(bound, S[0], Q[0])
    assert not np.array_equal(before, state.q_dot)
