"""Random reaching tasks of a simulated robot within sight of its cameras."""

import math

import numpy as np

from projservo_cli.calibration.prediction import image_points, moved_points
from projservo_cli.geometry.displacements import displacements
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.image_size import within_images
from projservo_cli.records import FloatArray, InputError, IntArray, WorkFailed
from projservo_cli.simulation.arm import METRIC_A_INF
from projservo_cli.simulation.ground_truth import Truth

_RANGE = 0.9  # share of the range of a joint that is drawn from
_LEAST_COSINE = math.cos(math.radians(75.0))  # minimum, of the angle between the normal of the face and a ray
STRATA = 6
"""Equal parts of the range of rotations, of each of which there are as many tasks."""
_BATCH = 2_000  # joint vectors drawn at once
_MOST_DRAWS = 20_000_000  # joint vectors


def random_tasks(
    truth: Truth,
    q_front: FloatArray,
    count: int,
    rng: np.random.Generator,
    min_views: int = 0,
    angles: tuple[float, float] = (0.0, math.pi),
) -> tuple[FloatArray, FloatArray]:
    """Draw tasks within sight of the cameras, one of each sixth of a range of rotations in turn.

    q_front : (n,) joints at which the first camera sees the front of the face, rad or m.
    min_views : number of cameras that see it at both ends, 0 for all.
    angles : minimum and maximum rotation, rad.
    Returns joints (count, n) at start and goal, rad or m.
    """
    limits, (low, high) = truth.robot.limits, angles
    middle, half = 0.5 * (limits.lower + limits.upper), 0.5 * _RANGE * (limits.upper - limits.lower)
    if not np.isfinite(half).all():
        raise InputError("random tasks need joint limits: set limits of every joint of the robot")
    front = math.copysign(1.0, float(_cosines(truth, _poses(truth, q_front[None]))[0, 0]))
    quota = [count // STRATA + (i < count % STRATA) for i in range(STRATA)]
    found: list[list[tuple[FloatArray, FloatArray]]] = [[] for _ in range(STRATA)]
    waiting: list[tuple[FloatArray, FloatArray]] = []
    drawn = 0
    while any(len(tasks) < high for tasks, high in zip(found, quota, strict=True)):
        if drawn >= _MOST_DRAWS:
            raise WorkFailed(
                f"of {drawn} joint vectors too few show the face to the cameras for {count} tasks: "
                "turn the cameras towards the workspace or ask for fewer"
            )
        q = middle + half * rng.uniform(-1.0, 1.0, (_BATCH, len(middle)))
        drawn += _BATCH
        poses = _poses(truth, q)
        accepted = _accepted(truth, poses, front, min_views or len(truth.P))
        waiting += [(q[i], poses[i, :3, :3]) for i in accepted]
        while len(waiting) >= 2:
            (start, R), (goal, R_goal) = waiting.pop(0), waiting.pop(0)
            angle = math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(R.T @ R_goal)) - 1.0))))
            stratum = min(STRATA - 1, math.floor(STRATA * (angle - low) / (high - low)))
            if low <= angle <= high and len(found[stratum]) < quota[stratum]:
                found[stratum].append((start, goal))
    tasks = [tasks[k] for k in range(max(quota)) for tasks in found if k < len(tasks)]
    starts, goals = (np.array(column) for column in zip(*tasks, strict=True))
    return starts, goals


def _poses(truth: Truth, q: FloatArray) -> FloatArray:
    """Displacements (k, 4, 4) of the face from the reference at joints (k, n), [RH00] eq. (6)."""
    robot = truth.robot
    E = displacements(robot.H_hat_0, robot.prismatic, q - robot.q_reference)
    poses = np.swapaxes(moved_points(E, np.eye(4))[0], 1, 2)
    return np.linalg.inv(poses) if truth.on_tool else poses


def _cosines(truth: Truth, poses: FloatArray) -> FloatArray:
    """Cosine (k, V) of the angle between the normal of the face and the rays to the optical centres."""
    M = truth.M_face[:, :3]
    middle = M.mean(axis=0) if truth.center < 0 else M[truth.center]
    normal = np.linalg.svd(M - M.mean(axis=0))[2][2]
    rays = optical_centers(truth.P, METRIC_A_INF)[:, :3] - (
        poses[:, None, :3, :3] @ middle + poses[:, None, :3, 3]
    )
    rays = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    return np.asarray(np.einsum("kvi,ki->kv", rays, poses[:, :3, :3] @ normal))


def _accepted(truth: Truth, poses: FloatArray, front: float, min_views: int) -> IntArray:
    """Indices of the poses that show the face to enough cameras."""
    m = image_points(truth.P, truth.M_face @ np.swapaxes(poses, 1, 2))
    before = (m[..., 2] > 0.0).all(axis=2)
    facing = front * _cosines(truth, poses) >= _LEAST_COSINE
    pixels = m[..., :2] / np.where(m[..., 2:] > 0.0, m[..., 2:], np.nan)
    inside = within_images(pixels, truth.image_size[:, None]).all(axis=2)
    return np.flatnonzero((before & facing & inside).sum(axis=1) >= min_views)
