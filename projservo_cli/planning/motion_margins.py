"""Constraints of a planned motion, by name and in words, and the margins of a motion along shares or joints.

Each margin is a number, positive if its constraint holds. Of joints (n,), as
``planning.joint_constraints`` writes them, less the error of a prediction:

- joints: the minimum distance of a joint from its limits over the required margin;
- front: the minimum third coordinate of P·M of a marker over that at the start: [RH00] section 4.2 carries
  the sign, which is otherwise open in projective space;
- visibility: a·O of the face and a camera over its value at the start, carried by the dual motion H⁻ᵀ;
- width: the minimum width of the image of the face, px, for an angle means nothing in projective space;
- image: the minimum distance of a marker of the face from the border of an image, px;
- clear: the minimum distance from a keep-out region, px: of all markers, and of all points between
  the markers of the face.

Of a motion of the face, the worst of the views that are to see it counts, and

- image: that distance less ``border_px``, over half the shorter side of the image less ``border_px``; 1 in
  the middle of a square image;
- joints: distance of a joint from its nearer limit over half its range; 1 in the middle;
- conditioning: reciprocal condition of the image Jacobian less ``conditioning``.

No path betters the margins of its ends. A planner therefore counts in shares of them, one scale a
constraint: the smallest ratio is 1 if no sample is nearer than the worse of both
ends, and 0 if a constraint is about to fail.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Mat4, Vec4, apply, mat, mat_into, meet, mul, vec
from projservo_cli.geometry.jit import inline, internal, merged, njit, separate
from projservo_cli.geometry.kinematics import (
    backward,
    image_velocity,
    limit_distance,
    operators_at,
    project,
    row,
)
from projservo_cli.geometry.lens import distort_pixel, distorts
from projservo_cli.geometry.mechanisms import (
    SETTLED,
    MeasuredFace,
    Work,
    make_span,
    reach,
    rows_of,
    workspace,
)
from projservo_cli.geometry.null_space import COORDINATES, orthogonalize, row_into
from projservo_cli.image_size import BEHIND, border_distance
from projservo_cli.records import VIEWS, FloatArray, IntArray, JointLimits, Model
from projservo_cli.task.trajectory import displaced

# Kinds of constraints. Margins of joints have a column of each, and one per view if each camera has its own;
# the last one is of a motion between them alone.
JOINTS, FRONT, VISIBILITY, WIDTH, IMAGE, CLEAR, CONDITIONING = range(7)


@inline
def column(kind: int, views: int) -> int:
    """First column of a kind in margins of joints before V views; of ``CONDITIONING`` their number."""
    if kind >= CLEAR:
        return 1 + (CLEAR - FRONT) * views + kind - CLEAR
    return 1 + (kind - FRONT) * views if kind >= FRONT else 0


class _Named(NamedTuple):
    """Name of a constraint and of its value in its own unit."""

    name: str
    value: str


CONSTRAINTS = {
    JOINTS: _Named("joints", "joints"),
    FRONT: _Named("front", "front"),
    VISIBILITY: _Named("visibility", "visibility"),
    WIDTH: _Named("width", "width_px"),
    IMAGE: _Named("image", "border_px"),
    CLEAR: _Named("clear", "clear_px"),
    CONDITIONING: _Named("conditioning", "condition"),
}
# Constraints of a motion of the face, in the order of its margins.
OF_MOTION = (VISIBILITY, IMAGE, JOINTS, CONDITIONING)


def columns_of_kind(kind: int, views: int) -> slice:
    """Columns of a kind in margins of joints."""
    return slice(column(kind, views), column(kind + 1, views))


def constraint_at(margin: int, views: int) -> tuple[_Named, int]:
    """Return the names of a column of margins, and its view if each camera has its own."""
    kind = max(kind for kind in CONSTRAINTS if column(kind, views) <= margin)
    return CONSTRAINTS[kind], margin - column(kind, views)


# A margin this bad is as bad as it gets: joints out of reach.
_WORST = -10.0
# A joint that moves more than this between neighbours on a path, rad or m, asks for twice the parts between.
_MOST_PART = 0.2
_MOST_PARTS = 256


class Demands(NamedTuple):
    """Constraints of a planned motion."""

    limits: JointLimits  # limits of the joints
    image_size: FloatArray  # (V, 2) width and height of each image, px; infinite if it has no border
    border_px: float  # minimum distance of a marker from the border of an image, px
    conditioning: float  # minimum reciprocal condition number of the image Jacobian of the face
    keep: FloatArray  # (n,) minimum distance from a joint limit, rad or m, along a path through joint space
    min_face_px: float = 0.0  # minimum width of the face in an image along such a path, px
    # (t, 4) corners of tags, markers of the body in the order of their numbers, of which one is to be seen by
    # enough cameras; none if the face is
    tags: IntArray = np.zeros((0, 4), np.int64)
    units: tuple[str, ...] = ()  # unit of each joint in messages: deg, rad or m
    view: tuple[str, ...] = VIEWS  # names of the views
    min_views: int = 0  # number of views that are to see the face, the best ones; 0 for all


def limits_alone(limits: JointLimits, views: int = len(VIEWS)) -> Demands:
    """Demands of joint limits alone."""
    return Demands(
        limits=limits,
        image_size=np.full((views, 2), math.inf),
        border_px=0.0,
        conditioning=0.0,
        keep=np.zeros(len(limits.lower)),
    )


class Reaching(NamedTuple):
    """A partitioned task as the planner sees it."""

    model: Model  # calibrated model; a_inf·M keeps its scale under all displacements
    demands: Demands  # constraints of the motion
    H_hat: FloatArray  # (3, 4, 4) operators t, r, p
    amplitudes: FloatArray  # (3,) τ in the unit of Ĥ_t, θ_r and θ_p in rad
    A: FloatArray  # (m, 4) face at the start
    a: FloatArray  # (4,) its plane
    O: FloatArray  # (V, 4) optical centres
    visible: FloatArray  # (V,) sign of a·O on the visible side of the face
    q_start: FloatArray  # (n,) joints at the start, rad or m
    # (b, 4) all markers of the body at the start, the face first
    body: FloatArray = np.zeros((0, 4))


class Along(NamedTuple):
    """Quantities along a motion, at s samples."""

    H_d: FloatArray  # (s, 4, 4) displacement of the face
    s: FloatArray  # (s, V, m, 2) its images, px
    visibility: FloatArray  # (s, V) margins a·O, 1 at the start
    # (s, V) minimum distance of a marker from the image border, px; ``BEHIND`` if none shows it
    distance: FloatArray
    q: FloatArray  # (s, n) joints, rad or m; NaN from where they cannot follow
    limit: FloatArray  # (s,) margins of the joint limits, NaN likewise
    condition: FloatArray  # (s,) reciprocal conditions of the image Jacobian, NaN likewise
    # (s, 4) the smallest of each of ``OF_MOTION``; ``_WORST`` if the joints cannot follow
    margins: FloatArray


def room_along(reaching: Reaching, count: int) -> Along:
    """Return empty arrays for a number of samples of a motion."""
    m, n, V = len(reaching.A), len(reaching.q_start), len(reaching.O)
    shapes = (4, 4), (V, m, 2), (V,), (V,), (n,), (), (), (4,)
    return Along(*(np.full((count, *shape), np.nan) for shape in shapes))


class Motion(NamedTuple):
    """A planned motion at s instants."""

    reaching: Reaching  # the task, in the senses of both rotations that were chosen
    mu: FloatArray  # (s, 3) shares; NaN of a path through joint space
    along: Along  # quantities along it

    def shares(self) -> FloatArray:
        """Each margin (s, 4) over that at the worse of both ends, or over 1 if that is not positive."""
        margins = self.along.margins
        worse = np.minimum(margins[0], margins[-1])
        return np.asarray(margins / np.where(worse > 0.0, worse, 1.0))

    def holds(self) -> bool:
        """Whether all constraints hold."""
        return bool(self.along.margins.min() > 0.0)


@merged
def straight_pixel(P: FloatArray, A: Vec4) -> tuple[float, float]:
    """Pixel of a point by a projective camera, [RH00] eq. (1)."""
    depth = row(P, 2, A)
    return row(P, 0, A) / depth, row(P, 1, A) / depth


@merged
def pixel(model: Model, view: int, A: Vec4) -> tuple[float, float]:
    """Pixel of a point, as the camera reports it."""
    u, v = straight_pixel(model.P[view], A)
    return distort_pixel(model.lens[view], u, v) if distorts(model.lens) else (u, v)


def image_margin(demands: Demands, distance: FloatArray) -> FloatArray:
    """Margins (...,) of distances from the border, px; 1 where images have no border."""
    half = 0.5 * float(demands.image_size.min())
    if not math.isfinite(half):
        return np.where(distance > 0.0, 1.0, _WORST)
    return np.maximum(_WORST, (distance - demands.border_px) / (half - demands.border_px))


@merged
def joint_margin(demands: Demands, q: FloatArray, i: int) -> float:
    """Margin of the limits of joint i of q (n,); 1 for a joint without."""
    size = float(demands.limits.upper[i]) - float(demands.limits.lower[i])
    if not math.isfinite(size):
        return 1.0
    return min(max(2.0 * limit_distance(demands.limits, q, i) / size, _WORST), 1.0)


@merged
def limit_margin(demands: Demands, q: FloatArray) -> float:
    """Return the minimum margin of the limits of joints q (n,)."""
    minimum = 1.0
    for i in range(q.shape[0]):
        minimum = min(minimum, joint_margin(demands, q, i))
    return minimum


_Ends = tuple[FloatArray, FloatArray]


class Carrier(NamedTuple):
    """State that carries the joints along a path."""

    reaching: Reaching  # the task
    work: Work  # workspace of n joints and the rows of the images of m markers
    before: FloatArray  # (n,) joints before a part of it


def carrier_of(reaching: Reaching) -> Carrier:
    """Workspace in which the joints of a task are carried."""
    n = len(reaching.q_start)
    rows = rows_of(len(reaching.O), len(reaching.A))
    work = workspace(n, rows, make_span(reaching.model, reaching.A))
    # Every other number of names would be a separate type to compile.
    nameless = reaching.demands._replace(units=(), view=())
    return Carrier(reaching._replace(demands=nameless), work, np.empty(n))


@separate
@internal
def carry_joints(
    carrier: Carrier, ends: _Ends, parts: int, settled: float, stride: float, q: FloatArray
) -> float:
    """Carry the joints ``q``, in place, along a straight piece of path in equal parts.

    ends : shares (3,) at both ends.
    parts : how many; of none the joints stay if they are.
    settled : Newton step, rad or m, that is the last of a part.
    stride : most that a part may move a joint, rad or m.
    Returns reciprocal condition of the image Jacobian there; −1 if a part does not settle or moves too
    far.
    """
    reaching, work, before = carrier.reaching, carrier.work, carrier.before
    model = reaching.model
    face = MeasuredFace(reaching.A, backward(model, reaching.q_start))
    operators_at(model, q, work.H_hat)
    first, last = ends
    goal = displaced(reaching.H_hat, reaching.amplitudes, first[0], first[1], first[2])
    for part in range(1, parts + 1):
        x = part / parts
        row_into(before, q)
        mu_t = (1.0 - x) * first[0] + x * last[0]
        mu_r = (1.0 - x) * first[1] + x * last[1]
        mu_p = (1.0 - x) * first[2] + x * last[2]
        goal = displaced(reaching.H_hat, reaching.amplitudes, mu_t, mu_r, mu_p)
        if not reach(model, face, goal, q, work, settled):
            return -1.0
        for i in range(q.shape[0]):
            if not abs(q[i] - before[i]) <= stride:
                return -1.0
    return _reciprocal_condition(carrier, goal)


@merged
def _reciprocal_condition(carrier: Carrier, H: Mat4) -> float:
    """Reciprocal condition of the image Jacobian of the displaced face, [RH00] eq. (7).

    The ratio of the last to the first pivot of an orthogonalisation, which no projective frame changes.
    The operators at the joints are in the workspace.
    """
    work, A, P = carrier.work, carrier.reaching.A, carrier.reaching.model.P
    n, m, V = work.H_hat.shape[0], A.shape[0], P.shape[0]
    for k in range(m):
        M = apply(H, vec(A[k]))
        for i in range(n):
            D = apply(mat(work.H_hat[i]), M)
            for view in range(V):
                _, _, u_dot, v_dot = image_velocity(P[view], M, D)
                at = 2 * (V * k + view)
                work.system.B[i, at], work.system.B[i, at + 1] = u_dot, v_dot
    first, _, last = orthogonalize(work.system, 2 * V * m, n, False)
    if n > COORDINATES:  # further joints add no motion of the face
        sixth = work.system.B[COORDINATES - 1, COORDINATES - 1]
        last = 1.0 / sixth if sixth > 0.0 else 0.0
    return last / first if first > 0.0 else 0.0


@njit
def displacements_into(reaching: Reaching, mu: FloatArray, along: Along) -> None:
    """Write the displacements at shares mu (s, 3)."""
    for i in range(mu.shape[0]):
        mat_into(along.H_d[i], displaced(reaching.H_hat, reaching.amplitudes, mu[i, 0], mu[i, 1], mu[i, 2]))


@njit
def carried_into(carrier: Carrier, mu: FloatArray, along: Along) -> None:
    """Write displacements, joints, limit and condition at shares mu (s, 3), from the joints at the first on.

    If the joints would move too far between two of them, the path is made in parts.
    """
    displacements_into(carrier.reaching, mu, along)
    for i in range(mu.shape[0]):
        before = max(0, i - 1)
        parts = 0 if i == 0 else 1
        condition = -1.0
        while condition < 0.0 and parts <= _MOST_PARTS:
            row_into(along.q[i], along.q[before])
            ends = (mu[before], mu[i])
            condition = carry_joints(carrier, ends, parts, SETTLED, _MOST_PART, along.q[i])
            parts = 2 * parts if parts > 0 else _MOST_PARTS + 1
        if condition < 0.0:
            for l in range(along.q.shape[1]):
                along.q[i, l] = math.nan
            return
        along.condition[i], along.limit[i] = condition, limit_margin(carrier.reaching.demands, along.q[i])


@njit
def _moved_into(carrier: Carrier, along: Along) -> None:
    """Write displacement, limit and condition at joints (s, n), by the forward kinematics."""
    reaching, model = carrier.reaching, carrier.reaching.model
    back = backward(model, reaching.q_start)
    for i in range(along.q.shape[0]):
        H = mul(operators_at(model, along.q[i], carrier.work.H_hat), back)
        mat_into(along.H_d[i], H)
        along.condition[i] = _reciprocal_condition(carrier, H)
        along.limit[i] = limit_margin(reaching.demands, along.q[i])


def along_shares(reaching: Reaching, mu: FloatArray, q: FloatArray | None = None) -> Motion:
    """The motion of shares mu (s, 3) from joints q (n,) at the first; none if it begins at the start."""
    along = room_along(reaching, len(mu))
    along.q[0] = reaching.q_start if q is None else q
    carried_into(carrier_of(reaching), np.ascontiguousarray(mu), along)
    return measured(Motion(reaching, mu, along))


def along_joints(reaching: Reaching, q: FloatArray) -> Motion:
    """Return the motion of joints (s, n) by the forward kinematics, [RH00] eq. (6)."""
    along = room_along(reaching, len(q))
    along.q[:] = q
    _moved_into(carrier_of(reaching), along)
    return measured(Motion(reaching, np.full((len(q), 3), np.nan), along))


def measured(motion: Motion) -> Motion:
    """The motion with its images, visibility, distances and margins, if the rest is known.

    Visibility is the dual motion of the optical centres against planes, [RH00] section 4.2. Of tags it and
    the distance are taken from the tag that keeps them best.
    """
    reaching, along = motion.reaching, motion.along
    demands, model, m = reaching.demands, reaching.model, len(reaching.A)
    A, tags, planes = reaching.A, np.arange(m)[None], reaching.a[None]
    if len(demands.tags):
        A, tags = reaching.body, demands.tags
        planes = tag_planes(tags, A, m, reaching.a)
    M = A @ np.swapaxes(along.H_d, 1, 2)
    s = np.moveaxis(project(model.P, M, model.lens), 0, 1)
    along.s[:] = s[:, :, :m]
    # A camera has a marker before it as long as it has it on the side on which it had it at the start.
    depth = A @ model.P[:, 2].T
    visible = np.swapaxes((M @ model.P[:, 2].T) * depth > 1e-9 * depth**2, 1, 2)
    border = border_distance(s, demands.image_size[:, None])
    border = np.where(visible & np.isfinite(border), border, BEHIND)
    scale = reaching.visible * np.abs(reaching.O @ reaching.a)
    side = planes @ np.linalg.inv(along.H_d) @ (reaching.O / scale[:, None]).T
    distance = border[:, :, tags].min(axis=3).swapaxes(1, 2)  # (s, t, V) both
    kept = np.stack([views.min(axis=2) for views in best_views(demands, side, distance)])
    kept[1] = image_margin(demands, kept[1])
    best = np.arange(len(s)), kept.min(axis=0).argmax(axis=1)
    along.visibility[:], along.distance[:] = side[best], distance[best]
    along.margins[:, [OF_MOTION.index(VISIBILITY), OF_MOTION.index(IMAGE)]] = kept[:, *best].T
    joint_margins_into(demands, along)
    return motion


def best_views(
    demands: Demands, visibility: FloatArray, distance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Visibility and distance from the border, px, (..., V) both, of the required number of best views."""
    worse = np.minimum(visibility, image_margin(demands, distance))
    best = np.argsort(-worse, axis=-1, kind="stable")[..., : demands.min_views or worse.shape[-1]]
    return np.take_along_axis(visibility, best, -1), np.take_along_axis(distance, best, -1)


def joint_margins_into(demands: Demands, along: Along) -> None:
    """Write the margins of joint limits and conditioning."""
    followed, excess = ~np.isnan(along.condition), along.condition - demands.conditioning
    along.margins[:, OF_MOTION.index(JOINTS)] = np.where(followed, along.limit, 1.0)
    along.margins[:, OF_MOTION.index(CONDITIONING)] = np.where(followed, excess, _WORST)


def tag_planes(tags: IntArray, body: FloatArray, m: int, a: FloatArray) -> FloatArray:
    """Oriented planes (t, 4) of tags (t, 4) of a body (b, 4), one on the face, its first m markers.

    All tags have their corners in the same sense, as seen from their front: planes through corners have the
    sign that they have for the face, and a scale that makes a·O of tags comparable.

    a : (4,) plane of the face.
    """
    corners = [[vec(A) for A in body[tag]] for tag in tags]
    planes = np.array([meet(A, B, C) for A, B, C, _ in corners])
    face = planes[(tags < m).all(axis=1)][0]
    return np.asarray(planes * (float(a @ face) / float(face @ face)))
