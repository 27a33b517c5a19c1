"""Numbers read off the traces: how errors decay, how paths differ, where a run stands still."""

import numpy as np

from projservo_cli.geometry.kinematics import forward_kinematics, project
from projservo_cli.records import FloatArray, Trace
from projservo_cli.report.material import Material

# A run counts as settled this many steps after its last command at the joint-speed limit.
SETTLING_STEPS = 20
# Where the must-decay ends: errors that nothing but the calibration explains, m and rad.
LEAST_DISTANCE = 1e-4
LEAST_ANGLE = np.radians(0.05)
# Longest joint motion, rad or m, between two points of a drawn path.
PATH_RESOLUTION = np.radians(1.0)


def settled_at(trace: Trace) -> int:
    """First instant that lies ``SETTLING_STEPS`` after the last speed-limited command, or the start."""
    limited = np.flatnonzero(trace.speed_factor < 1.0)
    return SETTLING_STEPS + (int(limited[-1]) if len(limited) else 0)


def decay_factors(values: FloatArray, first: int, least: float) -> FloatArray:
    """Ratios of successive values, from instant ``first`` to the last value above ``least``.

    Parameters
    ----------
    values : (k,) positive errors.
    first : instant of the first value.
    least : value below which nothing is counted.

    Returns
    -------
    (j,) ratios, possibly none.
    """
    small = np.flatnonzero(values[first:] <= least)
    used = values[first : first + int(small[0])] if len(small) else values[first:]
    return used[1:] / used[:-1]


def fitted_rate(values: FloatArray, first: int, least: float, period: float) -> float:
    """Rate, 1/s, of the geometric decay fitted to the logarithm of values; NaN below three values.

    A loop that takes the share λ T of the error in each period T has the rate λ.
    """
    ratios = decay_factors(values, first, least)
    if len(ratios) < 2:
        return float("nan")
    used = np.log(values[first : first + len(ratios) + 1])
    slope = np.polyfit(np.arange(len(used)), used, 1)[0]
    return float(1.0 - np.exp(slope)) / period


def center_distance(material: Material, trace: Trace) -> FloatArray:
    """True distance (k,) of the centre from its goal, m."""
    return np.asarray(np.linalg.norm(trace.center - material.goal_center(trace), axis=1))


def true_rotation(trace: Trace) -> float:
    """Angle between the rotations of the first pose and the goal, rad; NaN where that is unknown."""
    R = trace.pose[0, :3, :3].T @ trace.goal_pose[:3, :3]
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(sine, np.trace(R) - 1.0))


def center_path(material: Material, trace: Trace) -> FloatArray:
    """True centre (k, 3) along a run, m, between the instants too, where the joints move linearly."""
    amount = np.abs(np.diff(trace.q, axis=0)).max(axis=1, initial=0.0)
    points = [trace.center[0]]
    for k, most in enumerate(amount):
        parts = max(1, int(np.ceil(most / PATH_RESOLUTION)))
        for share in np.arange(1, parts) / parts:
            q = trace.q[k] + share * (trace.q[k + 1] - trace.q[k])
            points.append((forward_kinematics(material.plant.model, q) @ material.middle)[:3])
        points.append(trace.center[k + 1])
    return np.array(points)


def along_line(points: FloatArray, start: FloatArray, goal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Way (k,) along the straight line from start to goal and distance (k,) from it, m."""
    length = np.linalg.norm(goal - start)
    direction = (goal - start) / length if length > 0 else np.zeros(3)
    way = (points - start) @ direction
    off = points - start - way[:, None] * direction
    return way, np.asarray(np.linalg.norm(off, axis=1))


def path_gap(first: FloatArray, second: FloatArray) -> FloatArray:
    """Largest distance between two polylines, each point to the nearest of the other path.

    Parameters
    ----------
    first, second : (k, ..., 2) and (l, ..., 2) points of the paths, px.

    Returns
    -------
    (...) Hausdorff distance of the vertices of either path from the other, px.
    """
    shape = first.shape[1:-1]
    a = first.reshape(len(first), -1, 2)
    b = second.reshape(len(second), -1, 2)
    gaps = [
        max(_to_polyline(a[:, i], b[:, i]).max(), _to_polyline(b[:, i], a[:, i]).max())
        for i in range(a.shape[1])
    ]
    return np.array(gaps).reshape(shape)


def _to_polyline(points: FloatArray, path: FloatArray) -> FloatArray:
    """Distance (k,) of points (k, 2) from a polyline (l, 2)."""
    start, way = path[:-1], np.diff(path, axis=0)
    if not len(way):
        return np.asarray(np.linalg.norm(points - path[0], axis=1))
    square = np.maximum((way**2).sum(axis=1), np.finfo(float).tiny)
    offset = points[:, None] - start
    share = np.clip((offset * way).sum(axis=2) / square, 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * way, axis=2).min(axis=1))


def plateau_stretch(image_error: FloatArray, window: int) -> tuple[int, int] | None:
    """First and last instant of the longest stretch whose error falls < 1 % in each window of steps."""
    flat = image_error[window:] > 0.99 * image_error[:-window]
    best = (0, 0)
    first = 0
    for k, value in enumerate(flat):
        if not value:
            first = k + 1
        elif k + 1 - first > best[1] - best[0]:
            best = (first, k + 1)
    return (best[0], best[1] - 1 + window) if best[1] > best[0] else None


def coordinate_rise(e: FloatArray) -> FloatArray:
    """How far each error rises in size above the least it had before; 0 where it only falls.

    Parameters
    ----------
    e : (k, ...) errors over time.
    """
    size = np.abs(e)
    return np.asarray((size - np.minimum.accumulate(size, axis=0)).max(axis=0))


def off_exponential(e: FloatArray, factor: float) -> FloatArray:
    """Largest difference of errors (k, ...) from a decay of their first value by a factor a step."""
    shape = (-1,) + (1,) * (e.ndim - 1)
    expected = e[0] * (factor ** np.arange(len(e))).reshape(shape)
    return np.asarray(np.abs(e - expected).max(axis=0))


def center_image(material: Material, trace: Trace) -> FloatArray:
    """Pixels (k, 2, 2) of the true centre in both views."""
    points = np.c_[trace.center, np.ones(len(trace.center))]
    return np.asarray(project(material.plant.model.P, points).swapaxes(0, 1))


def curve_difference(first: FloatArray, second: FloatArray) -> tuple[FloatArray, bool]:
    """Difference of two angle curves over their common instants, rad, and whether they mirror.

    Half a turn may be made in either sense; curves that differ by the sense are compared by size.
    """
    k = min(len(first), len(second))
    straight = np.abs(first[:k] - second[:k])
    mirrored = np.abs(first[:k] + second[:k])
    if mirrored.max() < straight.max():
        return mirrored, True
    return straight, False


def second_order_drift(
    H_hat: FloatArray, joint_step: FloatArray, center: FloatArray, line: FloatArray
) -> FloatArray:
    """Contribution of each joint to the centre's second-order deviation from its line in one step, m.

    Under the product of exponentials of [RH00] eq. (6) a point M has the second derivatives
    Ĥ_i Ĥ_j M, i ≤ j. Joint i is given its own term and half of each term it shares with another
    joint; contributions are counted along the direction of their sum, so that they add up to its
    length.

    Parameters
    ----------
    H_hat : (n, 4, 4) metric operators at the current joints.
    joint_step : (n,) joint step, rad or m.
    center : (4,) centre, m.
    line : (3,) unit direction of the line.

    Returns
    -------
    (n,) signed contributions, m.
    """
    n = len(joint_step)
    parts = np.zeros((n, 3))
    for i in range(n):
        for j in range(n):
            acceleration = H_hat[min(i, j)] @ H_hat[max(i, j)] @ center
            parts[i] += 0.5 * joint_step[i] * joint_step[j] * acceleration[:3]
    parts -= np.outer(parts @ line, line)
    total = parts.sum(axis=0)
    size = float(np.linalg.norm(total))
    return np.asarray(parts @ total / size) if size > 0 else np.zeros(n)
