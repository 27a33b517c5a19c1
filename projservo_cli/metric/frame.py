"""Metric of a calibrated arm: cameras, axes and markers in metres, each with its covariance.

All revolute joints preserve one symmetric form of the plane at infinity. Its root turns every joint operator
into a rigid twist, up to one scale, which a known length fixes. Source of the principle: A. Ruf, R. Horaud,
"Projective rotations applied to a pan-tilt stereo head", CVPR 1999.

Base frame, at readings of zero: z along joint 1, x along z × the direction of the first joint that is not
parallel to it. The origin is on the first revolute axis, at its common normal with the first revolute axis
that is not parallel to it. If all are parallel, which takes a board of known shape, it is there at the foot
of the middle of the face, and x leads to the next axis where no direction is across. Tool frame: origin at
the mean of the face, x from its first to its second marker, z across the plane of the first two and the next
that is not on their line.

Cameras on the tool are in the flange frame: the base frame of the arm as seen from its last joint back, so z
along the last joint. Their pose there is the hand–eye transformation. The markers are points of the base.

By poses of the flange the base and the flange are those of the robot, in its metres.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from projservo_cli.calibration.prediction import pixels_of, projection_derivative
from projservo_cli.geometry.displacements import (
    carried_screws,
    homogeneous,
    rigid_inverse,
    rotation_vectors,
    screw_displacements,
    screws,
    twists,
)
from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.geometry.invariant_forms import (
    board_steps,
    changes_by_rotations,
    differences_of_lengths,
    distortions_of_boards,
    form_of,
    intrinsics_of,
)
from projservo_cli.geometry.joint_curve import true_joints
from projservo_cli.geometry.lens import TERMS, undistort
from projservo_cli.geometry.stereo import triangulate_points
from projservo_cli.records import (
    MM,
    TOOL,
    VIEWS,
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    JointCurve,
    StatedBoard,
    WorkFailed,
    prismatic_of,
)

# Step of the differences that propagate covariances, in standard deviations of the calibration.
_STEP = 0.05
# Number of steps of Gauss and Newton after a start by two views, which third ones change by their noise.
_REFINEMENTS = 4
# Sine of an angle between axes, or of markers off a line, below which a frame does not rest on it: 3°.
_PARALLEL = 0.05
# Relative deviation of the invariant form above which the data do not determine it.
_UNDETERMINED = 0.3
# Relative difference of the sides of a square tag, as noise leaves it on small ones, at most.
_UNEQUAL_SIDES = 0.15
# Singular value of the invariance, over the largest, below which a second form is invariant too.
_SECOND_FORM = 1e-6
_ALL_PARALLEL = (
    "metric: within their noise all revolute axes are parallel, which leaves the stretch along them open: a "
    "revolute joint about another direction, or a board of known shape (--board), would fix it"
)
_OPEN_WITH_BOARDS = (
    "metric: joints and boards leave stretches or shears open: tilt a board against the axes of the joints, "
    "or add a revolute joint about another direction"
)
_MIRRORED = "metric: one camera's images are mirrored: turn its flip off, and record again"

Scale = str | Sequence[int]


class MetricParameters(NamedTuple):
    """Arm in the base frame, cameras and markers in base and tool, of one model or of many (…)."""

    P: FloatArray  # (…, V, 3, 4) cameras to undistorted pixels, of the frame they are mounted in
    lens: FloatArray  # (…, V, 5) lenses
    axes: FloatArray  # (…, n, 6) screws at readings of zero: w rad and v m, per rad or m
    tool: FloatArray  # (…, 4, 4) pose of the tool, or flange, at readings of zero, m
    markers: FloatArray  # (…, m, 3) in the other frame, m

    def scaled(self, factor: FloatArray) -> "MetricParameters":
        """Multiply all lengths by a factor (…)."""
        P, axes, tool = self.P.copy(), self.axes.copy(), self.tool.copy()
        P[..., 3] *= factor[..., None, None]
        axes[..., 3:] *= factor[..., None, None]
        tool[..., :3, 3] *= factor[..., None]
        return MetricParameters(P, self.lens, axes, tool, self.markers * factor[..., None, None])

    def intrinsics(self) -> FloatArray:
        """Intrinsic matrices (…, V, 3, 3), px, from K Kᵀ of the cameras."""
        return intrinsics_of(self.P)

    def camera_poses(self) -> FloatArray:
        """Poses (…, V, 4, 4) of the cameras in the frame they are mounted in, m."""
        A = self.P[..., :3]
        R = np.linalg.solve(self.intrinsics(), A)
        R /= np.cbrt(np.linalg.det(R))[..., None, None]
        T = np.zeros((*R.shape[:-2], 4, 4))
        T[..., :3, :3], T[..., 3, 3] = R.swapaxes(-1, -2), 1.0
        T[..., :3, 3] = -np.linalg.solve(A, self.P[..., 3, None])[..., 0]
        return T

    def tool_poses(self, prismatic: BoolArray, q: FloatArray) -> FloatArray:
        """Poses (…, K, 4, 4) of the tool at readings (K, n), [RH00] eq. (6), m."""
        moved = screw_displacements(self.axes[..., None, :, :], prismatic, q)
        factors = [moved[..., i, :, :] for i in range(len(prismatic))]
        return np.asarray(reduce(np.matmul, factors) @ self.tool[..., None, :, :])

    def pixels(self, points: FloatArray) -> FloatArray:
        """Raw pixels (…, K, V, 2) of points (…, K, 3) of the frame of the cameras, by view."""
        return pixels_of(self.P, self.lens, homogeneous(points)).swapaxes(-3, -2)


class BoardCorners(NamedTuple):
    """Corners of a board of known shape among the markers."""

    at: IntArray  # (k,) indices of the markers
    positions: FloatArray  # (k, 2) in pitches

    @classmethod
    def in_calibration(cls, c: Calibration) -> tuple["BoardCorners", ...]:
        """Those of each board whose shape a calibration uses."""
        found = []
        for board in () if c.boards is None else map(StatedBoard.of, c.boards.tolist()):
            positions = board.positions_of(c.marker)
            at = np.flatnonzero(np.isfinite(positions[:, 0]))
            found.append(cls(at, positions[at]))
        return tuple(found)


def upgrade_of(c: Calibration, H_hat: FloatArray, M: FloatArray) -> FloatArray:
    """Homographies (…, 4, 4) to a metric frame, of operators (…, n, 4, 4) and markers (…, m, 4).

    c : calibration that they are of, or that they are near. By boards of known shape, where there are some,
        otherwise by the joints alone.
    Raises InputError if these leave it open.
    """
    boards = BoardCorners.in_calibration(c)
    if not boards:
        return invariant_upgrade(H_hat, c.prismatic)
    D, a_inf, L = _actions(H_hat)
    X = M @ D.swapaxes(-1, -2) / (M @ a_inf[..., None])
    slides = (D[..., None, :, :] @ H_hat[..., c.prismatic, :, :] @ M[..., None, 0, :, None])[..., 0]
    steps = np.stack([board_steps(one.positions, X[..., one.at, :]) for one in boards], axis=-3)
    rows = [
        changes_by_rotations(L[..., ~c.prismatic, :, :].swapaxes(-1, -2)),
        differences_of_lengths(slides),
        distortions_of_boards(steps).reshape(*steps.shape[:-3], -1, 6),
    ]
    _, sizes, forms = np.linalg.svd(np.concatenate(rows, axis=-2))
    if (sizes[..., 4] < _SECOND_FORM * sizes[..., 0]).any():
        raise InputError(_OPEN_WITH_BOARDS)
    try:
        C = np.linalg.cholesky(form_of(forms[..., 5, :])).swapaxes(-1, -2)
    except np.linalg.LinAlgError:
        raise InputError(_OPEN_WITH_BOARDS) from None
    return np.concatenate([C @ D, a_inf[..., None, :]], axis=-2)


def _actions(H_hat: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Basis D (…, 3, 4) across the plane at infinity (…, 4) of operators, and actions L = D Ĥ Dᵀ."""
    U = np.linalg.svd(np.concatenate(np.moveaxis(H_hat, -3, 0), axis=-1))[0]
    D, a_inf = U[..., :3].swapaxes(-1, -2), U[..., 3]
    return D, a_inf, D[..., None, :, :] @ H_hat @ D.swapaxes(-1, -2)[..., None, :, :]


def invariant_upgrade(H_hat: FloatArray, prismatic: BoolArray) -> FloatArray:
    """Homographies (…, 4, 4) from the projective frame to one in which operators (…, n, 4, 4) are twists.

    With D an orthonormal basis of the complement of the plane at infinity and L = D Ĥ Dᵀ, the form S with
    L S + S Lᵀ = 0 for all revolute joints is unique if two axes are not parallel; S = A Aᵀ, and A⁻¹ L A is a
    rotation.
    Raises InputError if the joints leave a second form.
    """
    turning = ~prismatic
    if turning.sum() < 2:
        left = (
            "one revolute joint leaves the stretch along its axis open: a second one, not parallel to it,"
            if turning.any()
            else "without a revolute joint five stretches and shears are open: two that are not parallel"
        )
        raise InputError(f"metric: {left} or a board of known shape (--board) would fix it")
    D, a_inf, L = _actions(H_hat)
    sizes, S = invariant_form(L[..., turning, :, :])
    if (sizes[..., 4] < _SECOND_FORM * sizes[..., 0]).any():
        raise InputError(_ALL_PARALLEL)
    try:
        A = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        raise InputError(_ALL_PARALLEL) from None
    return np.concatenate([np.linalg.solve(A, D), a_inf[..., None, :]], axis=-2)


def invariant_form(L: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Form S (…, 3, 3) of positive trace that actions L (…, n, 3, 3) change the least, L S + S Lᵀ.

    Also returns the singular values (…, 6) of the changes of all symmetric forms; S is unique if but the last
    is zero.
    """
    _, sizes, rows = np.linalg.svd(changes_by_rotations(L))
    return sizes, form_of(rows[..., 5, :])


def directions(axes: FloatArray, prismatic: BoolArray) -> FloatArray:
    """Unit directions (…, n, 3) of axes, or of translations."""
    d = np.where(prismatic[:, None], axes[..., 3:], axes[..., :3])
    return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))


class BaseJoints(NamedTuple):
    """Joints, by index, that a base frame rests on."""

    x: int | None  # that x is across, besides joint 1; None if all directions are parallel
    first: int | None  # first revolute joint; None without one
    other: int | None  # first revolute joint with another direction; None without one
    apart: int | None  # first revolute joint with another axis of the same direction; None without one


def base_joints(axes: FloatArray, prismatic: BoolArray) -> BaseJoints:
    """Joints that the base frame rests on, by screws (n, 6).

    Raises InputError if no joint fixes the direction of x.
    """
    d = directions(axes, prismatic)
    sine = np.linalg.norm(np.cross(d[:, None], d[None]), axis=-1)
    turning = np.flatnonzero(~prismatic)
    if not turning.size:
        first, off, beside = None, turning, turning
    else:
        first = int(turning[0])
        off = turning[sine[first, turning] > _PARALLEL]
        w, v = axes[turning, :3], axes[turning, 3:]
        from_first = np.cross(w, v) - np.cross(w[0], v[0])
        apart = np.linalg.norm(np.cross(from_first, w[0]), axis=-1)
        beside = turning[apart > _PARALLEL * max(float(apart.max()), 1e-12)]
    across = np.flatnonzero(sine[0] > _PARALLEL)
    if not across.size and not beside.size:
        raise InputError(_ALL_PARALLEL)
    x, other, apart = (int(one[0]) if one.size else None for one in (across, off, beside))
    return BaseJoints(x, first, other, apart)


def base_frame(
    axes: FloatArray, prismatic: BoolArray, joints: BaseJoints, near: FloatArray | None = None
) -> FloatArray:
    """Pose (…, 4, 4) of the base frame of screws (…, n, 6) at readings of zero, by ``base_joints``.

    near : (…, 3) point whose foot on the first revolute axis is the origin where all axes are parallel to it,
        or that is the origin without such an axis.
    Raises InputError if this point is needed and not known.
    """
    d = directions(axes, prismatic)
    z = d[..., 0, :]
    origin = _origin(axes, joints, near)
    if joints.x is not None:
        return _frame(np.cross(z, d[..., joints.x, :]), z, origin)
    x = np.cross(axes[..., joints.apart, :3], axes[..., joints.apart, 3:]) - origin
    return _frame(x - (x * z).sum(axis=-1, keepdims=True) * z, z, origin)


def _origin(axes: FloatArray, joints: BaseJoints, near: FloatArray | None) -> FloatArray:
    """Origin (…, 3) of a base frame, as ``base_frame`` takes it."""
    if joints.first is not None:
        w = axes[..., joints.first, :3]
        p = np.cross(w, axes[..., joints.first, 3:])
        if joints.other is not None:
            u = axes[..., joints.other, :3]
            r, normal = np.cross(u, axes[..., joints.other, 3:]), np.cross(w, u)
            along = (np.cross(r - p, u) * normal).sum(axis=-1) / (normal**2).sum(axis=-1)
            return np.asarray(p + along[..., None] * w)
    if near is None:
        raise InputError(_ALL_PARALLEL)
    if joints.first is None:
        return near
    return np.asarray(p + ((near - p) * w).sum(axis=-1)[..., None] * w)


def in_frame(axes: FloatArray, prismatic: BoolArray, frame: FloatArray) -> FloatArray:
    """Screws (…, n, 6) in a frame, by its poses (…, 4, 4)."""
    moved = screws(rigid_inverse(frame)[..., None, :, :] @ twists(axes) @ frame[..., None, :, :])
    moved[..., prismatic, :3] = 0.0
    return moved


def links(axes: FloatArray, prismatic: BoolArray, like: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles (…, n - 1), rad, and distances (…, n - 1), m, from each axis to the next, by screws (…, n, 6).

    A translation has no place, so no distance: NaN.
    like : (n, 6) screws nearby, of which angles and distances are positive; others may be beyond zero.
    """
    d, nominal = directions(axes, prismatic), directions(like, prismatic)
    across, normal = np.cross(d[..., :-1, :], d[..., 1:, :]), np.cross(nominal[:-1], nominal[1:])
    sine = np.linalg.norm(normal, axis=-1)
    parallel = sine <= _PARALLEL
    angle = np.arctan2((across * _unit(normal)).sum(axis=-1), (d[..., :-1, :] * d[..., 1:, :]).sum(axis=-1))
    way, towards = (np.diff(np.cross(part[..., :3], part[..., 3:]), axis=-2) for part in (axes, like))
    sign = np.copysign(1.0, (towards * normal).sum(axis=-1))
    # Between parallel axes it lies across both, along the direction between neighbours.
    towards = towards - nominal[:-1] * (towards * nominal[:-1]).sum(axis=-1, keepdims=True)
    common = np.where(parallel[:, None], _unit(towards), sign[:, None] * _unit(across))
    distance = (way * common).sum(axis=-1)
    return angle, np.where(prismatic[:-1] | prismatic[1:], np.nan, distance)


def _unit(vectors: FloatArray) -> FloatArray:
    """Vectors (…, 3) over their length; zero stays zero."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def _off_line(M: FloatArray, face: Sequence[int]) -> int:
    """Index of the marker of a face that is off the line of its first two. Raises InputError if none is."""
    for j in face[2:]:
        a, b = M[face[1]] - M[face[0]], M[j] - M[face[0]]
        if np.linalg.norm(np.cross(a, b)) > _PARALLEL * np.linalg.norm(a) * np.linalg.norm(b):
            return j
    raise InputError("metric: the face has no three markers off one line, which a frame of the tool needs")


def _frame(x: FloatArray, z: FloatArray, origin: FloatArray) -> FloatArray:
    """Pose (…, 4, 4) of a frame with x and z along vectors (…, 3) that are perpendicular."""
    x, z = (vector / np.linalg.norm(vector, axis=-1, keepdims=True) for vector in (x, z))
    T = np.zeros((*x.shape[:-1], 4, 4))
    T[..., :3, 0], T[..., :3, 1], T[..., :3, 2], T[..., :3, 3] = x, np.cross(z, x), z, origin
    T[..., 3, 3] = 1.0
    return T


def _tool_frame(M: FloatArray, face: Sequence[int], across: int) -> FloatArray:
    """Pose (…, 4, 4) of the tool frame among markers (…, m, 3), one of which is off the line of the first."""
    start = M[..., face[0], :]
    x, y = M[..., face[1], :] - start, M[..., across, :] - start
    return _frame(x, np.cross(x, y), M[..., [*face], :].mean(axis=-2))


class ProjectiveParameters(NamedTuple):
    """Arrays of a calibration, or of many that differ by its deviations (…)."""

    P: FloatArray
    H_hat: FloatArray
    lens: FloatArray
    M: FloatArray

    @classmethod
    def around(cls, c: Calibration, lens: FloatArray, factor: FloatArray) -> "ProjectiveParameters":
        """The calibration, then pairs off by plus and minus a step of each column of the factor.

        ``changes_of`` takes the results computed from each of them.
        """
        steps = _STEP * np.concatenate([np.zeros((len(factor), 1)), factor, -factor], axis=1).T
        n, B = len(c.H_hat_0), len(steps)
        of_curve = 0 if c.curve is None else len(c.curve.terms)
        edges = np.cumsum([c.P.size, 16 * n, len(c.P) * c.lens_terms, of_curve])
        P, H_hat, k, _, M = np.split(steps, edges, axis=1)
        lenses = np.tile(lens, (B, 1, 1))
        if c.lens is not None:
            lenses[..., list(TERMS[: c.lens_terms])] += k.reshape(B, len(c.P), -1)
        return cls(
            c.P + P.reshape(B, -1, 3, 4), c.H_hat_0 + H_hat.reshape(B, n, 4, 4), lenses,
            c.M + M.reshape(B, -1, 4),
        )  # fmt: skip


def changes_of(
    values: FloatArray, difference: Callable[[FloatArray, FloatArray], FloatArray] = np.subtract
) -> FloatArray:
    """Changes (c, …) by independent errors of unit variance, of values (1 + 2 c, …) of models around one."""
    up, down = np.split(values[1:], 2)
    return np.asarray(difference(up, down) / (2.0 * _STEP))


def _bodies(models: ProjectiveParameters, c: Calibration, face: Sequence[int]) -> MetricParameters:
    """Bodies (B, …) of models, the first of which decides the bases of frames. Their scale is arbitrary."""
    G = upgrade_of(c, models.H_hat, models.M)
    G = G * np.sign(models.M[:, :1] @ G[:, 3, :, None])
    G, M = _right_handed(models, G)
    back = np.linalg.inv(G)
    at_reference = screws(G[:, None] @ models.H_hat @ back[:, None])
    turning = ~c.prismatic
    at_reference[:, c.prismatic, :3] = 0.0
    w, v = at_reference[:, turning, :3], at_reference[:, turning, 3:]
    at_reference[:, turning, 3:] = v - w * (w * v).sum(axis=-1, keepdims=True) / (w * w).sum(-1)[..., None]
    axes, to_zero = carried_screws(at_reference, c.prismatic, -c.q_reference)
    axes[:, c.prismatic, :3] = 0.0
    near, eye = None, None
    if c.boards is not None:
        middle, center = homogeneous(M[:, [*face]].mean(axis=1)), _centers(models.P[:, 0] @ back)
        eye = _moved(to_zero, center)
        near = middle[:, :3] if c.mount == TOOL else _moved(to_zero, middle)
    base = base_frame(axes, c.prismatic, base_joints(axes[0], c.prismatic), near)
    inverse = rigid_inverse(base)
    # The frame on the last link, at the reference.
    if c.mount == TOOL:
        backward, types = axes[:, ::-1], c.prismatic[::-1]
        flange = base_frame(backward, types, base_joints(backward[0], types), eye)
        hand = rigid_inverse(to_zero) @ flange
        of_cameras, of_markers = hand, base
    else:
        hand = _tool_frame(M, face, _off_line(M[0], face))
        of_cameras, of_markers = base, hand
    P = models.P @ back[:, None] @ of_cameras[:, None]
    P /= np.linalg.norm(P[..., 2, :3], axis=-1)[..., None, None]
    markers = (homogeneous(M) @ rigid_inverse(of_markers).swapaxes(-1, -2))[..., :3]
    return MetricParameters(
        P, models.lens, in_frame(axes, c.prismatic, base), inverse @ to_zero @ hand, markers
    )


def _bodies_by_flange(models: ProjectiveParameters, c: Calibration, chart: FlangeChart) -> MetricParameters:
    """Bodies (B, …) of models in the base of poses of a flange, m, and markers in the flange or the base."""
    G = _to_known(models.H_hat, chart.H_hat)
    G = G * np.sign(models.M[:, :1] @ G[:, 3, :, None])
    M = models.M @ G.swapaxes(-1, -2)
    points = M[..., :3] / M[..., 3:]
    of_cameras, of_markers = (chart.T, np.eye(4)) if c.mount == TOOL else (np.eye(4), chart.T)
    P = models.P @ np.linalg.inv(G)[:, None]
    if (_handedness(P, points)[0] < 0.0).any():
        raise WorkFailed(_MIRRORED)
    P = P @ of_cameras
    P /= np.linalg.norm(P[..., 2, :3], axis=-1)[..., None, None]
    markers = (homogeneous(points) @ rigid_inverse(of_markers).T)[..., :3]
    B = len(P)
    axes = np.broadcast_to(screws(chart.H_hat), (B, 6, 6)).copy()
    return MetricParameters(P, models.lens, axes, np.broadcast_to(chart.T, (B, 4, 4)).copy(), markers)


def _moved(T: FloatArray, points: FloatArray) -> FloatArray:
    """Points (B, 3) of homogeneous ones (B, 4) after displacements (B, 4, 4)."""
    return np.asarray((T @ points[..., None])[:, :3, 0])


def _centers(P: FloatArray) -> FloatArray:
    """Centres (B, 4) of cameras (B, 3, 4), their last coordinate one."""
    center = np.linalg.svd(P)[2][:, 3]
    return np.asarray(center / center[:, 3:])


def _to_known(H_hat: FloatArray, known: FloatArray) -> FloatArray:
    """Homographies (B, 4, 4) of unit norm that turn operators (B, n, 4, 4) into known ones (n, 4, 4)."""
    rows = np.einsum("bnjk,ai->bnaikj", H_hat, np.eye(4)) - np.einsum("nai,jk->naikj", known, np.eye(4))
    B = len(H_hat)
    # W Ĥ − K W = 0, row by row of W: of the entry (a, k), by the unknown (i, j).
    rows = rows.transpose(0, 1, 2, 4, 3, 5).reshape(B, -1, 16)
    return np.asarray(np.linalg.svd(rows)[2][:, -1].reshape(B, 4, 4))


def _right_handed(models: ProjectiveParameters, G: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Upgrades (B, 4, 4) to a right-handed frame, and markers (B, m, 3) there.

    Each camera has the markers in front of it, and so determines the handedness of the frame.
    Raises WorkFailed if they contradict each other.
    """
    M = models.M @ G.swapaxes(-1, -2)
    points = M[..., :3] / M[..., 3:]
    P = models.P @ np.linalg.inv(G)[:, None]
    side = _handedness(P, points)
    if (side[0] != side[0, 0]).any():
        raise WorkFailed(_MIRRORED)
    flip = np.ones((len(G), 4))
    flip[:, 0] = side[:, 0]
    return flip[:, :, None] * G, points * flip[:, None, :3]


def _handedness(P: FloatArray, points: FloatArray) -> FloatArray:
    """Signs (B, V) of frames by cameras (B, V, 3, 4) with points (B, m, 3) in front, 1 for right-handed."""
    depth = (P[:, :, 2] @ homogeneous(points).swapaxes(-1, -2)).mean(axis=-1)
    return np.asarray(np.sign(np.linalg.det(P[..., :3]) * depth))


def _length_of(body: MetricParameters, between: Scale, marker: list[int], prismatic: BoolArray) -> FloatArray:
    """Length (…) that is known, in the unit of bodies. Raises InputError if there is none such."""
    if between == "joint":
        if not prismatic.any():
            raise InputError(
                "metric: the scale is unknown, since no joint is prismatic: give a known length and its ends"
            )
        return np.asarray(np.linalg.norm(body.axes[..., int(np.argmax(prismatic)), 3:], axis=-1))
    if between == "cameras":
        if body.P.shape[-3] < 2:
            raise InputError("metric: one camera has no distance to another: name two markers, or tags")
        centers = body.camera_poses()[..., :3, 3]
        return np.asarray(np.linalg.norm(centers[..., 1, :] - centers[..., 0, :], axis=-1))
    if between == "tags":
        tags = [number for number in marker if number % 4 == 0 and {*range(number, number + 4)} <= {*marker}]
        sides = [(t + k, t + (k + 1) % 4) for t in tags for k in range(4)]
        if not sides:
            raise InputError("metric: no tag has all its corners (4 t to 4 t + 3) among the markers")
    elif isinstance(between, str) or len(between) != 2 or between[0] == between[1]:
        raise InputError(f"metric: between {between!r}: give two markers, tags, cameras or joint")
    else:
        sides = [(int(between[0]), int(between[1]))]
    ends = np.array([_known_indices(side, marker) for side in sides])
    apart = body.markers[..., ends[:, 0], :] - body.markers[..., ends[:, 1], :]
    lengths = np.linalg.norm(apart, axis=-1)
    if between == "tags":
        _require_squares(lengths[0], sides)
    return np.asarray(lengths.mean(axis=-1))


def _pitch_of_boards(c: Calibration) -> tuple[float | None, Scale]:
    """Length of a row of the first board of known size, m, and its ends; None and ``joint`` without one."""
    for board in () if c.boards is None else map(StatedBoard.of, c.boards.tolist()):
        ends = [number for number in board.longest if number in c.marker]
        if board.pitch_m is not None and len(ends) == 2:
            return float(
                np.linalg.norm(np.diff(board.positions_of(np.array(ends)), axis=0))
            ) * board.pitch_m, ends
    return None, "joint"


def _known_indices(numbers: Sequence[int], marker: list[int]) -> list[int]:
    """Indices of markers by their numbers. Raises InputError for one that the calibration has not."""
    if unknown := [number for number in numbers if number not in marker]:
        raise InputError(f"metric: marker {unknown[0]} is not in the calibration; markers: {marker}")
    return [marker.index(number) for number in numbers]


def _require_squares(lengths: FloatArray, sides: Sequence[tuple[int, int]]) -> None:
    """Refuse sides (4 t,) of tags that are no squares: their markers are numbered like tags, and are none."""
    by_tag = lengths.reshape(-1, 4)
    unequal = by_tag.max(axis=1) / by_tag.min(axis=1) - 1.0
    worst = int(np.argmax(unequal))
    if unequal[worst] > _UNEQUAL_SIDES:
        first = sides[4 * worst][0]
        raise InputError(
            f"metric: markers {first} to {first + 3} are no tag: their sides differ by "
            f"{100.0 * unequal[worst]:.3g} %, more than {100.0 * _UNEQUAL_SIDES:g} %; name two markers"
        )


def _require_metres(length: float, known: FloatArray, between: Scale) -> None:
    """Refuse a length beside poses of a flange, which are in metres, saying how it compares; known : (B,)."""
    std, off = float(np.linalg.norm(changes_of(known))), 100.0 * (float(known[0]) / length - 1.0)
    raise InputError(
        f"metric: poses of the flange are in metres, and by them the length between {between} is "
        f"{known[0]:.5g} ± {std:.2g} m, {abs(off):.2g} % {'more' if off > 0.0 else 'less'} than the "
        f"{length:g} m given: leave the length out (--metric); if they differ, one of them errs"
    )


@dataclass(frozen=True, eq=False)
class Metric:
    """A calibration in metres, in the base frame of the arm: its arrays, and functions with covariances.

    Cameras on the tool are in the flange frame, and the markers in the frame of the base. Frames are as in
    the module ``metric.frame``. Covariances follow from the calibration, to first order, with covariances of
    frames and of the known length.
    """

    view: tuple[str, ...]  # names of the views
    mount: str  # mount of the cameras, world or tool
    joint_types: str  # one letter a joint, R or P
    marker: list[int]  # (m,) numbers of the markers
    sigma_px: float  # noise of a pixel, px
    # the model, then pairs changed by plus and minus a step of each independent error
    bodies: MetricParameters
    range: FloatArray  # (n, 2) readings in the data, rad or m
    q_reference: FloatArray  # (n,) readings of the reference, rad or m
    curve: JointCurve | None  # true joints by readings; frames at readings of zero are those of true zeros
    by_flange: bool = False  # whether readings are poses of the flange, in the base of the robot

    @classmethod
    def of(
        cls,
        c: Calibration,
        factor: FloatArray,
        *,
        length_m: float | None = None,
        between: Scale = "joint",
        length_std_m: float = 0.0,
        face: Sequence[int] | None = None,
    ) -> Self:
        """Upgrade a calibration, by the factor of its covariance; the rest as for ``ImageModel.metric``."""
        between = between if isinstance(between, str) else np.ravel(between).tolist()
        if between == "joint" and length_m is None and c.flange_chart is None and not c.prismatic.any():
            length_m, between = _pitch_of_boards(c)
        if between == "joint" and length_m is not None:
            raise InputError(
                f"metric: a length of {length_m} m without its ends: name them, such as two markers; "
                "readings of a prismatic joint set the scale by themselves"
            )
        if between != "joint" and length_m is None:
            raise InputError(f"metric: the length between {between} is not given: give it in m")
        length = 1.0 if length_m is None else float(length_m)
        if not 0.0 < length < np.inf or not 0.0 <= length_std_m < np.inf:
            raise InputError(
                f"metric: a length of {length_m} m with a standard deviation of {length_std_m} m: give a "
                "positive length, and a deviation that is not negative"
            )
        marker = c.marker.tolist()
        chosen = range(len(marker)) if face is None else _known_indices(face, marker)
        lens = c.model().lens
        models = ProjectiveParameters.around(c, lens, factor)
        try:
            chart = FlangeChart.from_optional(c.flange_chart)
            bodies = (
                _bodies(models, c, list(chosen)) if chart is None else _bodies_by_flange(models, c, chart)
            )
            K = bodies.intrinsics()
        except np.linalg.LinAlgError:
            raise InputError(_ALL_PARALLEL) from None
        change = np.linalg.solve(K[0], (K[1 : 1 + factor.shape[1]] - K[1 + factor.shape[1] :]))
        if np.sqrt((change**2).sum(axis=(0, 2, 3))).min() > 2.0 * _STEP * _UNDETERMINED:
            raise InputError(_ALL_PARALLEL)
        known = _length_of(bodies, between, marker, c.prismatic)
        if chart is not None and between != "joint":
            _require_metres(length, known, between)
        if not known[0] > 0.0:
            raise InputError(f"metric: the markers {between} of the known length are one point")
        bodies = bodies.scaled(length / known)
        if length_std_m > 0.0:  # one more independent error
            step = _STEP * length_std_m / length
            off = MetricParameters(*(values[:1].repeat(2, axis=0) for values in bodies))
            off = off.scaled(np.array([1.0 + step, 1.0 - step]))
            cut = 1 + factor.shape[1]
            parts = zip(bodies, off, strict=True)
            bodies = MetricParameters(*(np.concatenate([b[:cut], o[:1], b[cut:], o[1:]]) for b, o in parts))
        moved = np.stack([c.joint_min, c.joint_min + c.excitation], axis=1)
        moved_by = c.q_reference, c.curve, chart is not None
        return cls(c.view, c.mount, c.joint_types, marker, c.sigma_px, bodies, moved, *moved_by)

    @property
    def body(self) -> MetricParameters:
        """Cameras, arm and markers as calibrated."""
        return MetricParameters(*(values[0] for values in self.bodies))

    @property
    def prismatic(self) -> BoolArray:
        """Whether each joint (n,) is prismatic."""
        return prismatic_of(self.joint_types)

    @property
    def K(self) -> FloatArray:
        """Intrinsic matrices (V, 3, 3) of the cameras, px."""
        return self.body.intrinsics()

    @property
    def lens(self) -> FloatArray:
        """Radial distortion (V, 5): centre u, v and radius, px, then k1, k2."""
        return self.body.lens

    @property
    def poses(self) -> FloatArray:
        """Poses (V, 4, 4) of the cameras in the frame they are mounted in: z forward, y down; m.

        Of cameras on the tool it is the hand–eye transformation, from camera to flange.
        """
        return self.body.camera_poses()

    @property
    def axes(self) -> FloatArray:
        """Screws (n, 6) of the joints at readings of zero in the base frame: w rad and v m, per rad or m."""
        return self.body.axes

    @property
    def markers(self) -> FloatArray:
        """Markers (m, 3) in the tool frame, or in the base frame if the cameras are on the tool; m."""
        return self.body.markers

    @property
    def carrier(self) -> str:
        """Carrier of the cameras, which is their frame: ``base`` or ``flange``."""
        return "flange" if self.mount == TOOL else "base"

    def cameras(self, q: npt.ArrayLike) -> FloatArray:
        """Return cameras (V, 3, 4) to undistorted pixels of points of the base frame at readings (n,)."""
        P = self.body.P
        return P @ rigid_inverse(self.pose(q)) if self.mount == TOOL else P

    def pose(self, q: npt.ArrayLike) -> FloatArray:
        """Poses of the tool, or of the flange with cameras on it, in the base frame, [RH00] eq. (6).

        Parameters
        ----------
        q : (…, n) joint readings, rad or m.

        Returns
        -------
        (…, 4, 4) poses, m.

        Raises
        ------
        InputError
            If the readings have another number of joints, are not finite or look like degrees.
        """
        readings = self._readings(q)
        T = self.body.tool_poses(self.prismatic, readings.reshape(-1, readings.shape[-1]))
        return T.reshape(*readings.shape[:-1], 4, 4)

    def pose_covariance(self, q: npt.ArrayLike) -> FloatArray:
        """Covariances of the pose of the tool in the base frame.

        Parameters
        ----------
        q : (…, n) joint readings, rad or m.

        Returns
        -------
        (…, 6, 6): rotation vector, rad, then position, m.

        Raises
        ------
        InputError
            If the readings have another number of joints, are not finite or look like degrees.
        """
        readings = self._readings(q)
        rows = readings.reshape(-1, readings.shape[-1])
        of = self.changes(lambda body: body.tool_poses(self.prismatic, rows), _pose_difference)
        return _covariances(of).reshape(*readings.shape[:-1], 6, 6)

    def position_std(self, q: npt.ArrayLike) -> FloatArray:
        """Standard deviations of the position of the tool along the axes of the base frame.

        Parameters
        ----------
        q : (…, n) joint readings, rad or m.

        Returns
        -------
        (…, 3) deviations, mm.

        Raises
        ------
        InputError
            If the readings have another number of joints, are not finite or look like degrees.
        """
        C = self.pose_covariance(q)[..., 3:, 3:]
        return MM * np.sqrt(np.diagonal(C, axis1=-2, axis2=-1))

    def triangulate(self, pixels: npt.ArrayLike) -> FloatArray:
        """Points by their pixels in two views or more, in the frame of the cameras: base, or flange.

        Parameters
        ----------
        pixels : (…, V, m, 2) raw pixels, views as ``predict`` has them; NaN where unseen.

        Returns
        -------
        (…, m, 3) points, m; NaN if fewer than two views have pixels.

        Raises
        ------
        InputError
            For pixels of another shape, or of one camera.
        WorkFailed
            If two rays determine no finite point.
        """
        s, seen, shape = self._pixels(pixels)
        points = np.full((seen.shape[1], 3), np.nan)
        a_inf = np.array([0.0, 0.0, 0.0, 1.0])
        for i, j in combinations(range(len(s)), 2):  # the first and the last view that see a point
            at = seen[i] & seen[j] & ~seen[:i].any(axis=0) & ~seen[j + 1 :].any(axis=0)
            if at.any():
                pair = [i, j]
                straight = undistort(self.body.lens[pair], np.ascontiguousarray(s[pair][:, at]))
                points[at] = triangulate_points(self.body.P[pair], a_inf, straight)[:, :3]
        if (more := seen.sum(axis=0) > 2).any():
            for _ in range(_REFINEMENTS):
                X = points[more]
                off = np.where(seen[:, more, None], s[:, more] - self.body.pixels(X).swapaxes(0, 1), 0.0)
                pinv = np.linalg.pinv(self._by_point(X, seen[:, more]))
                points[more] += (pinv @ off.swapaxes(0, 1).reshape(len(X), -1, 1))[..., 0]
        return points.reshape(*shape, 3)

    def project(self, points: npt.ArrayLike) -> FloatArray:
        """Pixels of points in all views, of which ``triangulate`` makes the points again.

        Parameters
        ----------
        points : (…, m, 3) points, m, in the frame of the cameras: base, or flange.

        Returns
        -------
        (…, V, m, 2) raw pixels; NaN behind a camera.

        Raises
        ------
        InputError
            For points of another shape.
        """
        X = np.asarray(points, dtype=np.float64)
        if X.ndim < 2 or X.shape[-1] != 3:
            raise InputError(f"points: of shape {X.shape}, expected (…, m, 3), m")
        flat = X.reshape(-1, 3)
        depth = homogeneous(flat) @ self.body.P[:, 2].T * np.sign(np.linalg.det(self.body.P[..., :3]))
        s = np.where(depth[..., None] > 0.0, self.body.pixels(flat), np.nan)
        return np.moveaxis(s.reshape(*X.shape[:-1], -1, 2), -2, -3)

    def triangulation_covariance(self, pixels: npt.ArrayLike) -> FloatArray:
        """Covariances of triangulated points, with the noise of their pixels.

        Parameters
        ----------
        pixels : as for ``triangulate``.

        Returns
        -------
        (…, m, 3, 3), m²; NaN if fewer than two views have pixels.

        Raises
        ------
        InputError, WorkFailed
            As for ``triangulate``.
        """
        _, seen, shape = self._pixels(pixels)
        known = seen.sum(axis=0) > 1
        X = self.triangulate(pixels).reshape(-1, 3)[known]
        pinv = np.linalg.pinv(self._by_point(X, seen[:, known]))
        moved = self.changes(lambda body: body.pixels(np.broadcast_to(X, (len(body.P), *X.shape))))
        of = np.einsum("kij,ckj->cki", pinv, moved.reshape(len(moved), len(X), -1))
        C = np.full((len(known), 3, 3), np.nan)
        C[known] = _covariances(of) + self.sigma_px**2 * (pinv @ pinv.swapaxes(-1, -2))
        return C.reshape(*shape, 3, 3)

    def _by_point(self, X: FloatArray, seen: BoolArray) -> FloatArray:
        """Derivative (K, 2 V, 3) of pixels by points (K, 3); zero if a view (V, K) sees none."""
        P = self.body.P
        by_point = projection_derivative(P, self.body.lens, homogeneous(X))[1] @ P[:, None, :, :3]
        return np.where(seen[..., None, None], by_point, 0.0).swapaxes(0, 1).reshape(len(X), -1, 3)

    def covariance(self, name: str) -> FloatArray:
        """Covariance of an array.

        Parameters
        ----------
        name : ``K``, ``lens``, ``poses``, ``axes``, ``markers`` or ``tool``.

        Returns
        -------
        Of ``K`` (V, 5, 5): fx, skew, cx, fy, cy, px; of ``lens`` (V, 2, 2): k1, k2; of ``poses`` (V, 6, 6):
        rotation vector, rad, and position, m, in the base or the flange frame; of ``axes`` (n, 6, 6); of
        ``markers`` (m, 3, 3), m²; of ``tool`` (1, 6, 6), its pose at readings of zero.

        Raises
        ------
        InputError
            For another name.
        """
        return _covariances(self.deviations(name))

    def deviations(self, name: str) -> FloatArray:
        """Changes (c, count, d) of an array by independent errors of unit variance, as ``covariance`` has."""
        u, v = np.triu_indices(3)
        u, v = u[:5], v[:5]
        parts: dict[str, Callable[[], FloatArray]] = {
            "K": lambda: self.changes(lambda body: body.intrinsics()[..., u, v]),
            "lens": lambda: self.changes(lambda body: body.lens[..., 3:]),
            "poses": lambda: self.changes(lambda body: body.camera_poses(), _pose_difference),
            "axes": lambda: self.changes(lambda body: body.axes),
            "markers": lambda: self.changes(lambda body: body.markers),
            "tool": lambda: self.changes(lambda body: body.tool[:, None], _pose_difference),
        }
        if name not in parts:
            raise InputError(f"metric: no covariance of {name!r}: choose one of {', '.join(parts)}")
        return parts[name]()

    def point_changes(self, q: FloatArray, point: FloatArray) -> FloatArray:
        """Changes (c, K, 3), m, by independent errors of a point (3,) of the tool at readings (K, n)."""

        def position(body: MetricParameters) -> FloatArray:
            T = body.tool_poses(self.prismatic, q)
            return np.asarray(T[..., :3, :3] @ point + T[..., :3, 3])

        return self.changes(position)

    def in_order(self, axes: FloatArray, order: npt.NDArray[np.int64]) -> FloatArray:
        """Screws (…, n, 6) at readings of zero if joints followed each other in another order (n,).

        Those at the reference stay, which trial motions of single joints show.
        """
        q, prismatic = self.q_reference, self.prismatic
        there = carried_screws(axes, prismatic, q)[0][..., order, :]
        return carried_screws(there, prismatic[order], -q[order])[0]

    def changes(
        self,
        function: Callable[[MetricParameters], FloatArray],
        difference: Callable[[FloatArray, FloatArray], FloatArray] = np.subtract,
    ) -> FloatArray:
        """Changes (c, …) of a function of bodies by independent errors of unit variance."""
        return changes_of(function(self.bodies), difference)

    def _readings(self, q: npt.ArrayLike) -> FloatArray:
        readings = np.asarray(q, dtype=np.float64)
        n = len(self.joint_types)
        if readings.ndim == 0 or readings.shape[-1] != n or not np.isfinite(readings).all():
            raise InputError(f"joint readings of shape {readings.shape}: expected {n} finite numbers each")
        if self.curve is None:
            return readings
        away = (readings - self.q_reference).reshape(-1, n)
        return self.q_reference + true_joints(self.curve, self.prismatic, away).reshape(readings.shape)

    def _pixels(self, pixels: npt.ArrayLike) -> tuple[FloatArray, BoolArray, tuple[int, ...]]:
        """Pixels (V, N, 2) of points, which views see which (V, N), and the shape of the points."""
        s, V = np.asarray(pixels, dtype=np.float64), len(self.view)
        if V < 2:
            raise InputError("triangulate: one camera determines no point: calibrate with two or more")
        if s.ndim < 3 or s.shape[-3] != V or s.shape[-1] != 2:
            views = "left and right view" if self.view == VIEWS else f"views {', '.join(self.view)}"
            raise InputError(f"pixels of shape {s.shape}: expected (…, {V}, m, 2), {views}")
        views_first = np.moveaxis(s, -3, 0)
        flat = np.ascontiguousarray(views_first.reshape(V, -1, 2))
        return flat, np.isfinite(flat[..., 0]), views_first.shape[1:-1]


def _covariances(changes: FloatArray) -> FloatArray:
    """Covariances (k, d, d) by changes (c, k, d)."""
    return np.asarray(np.einsum("cki,ckj->kij", changes, changes))


def _pose_difference(T: FloatArray, T0: FloatArray) -> FloatArray:
    """Rotation vectors and shifts (…, 6) from poses T0 to T (…, 4, 4), in the outer frame."""
    turn = rotation_vectors(T[..., :3, :3] @ T0[..., :3, :3].swapaxes(-1, -2))
    return np.concatenate([turn, T[..., :3, 3] - T0[..., :3, 3]], axis=-1)
