"""What many runs of a sweep share and what takes long to make: random tasks and calibrations."""

import dataclasses
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from projservo_cli import provenance
from projservo_cli.config import Config, to_yaml
from projservo_cli.files import replacing
from projservo_cli.records import Calibration, CrossValidation, InputError, IntArray, Observation, WorkFailed
from projservo_cli.stages import calibrate
from projservo_cli.stages.chain import steps_for
from projservo_cli.stages.random_tasks import STRATA, random_tasks
from projservo_cli.stages.truth import truth_of
from projservo_cli.store import Result, Run, load, save
from projservo_cli.sweep.design import Design, TaskSet
from projservo_cli.sweep.draws import TASKS

REFUSED = ".refused"  # a calibration that cannot be made leaves a file with the reason


class Wanted(NamedTuple):
    """A calibration to make: its key, and the configuration of a run that needs it."""

    key: str
    config: Config


class Calibrated(NamedTuple):
    """What became of it: records, or why there are none."""

    wanted: Wanted
    records: tuple[Observation, Calibration, CrossValidation | None] | None
    reason: str


def calibrate_one(wanted: Wanted) -> Calibrated:
    """Make one calibration, on one thread like all that must be the same to the bit."""
    with threadpool_limits(1):
        try:
            return Calibrated(wanted, calibrate.run(wanted.config), "")
        except WorkFailed as error:
            return Calibrated(wanted, None, str(error))


def tasks_of(design: Design, folder: Path, say: Callable[[str], None]) -> dict[int, TaskSet]:
    """Random tasks of every base, drawn once and kept in files.

    Raises
    ------
    InputError, WorkFailed
        If there are no such tasks.
    """
    if design.sweep.tasks is None:
        return {}
    found = {}
    for number, (name, _) in enumerate(design.bases):
        path = folder / f"tasks_{name}.npz"
        if not path.exists():
            say(f"drawing {design.sweep.tasks.random} random tasks of {name}")
            _write_tasks(path, drawn_tasks(design, number, design.sweep.tasks.random))
        found[number] = read_tasks(path)
    return found


def drawn_tasks(design: Design, base: int, count: int) -> TaskSet:
    """Random tasks of a base, the strata of their angles in turn."""
    config = design.cell(base * (design.cells // len(design.bases)))
    assert config.task is not None
    assert config.robot is not None
    q_front = np.array(config.task.start.values(config.robot.joint_types))
    rng = np.random.default_rng(np.random.SeedSequence(design.sweep.seed, spawn_key=(TASKS,)))
    tasks = random_tasks(truth_of(config), q_front, count, rng)
    order = in_turn(count)
    return TaskSet(tasks.q_start[order], tasks.q_goal[order])


def in_turn(count: int) -> IntArray:
    """Order in which tasks that are sorted by stratum come one of each stratum after the other."""
    quota = [count // STRATA + (i < count % STRATA) for i in range(STRATA)]
    first = np.cumsum([0, *quota[:-1]])
    return np.array([first[i] + k for k in range(max(quota)) for i in range(STRATA) if k < quota[i]])


def _write_tasks(path: Path, tasks: TaskSet) -> None:
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, q_start=tasks.q_start, q_goal=tasks.q_goal)


def read_tasks(path: Path) -> TaskSet:
    """Random tasks of a file.

    Raises
    ------
    InputError
        If it is damaged.
    """
    try:
        with np.load(path) as file:
            return TaskSet(file["q_start"], file["q_goal"])
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: damaged; delete it and run the sweep again") from error


def missing_calibrations(design: Design, folder: Path) -> Iterator[Wanted]:
    """Calibrations that are needed and not yet stored."""
    for cell, number in design.calibrations():
        key = design.calibration_key(cell, number)
        path = calibration_path(folder, key)
        if not path.exists() and not path.with_suffix(REFUSED).exists():
            yield Wanted(key, design.calibrated(cell, number))


def calibration_path(folder: Path, key: str) -> Path:
    """The run file that holds a calibration."""
    return folder / "calibrations" / f"{key[:20]}.h5"


def keep_calibration(folder: Path, made: Calibrated) -> None:
    """Store a calibration as a run file of its own, or why there is none."""
    path = calibration_path(folder, made.wanted.key)
    if made.records is None:
        with replacing(path.with_suffix(REFUSED)) as temporary:
            temporary.write_text(made.reason + "\n", encoding="utf-8")
        return
    observation, calibration, held_out = made.records
    records = {"observation": observation, "calibration": calibration}
    records |= {} if held_out is None else {"cross_validation": held_out}
    config = made.wanted.config
    (step,) = steps_for(config, Run(path), ["calibrate"])
    origin = provenance.collect(seed=config.seed)
    text = to_yaml(config)
    save(Run(path, text, {"calibrate": Result(step.key, text, origin, step.inputs, records)}))


def calibrations_of(design: Design, folder: Path) -> dict[str, Calibration | None]:
    """Calibrations by their key, None where one was refused; without covariance, which no run needs."""
    found: dict[str, Calibration | None] = {}
    for cell, number in design.calibrations():
        key = design.calibration_key(cell, number)
        path = calibration_path(folder, key)
        none = np.zeros((0, 0))
        found[key] = dataclasses.replace(load(path).calibration, covariance=none) if path.exists() else None
    return found
