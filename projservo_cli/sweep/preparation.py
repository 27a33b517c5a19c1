"""What many runs of a sweep share and what takes long to make: random tasks and calibrations."""

import dataclasses
import math
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from projservo_cli import provenance
from projservo_cli.calibration.prediction import displacements, image_points, moved_points
from projservo_cli.config import Config, to_yaml
from projservo_cli.files import replacing
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.records import (
    PRISMATIC,
    Calibration,
    CrossValidation,
    FloatArray,
    InputError,
    IntArray,
    Observation,
    WorkFailed,
)
from projservo_cli.robots.truth import METRIC_A_INF
from projservo_cli.stages import calibrate
from projservo_cli.stages.steps import steps_for
from projservo_cli.stages.world import Truth, truth_of
from projservo_cli.store import Result, Run, load, save
from projservo_cli.sweep.design import TASKS, Design, TaskSet

RANGE = 0.9
LEAST_COSINE = math.cos(math.radians(75.0))
STRATA = 6
BATCH = 2_000
MOST_DRAWS = 20_000_000


@dataclass(frozen=True, eq=False)
class RandomTasks:
    """Tasks and how they came about.

    Attributes
    ----------
    q_start, q_goal : (k, n) joints, rad or m.
    angle : (k,) rotation from start to goal, rad; a sixth of the tasks in each sixth of half a turn.
    drawn : joint vectors drawn.
    rejected : how many of them were rejected for each reason, and pairs whose stratum was full.
    """

    q_start: FloatArray
    q_goal: FloatArray
    angle: FloatArray
    drawn: int
    rejected: dict[str, int]

    def words(self) -> str:
        """Rejection rate and reasons."""
        vectors = {reason: count for reason, count in self.rejected.items() if reason != "stratum full"}
        rate = sum(vectors.values()) / self.drawn
        reasons = ", ".join(f"{reason} {count / self.drawn:.1%}" for reason, count in vectors.items())
        return (
            f"{len(self.angle)} tasks from {self.drawn} joint vectors, {rate:.2%} of them rejected "
            f"({reasons}); {self.rejected['stratum full']} pairs rejected as their stratum was full"
        )


def random_tasks(truth: Truth, q_front: FloatArray, count: int, rng: np.random.Generator) -> RandomTasks:
    """Draw tasks.

    Parameters
    ----------
    truth : robot, rig and markers.
    q_front : (n,) joints at which the cameras see the front of the face, rad or m.
    count : tasks wanted.
    rng : seeded.

    Raises
    ------
    InputError
        If a joint has no limits to draw within.
    WorkFailed
        If too few joint vectors show the face to both cameras.
    """
    robot = truth.robot
    middle, half = 0.5 * (robot.lower + robot.upper), 0.5 * RANGE * (robot.upper - robot.lower)
    if not np.isfinite(half).all():
        raise InputError("random tasks need joint limits: set limits of every joint of the robot")
    front = math.copysign(1.0, float(_cosines(truth, _poses(truth, q_front[None]))[0, 0]))
    quota = [count // STRATA + (i < count % STRATA) for i in range(STRATA)]
    rejected = dict.fromkeys(("behind a camera", "turned away", "outside an image", "stratum full"), 0)
    found: list[list[tuple[FloatArray, FloatArray, float]]] = [[] for _ in range(STRATA)]
    waiting: list[tuple[FloatArray, FloatArray]] = []
    drawn = 0
    while any(len(tasks) < most for tasks, most in zip(found, quota, strict=True)):
        if drawn >= MOST_DRAWS:
            raise WorkFailed(
                f"of {drawn} joint vectors too few show the face to both cameras for {count} tasks: "
                "turn the cameras towards the workspace or ask for fewer"
            )
        q = middle + half * rng.uniform(-1.0, 1.0, (BATCH, len(middle)))
        drawn += BATCH
        poses = _poses(truth, q)
        waiting += [(q[i], poses[i, :3, :3]) for i in _accepted(truth, poses, front, rejected)]
        while len(waiting) >= 2:
            (start, R), (goal, R_goal) = waiting.pop(0), waiting.pop(0)
            angle = math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(R.T @ R_goal)) - 1.0))))
            stratum = min(STRATA - 1, int(STRATA * angle / math.pi))
            if len(found[stratum]) < quota[stratum]:
                found[stratum].append((start, goal, angle))
            else:
                rejected["stratum full"] += 1
    tasks = [task for stratum in found for task in stratum]
    starts, goals, angles = (np.array(column) for column in zip(*tasks, strict=True))
    return RandomTasks(starts, goals, angles, drawn, rejected)


def _poses(truth: Truth, q: FloatArray) -> FloatArray:
    """Displacements (k, 4, 4) from the reference at joints (k, n), [RH00] eq. (6) for many at once."""
    robot = truth.robot
    E = displacements(robot.H_hat_0, robot.joint_types == PRISMATIC, q - robot.q_reference)
    return np.swapaxes(moved_points(E, np.eye(4))[0], 1, 2)


def _cosines(truth: Truth, poses: FloatArray) -> FloatArray:
    """Cosine (k, 2) of the angle between the normal of the face and the rays to the optical centres."""
    M = truth.M_face[:, :3]
    middle = M.mean(axis=0) if truth.center < 0 else M[truth.center]
    normal = np.linalg.svd(M - M.mean(axis=0))[2][2]
    rays = optical_centers(truth.P, METRIC_A_INF)[:, :3] - (
        poses[:, None, :3, :3] @ middle + poses[:, None, :3, 3]
    )
    rays = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    return np.asarray(np.einsum("kvi,ki->kv", rays, poses[:, :3, :3] @ normal))


def _accepted(truth: Truth, poses: FloatArray, front: float, rejected: dict[str, int]) -> IntArray:
    """Indices of the poses that show the face to both cameras; the others are counted by reason."""
    m = image_points(truth.P, truth.M_face @ np.swapaxes(poses, 1, 2))
    before = (m[..., 2] > 0.0).all(axis=(1, 2))
    turned = (front * _cosines(truth, poses) >= LEAST_COSINE).all(axis=1)
    pixels = m[..., :2] / np.where(m[..., 2:] > 0.0, m[..., 2:], np.nan)
    inside = ((pixels >= -0.5) & (pixels <= truth.image_size - 0.5)).all(axis=(1, 2, 3))
    rejected["behind a camera"] += int((~before).sum())
    rejected["turned away"] += int((before & ~turned).sum())
    rejected["outside an image"] += int((before & turned & ~inside).sum())
    return np.flatnonzero(before & turned & inside)


REFUSED = ".refused"  # a calibration that cannot be made leaves a file with the reason


class Calibrated(NamedTuple):
    """What became of the calibration of a key: records, or why there are none."""

    key: str
    config: Config
    records: tuple[Observation, Calibration, CrossValidation | None] | None
    reason: str = ""


def calibrate_one(wanted: tuple[str, Config]) -> Calibrated:
    """Make the calibration of a key, on one thread like all that must be the same to the bit."""
    with threadpool_limits(1):
        try:
            return Calibrated(*wanted, calibrate.run(wanted[1]))
        except WorkFailed as error:
            return Calibrated(*wanted, None, str(error))


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
            tasks = drawn_tasks(design, number, design.sweep.tasks.random)
            with replacing(path) as temporary, open(temporary, "wb") as file:
                np.savez(file, **tasks._asdict())
        found[number] = read_tasks(path)
    return found


def drawn_tasks(design: Design, base: int, count: int) -> TaskSet:
    """Random tasks of a base, one of each stratum of their angles after the other."""
    config = design.cell(base * (design.cells // len(design.bases)))
    assert config.task is not None
    assert config.robot is not None
    q_front = np.array(config.task.start.values(config.robot.joint_types))
    rng = np.random.default_rng(np.random.SeedSequence(design.sweep.seed, spawn_key=(TASKS,)))
    tasks = random_tasks(truth_of(config), q_front, count, rng)
    quota = [count // STRATA + (i < count % STRATA) for i in range(STRATA)]  # they come sorted by stratum
    first = np.cumsum([0, *quota[:-1]])
    order = [first[i] + k for k in range(max(quota)) for i in range(STRATA) if k < quota[i]]
    return TaskSet(tasks.q_start[order], tasks.q_goal[order])


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


def missing_calibrations(design: Design, folder: Path) -> Iterator[tuple[str, Config]]:
    """Calibrations that are needed and not yet stored: their keys, and configurations that need them."""
    for key, config in design.calibrations():
        path = calibration_path(folder, key)
        if not path.exists() and not path.with_suffix(REFUSED).exists():
            yield key, config


def calibration_path(folder: Path, key: str) -> Path:
    """The run file that holds a calibration."""
    return folder / "calibrations" / f"{key[:20]}.h5"


def keep_calibration(folder: Path, made: Calibrated) -> None:
    """Store a calibration as a run file of its own, or why there is none."""
    path = calibration_path(folder, made.key)
    if made.records is None:
        with replacing(path.with_suffix(REFUSED)) as temporary:
            temporary.write_text(made.reason + "\n", encoding="utf-8")
        return
    names = ("observation", "calibration", "cross_validation")
    records = {name: one for name, one in zip(names, made.records, strict=True) if one is not None}
    (step,) = steps_for(made.config, Run(path), ["calibrate"])
    origin = provenance.collect(seed=made.config.seed)
    text = to_yaml(made.config)
    save(Run(path, text, {"calibrate": Result(step.key, text, origin, step.inputs, records)}))


def calibrations_of(design: Design, folder: Path) -> dict[str, Calibration | None]:
    """Calibrations by their key, None where one was refused; without covariance, which no run needs."""
    found: dict[str, Calibration | None] = {}
    for key, _ in design.calibrations():
        path, none = calibration_path(folder, key), np.zeros((0, 0))
        found[key] = dataclasses.replace(load(path).calibration, covariance=none) if path.exists() else None
    return found
