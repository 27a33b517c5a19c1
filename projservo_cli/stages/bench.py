"""Speed of control steps and whole runs, relative to one SVD of NumPy in the same process.

Everything is timed in turn, round by round, in pieces of about a millisecond. Ratios are between the
minimum times, which a busy machine hardly disturbs.
"""

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from timeit import timeit
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from projservo_cli.control import make_law
from projservo_cli.control.law import ERRORS, Law, State, new_state
from projservo_cli.laws import CODES, INCIDENCES, LAWS
from projservo_cli.loop.compiled_loop import Course, many_steps, run_compiled
from projservo_cli.loop.python_loop import BuiltInLaw
from projservo_cli.loop.verdicts import Log, new_log
from projservo_cli.records import FloatArray
from projservo_cli.simulation.analytic_plant import Plant
from projservo_cli.stages.scenario import run_scenario
from projservo_cli.stages.stage_inputs import ServoInputs, of_simulation
from projservo_cli.task.face import Task
from projservo_cli.task.incidences import whole_pose

STATES, STEPS, PIECE, ROUNDS = 256, 150, 64, 200
NOISE_PX = 0.5
BODY, CODE = "exact, body", CODES["direct_three"]


class _Job(NamedTuple):
    """A run; ``state`` and ``log`` are its own, the rest may be shared."""

    law: Law
    course: Course
    noise: FloatArray
    state: State
    log: Log


class Case:
    """A noisy run of 256 states of a simulated task and all that a step needs, with the true model."""

    def __init__(self, inputs: ServoInputs) -> None:
        given = replace(inputs, plan=replace(inputs.plan.of_taught_pose, features="body"))
        scenario = run_scenario(given, of_simulation(inputs.plan.described.truth).calibration)
        shown, gains = scenario.exact, scenario.gains
        self.m, self.q_start, self.model, self.gains = (
            scenario.world.m,
            shown.q_start,
            scenario.world.model,
            gains,
        )
        self.limits = scenario.termination._replace(
            image_error_px=1e-9, max_steps=STATES - 1, stop_at_border=False, stop_at_joint_limit=False
        )
        seen = 2, len(scenario.world.numbers), 2
        self.noise = NOISE_PX * np.random.default_rng(0).standard_normal((STATES, *seen))
        self.whole = self._run(shown.task(self.model), scenario.plant_of("exact"))
        self.points = self._run(shown.by_points().task(self.model), scenario.plant_of("stacked"))
        posed = shown.asking(whole_pose(shown.body.M[: self.m]))
        self.incidences = self._run(posed.task(self.model), scenario.plant_of("exact"))
        self.law = BuiltInLaw(CODE, *self.points.law[2:])

    def _run(self, task: Task, plant: Plant) -> _Job:
        """A run, whose log has the states that are cycled through."""
        n, seen = len(self.q_start), self.m + len(plant.pins)
        noise = np.ascontiguousarray(self.noise[:, :, :seen])
        law, course = make_law(CODE, self.model, task, self.gains), Course(plant, self.limits, self.q_start)
        log = new_log(n, seen, self.limits.max_steps, len(ERRORS))
        job = _Job(law, course, noise, new_state(n, self.m), log)
        run_compiled(*job)
        return job

    def steps(self, law: str, *, body: bool = False) -> float:
        """One step of a law in each state."""
        job = self.incidences if law == INCIDENCES else self.whole if body else self.points
        built_in = make_law(CODES[law], *job.law[2:])
        return many_steps(built_in, job.course, job.state, job.log)

    def whole_run(self) -> _Job:
        """A run of 150 steps, traced."""
        log = new_log(len(self.q_start), self.m, STEPS, len(ERRORS))
        course = self.points.course._replace(limits=self.limits._replace(max_steps=STEPS))
        return self.points._replace(course=course, log=log)


def timings(case: Case, rounds: int = ROUNDS) -> dict[str, Any]:
    """Time all for a number of rounds; see the schema of ``projservo bench --json``."""
    matrices = itertools.cycle(np.random.default_rng(0).standard_normal((STATES, 8, 6)))
    whole, log = case.whole_run(), case.points.log
    timed: dict[str, tuple[Callable[[], object], int]] = {
        "numpy.linalg.svd": (lambda: [np.linalg.svd(next(matrices)) for _ in range(PIECE)], PIECE),
        **{law: (partial(case.steps, law), STATES) for law in LAWS},
        BODY: (lambda: case.steps("exact", body=True), STATES),
        "one call from Python": (lambda: [case.law(log.s[0], log.q[0]) for _ in range(PIECE)], PIECE),
        "run of 150 steps": (lambda: run_compiled(*whole), 1),
    }
    with threadpool_limits(1):
        for function, _ in timed.values():
            function()
        found = [[timeit(call, number=1) / count for call, count in timed.values()] for _ in range(rounds)]
    table = 1e6 * np.array(found).T
    quartiles = np.percentile(table, [0, 25, 50, 75], axis=1)
    rows = np.vstack([quartiles, quartiles[0] / quartiles[0, 0]]).T.tolist()
    # µs, and the minimum over the minimum of one SVD
    keys = ("least", "lower", "median", "upper", "over_svd")
    times = {name: dict(zip(keys, row, strict=True)) for name, row in zip(timed, rows, strict=True)}
    return {
        "step_over_svd": max(times["direct_three"]["over_svd"], times["direct_two"]["over_svd"]),
        "exact_over_svd": times[BODY]["over_svd"],
        "run_150_ms": 1e-3 * times["run of 150 steps"]["least"],
        "python_call_us": times["one call from Python"]["least"],
        "times_us": times,
    }
