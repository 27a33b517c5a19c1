"""Pose of the rigid body that the face belongs to, from all its markers.

The calibration gives the structure of the markers and the displacements that the robot can make. One
displacement of six coordinates remains, estimated from all markers that any camera sees.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import (
    Mat4,
    Vec4,
    add,
    apply,
    apply_transposed,
    combine,
    dot,
    mat,
    mul,
    scale,
    vec,
    vec_into,
)
from projservo_cli.geometry.displacements import invariant_rotations, twist_exponential
from projservo_cli.geometry.jit import inline, internal, merged, njit, separate
from projservo_cli.geometry.null_space import COORDINATES, solve_normal
from projservo_cli.records import BoolArray, FloatArray, Model

_Vec3 = tuple[float, float, float]
_Row = tuple[float, float, float, float, float, float, float]
# Products of the columns of (J, e) with columns of J, upper triangle by rows.
_Sums = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float, float,
    float, float, float, float, float, float, float, float, float, float, float, float, float,
]  # fmt: skip
# Sums over no rows.
_NO_SUMS: _Sums = (
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
)  # fmt: skip
# Squared part of a coordinate independent of the others, over the whole, below which it is not determined.
_RANK_TOLERANCE = 1e-7


class Body(NamedTuple):
    """Markers of a rigid body, and a basis of its displacements.

    The coordinates of a displacement are three translations and three rotations about the middle of the
    markers; a_inf is the plane at infinity of the translations.
    """

    # (m, 4) markers at the reference, a_inf·M = 1, the face first; none if measured point by point
    M: FloatArray
    D: FloatArray  # (3, 4) points at infinity, the directions of the translations
    H_hat: FloatArray  # (3, 4, 4) operators of the rotations, per rad
    turn: FloatArray  # (m, 3, 3) coordinates of Ĥ_r M in the basis D, one row a rotation
    a_inf: FloatArray  # (4,) plane at infinity
    in_goal: BoolArray  # (V, m) whether the image of the goal has the marker
    weight: FloatArray  # (V, m) of the residuals in a fit


class _Until(NamedTuple):
    """Views of a fit and its end."""

    goal_views_only: bool  # omit markers of a view that the image of the goal lacks
    settled_px: float  # motion of the images, px rms a coordinate, below which a step is the last
    max_steps: int  # number of steps after which the fit is taken as it is


# Limits in the loop, by the views in the image of the goal: half a pixel leaves some thousandths, as its
# square.
GOAL_VIEWS = _Until(True, 0.5, 2)
# Limits in the loop, by all views.
ALL_VIEWS = _Until(False, 0.5, 2)
# Limits at the goal, by all views, to round-off.
SETTLED = _Until(False, 1e-6, 30)


class _Fit(NamedTuple):
    """Displacement fitted to markers, and its residuals."""

    found: bool  # False if the markers seen do not determine it
    settled: bool  # whether the last step was short enough
    H: Mat4  # displacement from the reference
    before: float  # sum of squared residuals of the prediction, px²
    after: float  # sum of squared residuals of the fit, px²
    views: int  # number of markers used, counted once a view


# Body of a face that is measured point by point.
NO_BODY = Body(
    M=np.zeros((0, 4)),
    D=np.zeros((3, 4)),
    H_hat=np.zeros((3, 4, 4)),
    turn=np.zeros((0, 3, 3)),
    a_inf=np.zeros(4),
    in_goal=np.zeros((2, 0), dtype=np.bool_),
    weight=np.ones((2, 0)),
)


def make_body(model: Model, M: FloatArray) -> Body:
    """Body of calibrated markers.

    The rotations follow from the joints: the three main directions of their actions on the plane at
    infinity, orthonormal in the invariant form −½ trace(L L'), hence per rad. If the joints do not turn the
    body about three directions, the rotations belong to a metric that the joints preserve.

    model : calibrated model; M : (m, 4) its markers at the reference, the face first.
    Raises WorkFailed if the joints preserve no metric of the calibrated frame.
    """
    M = M / (M @ model.a_inf)[:, None]
    D = np.linalg.svd(model.a_inf[None])[2][1:]
    actions = D @ model.H_hat_0 @ D.T
    brackets = np.array([A @ B - B @ A for A in actions for B in actions])
    _, sizes, rows = np.linalg.svd(np.concatenate([actions, brackets]).reshape(-1, 9))
    L = rows[:3].reshape(3, 3, 3)
    form = -0.5 * np.einsum("iab,jba->ij", L, L)
    if sizes[2] > 1e-6 * sizes[0] and np.linalg.eigvalsh(form)[0] > 1e-6:
        L = np.linalg.solve(np.linalg.cholesky(form), L.reshape(3, 9)).reshape(3, 3, 3)
    else:
        L = invariant_rotations(actions)
    offset = M - M.mean(axis=0)
    carry = np.eye(4) - np.outer(M.mean(axis=0), model.a_inf)
    return Body(
        M=np.ascontiguousarray(M),
        D=np.ascontiguousarray(D),
        H_hat=np.ascontiguousarray(D.T @ L @ D @ carry),
        turn=np.ascontiguousarray(np.einsum("rab,bc,kc->kra", L, D, offset)),
        a_inf=np.ascontiguousarray(model.a_inf),
        in_goal=np.ones((len(model.P), len(M)), dtype=np.bool_),
        weight=np.ones((len(model.P), len(M))),
    )


@inline
def _accumulate(N: _Sums, a: _Row, b: _Row) -> _Sums:
    """Sums after two more rows (J, e) of Jacobian and residual."""
    return (
        N[0] + (a[0] * a[0] + b[0] * b[0]), N[1] + (a[0] * a[1] + b[0] * b[1]),
        N[2] + (a[0] * a[2] + b[0] * b[2]), N[3] + (a[0] * a[3] + b[0] * b[3]),
        N[4] + (a[0] * a[4] + b[0] * b[4]), N[5] + (a[0] * a[5] + b[0] * b[5]),
        N[6] + (a[0] * a[6] + b[0] * b[6]), N[7] + (a[1] * a[1] + b[1] * b[1]),
        N[8] + (a[1] * a[2] + b[1] * b[2]), N[9] + (a[1] * a[3] + b[1] * b[3]),
        N[10] + (a[1] * a[4] + b[1] * b[4]), N[11] + (a[1] * a[5] + b[1] * b[5]),
        N[12] + (a[1] * a[6] + b[1] * b[6]), N[13] + (a[2] * a[2] + b[2] * b[2]),
        N[14] + (a[2] * a[3] + b[2] * b[3]), N[15] + (a[2] * a[4] + b[2] * b[4]),
        N[16] + (a[2] * a[5] + b[2] * b[5]), N[17] + (a[2] * a[6] + b[2] * b[6]),
        N[18] + (a[3] * a[3] + b[3] * b[3]), N[19] + (a[3] * a[4] + b[3] * b[4]),
        N[20] + (a[3] * a[5] + b[3] * b[5]), N[21] + (a[3] * a[6] + b[3] * b[6]),
        N[22] + (a[4] * a[4] + b[4] * b[4]), N[23] + (a[4] * a[5] + b[4] * b[5]),
        N[24] + (a[4] * a[6] + b[4] * b[6]), N[25] + (a[5] * a[5] + b[5] * b[5]),
        N[26] + (a[5] * a[6] + b[5] * b[6]),
    )  # fmt: skip


@merged
def _sums_into(N: FloatArray, sums: _Sums) -> None:
    """Write the sums into the upper triangle and the last column of an array (6, 7)."""
    n = 0
    for i in range(COORDINATES):
        for j in range(i, COORDINATES + 1):
            N[i, j] = sums[n]
            n += 1


@inline
def _image_row(
    t: _Vec3, t_depth: _Vec3, pixel: float, inverse_depth: float, turn: FloatArray, e: float
) -> _Row:
    """Velocities of one image coordinate under the six motions, [RH00] eq. (7), and its residual.

    t, t_depth : numerator and denominator of the coordinate under the translations.
    inverse_depth : of the marker, 1/m3; it and the residual e have the same weight.
    turn : (3, 3) rotations of the marker as translations.
    """
    x = (t[0] - pixel * t_depth[0]) * inverse_depth
    y = (t[1] - pixel * t_depth[1]) * inverse_depth
    z = (t[2] - pixel * t_depth[2]) * inverse_depth
    return (
        x,
        y,
        z,
        (float(turn[0, 0]) * x + float(turn[0, 1]) * y) + float(turn[0, 2]) * z,
        (float(turn[1, 0]) * x + float(turn[1, 1]) * y) + float(turn[1, 2]) * z,
        (float(turn[2, 0]) * x + float(turn[2, 1]) * y) + float(turn[2, 2]) * z,
        e,
    )


@merged
def _normal_equations(
    P: FloatArray, body: Body, s: FloatArray, H: Mat4, goal_views_only: bool, normal: FloatArray
) -> tuple[float, int]:
    """Normal equations of the displacement exp(ξ) after which H carries the markers to their images.

    Arguments as of ``fit_body``; images are linearised in ξ about H. Writes the equations to ``normal``.
    Returns the sum of squared residuals, px², and the number of markers seen, counted once a view.
    """
    N = _NO_SUMS
    squares = 0.0
    views = 0
    D_0, D_1, D_2 = vec(body.D[0]), vec(body.D[1]), vec(body.D[2])
    for view in range(P.shape[0]):
        # Rows of the camera in the frame of the body.
        p_u = apply_transposed(H, vec(P[view, 0]))
        p_v = apply_transposed(H, vec(P[view, 1]))
        p_w = apply_transposed(H, vec(P[view, 2]))
        t_u = (dot(p_u, D_0), dot(p_u, D_1), dot(p_u, D_2))
        t_v = (dot(p_v, D_0), dot(p_v, D_1), dot(p_v, D_2))
        t_w = (dot(p_w, D_0), dot(p_w, D_1), dot(p_w, D_2))
        for k in range(min(body.M.shape[0], s.shape[1])):
            if goal_views_only and not body.in_goal[view, k]:
                continue
            M = vec(body.M[k])
            depth = dot(p_w, M)
            if depth == 0.0 or not (math.isfinite(s[view, k, 0]) and math.isfinite(s[view, k, 1])):
                continue
            inverse = 1.0 / depth
            u = dot(p_u, M) * inverse
            v = dot(p_v, M) * inverse
            weight = float(body.weight[view, k])
            e_u = weight * (float(s[view, k, 0]) - u)
            e_v = weight * (float(s[view, k, 1]) - v)
            row_u = _image_row(t_u, t_w, u, weight * inverse, body.turn[k], e_u)
            row_v = _image_row(t_v, t_w, v, weight * inverse, body.turn[k], e_v)
            N = _accumulate(N, row_u, row_v)
            squares += e_u * e_u + e_v * e_v
            views += 1
    _sums_into(normal, N)
    return squares, views


@inline
def _outer(A: Vec4, a: Vec4) -> Mat4:
    """Product A aᵀ of a point and a plane."""
    return scale(A[0], a) + scale(A[1], a) + scale(A[2], a) + scale(A[3], a)


@internal
def _displaced(body: Body, H: Mat4, normal: FloatArray) -> Mat4:
    """Displacement H exp(ξ), with the coordinates ξ in the last column of the solved equations."""
    xi = normal[:, COORDINATES]
    direction = add(
        scale(float(xi[0]), vec(body.D[0])),
        add(scale(float(xi[1]), vec(body.D[1])), scale(float(xi[2]), vec(body.D[2]))),
    )
    X = _outer(direction, vec(body.a_inf))
    for i in range(3):
        X = combine(1.0, X, float(xi[3 + i]), mat(body.H_hat[i]))
    return mul(H, twist_exponential(X))


@separate
@njit
def fit_body(P: FloatArray, body: Body, s: FloatArray, H: Mat4, until: _Until, normal: FloatArray) -> _Fit:
    """Displacement of minimum reprojection error over all markers seen, by Gauss–Newton steps.

    The markers must determine six coordinates, as three in general position do in one view.

    P : (V, 3, 4) cameras.
    s : (V, k, 2) pixels of the first k markers, NaN where unseen.
    H : predicted displacement from the reference.
    until : ``GOAL_VIEWS``, ``ALL_VIEWS`` or ``SETTLED``.
    normal : (6, 7) workspace of the normal equations.
    """
    before = 0.0
    after = 0.0
    views = 0
    settled = False
    for step in range(until.max_steps):
        squares, views = _normal_equations(P, body, s, H, until.goal_views_only, normal)
        if step == 0:
            before = squares
        gradient = (
            normal[0, 6], normal[1, 6], normal[2, 6],
            normal[3, 6], normal[4, 6], normal[5, 6],
        )  # fmt: skip
        if not solve_normal(normal, COORDINATES, _RANK_TOLERANCE):
            return _Fit(found=False, settled=False, H=H, before=before, after=before, views=views)
        fall = 0.0
        for i in range(COORDINATES):
            fall += gradient[i] * normal[i, COORDINATES]
        H = _displaced(body, H, normal)
        after = max(0.0, squares - fall)
        settled = fall <= until.settled_px * until.settled_px * (2 * views)
        if settled:
            break
    return _Fit(found=True, settled=settled, H=H, before=before, after=after, views=views)


@njit
def carry(body: Body, H: Mat4, A: FloatArray) -> None:
    """Points (m, 4) of the face, the first of the body, after the displacement H."""
    for k in range(A.shape[0]):
        vec_into(A[k], apply(H, vec(body.M[k])))
