"""A given model of the arm against the calibrated one: zeros of joints, then errors of axes.

The zeros of the first and the last joint are gauge: they move base and tool, which no image knows.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.rigid import exponentials, homogeneous, rigid, rigid_inverse, screws, twists
from projservo_cli.metric.frame import Body, Metric, base_frame, base_joints, directions, in_frame
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


class _ModelFit:
    """Fit of a model's base and inner zeros to the calibrated axes.

    Weighted by the covariance of the axes and by 0.5 mm and 0.5 mrad for the links of any model.
    Raises InputError if the joint types differ.
    """

    def __init__(self, metric: Metric, given: FloatArray) -> None:
        prismatic, n = metric.prismatic, len(metric.joint_types)
        types = "".join("R" if w.any() else "P" for w in given[:, :3])
        if types != metric.joint_types:
            raise InputError(
                f"the model's joints are {types}, the calibrated ones {metric.joint_types}: choose the link "
                "of the tool as its tip"
            )
        self.given, self.prismatic, self.axes = given, prismatic, metric.axes
        self._near = metric.pose(np.zeros(n))[:3, 3]
        self._base = rigid_inverse(base_frame(given, prismatic, base_joints(given, prismatic)))
        x, change = np.zeros(6 + max(n - 2, 0)), _STEP * metric.deviations("axes")
        ends = (self.left(x, self.axes + sign * change) for sign in (1, -1))
        self.E = (np.subtract(*ends) / (2.0 * _STEP)).T  # (6 n, c) by errors of the calibration
        self.root = np.linalg.inv(np.linalg.cholesky(self.E @ self.E.T + np.diag(np.tile(_LINK_STD**2, n))))

        def weighted(x: FloatArray) -> FloatArray:
            return np.asarray(self.root @ self.left(x, self.axes))

        fit = least_squares(weighted, x, x_scale="jac")
        self.x, self.residual, self.J = fit.x, np.asarray(fit.fun), np.asarray(fit.jac)
        self.pinv = np.linalg.pinv(self.J)

    def left(self, x: FloatArray, found: FloatArray, factor: float = 1.0) -> FloatArray:
        """Differences (…, 6 n) of axes (…, n, 6) from those of the model, its lengths times a factor."""
        base, given = self._base.copy(), self.given.copy()
        base[:3, 3] *= factor
        given[~self.prismatic, 3:] *= factor
        model = _moved(_placed(base, x), x, given, self.prismatic)
        return _differences(found, model, self.prismatic, self._near).reshape(*found.shape[:-2], -1)

    def bases_and_zeros(self, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Poses (B, 4, 4) of the model's base and its zeros (B, n) for axes (B, n, 6) near the calibrated."""
        off = self.left(self.x, axes) - self.left(self.x, self.axes)
        x = self.x - off @ (self.pinv @ self.root).T
        return np.array([_placed(self._base, row) for row in x]), _zeros_of(x, len(self.given))


def kinematic_errors(metric: Metric, given: FloatArray) -> KinematicErrors:
    """Compare a model with the calibrated arm, joint by joint, and its links with the known length.

    The base and the zeros of the inner joints are fitted first. What remains are errors of axes.

    metric : of the calibration, in metres.
    given : (n, 6) screws of the model at readings of zero, rad and m.
    Raises InputError if the joint types differ.
    """
    fit, n = _ModelFit(metric, given), len(given)
    J, E, pinv = fit.J, fit.E, fit.pinv
    std = np.sqrt(np.diag(np.linalg.pinv(J.T @ J)))
    remains = fit.left(fit.x, fit.axes).reshape(n, 2, 3)
    changed = (E - np.linalg.solve(fit.root, J @ (pinv @ fit.root @ E))).reshape(n, 2, 3, -1)
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
    ends = (fit.left(fit.x, fit.axes, 1.0 + sign * _STEP) for sign in (1, -1))
    by_scale = fit.root @ np.subtract(*ends) / (2.0 * _STEP)
    return KinematicErrors(joints, *_length_error(fit.residual, J, by_scale - J @ (pinv @ by_scale)))


def in_model_frames(metric: Metric, given: FloatArray, tip: FloatArray) -> Metric:
    """Express a metric in the base of a model, and its tool in that of the model's tip.

    The base is where it fits the calibrated axes best; the tip is where the model has it, with the zeros that
    were found. Covariances include those of both.

    given : (n, 6) screws of the model at readings of zero, rad and m; tip : (4, 4) its tip there, m.
    Raises InputError if the joint types differ.
    """
    fit, bodies = _ModelFit(metric, given), metric.bodies
    base, zeros = fit.bases_and_zeros(bodies.axes)
    tips = metric.body._replace(axes=given, tool=tip).tool_poses(metric.prismatic, zeros)
    axes = in_frame(bodies.axes, metric.prismatic, base)
    to_tip = rigid_inverse(tips) @ rigid_inverse(base) @ bodies.tool
    markers = (homogeneous(bodies.markers) @ to_tip.swapaxes(-1, -2))[..., :3]
    return dataclasses.replace(
        metric, bodies=Body(bodies.P @ base[:, None], bodies.lens, axes, tips, markers)
    )


def _length_error(r: FloatArray, J: FloatArray, across: FloatArray) -> tuple[float, float]:
    """Error of the known length and its deviation, by whitened residuals (6 n,) of a fit and its J.

    across : (6 n,) their derivative by the scale of the model, less what the fit makes up for.
    """
    information = float(across @ across)
    share = float(across @ r) / information
    beyond = r - share * across
    degrees = max(len(r) - int(np.linalg.matrix_rank(J)) - 1, 1)
    return share, float(np.sqrt(max(1.0, float(beyond @ beyond) / degrees) / information))


def _placed(base: FloatArray, x: FloatArray) -> FloatArray:
    """Base (4, 4) of a model that moves by x[:6]: a rotation vector and a shift."""
    return rigid(Rotation.from_rotvec(x[:3]), x[3:6]) @ base


def _zeros_of(x: FloatArray, n: int) -> FloatArray:
    """Zeros (…, n) of all joints by fitted numbers (…, 6 + n - 2); those of the ends are gauge."""
    zeros = np.zeros((*x.shape[:-1], n))
    zeros[..., 1 : n - 1] = x[..., 6:]
    return zeros


def _moved(base: FloatArray, x: FloatArray, given: FloatArray, prismatic: BoolArray) -> FloatArray:
    """Screws (n, 6) of a model at a base (4, 4), whose inner zeros move by x[6:]."""
    n = len(given)
    T, moved, steps = base, np.empty_like(given), exponentials(given, prismatic, _zeros_of(x, n))
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
