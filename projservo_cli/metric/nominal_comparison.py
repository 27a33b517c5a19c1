"""A given model of the arm against the calibrated one: order and senses of joints, zeros, errors of axes.

The zeros of the first and the last joint are gauge: they move base and tool, which no image knows.
"""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from projservo_cli.findings import NOTE, REFUSES, Finding, Subject
from projservo_cli.geometry.displacements import (
    carried_screws,
    homogeneous,
    rigid,
    rigid_inverse,
    screw_displacements,
)
from projservo_cli.messages import failed, lines
from projservo_cli.metric.frame import Metric, MetricParameters, base_frame, base_joints, directions, in_frame
from projservo_cli.records import (
    TOOL,
    BoolArray,
    FloatArray,
    InputError,
    IntArray,
    letters_of,
)

# Errors of axes that any model has, of machining and assembly, rad and m.
_LINK_STD = np.repeat([5e-4, 5e-4], 3)
# Step of the differences that propagate covariances, in standard deviations.
_STEP = 1e-3
# Maximum zero of a revolute joint, rad, as of a hobby arm homed by eye, and tilt of an axis, rad.
_MAX_ZERO, _MAX_TILT = np.radians(45.0), np.radians(10.0)
# Maximum offset of an axis over the distance of the tool from the base, and deviations that it exceeds it by.
_MAX_OFFSET, _BEYOND = 0.05, 4.0
# χ² per degree of freedom above which other hypotheses are tried, and the share that a true one leaves of it.
_DOUBTED, _DECISIVE = 4.0, 0.25
# Ratio of χ² within which hypotheses are equal, as joint 1 reversed and the zero of joint 2 wrong by 180°.
_EQUAL = 1.5
# Number of angles at which a joint starts, number of starts that are fitted, and their largest ratio of χ².
_ANGLES, _FITTED, _NEAR_BEST = 72, 8, 30.0
# Maximum number of joints that turn the other way together.
_MAX_REVERSED = 3


class _JointError(NamedTuple):
    """Error of the model at one joint, each with its standard deviation."""

    joint: int  # number of the joint, from 1
    zero: float | None  # rad or m to add to readings before the model takes them; None if it is gauge
    zero_std: float | None  # rad or m
    offset_m: float  # distance of the calibrated axis from the model's, at the point nearest to the tool
    offset_std_m: float  # m
    tilt_rad: float  # angle between both axes
    tilt_std_rad: float  # rad


class KinematicErrors(NamedTuple):
    """Errors of a model against the calibrated arm."""

    joints: list[_JointError]
    length: float  # share by which the known length is too short for the links of the model
    length_std: float  # its standard deviation, which grows with residuals of the model beyond its errors


class _ModelFit:
    """Fit of a model's base and inner zeros to the calibrated axes.

    Weighted by the covariance of the axes and by 0.5 mm and 0.5 mrad for the links of any model.

    senses, order : (n,) −1 for joints that turn the other way, and the calibrated joint of each of the model.
    Raises InputError if the joint types differ.
    """

    def __init__(
        self,
        metric: Metric,
        model_axes: FloatArray,
        senses: IntArray | None = None,
        order: IntArray | None = None,
    ) -> None:
        prismatic, n = metric.prismatic, len(metric.joint_types)
        types = letters_of(not w.any() for w in model_axes[:, :3])
        if types != metric.joint_types:
            raise InputError(
                f"the model's joints are {types}, the calibrated ones {metric.joint_types}: choose the link "
                "of the tool as its tip"
            )
        self.senses = np.ones(n, dtype=np.int64) if senses is None else senses
        self.model_axes, self.prismatic, self.order = model_axes * self.senses[:, None], prismatic, order
        self._near = metric.pose(np.zeros(n))[:3, 3]
        self._base = rigid_inverse(
            base_frame(self.model_axes, prismatic, base_joints(self.model_axes, prismatic))
        )
        self.axes, changes = metric.axes, metric.deviations("axes")
        if order is not None:
            self.axes = metric.in_order(metric.axes, order)
            changes = metric.changes(lambda body: metric.in_order(body.axes, order))
            self._base = base_frame(self.axes, prismatic, base_joints(self.axes, prismatic)) @ self._base
        self.x, change = np.zeros(6 + max(n - 2, 0)), _STEP * changes
        ends = (self.left(self.x, self.axes + sign * change) for sign in (1, -1))
        self.E = (np.subtract(*ends) / (2.0 * _STEP)).T  # (6 n, c) by errors of the calibration
        self.root = np.linalg.inv(np.linalg.cholesky(self.E @ self.E.T + np.diag(np.tile(_LINK_STD**2, n))))

    def _weighted(self, x: FloatArray) -> FloatArray:
        return np.asarray(self.root @ self.left(x, self.axes))

    @property
    def chi2(self) -> float:
        """Sum of squared residuals over their covariance."""
        return float((self._weighted(self.x) ** 2).sum())

    def fitted(self) -> "_ModelFit":
        """Fit by least squares from the start."""
        fit = least_squares(self._weighted, self.x, x_scale="jac")
        self.x, self.residual, self.J = fit.x, np.asarray(fit.fun), np.asarray(fit.jac)
        self.pinv = np.linalg.pinv(self.J)
        return self

    def aligned(self) -> "_ModelFit":
        """Start where each joint in turn brings the next axis nearest to the calibrated one."""
        n = len(self.model_axes)
        zeros, size = np.zeros(n), float(np.linalg.norm(self._near))
        for i in np.flatnonzero(~self.prismatic[:-1]):
            for width in (np.pi, 2.0 * np.pi / _ANGLES):
                at = np.tile(zeros, (_ANGLES + 1, 1))
                at[:, i] += width * np.linspace(-1.0, 1.0, _ANGLES + 1)
                moved, _ = carried_screws(self.model_axes, self.prismatic, at, self._base)
                off = _differences(self.axes, moved, self.prismatic, self._near)[:, i + 1]
                misfit = (off[:, :3] ** 2).sum(axis=1) + (off[:, 3:] ** 2).sum(axis=1) / size**2
                zeros[i] = at[np.argmin(misfit.round(9) + 1e-6 * np.abs(at[:, i])), i]
        self._base = self._base @ screw_displacements(self.model_axes, self.prismatic, zeros)[0]
        self.x[6:] = zeros[1:-1]
        return self

    def zeros(self) -> FloatArray:
        """Zeros (n,), rad or m, for revolute joints within half a turn."""
        zeros = _zeros_of(self.x, len(self.model_axes))
        around = ~self.prismatic & (np.abs(zeros) > np.pi)
        return np.where(around, (zeros + np.pi) % (2.0 * np.pi) - np.pi, zeros)

    def axis_errors(self) -> tuple[FloatArray, FloatArray]:
        """Tilts, rad, and offsets, m, of the axes (n, 2), and their deviations."""
        remains = self.left(self.x, self.axes).reshape(-1, 2, 3)
        changed = self.E - np.linalg.solve(self.root, self.J @ (self.pinv @ self.root @ self.E))
        size, std = (
            np.linalg.norm(remains, axis=2),
            np.linalg.norm(changed.reshape(-1, 2, 3, changed.shape[1]), axis=(2, 3)),
        )
        chord = np.minimum(0.5 * size[:, 0], 1.0)
        size[:, 0] = 2.0 * np.arctan2(chord, np.sqrt(1.0 - chord**2))
        return size, std

    def differences(self) -> list[Finding]:
        """Return the discrete differences between the model and the arm: order, senses, far zeros."""
        found = []
        if self.order is not None:
            i, j = np.flatnonzero(self.order != np.arange(len(self.order))).tolist()
            found.append(Finding("exchanged_in_model", REFUSES, Subject(joints=(i + 1, j + 1))))
        for i in np.flatnonzero(self.senses < 0).tolist():
            unit = "m" if self.prismatic[i] else "rad"
            found.append(Finding("other_sense", REFUSES, Subject(joints=(i + 1,)), unit=unit))
        zeros = np.where(self.prismatic, 0.0, self.zeros())
        for i in np.flatnonzero(np.abs(zeros) > _MAX_ZERO).tolist():
            joint, off = Subject(joints=(i + 1,)), float(zeros[i])
            found.append(Finding("far_zero", REFUSES, joint, off, limit=_MAX_ZERO, unit="rad"))
        return found

    def implausible(self) -> list[Finding]:
        """Return the axis that is farthest beyond the errors of any model, if one is."""
        size, std = self.axis_errors()
        limit = np.array([_MAX_TILT, _MAX_OFFSET * float(np.linalg.norm(self._near))]) + _BEYOND * std
        i, kind = np.unravel_index(int(np.argmax(size / limit)), size.shape)
        if size[i, kind] <= limit[i, kind]:
            return []
        off, most, joint = float(size[i, kind]), float(limit[i, kind]), Subject(joints=(int(i) + 1,))
        return [Finding("far_axis", REFUSES, joint, off, limit=most, unit="m" if kind else "rad")]

    def left(self, x: FloatArray, calibrated: FloatArray, factor: float = 1.0) -> FloatArray:
        """Differences (…, 6 n) of axes (…, n, 6) from the axes of the model, its lengths times a factor."""
        base, model_axes = self._base.copy(), self.model_axes.copy()
        base[:3, 3] *= factor
        model_axes[~self.prismatic, 3:] *= factor
        model, _ = carried_screws(model_axes, self.prismatic, _zeros_of(x, len(model_axes)), _placed(base, x))
        return _differences(calibrated, model, self.prismatic, self._near).reshape(*calibrated.shape[:-2], -1)

    def bases_and_zeros(self, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Poses (B, 4, 4) of the model's base and its zeros (B, n) for axes (B, n, 6) near the calibrated."""
        off = self.left(self.x, axes) - self.left(self.x, self.axes)
        x = self.x - off @ (self.pinv @ self.root).T
        return np.array([_placed(self._base, row) for row in x]), _zeros_of(x, len(self.model_axes))


def _model_fit(metric: Metric, model_axes: FloatArray) -> _ModelFit:
    """Fit a model, and refuse one that another sense, order or far zero of joints would fit better.

    Raises WorkFailed naming it, or the wrong axis, if the model does not describe the arm.
    """
    fit = _ModelFit(metric, model_axes).fitted()
    wrong = fit.implausible() or fit.differences()
    if not wrong and fit.chi2 <= _DOUBTED * len(fit.residual):
        return fit
    n = len(model_axes)
    few = [which for k in range(_MAX_REVERSED + 1) for which in itertools.combinations(range(n), k)]
    starts = [_ModelFit(metric, model_axes, np.where(np.isin(range(n), which), -1, 1)) for which in few]
    for i, j in itertools.combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        if metric.prismatic[i] == metric.prismatic[j]:
            starts.append(_ModelFit(metric, model_axes, order=order))
    starts = [start.aligned() for start in starts]
    min_chi2 = min(start.chi2 for start in starts)
    near = [start for start in starts if start.chi2 <= _NEAR_BEST * min_chi2]
    near = sorted(near, key=lambda other: (len(other.differences()), other.chi2))[:_FITTED]
    fits = [other for other in (start.fitted() for start in near) if not other.implausible()]
    min_chi2 = min((other.chi2 for other in fits), default=np.inf)
    equal = [other.differences() for other in fits if other.chi2 <= _EQUAL * min_chi2]
    fewest = min(map(len, equal), default=0)
    best = sorted((found for found in equal if len(found) == fewest), key=lines)  # senses before zeros
    if fewest and (wrong or min_chi2 < _DECISIVE * fit.chi2):
        wrong = best[0] + [Finding("undecided_model", others=tuple(other)) for other in best[1:2]]
    if wrong:
        raise failed([Finding("other_model", REFUSES, others=tuple(wrong))])
    return fit


def kinematic_errors(metric: Metric, model_axes: FloatArray) -> KinematicErrors:
    """Compare a model with the calibrated arm, joint by joint, and its links with the known length.

    The base and the zeros of the inner joints are fitted first. What remains are errors of axes.

    metric : of the calibration, in metres.
    model_axes : (n, 6) screws of the model at readings of zero, rad and m.
    Raises InputError if the joint types differ, WorkFailed if the model is not of this arm.
    """
    fit, n = _model_fit(metric, model_axes), len(model_axes)
    std, zeros = np.sqrt(np.diag(np.linalg.pinv(fit.J.T @ fit.J))), fit.zeros()
    size, size_std = fit.axis_errors()
    joints = [
        _JointError(
            joint=i + 1,
            zero=float(zeros[i]) if 0 < i < n - 1 else None,
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
    return KinematicErrors(
        joints, *_length_error(fit.residual, fit.J, by_scale - fit.J @ (fit.pinv @ by_scale))
    )


def in_model_frames(metric: Metric, model_axes: FloatArray, tip: FloatArray) -> Metric:
    """Express a metric in the base of a model, and its tool, or flange, in the frame of the model's tip.

    The base is where it fits the calibrated axes best; the tip is where the model has it, with the zeros that
    were found. Covariances include the errors of both.

    model_axes : (n, 6) screws of the model at readings of zero, rad and m; tip : (4, 4) its tip there, m.
    Raises InputError if the joint types differ, WorkFailed if the model is not of this arm.
    """
    fit, bodies = _model_fit(metric, model_axes), metric.bodies
    base, zeros = fit.bases_and_zeros(bodies.axes)
    tips = metric.body._replace(axes=model_axes, tool=tip).tool_poses(metric.prismatic, zeros)
    axes = in_frame(bodies.axes, metric.prismatic, base)
    to_base = rigid_inverse(base)
    to_tip = rigid_inverse(tips) @ to_base @ bodies.tool
    if metric.mount == TOOL:
        P, of_markers = bodies.P @ rigid_inverse(to_tip)[:, None], to_base
    else:
        P, of_markers = bodies.P @ base[:, None], to_tip
    markers = (homogeneous(bodies.markers) @ of_markers.swapaxes(-1, -2))[..., :3]
    return dataclasses.replace(metric, bodies=MetricParameters(P, bodies.lens, axes, tips, markers))


def _length_error(r: FloatArray, J: FloatArray, across: FloatArray) -> tuple[float, float]:
    """Error of the known length and its deviation, by whitened residuals (6 n,) of a fit and its J.

    across : (6 n,) their derivative by the scale of the model, less the part that the fit compensates.
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
    """Zeros (…, n) of all joints by fitted numbers (…, 6 + n - 2); the end zeros are gauge."""
    zeros = np.zeros((*x.shape[:-1], n))
    zeros[..., 1 : n - 1] = x[..., 6:]
    return zeros


def _differences(
    calibrated: FloatArray, model: FloatArray, prismatic: BoolArray, near: FloatArray
) -> FloatArray:
    """Differences (…, n, 6) of directions, and of lines at their points nearest to ``near`` (3,), m."""
    d, d0 = directions(calibrated, prismatic), directions(model, prismatic)
    p, p0 = np.cross(calibrated[..., :3], calibrated[..., 3:]), np.cross(model[..., :3], model[..., 3:])
    at = p0 + d0 * ((near - p0) * d0).sum(axis=-1, keepdims=True)
    offset = p - at
    offset = offset - d * (offset * d).sum(axis=-1, keepdims=True)
    offset[..., prismatic, :] = 0.0
    return np.concatenate([d - d0, offset], axis=-1)


# Deviations beyond which the links of a model contradict the known length.
_CONTRADICTED = 4.0
# Relative deviation of a known length whose error is not given, as by a ruler, and of an axis by rounding.
_UNMEASURED, _ROUNDING = 0.0025, 1e-9
# Largest distance of a tool or a camera from the base, m.
_FARTHEST = 20.0


def length_contradictions(
    metric: Metric, errors: KinematicErrors | None, *, measured: bool
) -> Iterator[Finding]:
    """Yield contradictions of the known length: far cameras, readings of prismatic joints, links of a model.

    measured : whether the deviation of the length is known; otherwise one per cent passes.
    """
    min_chi2 = _ROUNDING if measured else _UNMEASURED
    of_axes = metric.deviations("axes")
    for i in np.flatnonzero(metric.prismatic):
        v = metric.axes[i, 3:]
        size = float(np.linalg.norm(v))
        std = float(np.linalg.norm(of_axes[:, i, 3:] @ v)) / size
        if abs(size - 1.0) > _CONTRADICTED * np.hypot(std, min_chi2):
            yield Finding("length_by_joint", REFUSES, Subject(joints=(int(i) + 1,)), size, std, unit="1")
    if errors is not None and abs(errors.length) > _CONTRADICTED * np.hypot(errors.length_std, min_chi2):
        code = "length_short" if errors.length > 0.0 else "length_long"
        yield Finding(code, REFUSES, amount=errors.length, deviation=errors.length_std, unit="1")
    hand = "flange" if metric.mount == TOOL else "tool"
    carriers = [
        ("far_camera", Subject(views=(view,), name=metric.carrier), T)
        for view, T in zip(metric.view, metric.poses, strict=True)
    ]
    for code, of, T in (*carriers, ("far_hand", Subject(name=hand), metric.body.tool)):
        if (far := float(np.linalg.norm(T[:3, 3]))) > _FARTHEST:
            yield Finding(code, REFUSES, of, far, limit=_FARTHEST, unit="m")


def errors_found(errors: KinematicErrors, joint_types: str) -> Iterator[Finding]:
    """Yield corrections of a model: zeros of joints, then axes, each by significance."""
    zeros = [one for one in errors.joints if one.zero is not None and one.zero_std is not None]
    for one in sorted(zeros, key=lambda one: -abs((one.zero or 0.0) / (one.zero_std or 1.0))):
        of, unit = Subject(joints=(one.joint,)), "m" if joint_types[one.joint - 1] == "P" else "rad"
        yield Finding("zero_off", NOTE, of, one.zero or 0.0, one.zero_std or 0.0, unit=unit)
    for one in sorted(errors.joints, key=lambda one: -one.offset_m / max(one.offset_std_m, 1e-12)):
        tilt = Finding("axis_tilt", amount=one.tilt_rad, deviation=one.tilt_std_rad, unit="rad")
        of = Subject(joints=(one.joint,))
        yield Finding("axis_off", NOTE, of, one.offset_m, one.offset_std_m, unit="m", others=(tilt,))
