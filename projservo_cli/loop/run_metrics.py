"""Metrics of a run, from its log and the ground truth."""

import math
from typing import NamedTuple

from projservo_cli.geometry.algebra import Mat4, Vec4, apply, axpy, dot, mat, mul, sub, vec, vec_into
from projservo_cli.geometry.jit import inline, merged, njit
from projservo_cli.geometry.kinematics import backward, beyond_limits, forward
from projservo_cli.loop.verdicts import CONVERGED, FOLLOWED, Log
from projservo_cli.records import MM, FloatArray
from projservo_cli.simulation.analytic_plant import Ends, Plant, shows_face
from projservo_cli.task.face import center_of

_ROUND_OFF = 1e-9  # rad or m, by which a joint at its limit may seem to be beyond
SUBSAMPLES = 50  # points of a joint step at which the deviation between samples is measured


class Ended(NamedTuple):
    """End of a run."""

    verdict: int
    steps: int  # commands sent
    limited: float  # how often visibility limited the translation


class Summary(NamedTuple):
    """Numbers of a run that ended; NaN if they need the true goal and that is not known."""

    # 1 if it converged and, at every instant, enough cameras truly saw the face whole and from its front
    # and no joint was past a limit, 0 if not; the time between the instants is not checked
    success: float
    image_error_px: float  # at the end, rms over markers and views
    first_outside_image: int
    first_beyond_limit: int  # first_outside_image, first_beyond_limit: instants, −1 for never
    speed_limited_steps: int
    visibility_limited_steps: int  # speed_limited_steps, visibility_limited_steps: commands
    effort: float  # integral of the squared joint velocities, rad²/s and m²/s added
    # rotation_deg, distance_mm: true rotation, and distance of the centre, from start to goal
    rotation_deg: float
    distance_mm: float
    position_error_mm: float
    rotation_error_deg: float  # position_error_mm, rotation_error_deg: errors at the end
    path_length_mm: float  # path of the centre, from sample to sample
    center_deviation_at_samples_mm: float  # largest distance of the centre from its line


@njit
def summarize(plant: Plant, log: Log, ended: Ended, period: float, ends: Ends) -> Summary:
    """Numbers of a run."""
    steps = ended.steps
    slowed = 0
    for k in range(steps):
        if log.factor[k] < 1.0:
            slowed += 1
    middle, goal = center_of(plant.M, plant.center), vec(ends.goal)
    first, last = mat(log.H[0]), mat(log.H[steps])
    start, end = apply(first, middle), apply(last, middle)
    length, at_samples = math.nan, math.nan
    if math.isfinite(goal[0]):
        length, at_samples = _path_along(plant, log, steps, start, goal)
    base_tool, goal_pose = mat(ends.base_tool), mat(ends.goal_pose)
    pose_first, pose = mul(first, base_tool), mul(last, base_tool)
    error = _distance(end, goal)
    if plant.model.on_tool:  # the scene is displaced: the error is measured at the tool's origin
        pose_first = mul(backward(plant.model, log.q[0]), base_tool)
        pose = mul(backward(plant.model, log.q[steps]), base_tool)
        error = _distance(_origin(pose), _origin(goal_pose))
    arrived = ended.verdict in (CONVERGED, FOLLOWED)
    return Summary(
        success=1.0 if arrived and _keeps_within(plant, log, steps) else 0.0,
        image_error_px=float(log.error[steps]),
        first_outside_image=int(log.events[0]),
        first_beyond_limit=int(log.events[1]),
        speed_limited_steps=slowed,
        visibility_limited_steps=int(ended.limited),
        effort=_effort(log, steps, period),
        rotation_deg=math.degrees(angle_between(pose_first, goal_pose)),
        distance_mm=MM * _distance(start, goal),
        position_error_mm=MM * error,
        rotation_error_deg=math.degrees(angle_between(pose, goal_pose)),
        path_length_mm=MM * length,
        center_deviation_at_samples_mm=MM * at_samples,
    )


@merged
def _keeps_within(plant: Plant, log: Log, steps: int) -> bool:
    """Whether at each instant all joints are within their limits and the face within enough true images."""
    for k in range(steps + 1):
        if beyond_limits(plant.limits, log.q[k], _ROUND_OFF) >= 0:
            return False
        if not shows_face(plant, mat(log.H[k]), log.hidden[k], log.scratch[0]):
            return False
    return True


@merged
def _effort(log: Log, steps: int, period: float) -> float:
    """Integral of the squared joint velocities, rad²/s and m²/s added."""
    total = 0.0
    for k in range(steps):
        for i in range(log.q_dot.shape[1]):
            total += log.q_dot[k, i] * log.q_dot[k, i]
    return total * period


@inline
def _origin(pose: Mat4) -> Vec4:
    """Origin of a pose."""
    return (pose[3], pose[7], pose[11], 1.0)


@merged
def _distance(A: Vec4, B: Vec4) -> float:
    """Distance of two metric points, m."""
    distance = sub(A, B)
    return math.sqrt(dot(distance, distance))


@inline
def angle_between(A: Mat4, B: Mat4) -> float:
    """Angle of the rotation from pose A to pose B, rad."""
    trace = (A[0] * B[0] + A[4] * B[4] + A[8] * B[8]) + (A[1] * B[1] + A[5] * B[5] + A[9] * B[9])
    trace += A[2] * B[2] + A[6] * B[6] + A[10] * B[10]
    x = (A[2] * B[1] + A[6] * B[5] + A[10] * B[9]) - (A[1] * B[2] + A[5] * B[6] + A[9] * B[10])
    y = (A[0] * B[2] + A[4] * B[6] + A[8] * B[10]) - (A[2] * B[0] + A[6] * B[4] + A[10] * B[8])
    z = (A[1] * B[0] + A[5] * B[4] + A[9] * B[8]) - (A[0] * B[1] + A[4] * B[5] + A[8] * B[9])
    return math.atan2(math.sqrt(x * x + y * y + z * z), trace - 1.0)


@merged
def _path_along(plant: Plant, log: Log, steps: int, start: Vec4, goal: Vec4) -> tuple[float, float]:
    """Length of the true centre's path from sample to sample, and its largest distance from start–goal, m."""
    M = log.M[: plant.M.shape[0]]
    length = 0.0
    maximum = 0.0
    last = start
    for k in range(steps + 1):
        H = mat(log.H[k])
        for j in range(M.shape[0]):
            vec_into(M[j], apply(H, vec(plant.M[j])))
        A_c = center_of(M, plant.center)
        distance = sub(A_c, last)
        last = A_c
        if k > 0:
            length += math.sqrt(dot(distance, distance))
            maximum = max(maximum, _line_distance(A_c, start, goal))
    return length, maximum


@njit
def path_deviation(
    plant: Plant, log: Log, steps: int, period: float, start: FloatArray, goal: FloatArray
) -> float:
    """Largest distance of the true centre from the line start–goal, between the samples too, m.

    Between two samples, or the ends of the parts of a step, the joints move linearly.
    """
    ends = vec(start), vec(goal)
    n, M = log.q.shape[1], log.M[: plant.M.shape[0]]
    q, dq, q_part = log.scratch[0], log.scratch[1], log.scratch[2, :n]
    maximum = 0.0
    for k in range(steps):
        parts = max(1, log.parts[k])
        samples = max(1, SUBSAMPLES // parts)
        for j in range(parts):
            for i in range(n):
                if log.parts[k] == 0:
                    q[i], dq[i] = log.q[k, i], log.q_dot[k, i] * period
                else:
                    q[i], dq[i] = log.path[k, j, i], log.path[k, j + 1, i] - log.path[k, j, i]
            for sample in range(1, samples + 1):
                for i in range(n):
                    q_part[i] = q[i] + dq[i] * (sample / samples)
                H = forward(plant.model, q_part)
                for i in range(M.shape[0]):
                    vec_into(M[i], apply(H, vec(plant.M[i])))
                maximum = max(maximum, _line_distance(center_of(M, plant.center), ends[0], ends[1]))
    return maximum


@merged
def _line_distance(A: Vec4, start: Vec4, goal: Vec4) -> float:
    """Distance of a metric point from the line through start and goal; from start if they agree."""
    distance = axpy(-1.0, start, goal)
    off = axpy(-1.0, start, A)
    length = dot(distance, distance)
    if length > 0.0:
        off = axpy(-dot(off, distance) / length, distance, off)
    return math.sqrt(dot(off, off))
