"""Random feasible tasks, planned and driven with operators calibrated from noisy images.

From the root of the repository: ``python -m tests.planning.driven paper 500 [FILE]``. Which tasks are
feasible is decided by a grid search with the true arm. They take longest: where a file is named they are
kept in it, and taken from it the next time.
"""

import sys
import time
from collections import Counter
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from pathlib import Path

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.records import WorkFailed
from projservo_cli.stages import calibrate, plan, servo
from projservo_cli.stages.world import truth_of
from projservo_cli.sweep.tasks import STRATA, random_tasks
from tests.conftest import ROOT
from tests.planning.arm import arm_of, feasible
from tests.planning.oracle import TrueTask

NOISE_PX = 0.5
CALIBRATIONS = 10
BATCH = 60
SETTINGS = (
    f"noise.calibration_px={NOISE_PX}",
    f"noise.servo_px={NOISE_PX}",
    "trajectory.profile=constrained",
    "trajectory.border_px=0.0",
    "plant.joint_limits=stop",
    "plant.self_occlusion=opaque",
)


def configured(name, *overrides):
    """A shipped configuration with the settings of the study."""
    return load_config(ROOT / "configs" / f"{name}.yaml", [*SETTINGS, *overrides])


@dataclass(frozen=True)
class Tasks:
    """Feasible tasks (k, n) and (k, n), rad, evenly from all strata, and how many had to be looked at."""

    q_start: np.ndarray
    q_goal: np.ndarray
    looked_at: int
    words: str


def true_task(truth, q_start, q_goal):
    """A task as the grid search sees it."""
    H = [truth.robot.pose(q) @ np.linalg.inv(truth.robot.base_tool) for q in (q_start, q_goal)]
    return TrueTask(truth.P, truth.image_size, *((truth.M_face @ T.T)[:, :3] for T in H))


def feasible_tasks(name, count, seed=1):
    """Draw random tasks until so many of them are feasible by the grid search, a sixth in each stratum."""
    config = configured(name)
    truth = truth_of(config)
    arm = arm_of(truth, config.trajectory.least_condition)
    q_front = np.array(config.task.start.values(config.robot.joint_types))
    rng = np.random.default_rng(seed)
    quota = [count // STRATA + (i < count % STRATA) for i in range(STRATA)]
    kept = [[] for _ in range(STRATA)]
    looked_at = 0
    while any(len(found) < most for found, most in zip(kept, quota, strict=True)):
        batch = random_tasks(truth, q_front, BATCH, rng)
        for q_start, q_goal, angle in zip(batch.q_start, batch.q_goal, batch.angle, strict=True):
            stratum = min(STRATA - 1, int(STRATA * angle / np.pi))
            if len(kept[stratum]) < quota[stratum]:
                looked_at += 1
                if feasible(arm, true_task(truth, q_start, q_goal), q_start):
                    kept[stratum].append((q_start, q_goal))
    starts, goals = (np.array(column) for column in zip(*chain.from_iterable(kept), strict=True))
    return Tasks(starts, goals, looked_at, f"{count} feasible of {looked_at} tasks")


@cache
def calibrated(name, seed):
    """Calibration of a shipped configuration from trials of one seed."""
    return calibrate.run(configured(name, f"seed={seed}"))[1]


@dataclass
class Run:
    """What became of one task."""

    number: int
    verdict: str
    reason: str = ""
    planned: bool = False
    occluded: int = 0
    outside: bool = False
    steps: int = 0
    position_mm: float = np.nan
    rotation_deg: float = np.nan
    near: bool = False

    @property
    def converged(self):
        return self.verdict == "converged"


def driven(name, number, q_start, q_goal):
    """Plan and drive one task with the law ``exact``, which follows the plan."""
    config = configured(
        name,
        f"seed={1000 + number}",
        f"task.start={{joints: {q_start.tolist()}, unit: rad}}",
        f"task.goal={{joints: {{joints: {q_goal.tolist()}, unit: rad}}}}",
    )
    calibration = calibrated(name, 1 + number % CALIBRATIONS)
    try:
        planned = plan.run(config, calibration)
        trace = servo.run(config, calibration, planned, "exact_track")
    except WorkFailed as error:
        return Run(number, "no plan", str(error))
    return Run(
        number,
        trace.verdict,
        trace.reason if planned.feasible else f"{trace.reason}; plan: {planned.reason}",
        planned.feasible,
        trace.self_occluded_steps_left + trace.self_occluded_steps_right,
        trace.first_outside_image >= 0,
        trace.steps,
        trace.position_error_mm,
        trace.rotation_error_deg,
    )


def study(name, tasks):
    """Runs of all tasks; of those that fail, whether every path comes within one cell of a boundary."""
    truth = truth_of(configured(name))
    arm = arm_of(truth, configured(name).trajectory.least_condition)
    runs = []
    for number, (q_start, q_goal) in enumerate(zip(tasks.q_start, tasks.q_goal, strict=True)):
        run = driven(name, number, q_start, q_goal)
        if not run.converged:
            clear = feasible(arm, true_task(truth, q_start, q_goal), q_start, cells=1)
            run = replace(run, near=not clear)
        runs.append(run)
    return runs


def words(runs):
    """The table of a study, and each failure with its verdict."""
    failed = [run for run in runs if not run.converged]
    done = [run for run in runs if run.converged]
    yield f"converged: {len(done)} of {len(runs)} ({len(done) / len(runs):.1%}); plan feasible: " + str(
        sum(run.planned for run in runs)
    )
    counted = len(runs) - sum(run.near for run in failed)
    yield f"of those with a path more than one cell from what must not happen: {len(done)} of {counted}"
    yield f"self-occluded steps: {sum(run.occluded for run in runs)} in {sum(run.steps for run in runs)}"
    yield f"runs with a marker seen outside an image: {sum(run.outside for run in runs)}"
    for unit, errors in (("mm", [r.position_mm for r in done]), ("deg", [r.rotation_deg for r in done])):
        yield f"error at the end, {unit}: median {np.median(errors):.3f}, most {max(errors):.3f}"
    yield f"verdicts: {dict(Counter(run.verdict for run in runs))}"
    for run in failed:
        near = " (every path within one cell of a boundary)" if run.near else ""
        yield f"  task {run.number}{near}: {run.verdict}: {run.reason}; occluded {run.occluded}"


def stored(name, count, file):
    """Tasks from a file, which is made where it is not there."""
    if file is None:
        return feasible_tasks(name, count)
    if not file.exists():
        tasks = feasible_tasks(name, count)
        np.savez(
            file, q_start=tasks.q_start, q_goal=tasks.q_goal, looked_at=tasks.looked_at, words=tasks.words
        )
    with np.load(file) as found:
        return Tasks(found["q_start"], found["q_goal"], int(found["looked_at"]), str(found["words"]))


if __name__ == "__main__":
    arm_name, wanted = sys.argv[1], int(sys.argv[2])
    begun = time.process_time()
    drawn_tasks = stored(arm_name, wanted, Path(sys.argv[3]) if len(sys.argv) > 3 else None)
    print(drawn_tasks.words, flush=True)
    for line in words(study(arm_name, drawn_tasks)):
        print(line)
    print(f"CPU s: {time.process_time() - begun:.0f}")
