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


class KinematicErrors(NamedTuple):
    """Errors of a model against the calibrated arm."""

    joints: list[JointError]
    length: float  # share by which the known length is too short for the links of the model
    length_std: float  # its standard deviation, which grows with what the model leaves beyond its own errors


def kinematic_errors(metric: Metric, given: FloatArray) -> KinematicErrors:
    """Compare a model with the calibrated arm, joint by joint, and its links with the known length.

    The base and the zeros of the inner joints are fitted first, weighted by the covariance of the axes and by
    0.5 mm and 0.5 mrad for the links of any model. What remains are errors of axes.

    metric : of the calibration, in metres.
    given : (n, 6) screws of the model at readings of zero, rad and m.
    Raises InputError if the joint types differ.
    """
    prismatic, n = metric.prismatic, len(metric.joint_types)
    types = "".join("R" if w.any() else "P" for w in given[:, :3])
    if types != metric.joint_types:
        raise InputError(
            f"the model's joints are {types}, the calibrated ones {metric.joint_types}: choose the link of "
            "the tool as its tip"
        )
    base = rigid_inverse(base_frame(given, prismatic, base_joints(given, prismatic)))
    near = metric.pose(np.zeros(n))[:3, 3]

    def left(
        x: FloatArray, found: FloatArray, base: FloatArray = base, given: FloatArray = given
    ) -> FloatArray:
        model = _moved(base, x, given, prismatic)
        return _differences(found, model, prismatic, near).reshape(*found.shape[:-2], 6 * n)

    x, change = np.zeros(6 + max(n - 2, 0)), _STEP * metric.deviations("axes")
    E = ((left(x, metric.axes + change) - left(x, metric.axes - change)) / (2.0 * _STEP)).T
    root = np.linalg.inv(np.linalg.cholesky(E @ E.T + np.diag(np.tile(_LINK_STD**2, n))))
    axes = metric.axes

    def weighted(x: FloatArray) -> FloatArray:
        return np.asarray(root @ left(x, axes))

    fit = least_squares(weighted, x, x_scale="jac")
    J = np.asarray(fit.jac)
    pinv = np.linalg.pinv(J)
    std = np.sqrt(np.diag(np.linalg.pinv(J.T @ J)))
    remains = left(fit.x, axes).reshape(n, 2, 3)
    changed = (E - np.linalg.solve(root, J @ (pinv @ root @ E))).reshape(n, 2, 3, -1)
    size, size_std = np.linalg.norm(remains, axis=2), np.linalg.norm(changed, axis=(2, 3))
    joints = [
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
    ends = (left(fit.x, axes, *_scaled(base, given, prismatic, 1.0 + sign * _STEP)) for sign in (1, -1))
    by_scale = root @ np.subtract(*ends) / (2.0 * _STEP)
    return KinematicErrors(joints, *_length_error(np.asarray(fit.fun), J, by_scale - J @ (pinv @ by_scale)))


def _scaled(
    base: FloatArray, given: FloatArray, prismatic: BoolArray, factor: float
) -> tuple[FloatArray, FloatArray]:
    """Base (4, 4) and screws (n, 6) of a model whose lengths are multiplied by a factor."""
    base, given = base.copy(), given.copy()
    base[:3, 3] *= factor
    given[~prismatic, 3:] *= factor
    return base, given


def _length_error(r: FloatArray, J: FloatArray, across: FloatArray) -> tuple[float, float]:
    """Error of the known length and its deviation, by whitened residuals (6 n,) of a fit and its J.

    across : (6 n,) their derivative by the scale of the model, less what the fit makes up for.
    """
    information = float(across @ across)
    share = float(across @ r) / information
    beyond = r - share * across
    degrees = max(len(r) - int(np.linalg.matrix_rank(J)) - 1, 1)
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
