"""How far a planned motion is from what must not happen: its joints and its margins.

Each margin is a number, positive where its constraint holds:

- visibility: a·O of the face and a camera over its value at the start, [RH00] section 4.2; 0 where the
  camera looks along the face;
- image: distance of a marker from the border of an image less ``border_px``, over half the shorter
  side of the image less ``border_px``; 1 in the middle of a square image;
- joints: distance of a joint from its nearer limit over half its range; 1 in the middle;
- conditioning: reciprocal condition of the image Jacobian less ``conditioning``.

No path betters the margins of its ends. A planner therefore counts in shares of them, one scale a
constraint: the smallest share of an instant is 1 where nothing is nearer than at the worse of both
ends, and 0 where a constraint is about to fail.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Mat4, apply, axpy, dot, mat, mul, put_mat, put_vec, vec
from projservo_cli.geometry.jit import merged, njit
from projservo_cli.geometry.kernels import COORDINATES, orthogonalize
from projservo_cli.geometry.kinematics import backward, forward, image_velocity, operators_at, project
from projservo_cli.geometry.mechanisms import SETTLED, Seen, Work, reach, span_of, workspace
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.trajectory import displaced
from projservo_cli.task.visibility import margin_coefficients

CONSTRAINTS = ("visibility", "image", "joints", "conditioning")
VISIBILITY, IMAGE, JOINTS, CONDITIONING = range(4)
# A margin this bad is as bad as it gets: joints out of reach.
WORST = -10.0
# Distance, px, from the border of an image of what no camera shows.
BEHIND = -1e9
# A joint that moves more than this between neighbours on a path, rad or m, asks for points between.
MOST_PART = 0.2
PARTS = (1, 2, 4, 8, 16, 32, 64, 128, 256)


class Demands(NamedTuple):
    """What a planned motion must keep to."""

    lower: FloatArray
    upper: FloatArray  # lower, upper: (n,) joint limits, rad or m
    speed: FloatArray  # (n,) most joint motion per second, rad/s or m/s; infinite for none
    image_size: FloatArray  # (2,) width and height of both images, px; infinite where an image has no border
    border_px: float  # least distance of a marker from the border of an image, px
    conditioning: float  # least reciprocal condition of the image Jacobian of the face


def within(lower: FloatArray, upper: FloatArray) -> Demands:
    """Demands of joint limits alone, (n,) rad or m."""
    endless = np.full(len(lower), math.inf)
    return Demands(lower, upper, endless, np.full(2, math.inf), 0.0, 0.0)


class Reaching(NamedTuple):
    """A partitioned task as the planner sees it."""

    model: Model  # calibrated model; a_inf·M keeps its scale under all displacements
    demands: Demands  # what the motion must keep to
    H_hat: FloatArray  # (3, 4, 4) operators t, r, p
    amplitudes: FloatArray  # (3,) τ in the unit of Ĥ_t, θ_r and θ_p in rad
    A: FloatArray  # (m, 4) face at the start
    a: FloatArray  # (4,) its plane
    O: FloatArray  # (2, 4) optical centres
    q_start: FloatArray  # (n,) joints at the start, rad or m


class _Seen(NamedTuple):
    """What both cameras have of the face at s instants."""

    H_d: FloatArray  # (s, 4, 4) planned displacement
    s: FloatArray  # (s, 2, m, 2) images of the face, px
    visibility: FloatArray  # (s, 2) margins a·O, 1 at the start
    # (s, 2) least distance of a marker from the image border, px; ``BEHIND`` where none shows it
    distance: FloatArray


class Along(NamedTuple):
    """Margins along a path of s instants."""

    view: _Seen  # what both cameras have of the face
    q: FloatArray  # (s, n) joints, rad or m; NaN from where they cannot follow
    limit: FloatArray  # (s,) margins of the joint limits, NaN likewise
    condition: FloatArray  # (s,) reciprocal conditions of the image Jacobian, NaN likewise
    # (s, 4) the smallest of each of ``CONSTRAINTS``; ``WORST`` where the joints cannot follow
    margins: FloatArray


@merged
def visibility_margin(reaching: Reaching, view: int, mu_t: float, mu_r: float) -> float:
    """Margin of one camera: the dual motion of its optical centre against the plane, [RH00] section 4.2.

    The translation carries the centre along a line, the rotation within the plane leaves the plane as
    it is: for every share μ_t the margin is c_0 + c_s sin θ + c_c cos θ with coefficients affine in μ_t.
    """
    O = vec(reaching.O[view])
    a = vec(reaching.a)
    moved = axpy(-mu_t * float(reaching.amplitudes[0]), apply(mat(reaching.H_hat[0]), O), O)
    c_0, c_s, c_c = margin_coefficients(a, mat(reaching.H_hat[1]), moved)
    theta = mu_r * float(reaching.amplitudes[1])
    return (c_0 + c_s * math.sin(theta) + c_c * math.cos(theta)) / dot(a, O)


@njit
def _put_displaced(reaching: Reaching, mu: FloatArray, H_d: FloatArray, visibility: FloatArray) -> None:
    """Write displacements (s, 4, 4) and margins of visibility (s, 2) at the shares mu (s, 3)."""
    for i in range(mu.shape[0]):
        put_mat(H_d[i], displaced(reaching.H_hat, reaching.amplitudes, mu[i, 0], mu[i, 1], mu[i, 2]))
        for view in range(2):
            visibility[i, view] = visibility_margin(reaching, view, mu[i, 0], mu[i, 1])


def view_at(reaching: Reaching, mu: FloatArray) -> _Seen:
    """What both cameras have of the face at the shares mu (s, 3)."""
    H_d, visibility = np.empty((len(mu), 4, 4)), np.empty((len(mu), 2))
    _put_displaced(reaching, np.ascontiguousarray(mu), H_d, visibility)
    return _seen(reaching, H_d, visibility)


def _seen(reaching: Reaching, H_d: FloatArray, visibility: FloatArray) -> _Seen:
    """What both cameras have of the face after displacements (s, 4, 4)."""
    model = reaching.model
    M = reaching.A @ np.swapaxes(H_d, 1, 2)
    images = np.moveaxis(project(model.P, M, model.lens), 0, 1)
    depth, at_start = M @ model.P[:, 2].T, reaching.A @ model.P[:, 2].T
    u_v = np.minimum(images + 0.5, reaching.demands.image_size - 0.5 - images)
    border = np.minimum(u_v[..., 0], u_v[..., 1])
    shown = np.isfinite(border) & np.swapaxes(depth * at_start > 1e-9 * at_start**2, 1, 2)
    return _Seen(H_d, images, visibility, np.where(shown, border, BEHIND).min(axis=2))


def image_margin(distance: FloatArray, demands: Demands) -> FloatArray:
    """Margins of distances from the border, px; 1 where images have no border."""
    half = 0.5 * float(demands.image_size.min())
    if not math.isfinite(half):
        return np.where(distance > 0.0, 1.0, WORST)
    return np.maximum(WORST, (distance - demands.border_px) / (half - demands.border_px))


def limit_margin(q: FloatArray, demands: Demands) -> FloatArray:
    """Margins (..., n) of the limits of each joint, at the joints q (..., n); 1 for a joint without."""
    lower, upper = demands.lower, demands.upper
    span = np.where(np.isfinite(upper - lower), upper - lower, np.nan)
    margin = np.where(np.isnan(span), 1.0, 2.0 * np.minimum(q - lower, upper - q) / span)
    return np.clip(margin, WORST, 1.0)


class _Carrier(NamedTuple):
    """What carries the joints along a path."""

    reaching: Reaching  # the task
    work: Work  # workspace of n joints and 4m rows
    before: FloatArray
    M: FloatArray  # before, M: (n,) and (2, 4) workspaces


def carrier_of(reaching: Reaching) -> _Carrier:
    """Workspace in which the joints of a task are carried."""
    n = len(reaching.q_start)
    work = workspace(n, 4 * len(reaching.A), span_of(reaching.model, reaching.A))
    return _Carrier(reaching, work, np.empty(n), np.empty((2, 4)))


@njit
def carry_joints(
    carrier: _Carrier, ends: FloatArray, parts: int, settled: float, stride: float, q: FloatArray
) -> float:
    """Carry the joints ``q``, in place, along a straight piece of path in equal parts.

    ends : (2, 3) shares at both ends.
    parts : how many; of none the joints stay where they are.
    settled : Newton step, rad or m, that is the last of a part.
    stride : most that a part may move a joint, rad or m.
    Returns reciprocal condition of the image Jacobian there; −1 where a part does not settle or moves too
    far.
    """
    reaching, work, before = carrier.reaching, carrier.work, carrier.before
    model = reaching.model
    face = Seen(reaching.A, backward(model, reaching.q_start))
    operators_at(model, q, work.H_hat)
    goal = displaced(reaching.H_hat, reaching.amplitudes, ends[0, 0], ends[0, 1], ends[0, 2])
    for part in range(1, parts + 1):
        x = part / parts
        for i in range(q.shape[0]):
            before[i] = q[i]
        mu_t = (1.0 - x) * ends[0, 0] + x * ends[1, 0]
        mu_r = (1.0 - x) * ends[0, 1] + x * ends[1, 1]
        mu_p = (1.0 - x) * ends[0, 2] + x * ends[1, 2]
        goal = displaced(reaching.H_hat, reaching.amplitudes, mu_t, mu_r, mu_p)
        if not reach(model, face, goal, q, work, settled):
            return -1.0
        for i in range(q.shape[0]):
            if not abs(q[i] - before[i]) <= stride:
                return -1.0
    return _reciprocal_condition(carrier, goal)


@merged
def _reciprocal_condition(carrier: _Carrier, H: Mat4) -> float:
    """Reciprocal condition of the image Jacobian of the displaced face, [RH00] eq. (7).

    The ratio of the last to the first pivot of an orthogonalisation, which no projective frame changes.
    The operators at the joints are in the workspace.
    """
    work, M = carrier.work, carrier.M
    A, P = carrier.reaching.A, carrier.reaching.model.P
    n, m = work.H_hat.shape[0], A.shape[0]
    for k in range(m):
        put_vec(M[0], apply(H, vec(A[k])))
        for i in range(n):
            put_vec(M[1], apply(mat(work.H_hat[i]), vec(M[0])))
            for view in range(2):
                _, _, du, dv = image_velocity(P[view], M[0], M[1])
                work.system.B[i, 4 * k + 2 * view] = du
                work.system.B[i, 4 * k + 2 * view + 1] = dv
    first, _, last = orthogonalize(work.system, 4 * m, n, False)
    if n > COORDINATES:  # further joints add no motion of the face
        sixth = work.system.B[COORDINATES - 1, COORDINATES - 1]
        last = 1.0 / sixth if sixth > 0.0 else 0.0
    return last / first if first > 0.0 else 0.0


def along(reaching: Reaching, mu: FloatArray) -> Along:
    """Joints and margins at the shares mu (s, 3), whose first row is zero.

    Where the joints would move too far between two of them, the way is made in parts.
    """
    carrier = carrier_of(reaching)
    q = np.full((len(mu), len(reaching.q_start)), np.nan)
    condition = np.full(len(mu), np.nan)
    for i in range(len(mu)):
        ends = np.ascontiguousarray(mu[[max(0, i - 1), i]])
        for parts in (0,) if i == 0 else PARTS:
            here = (reaching.q_start if i == 0 else q[i - 1]).copy()
            found = carry_joints(carrier, ends, parts, SETTLED, MOST_PART, here)
            if found >= 0.0:
                q[i], condition[i] = here, found
                break
        if math.isnan(condition[i]):
            break
    return _margins(view_at(reaching, mu), q, condition, reaching.demands)


@njit
def _put_moved(
    carrier: _Carrier, q: FloatArray, H_d: FloatArray, visibility: FloatArray, condition: FloatArray
) -> None:
    """Write displacements (s, 4, 4), visibility (s, 2) and reciprocal conditions (s,) at joints (s, n)."""
    reaching, model = carrier.reaching, carrier.reaching.model
    a, start = vec(reaching.a), forward(model, reaching.q_start)
    back = backward(model, reaching.q_start)
    for i in range(q.shape[0]):
        H = mul(operators_at(model, q[i], carrier.work.H_hat), back)
        put_mat(H_d[i], H)
        condition[i] = _reciprocal_condition(carrier, H)
        H_back = mul(start, backward(model, q[i]))
        for view in range(2):
            O = vec(reaching.O[view])
            visibility[i, view] = dot(a, apply(H_back, O)) / dot(a, O)


def along_joints(reaching: Reaching, q: FloatArray) -> Along:
    """Margins at joints (s, n), whose displacements are those of the forward kinematics, [RH00] eq. (6)."""
    H_d, visibility, condition = np.empty((len(q), 4, 4)), np.empty((len(q), 2)), np.empty(len(q))
    _put_moved(carrier_of(reaching), np.ascontiguousarray(q), H_d, visibility, condition)
    return _margins(_seen(reaching, H_d, visibility), q, condition, reaching.demands)


def _margins(view: _Seen, q: FloatArray, condition: FloatArray, demands: Demands) -> Along:
    """All margins along a path of joints (s, n)."""
    limit = limit_margin(q, demands).min(axis=1)
    margins = np.stack(
        [
            view.visibility.min(axis=1),
            image_margin(view.distance.min(axis=1), demands),
            np.where(np.isnan(limit), 1.0, limit),
            np.where(np.isnan(condition), WORST, condition - demands.conditioning),
        ],
        axis=1,
    )
    return Along(view, q, limit, condition, margins)
