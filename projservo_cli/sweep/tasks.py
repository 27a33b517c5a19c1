"""Random reaching tasks within sight of both cameras, as many in each sixth of half a turn."""

import math
from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.forward import displacements, image_points, moved_points
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.records import PRISMATIC, FloatArray, InputError, IntArray, WorkFailed
from projservo_cli.robots.truth import METRIC_A_INF
from projservo_cli.stages.world import Truth

RANGE = 0.9
LEAST_COSINE = math.cos(math.radians(75.0))
STRATA = 6
BATCH = 2_000
MOST_DRAWS = 20_000_000


@dataclass(frozen=True, eq=False)
class _RandomTasks:
    """Tasks, one of each stratum in turn while there are any."""

    q_start: FloatArray
    q_goal: FloatArray  # q_start, q_goal: (k, n) joints, rad or m
    # (k,) rotation from start to goal, rad; a sixth of the tasks in each sixth of half a turn
    angle: FloatArray


def random_tasks(truth: Truth, q_front: FloatArray, count: int, rng: np.random.Generator) -> _RandomTasks:
    """Draw tasks.

    truth : robot, rig and markers.
    q_front : (n,) joints at which the cameras see the front of the face, rad or m.
    count : tasks wanted.
    rng : seeded.
    """
    robot = truth.robot
    middle, half = 0.5 * (robot.lower + robot.upper), 0.5 * RANGE * (robot.upper - robot.lower)
    if not np.isfinite(half).all():
        raise InputError("random tasks need joint limits: set limits of every joint of the robot")
    front = math.copysign(1.0, float(_cosines(truth, _poses(truth, q_front[None]))[0, 0]))
    quota = [count // STRATA + (i < count % STRATA) for i in range(STRATA)]
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
        waiting += [(q[i], poses[i, :3, :3]) for i in _accepted(truth, poses, front)]
        while len(waiting) >= 2:
            (start, R), (goal, R_goal) = waiting.pop(0), waiting.pop(0)
            angle = math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(R.T @ R_goal)) - 1.0))))
            stratum = min(STRATA - 1, int(STRATA * angle / math.pi))
            if len(found[stratum]) < quota[stratum]:
                found[stratum].append((start, goal, angle))
    tasks = [tasks[k] for k in range(max(quota)) for tasks in found if k < len(tasks)]
    starts, goals, angles = (np.array(column) for column in zip(*tasks, strict=True))
    return _RandomTasks(starts, goals, angles)


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


def _accepted(truth: Truth, poses: FloatArray, front: float) -> IntArray:
    """Indices of the poses that show the face to both cameras."""
    m = image_points(truth.P, truth.M_face @ np.swapaxes(poses, 1, 2))
    before = (m[..., 2] > 0.0).all(axis=(1, 2))
    facing = (front * _cosines(truth, poses) >= LEAST_COSINE).all(axis=1)
    pixels = m[..., :2] / np.where(m[..., 2:] > 0.0, m[..., 2:], np.nan)
    inside = ((pixels >= -0.5) & (pixels <= truth.image_size - 0.5)).all(axis=(1, 2, 3))
    return np.flatnonzero(before & facing & inside)
