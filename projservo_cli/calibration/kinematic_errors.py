"""A given model of the arm against the calibrated one: zeros of joints, then errors of axes.

The zeros of the first and the last joint are gauge: they move base and tool, which no image knows.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.metric import Metric, base_frame, base_joints, directions
from projservo_cli.geometry.rigid import exponentials, rigid, rigid_inverse, screws, twists
from projservo_cli.records import BoolArray, FloatArray, InputError

# Errors of axes that any model has, of machining and assembly, rad and m.
_LINK_STD = np.repeat([5e-4, 5e-4], 3)
# Step of the differences that propagate covariances, in standard deviations.
_STEP = 1e-3


class JointError(NamedTuple):
    """Error of the model at one joint, each with its standard deviation."""

    joint: int  # number of the joint, from 1
    zero: float | None  # rad or m to add to readings before the model takes them; None where it is gauge
    zero_std: float | None  # rad or m
    offset_m: float  # distance of the calibrated axis from the model's, at the point nearest to the tool
    offset_std_m: float  # m
    tilt_rad: float  # angle between both axes
    tilt_std_rad: float  # rad


class _Fit(NamedTuple):
    """Model fitted to the calibrated axes, whitened residuals and their derivatives."""

    x: FloatArray  # (6 + n - 2,) base and inner zeros
    J: FloatArray  # (6 n, 6 + n - 2)
    root: FloatArray  # (6 n, 6 n) inverse root of the covariance of differences
    remains: FloatArray  # (6 n,) differences after the fit, not whitened
    errors: FloatArray  # (6 n, c) their changes by independent errors of the calibration
    to_scale: FloatArray  # (6 n,) whitened derivative by the scale of the model's lengths


def _fitted(metric: Metric, given: FloatArray) -> _Fit:
    """Fit the base and the inner zeros of a model, as ``kinematic_errors`` says."""
    prismatic, n = metric.prismatic, len(metric.joint_types)
    types = "".join("R" if w.any() else "P" for w in given[:, :3])
    if types != metric.joint_types:
        raise InputError(
            f"the model's joints are {types}, the calibrated ones {metric.joint_types}: choose the link of "
            "the tool as its tip"
        )
    near = metric.pose(np.zeros(n))[:3, 3]

    def left(x: FloatArray, found: FloatArray, scale: float = 1.0) -> FloatArray:
        sized = given * np.where(prismatic[:, None], 1.0, [1.0, 1.0, 1.0, scale, scale, scale])
        base = rigid_inverse(base_frame(sized, prismatic, base_joints(sized, prismatic)))
        model = _moved(base, x, sized, prismatic)
        return _differences(found, model, prismatic, near).reshape(*found.shape[:-2], 6 * n)

    x, change = np.zeros(6 + max(n - 2, 0)), _STEP * metric.deviations("axes")
    E = ((left(x, metric.axes + change) - left(x, metric.axes - change)) / (2.0 * _STEP)).T
    root = np.linalg.inv(np.linalg.cholesky(E @ E.T + np.diag(np.tile(_LINK_STD**2, n))))
    axes = metric.axes

    def weighted(x: FloatArray) -> FloatArray:
        return np.asarray(root @ left(x, axes))

    fit = least_squares(weighted, x, x_scale="jac")
    ends = (left(fit.x, axes, 1.0 + sign * _STEP) for sign in (1, -1))
    to_scale = root @ np.subtract(*ends) / (2.0 * _STEP)
    return _Fit(fit.x, np.asarray(fit.jac), root, left(fit.x, axes), E, to_scale)


def kinematic_errors(metric: Metric, given: FloatArray) -> list[JointError]:
    """Compare a model with the calibrated arm, joint by joint.

    The base and the zeros of the inner joints are fitted first, weighted by the covariance of the axes and by
    0.5 mm and 0.5 mrad for the links of any model. What remains are errors of axes.

    metric : of the calibration, in metres.
    given : (n, 6) screws of the model at readings of zero, rad and m.
    Raises InputError if the joint types differ.
    """
    fit, n = _fitted(metric, given), len(given)
    J, root, E = fit.J, fit.root, fit.errors
    std = np.sqrt(np.diag(np.linalg.pinv(J.T @ J)))
    remains = fit.remains.reshape(n, 2, 3)
    changed = (E - np.linalg.solve(root, J @ (np.linalg.pinv(J) @ root @ E))).reshape(n, 2, 3, -1)
    size, size_std = np.linalg.norm(remains, axis=2), np.linalg.norm(changed, axis=(2, 3))
    return [
        JointError(
            joint=i + 1,
            zero=float(fit.x[5 + i]) if 0 < i < n - 1 else None,
            zero_std=float(std[5 + i]) if 0 < i < n - 1 else None,
            offset_m=float(size[i, 1]),
            offset_std_m=float(size_std[i, 1]),
            tilt_rad=float(size[i, 0]),
            tilt_std_rad=float(size_std[i, 0]),
        )
        for i in range(n)
    ]


def length_error(metric: Metric, given: FloatArray) -> tuple[float, float]:
    """Share by which the known length is too short for the links of a model, and its standard deviation.

    The deviation grows with what the model leaves beyond its own errors. Arguments as of
    ``kinematic_errors``.
    """
    fit = _fitted(metric, given)
    r = fit.root @ fit.remains
    across = fit.to_scale - fit.J @ (np.linalg.pinv(fit.J) @ fit.to_scale)
    information = float(across @ across)
    share = float(across @ r) / information
    beyond = r - share * across
    degrees = max(len(r) - np.linalg.matrix_rank(fit.J) - 1, 1)
    return share, float(np.sqrt(max(1.0, float(beyond @ beyond) / degrees) / information))


def _moved(base: FloatArray, x: FloatArray, given: FloatArray, prismatic: BoolArray) -> FloatArray:
    """Screws (n, 6) of a model whose base moves by x[:6] and whose inner zeros move by the rest."""
    n = len(given)
    zeros = np.zeros(n)
    zeros[1 : n - 1] = x[6:]
    T = rigid(Rotation.from_rotvec(x[:3]), x[3:6]) @ base
    moved, steps = np.empty_like(given), exponentials(given, prismatic, zeros)
    for i in range(n):
        moved[i] = screws(T @ twists(given[i]) @ rigid_inverse(T))
        T = T @ steps[i]
    return moved


def _differences(found: FloatArray, model: FloatArray, prismatic: BoolArray, near: FloatArray) -> FloatArray:
    """Differences (…, n, 6) of directions, and of lines at their points nearest to ``near`` (3,), m."""
    d, d0 = directions(found, prismatic), directions(model, prismatic)
    p, p0 = np.cross(found[..., :3], found[..., 3:]), np.cross(model[:, :3], model[:, 3:])
    at = p0 + d0 * ((near - p0) * d0).sum(axis=-1, keepdims=True)
    offset = p - at
    offset = offset - d * (offset * d).sum(axis=-1, keepdims=True)
    offset[..., prismatic, :] = 0.0
    return np.concatenate([d - d0, offset], axis=-1)
