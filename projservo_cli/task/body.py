"""Pose of the rigid body that the face belongs to, from all its markers.

The markers' structure and the displacements a robot can make are known from the calibration. What is
left to measure is one displacement, six coordinates, by all markers either camera sees.
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
    invariant_rotations,
    mat,
    mul,
    put_vec,
    scale,
    twist_exponential,
    vec,
)
from projservo_cli.geometry.jit import inline, internal, merged, njit
from projservo_cli.geometry.kernels import COORDINATES, solve_normal
from projservo_cli.records import BoolArray, FloatArray, Model

_Vec3 = tuple[float, float, float]
Row = tuple[float, float, float, float, float, float, float]
# Products of the columns of (J, e) with those of J, upper triangle by rows.
Sums = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float, float,
    float, float, float, float, float, float, float, float, float, float, float, float, float,
]  # fmt: skip
NOTHING: Sums = (
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
)  # fmt: skip
# A coordinate of which the others leave less than this share, squared, is not determined.
_RANK_TOLERANCE = 1e-7


class Body(NamedTuple):
    """Markers that move as one, and a basis of the displacements they can make.

    The coordinates of a displacement are three translations and three rotations about the middle of
    the markers; the translations have a_inf for their plane at infinity.
    """

    # (m, 4) markers at the reference, a_inf·M = 1, those of the face first; none where the face is measured
    # point by point
    M: FloatArray
    D: FloatArray  # (3, 4) points at infinity along which the translations go
    H_hat: FloatArray  # (3, 4, 4) operators of the rotations, per rad
    turn: FloatArray  # (m, 3, 3) coordinates of Ĥ_r M in the basis D, one row a rotation
    a_inf: FloatArray  # (4,) plane at infinity
    shown: BoolArray  # (2, m) views of the markers that the goal showed
    weight: FloatArray  # (2, m) of their residuals in a fit


class _Until(NamedTuple):
    """When a fit ends."""

    shown_only: bool  # leave out views that the goal did not show
    settled_px: float  # a step that moves the images by no more, px rms a coordinate, is the last
    most_steps: int  # the fit after so many steps is taken as it is


# In the loop, by the views that the goal showed or by all: what a step of half a pixel leaves is its square
# over the size of the body in the image, a few thousandths of a pixel.
SHOWN, SEEN = _Until(True, 0.5, 2), _Until(False, 0.5, 2)
# At the goal, to round-off.
SETTLED = _Until(False, 1e-6, 30)


class _Fit(NamedTuple):
    """Displacement that markers say, and how well they agree."""

    found: bool  # False where the markers that were seen do not determine it
    settled: bool  # whether the last step was short enough
    H: Mat4  # displacement from the reference
    before: float
    after: float  # before, after: sum of squared residuals of the prediction and of the fit, px²
    views: int  # markers used, counted once a view


# The face measured point by point.
NO_BODY = Body(
    M=np.zeros((0, 4)),
    D=np.zeros((3, 4)),
    H_hat=np.zeros((3, 4, 4)),
    turn=np.zeros((0, 3, 3)),
    a_inf=np.zeros(4),
    shown=np.zeros((2, 0), dtype=np.bool_),
    weight=np.ones((2, 0)),
)


def body_of(model: Model, M: FloatArray) -> Body:
    """Body of calibrated markers.

    The rotations are those of the joints: the three directions in which their actions on the plane at
    infinity spread most, orthonormal in the invariant form −½ trace(L L'), hence per rad. Where the joints
    do not turn the body about three directions, they are those of a metric that the joints keep.

    model : calibrated model; M : (m, 4) its markers at the reference, those of the face first.
    Raises WorkFailed if the joints keep no metric of the calibrated frame.
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
        shown=np.ones((2, len(M)), dtype=np.bool_),
        weight=np.ones((2, len(M))),
    )


@inline
def _accumulate(N: Sums, a: Row, b: Row) -> Sums:
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
def _put_sums(N: FloatArray, sums: Sums) -> None:
    """Write the sums into the upper triangle and the last column of an array (6, 7)."""
    n = 0
    for i in range(COORDINATES):
        for j in range(i, COORDINATES + 1):
            N[i, j] = sums[n]
            n += 1


@inline
def _image_row(
    t: _Vec3, t_depth: _Vec3, pixel: float, inverse_depth: float, turn: FloatArray, e: float
) -> Row:
    """Velocities of one image coordinate under the six motions, [RH00] eq. (7), and its residual.

    t, t_depth : numerator and denominator of the coordinate under the translations.
    inverse_depth : of the marker, 1/m3; it and the residual e are weighed alike.
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
    P: FloatArray, body: Body, s: FloatArray, H: Mat4, shown_only: bool, normal: FloatArray
) -> tuple[float, int]:
    """Normal equations of the displacement exp(ξ) after which H carries the markers to their images.

    Arguments as of ``fit_body``; the images are linear in ξ about H, and the equations are in ``normal`` on
    return. Returns sum of squared residuals, px², and the number of markers seen, counted once a view.
    """
    N = NOTHING
    squares = 0.0
    views = 0
    D_0, D_1, D_2 = vec(body.D[0]), vec(body.D[1]), vec(body.D[2])
    for view in range(2):
        # Rows of the camera carried back to the body: its image of what stands still there.
        p_u = apply_transposed(H, vec(P[view, 0]))
        p_v = apply_transposed(H, vec(P[view, 1]))
        p_w = apply_transposed(H, vec(P[view, 2]))
        t_u = (dot(p_u, D_0), dot(p_u, D_1), dot(p_u, D_2))
        t_v = (dot(p_v, D_0), dot(p_v, D_1), dot(p_v, D_2))
        t_w = (dot(p_w, D_0), dot(p_w, D_1), dot(p_w, D_2))
        for k in range(min(body.M.shape[0], s.shape[1])):
            if shown_only and not body.shown[view, k]:
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
    _put_sums(normal, N)
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


@njit
def fit_body(P: FloatArray, body: Body, s: FloatArray, H: Mat4, until: _Until, normal: FloatArray) -> _Fit:
    """Displacement of least reprojection error over all markers seen, by Gauss–Newton steps.

    Any markers do that determine six coordinates: three that one camera sees, in general position.

    P : (2, 3, 4) cameras.
    s : (2, k, 2) pixels of the first k markers, NaN where unseen.
    H : predicted displacement from the reference.
    until : ``SHOWN``, ``SEEN`` or ``SETTLED``.
    normal : (6, 7) workspace of the normal equations.
    """
    before = 0.0
    after = 0.0
    views = 0
    settled = False
    for step in range(until.most_steps):
        squares, views = _normal_equations(P, body, s, H, until.shown_only, normal)
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
        put_vec(A[k], apply(H, vec(body.M[k])))
