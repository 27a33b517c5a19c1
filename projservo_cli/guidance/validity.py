"""Whether joints keep what must hold, as numbers with a sign, from the calibrated model alone.

Each margin is positive where its constraint holds:

- limits: the least distance of a joint from its limits over the margin asked for;
- front: the least third coordinate of P·M of a marker over that at the start: [RH00] section 4.2 carries
  the sign, which nothing else fixes in projective space;
- side: a·O of the face and a camera over its value at the start, carried by the dual motion H⁻ᵀ;
- width: the least width of the image of the face, px, for an angle means nothing in projective space;
- border: the least distance of a marker of the face from the border of an image, px, less what its prediction
  may be off;
- clear: the least distance from a region that is kept out of, px, less what a prediction may be off: of all
  markers, and of all points between those of the face.

Joints are valid where each margin is above what is asked for, and that is no more than a share of what start
and goal have themselves, rising to its full value within ``RISE`` of them.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Mat4, Vec4, apply, axpy, dot, sub, vec
from projservo_cli.geometry.jit import internal, merged, njit
from projservo_cli.geometry.kinematics import backward, forward, forward_kinematics, row
from projservo_cli.guidance.keep_out import BOTH, NO_KEEP_OUT, KeepOut, apart, bulge, clearance, squared
from projservo_cli.guidance.margins import Demands, from_border, pixel, straight_pixel
from projservo_cli.records import NO_SPREAD, FloatArray, IntArray, Model, Spread
from projservo_cli.task.face import Task, center_of, face_plane

LIMITS, FRONT, SIDE, WIDTH, BORDER, CLEAR = 0, 1, 3, 5, 7, 9
MARGINS = 10  # all but the limits and clear by view
# Of what start and goal have themselves, so much is asked for there.
SHARE = 0.5
# Motion, s at the speed limits, from start or goal within which demands rise to their full value.
RISE = 0.5
# Between two checks no marker moves more than this in an image, px, and no joint more than that, rad or m.
FINE_PX = 4.0
FINE_STEP = 0.2


# So many standard deviations a prediction may be off.
DEVIATIONS = 3.0


class Constraints(NamedTuple):
    """What joints are held against, in the frame of the calibrated model."""

    model: Model  # its cameras scaled so that markers in front have a positive third coordinate
    M: FloatArray  # (b, 4) markers of the body at the reference, those of the face first
    face: int  # how many are of the face
    a: FloatArray  # (4,) plane of the face at the reference
    O: FloatArray  # (2, 4) optical centres, a·O = 1 at the start
    depth: FloatArray  # (2,) least third coordinate of a marker at the start
    lower: FloatArray
    upper: FloatArray  # lower, upper: (n,) joint limits, rad or m
    speed: FloatArray  # (n,) most motion per second, rad/s or m/s
    image_size: FloatArray  # (2,) px; infinite where an image has no border
    keep: FloatArray  # (n,) distance from a limit that counts as margin one, rad or m
    full: FloatArray  # (10,) margins asked for
    ends: FloatArray  # (k, n) start and goals, near which less is asked for
    had: FloatArray  # (k, 10) what is asked for there
    spread: Spread = NO_SPREAD
    keep_out: KeepOut = NO_KEEP_OUT


def constraints_of(
    model: Model, A: FloatArray, task: Task, q_start: FloatArray, asked: "Asked"
) -> Constraints:
    """What joints are held against, of a task whose points (b, 4) are given at the start, face first.

    Signs are those at the start: [RH00] section 4.2 carries them along.
    """
    m = len(task.order)
    a = np.array(face_plane(A[:m], task.order, center_of(A[:m], task.center)))
    H = forward_kinematics(model, q_start)
    sides = np.sign((A @ model.P[:, 2].T)[0])
    model = model._replace(P=np.ascontiguousarray(model.P * sides[:, None, None]))
    n = len(q_start)
    demands, steep = asked.demands, asked.least_face_px
    border = demands.border_px
    return Constraints(
        model,
        np.ascontiguousarray(A @ np.linalg.inv(H).T),
        m,
        H.T @ a,
        np.ascontiguousarray(task.O / (task.O @ a)[:, None]),
        (A @ model.P[:, 2].T).min(axis=0),
        demands.lower,
        demands.upper,
        demands.speed,
        demands.image_size,
        np.maximum(asked.keep, 1e-9),
        np.array([1.0, 0.0, 0.0, 0.0, 0.0, steep, steep, border, border, FINE_PX]),
        np.zeros((0, n)),
        np.zeros((0, MARGINS)),
    )


class Asked(NamedTuple):
    """What a way is to keep to."""

    demands: Demands  # limits and speeds of the joints, of which each has one, images and their border
    keep: FloatArray  # (n,) distance from the joint limits, rad or m
    least_face_px: float  # width of the face in the images


@merged
def _put_limits(c: Constraints, q: FloatArray, margins: FloatArray) -> None:
    least = math.inf
    for i in range(q.shape[0]):
        least = min(least, min(q[i] - c.lower[i], c.upper[i] - q[i]) / c.keep[i])
    margins[LIMITS] = least


@merged
def _put_sides(c: Constraints, q: FloatArray, margins: FloatArray) -> None:
    back = backward(c.model, q)
    for view in range(2):
        margins[SIDE + view] = dot(vec(c.a), apply(back, vec(c.O[view])))


@internal
def width(s: FloatArray, m: int) -> float:
    """Least width of m image points (≥ m, 2), px: between the two nearest parallel lines that hold them.

    One of them goes through two of the points.
    """
    least = math.inf
    for i in range(m):
        for j in range(i):
            dx, dy = s[i, 0] - s[j, 0], s[i, 1] - s[j, 1]
            length = math.sqrt(dx * dx + dy * dy)
            if length > 0.0:
                low, high = 0.0, 0.0
                for k in range(m):
                    off = (dx * (s[k, 1] - s[j, 1]) - dy * (s[k, 0] - s[j, 0])) / length
                    low, high = min(low, off), max(high, off)
                least = min(least, high - low)
    return least if math.isfinite(least) else 0.0


@merged
def twin_of(c: Constraints, j: int) -> Model:
    """The calibrated model, off by the deviation j."""
    m = c.model
    return Model(c.spread.P[j], c.spread.H_hat[j], m.joint_types, m.q_reference, m.a_inf, m.lens)


@merged
def _put_views(c: Constraints, q: FloatArray, s: FloatArray, margins: FloatArray, asked: float) -> bool:
    """Write the images (2, b, 2) and what they tell; False where a marker is behind a camera.

    asked : what the distance from regions is held against, infinite where it is told.
    """
    H = forward(c.model, q)
    P = c.model.P
    for view in range(2):
        nearest, border = math.inf, math.inf
        for k in range(c.M.shape[0]):
            A = apply(H, vec(c.M[k]))
            depth = row(P[view], 2, A)
            nearest = min(nearest, depth)
            if not depth > 0.0:
                continue
            u, v = pixel(c.model, view, A)
            s[view, k, 0], s[view, k, 1] = u, v
            if k < c.face:
                border = min(border, from_border(c.image_size, u, v))
        margins[FRONT + view] = nearest / c.depth[view]
        if not nearest > 0.0:
            return False
        margins[WIDTH + view] = width(s[view], c.face)
        margins[BORDER + view] = border
    left = right = most = c.spread.most
    room = min(margins[BORDER] - c.full[BORDER], margins[BORDER + 1] - c.full[BORDER + 1])
    if most > 0.0 and room < DEVIATIONS * most:  # near enough for the deviation there to tell
        left, right = most_off(c, q, H)
    margins[BORDER] -= DEVIATIONS * left
    margins[BORDER + 1] -= DEVIATIONS * right
    margins[CLEAR] = _clear(c, q, H, s, asked) if c.keep_out.image.shape[0] > 0 else math.inf
    return True


# No marker of the body is off by so many times as much as the face was at most.
FAR_OFF = 5.0


@internal
def _clear(c: Constraints, q: FloatArray, H: Mat4, s: FloatArray, asked: float) -> float:
    """Margin of the regions that are kept out of; near them, or to tell it, by what is off there."""
    off = DEVIATIONS * FAR_OFF * c.spread.most
    if off > 0.0 and asked < math.inf:
        far = clear_by(c, H, s, (off, off), c.full[CLEAR])
        if far >= c.full[CLEAR]:
            return far
    left, right = most_off(c, q, H)
    return clear_by(c, H, s, (DEVIATIONS * left, DEVIATIONS * right), asked)


@internal
def most_off(c: Constraints, q: FloatArray, H: Mat4) -> tuple[float, float]:
    """Standard deviation of a coordinate in each image, px, no less than that of any marker of the body."""
    left = right = c.spread.rest * c.spread.rest
    for j in range(1, c.spread.P.shape[0]):
        twin = twin_of(c, j)
        H_j = forward(twin, q)
        worst_left, worst_right = 0.0, 0.0
        for k in range(c.M.shape[0]):
            A, A_j = apply(H, vec(c.M[k])), apply(H_j, vec(c.spread.M[j, k]))
            s_left, s_right = straight_pixel(c.model.P[0], A), straight_pixel(c.model.P[1], A)
            worst_left = max(worst_left, squared(s_left, straight_pixel(twin.P[0], A_j)))
            worst_right = max(worst_right, squared(s_right, straight_pixel(twin.P[1], A_j)))
        left, right = left + 0.5 * worst_left, right + 0.5 * worst_right
    return math.sqrt(left), math.sqrt(right)


@internal
def clear_by(c: Constraints, H: Mat4, s: FloatArray, off: tuple[float, float], asked: float) -> float:
    """Least distance, px, of the displaced body with images s (2, b, 2) from regions that are kept out of.

    off : how far predictions may be off in each image, px.
    asked : what the distance is held against: beyond it, and once it is missed, less is looked at; infinite
        where the distance itself matters.
    A point is clear where one camera sees it beside a region. Markers of a face that the obstacle may hide
    are so in both images, and all markers in the only image in which a region is drawn.
    """
    keep, least = c.keep_out, math.inf
    enough = min(asked, c.full[CLEAR]) if asked < math.inf else asked
    for region in range(keep.hides.shape[0]):
        for k in range(c.M.shape[0]):
            u, v, x, y = s[0, k, 0], s[0, k, 1], s[1, k, 0], s[1, k, 1]
            first = clearance(keep, region, 0, (u, v)) - off[0]
            second = clearance(keep, region, 1, (x, y)) - off[1]
            if keep.views[region] != BOTH or (keep.hides[region] == 1 and k < c.face):
                least = min(least, first, second)
            else:
                first, second = (
                    min(first, from_border(c.image_size, u, v) - off[0]),
                    min(second, from_border(c.image_size, x, y) - off[1]),
                )
                least = min(least, max(first, second))
        for k in range(c.face if keep.views[region] == BOTH else 0):
            for l in range(k):
                if least < asked < math.inf:
                    return least
                A, B = apply(H, vec(c.M[k])), apply(H, vec(c.M[l]))
                least = min(least, _clear_between(c, region, (A, B), off, enough))
    return least


# Half the length, px, of the pieces of a segment that are told apart at a region.
PIECE = 0.5


@internal
def _clear_between(
    c: Constraints, region: int, ends: tuple[Vec4, Vec4], off: tuple[float, float], enough: float
) -> float:
    """Least distance, px, of a segment from a region of both images, as above; never too large.

    Pieces of it, of the segment in space and so the same in both images, are halved until one image shows
    all of each ``enough`` beside the region, or they are short: a distance changes by no more than the way.
    """
    least, done, step = math.inf, 0.0, 1.0
    while done < 1.0:
        step = min(step, 1.0 - done)
        first, last = combined(done, ends[0], ends[1]), combined(done + step, ends[0], ends[1])
        middle = combined(done + 0.5 * step, ends[0], ends[1])
        here, all_along, half = -math.inf, -math.inf, 0.0
        for view in range(2):
            s, at, t = pixel(c.model, view, first), pixel(c.model, view, middle), pixel(c.model, view, last)
            radius = math.sqrt(max(squared(at, s), squared(at, t)))
            clear = (
                min(clearance(c.keep_out, region, view, at), from_border(c.image_size, at[0], at[1]))
                - off[view]
            )
            along = clear - radius
            if along < enough <= clear:
                # A lens bends the image of a straight piece: by no more than in its middle.
                border = min(from_border(c.image_size, s[0], s[1]), from_border(c.image_size, t[0], t[1]))
                along = min(apart(c.keep_out, region, view, s, t), border) - off[view] - bulge(s, at, t)
            here, all_along, half = max(here, clear), max(all_along, along), max(half, radius)
            if all_along >= enough:
                break
        if all_along < enough and half > max(PIECE, 0.25 * abs(here)):
            step *= 0.5
            continue
        least = min(least, max(all_along, here - half))
        done += step
        step *= 2.0
    return least


@merged
def combined(x: float, A: Vec4, B: Vec4) -> Vec4:
    """Point (1 − x) A + x B."""
    return axpy(x, sub(B, A), A)


@njit
def put_margins(c: Constraints, q: FloatArray, s: FloatArray, margins: FloatArray) -> None:
    """Write all margins (10,) at joints (n,), rad or m, and the images (2, b, 2), px."""
    for i in range(MARGINS):
        margins[i] = -math.inf
    _put_limits(c, q, margins)
    _put_sides(c, q, margins)
    _put_views(c, q, s, margins, math.inf)


@njit
def put_demands(c: Constraints, q: FloatArray, demands: FloatArray) -> None:
    """Write what is asked for (10,) at joints (n,): the full margins, or less near start and goals."""
    for i in range(MARGINS):
        demands[i] = c.full[i]
    for e in range(c.ends.shape[0]):
        rise = time_between(c.speed, q, c.ends[e]) / RISE
        if rise < 1.0:
            for i in range(MARGINS):
                demands[i] = min(demands[i], c.had[e, i] + rise * (c.full[i] - c.had[e, i]))


@njit
def put_along(c: Constraints, q: FloatArray, s: FloatArray, margins: FloatArray, demands: FloatArray) -> None:
    """Write margins and demands (k, 10) along joints (k, n), and the last images (2, b, 2), px."""
    for i in range(q.shape[0]):
        put_margins(c, q[i], s, margins[i])
        put_demands(c, q[i], demands[i])


@merged
def time_between(speed: FloatArray, q: FloatArray, r: FloatArray) -> float:
    """Time, s, of the straight way between joints at the speed limits (n,)."""
    most = 0.0
    for i in range(q.shape[0]):
        most = max(most, abs(q[i] - r[i]) / speed[i])
    return most


@merged
def _moved(s: FloatArray, before: FloatArray) -> float:
    """Longest way of an image point between two views (2, b, 2), px."""
    most = 0.0
    for view in range(2):
        for k in range(s.shape[1]):
            du, dv = s[view, k, 0] - before[view, k, 0], s[view, k, 1] - before[view, k, 1]
            most = max(most, du * du + dv * dv)
    return math.sqrt(most)


@merged
def _keep_images(trial: "Trial") -> None:
    for view in range(2):
        for k in range(trial.s.shape[1]):
            trial.s_before[view, k, 0], trial.s_before[view, k, 1] = trial.s[view, k, 0], trial.s[view, k, 1]


class Trial(NamedTuple):
    """Workspace of one test of joints, or of the way between two."""

    margins: FloatArray
    demands: FloatArray  # margins, demands: (10,)
    s: FloatArray
    s_before: FloatArray  # s, s_before: (2, b, 2) px
    q: FloatArray  # (n,)
    failures: IntArray  # (10 + n,) how often each margin failed; of the limits, how often each joint


def new_trial(n: int, b: int) -> Trial:
    """Workspace for n joints and b markers."""
    one, s = np.zeros(MARGINS), np.zeros((2, b, 2))
    return Trial(one, one.copy(), s, s.copy(), np.zeros(n), np.zeros(MARGINS + n, np.int64))


@internal
def valid(c: Constraints, q: FloatArray, trial: Trial) -> bool:
    """Whether joints keep all that is asked for; what fails is counted, the images are written."""
    margins, demands = trial.margins, trial.demands
    put_demands(c, q, demands)
    _put_limits(c, q, margins)
    if not margins[LIMITS] >= demands[LIMITS]:
        trial.failures[LIMITS] += 1
        for i in range(q.shape[0]):
            if not min(q[i] - c.lower[i], c.upper[i] - q[i]) / c.keep[i] >= demands[LIMITS]:
                trial.failures[MARGINS + i] += 1
        return False
    _put_sides(c, q, margins)
    for view in range(2):
        if not margins[SIDE + view] > demands[SIDE + view]:
            trial.failures[SIDE + view] += 1
            return False
    if not _put_views(c, q, trial.s, margins, demands[CLEAR]):
        trial.failures[FRONT if not margins[FRONT] > 0.0 else FRONT + 1] += 1
        return False
    for i in (FRONT, FRONT + 1, WIDTH, WIDTH + 1, BORDER, BORDER + 1, CLEAR):
        if not margins[i] >= demands[i]:
            trial.failures[i] += 1
            return False
    return True


@njit
def reached(c: Constraints, start: FloatArray, end: FloatArray, trial: Trial) -> float:
    """Share of the straight way from valid joints that is valid: 1 for all of it.

    Checks are so dense that between two of them no marker moves more than ``FINE_PX`` and no joint more
    than ``FINE_STEP``: a step that did is halved, and the next one made to do so by its speed.
    """
    n = start.shape[0]
    stride = 0.0
    for i in range(n):
        stride = max(stride, abs(end[i] - start[i]))
    if stride == 0.0:
        return 1.0
    least = min(1.0, 1e-6 / stride)
    most = FINE_STEP / stride
    valid(c, start, trial)
    _keep_images(trial)
    done, step = 0.0, 0.25 * most
    while done < 1.0:
        step = min(step, most, 1.0 - done)
        share = 1.0 if done + step >= 1.0 - 1e-12 else done + step
        for i in range(n):
            trial.q[i] = end[i] if share == 1.0 else start[i] + share * (end[i] - start[i])
        if not valid(c, trial.q, trial):
            return done
        moved = _moved(trial.s, trial.s_before)
        if moved > FINE_PX and step > least:
            step *= max(0.25, 0.9 * FINE_PX / moved)
            continue
        _keep_images(trial)
        done = share
        step *= min(2.0, 0.9 * FINE_PX / moved) if moved > 0.0 else 2.0
    return 1.0
