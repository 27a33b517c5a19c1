"""Constraints as signed numbers: joint limits, visibility, image borders, from the calibrated model alone.

The margins are defined in ``planning.motion_margins``. For a tool with several tags, visibility,
width and image come from the tag that keeps them best.

Joints are valid if each margin is above the required one, which is at most a fraction of the margins of start
and goal have themselves, rising to its full value within ``_RISE`` of them.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Mat4, Vec4, apply, axpy, dot, sub, vec
from projservo_cli.geometry.jit import internal, merged, njit
from projservo_cli.geometry.kinematics import (
    backward,
    forward,
    forward_kinematics,
    from_border,
    limit_distance,
    row,
)
from projservo_cli.geometry.null_space import row_into
from projservo_cli.planning.keep_out import NO_KEEP_OUT, SEVERAL, KeepOut, clearance, draws, squared
from projservo_cli.planning.motion_margins import (
    CLEAR,
    CONDITIONING,
    FRONT,
    IMAGE,
    JOINTS,
    VISIBILITY,
    WIDTH,
    Demands,
    column,
    columns_of_kind,
    pixel,
    straight_pixel,
    tag_planes,
)
from projservo_cli.records import NO_SPREAD, FloatArray, IntArray, JointLimits, Model, Spread
from projservo_cli.task.face import Task, center_of, face_plane

# Required fraction of the margins of start and goal near them.
SHARE = 0.5
# Motion, s at the speed limits, from start or goal within which demands rise to their full value.
_RISE = 0.5
# Between two checks no marker moves more than this in an image, px, and no joint more than that, rad or m.
FINE_PX = 4.0
_FINE_STEP = 0.2
# Standard deviations by which a prediction may err.
DEVIATIONS = 3.0
# Maximum error of a marker of the body, over the maximum error of the face.
_FAR_OFF = 5.0
# Half the length, px, of the shortest pieces of a segment that are checked at a region.
_PIECE = 0.5


class Constraints(NamedTuple):
    """Constraints of joints, in the frame of the calibrated model."""

    model: Model  # its cameras scaled so that markers in front have a positive third coordinate
    M: FloatArray  # (b, 4) markers of the body at the reference, the face first
    face: int  # how many are of the face
    tags: IntArray  # (t, k) markers of the face, or of tags, of which one is to be in sight
    a: FloatArray  # (t, 4) their planes at the reference
    O: FloatArray  # (V, 4) optical centres, a·O = 1 of the face at the start if they are before it
    depth: FloatArray  # (V,) minimum third coordinate of a marker at the start
    limits: JointLimits  # limits of the joints
    image_size: FloatArray  # (V, 2) px, of each; infinite if an image has no border
    min_views: int  # number of views that are to see the face, the best ones
    keep: FloatArray  # (n,) distance from a limit that counts as margin one, rad or m
    full: FloatArray  # (c,) margins asked for, in the columns of ``planning.motion_margins``
    ends: FloatArray  # (k, n) start and goals, near which constraints are relaxed
    end_demands: FloatArray  # (k, c) required margins there
    spread: Spread = NO_SPREAD
    keep_out: KeepOut = NO_KEEP_OUT


def constraints_of(
    model: Model,
    A: FloatArray,
    task: Task,
    q_start: FloatArray,
    demands: Demands,
    keep_out: KeepOut = NO_KEEP_OUT,
) -> Constraints:
    """Return the constraints of a task whose points (b, 4) are given at the start, face first.

    Signs are those at the start: [RH00] section 4.2 carries them along.
    """
    m, n, V, tags = len(task.order), len(q_start), len(task.O), demands.tags
    face = np.array(face_plane(A[:m], task.order, center_of(A[:m], task.center)))
    H = forward_kinematics(model, q_start)
    sides = np.sign((A @ model.P[:, 2].T)[0])
    model = model._replace(P=np.ascontiguousarray(model.P * sides[:, None, None]))
    full = np.zeros(column(CONDITIONING, V))
    full[JOINTS], full[columns_of_kind(CLEAR, V)] = 1.0, FINE_PX
    full[columns_of_kind(WIDTH, V)], full[columns_of_kind(IMAGE, V)] = demands.min_face_px, demands.border_px
    return Constraints(
        model=model,
        M=np.ascontiguousarray(A @ np.linalg.inv(H).T),
        face=m,
        tags=tags if len(tags) else np.arange(m)[None],
        a=np.ascontiguousarray((tag_planes(tags, A, m, face) if len(tags) else face[None]) @ H),
        O=np.ascontiguousarray(task.O / (task.visible * np.abs(task.O @ face))[:, None]),
        depth=(A @ model.P[:, 2].T).min(axis=0),
        limits=demands.limits,
        image_size=demands.image_size,
        min_views=demands.min_views or V,
        keep=np.maximum(demands.keep, 1e-9),
        full=full,
        ends=np.zeros((0, n)),
        end_demands=np.zeros((0, len(full))),
        keep_out=keep_out,
    )


@merged
def _limits_into(c: Constraints, q: FloatArray, margins: FloatArray) -> None:
    minimum = math.inf
    for i in range(q.shape[0]):
        minimum = min(minimum, limit_distance(c.limits, q, i) / c.keep[i])
    margins[JOINTS] = minimum


@merged
def _images_into(c: Constraints, H: Mat4, s: FloatArray, margins: FloatArray) -> bool:
    """Write the images (V, b, 2) of the displaced body; False where too few cameras have it before them.

    A camera that has not all of it before it shows nothing.
    """
    V, before = c.O.shape[0], 0
    for view in range(V):
        nearest = math.inf
        for k in range(c.M.shape[0]):
            A = apply(H, vec(c.M[k]))
            depth = row(c.model.P[view], 2, A)
            nearest = min(nearest, depth)
            if depth > 0.0:
                s[view, k, 0], s[view, k, 1] = pixel(c.model, view, A)
        front = nearest / c.depth[view]
        margins[column(FRONT, V) + view] = front
        if front > 0.0:
            before += 1
        else:
            for k in range(c.M.shape[0]):
                s[view, k, 0] = s[view, k, 1] = math.nan
    return before >= c.min_views


@internal
def width(s: FloatArray, which: IntArray) -> float:
    """Least width of some (k,) image points of (b, 2), px: between the nearest parallel lines that hold them.

    One of them goes through two of the points.
    """
    minimum = math.inf
    for i in which:
        for j in which:
            dx, dy = s[i, 0] - s[j, 0], s[i, 1] - s[j, 1]
            length = math.sqrt(dx * dx + dy * dy)
            if j < i and length > 0.0:
                low, high = 0.0, 0.0
                for k in which:
                    off = (dx * (s[k, 1] - s[j, 1]) - dy * (s[k, 0] - s[j, 0])) / length
                    low, high = min(low, off), max(high, off)
                minimum = min(minimum, high - low)
    return minimum if math.isfinite(minimum) else 0.0


@internal
def _sight_into(
    c: Constraints, tag: int, back: Mat4, visible: bool, s: FloatArray, sight: FloatArray
) -> None:
    """Write side, width and border (3 V,) of a tag; the latter by images (V, b, 2), if they are shown.

    back : inverse of the forward kinematics.
    """
    V = c.O.shape[0]
    for view in range(V):
        seen_whole = visible and math.isfinite(s[view, 0, 0])
        sight[view] = dot(vec(c.a[tag]), apply(back, vec(c.O[view])))
        sight[V + view] = width(s[view], c.tags[tag]) if seen_whole else -math.inf
        sight[2 * V + view] = math.inf if seen_whole else -math.inf
        for k in c.tags[tag]:
            border = from_border(c.image_size[view], s[view, k, 0], s[view, k, 1])
            sight[2 * V + view] = min(sight[2 * V + view], border)


@internal
def _excess(c: Constraints, view: int, trial: "Trial") -> float:
    """Least excess of side, width and border of one tag in a view over the required margins."""
    V, minimum = c.O.shape[0], math.inf
    for kind in range(3):
        unit = 1.0 if kind == 0 else FINE_PX
        asked = trial.demands[column(VISIBILITY, V) + kind * V + view]
        minimum = min(minimum, (trial.sight[kind * V + view] - asked) / unit)
    return minimum


@internal
def _rank(trial: "Trial", view: int) -> int:
    """Number of views that show the tag better."""
    better = 0
    for other in range(trial.excess.shape[0]):
        more = trial.excess[other] > trial.excess[view]
        better += more or (trial.excess[other] == trial.excess[view] and other < view)
    return better


@internal
def _best_sight_into(c: Constraints, q: FloatArray, visible: bool, trial: "Trial") -> None:
    """Write side, width and border of the tag whose minimum excess over the required margin is largest.

    The views that count are the best ones; margins of the others are infinite.
    """
    best, back, V = -math.inf, backward(c.model, q), c.O.shape[0]
    first, end = column(VISIBILITY, V), column(CLEAR, V)
    for tag in range(c.tags.shape[0]):
        _sight_into(c, tag, back, visible, trial.s, trial.sight)
        minimum = math.inf
        for view in range(V):
            trial.excess[view] = _excess(c, view, trial)
        for view in range(V):
            if _rank(trial, view) < c.min_views:
                minimum = min(minimum, trial.excess[view])
            else:
                for kind in range(3):
                    trial.sight[kind * V + view] = math.inf
        if tag == 0 or minimum > best:
            best = minimum
            row_into(trial.margins[first:end], trial.sight)
    for view in range(V):
        if trial.margins[first + view] == math.inf:
            trial.margins[column(FRONT, V) + view] = math.inf


@merged
def twin_of(c: Constraints, j: int) -> Model:
    """The calibrated model, changed by the deviation j."""
    m = c.model
    return Model(
        P=c.spread.P[j],
        H_hat_0=c.spread.H_hat[j],
        prismatic=m.prismatic,
        q_reference=m.q_reference,
        a_inf=m.a_inf,
        lens=m.lens,
        on_tool=m.on_tool,
        curve=m.curve,
    )


@internal
def max_error(c: Constraints, q: FloatArray, H: Mat4, trial: "Trial") -> float:
    """Largest standard deviation of a coordinate, px, at the worst marker along each direction.

    That of each image is written to ``trial.error``.
    """
    V, error, worst = c.O.shape[0], trial.error, trial.worst
    for view in range(V):
        error[view] = c.spread.rest * c.spread.rest
    for j in range(1, c.spread.P.shape[0]):
        twin = twin_of(c, j)
        H_j = forward(twin, q)
        for view in range(V):
            worst[view] = 0.0
        for k in range(c.M.shape[0]):
            A, A_j = apply(H, vec(c.M[k])), apply(H_j, vec(c.spread.M[j, k]))
            for view in range(V):
                s, s_j = straight_pixel(c.model.P[view], A), straight_pixel(twin.P[view], A_j)
                worst[view] = max(worst[view], squared(s, s_j))
        for view in range(V):
            error[view] += 0.5 * worst[view]
    maximum = 0.0
    for view in range(V):
        error[view] = math.sqrt(error[view])
        maximum = max(maximum, error[view])
    return maximum


@internal
def clear_by(c: Constraints, H: Mat4, s: FloatArray) -> float:
    """Least distance, px, of the displaced body with images s (V, b, 2) from regions that are kept out of.

    A point is clear if one camera sees it outside a region. Markers of a face that the obstacle may hide
    are so in all images, and all markers in the only image in which a region is drawn.
    """
    keep, minimum = c.keep_out, math.inf
    for region in range(keep.occludes.shape[0]):
        several = keep.views[region] == SEVERAL
        for k in range(c.M.shape[0]):
            in_all = not several or (keep.occludes[region] == 1 and k < c.face)
            clear = math.inf if in_all else -math.inf
            for view in range(c.O.shape[0]):
                if not draws(keep, region, view):
                    continue
                at = (s[view, k, 0], s[view, k, 1])
                here = clearance(keep, region, view, at)
                if in_all:
                    clear = min(clear, here)
                else:
                    clear = max(clear, min(here, from_border(c.image_size[view], at[0], at[1])))
            minimum = min(minimum, clear)
        for k in range(c.face if several else 0):
            A = apply(H, vec(c.M[k]))
            for l in range(k):
                minimum = min(minimum, _clear_between(c, region, A, apply(H, vec(c.M[l]))))
    return minimum


@internal
def _clear_between(c: Constraints, region: int, A: Vec4, B: Vec4) -> float:
    """Least distance, px, of a segment from a region of both images, as above; never too large.

    Pieces of it, of the segment in space and so the same in all images, are halved until their images are
    short, or short against the distance of their middles and on one side of the required margin: a distance
    changes by no more than the path.
    """
    minimum, done, step = math.inf, 0.0, 1.0
    while done < 1.0:
        step = min(step, 1.0 - done)
        first, middle, last = (
            _combined(done, A, B),
            _combined(done + 0.5 * step, A, B),
            _combined(done + step, A, B),
        )
        here, along, half = -math.inf, -math.inf, 0.0
        for view in range(c.O.shape[0]):
            if not draws(c.keep_out, region, view):
                continue
            s, at, t = pixel(c.model, view, first), pixel(c.model, view, middle), pixel(c.model, view, last)
            radius = math.sqrt(max(squared(at, s), squared(at, t)))
            clear = min(
                clearance(c.keep_out, region, view, at), from_border(c.image_size[view], at[0], at[1])
            )
            here, along, half = max(here, clear), max(along, clear - radius), max(half, radius)
        decided = along >= c.full[CLEAR] or here < c.full[CLEAR]
        if half > _PIECE and not (decided and half <= 0.5 * abs(here)):
            step *= 0.5
            continue
        minimum = min(minimum, along)
        done += step
        step *= 2.0
    return minimum


@merged
def _combined(x: float, A: Vec4, B: Vec4) -> Vec4:
    """Point (1 − x) A + x B."""
    return axpy(x, sub(B, A), A)


@njit
def margins_into(c: Constraints, q: FloatArray, trial: "Trial") -> None:
    """Write margins, required margins, and images at joints (n,), rad or m."""
    margins, s, V = trial.margins, trial.s, c.O.shape[0]
    clear, image = column(CLEAR, V), column(IMAGE, V)
    demands_into(c, q, trial.demands)
    _limits_into(c, q, margins)
    H = forward(c.model, q)
    visible = _images_into(c, H, s, margins)
    _best_sight_into(c, q, visible, trial)
    margins[clear] = clear_by(c, H, s) if visible else -math.inf
    # Error of a prediction: its maximum or, if that could decide, its value there.
    maximum, room = c.spread.max_sigma, math.inf
    anywhere = _FAR_OFF * maximum
    for view in range(V):
        trial.error[view] = maximum
        room = min(room, margins[image + view] - c.full[image + view])
    near = room < DEVIATIONS * maximum or margins[clear] - c.full[clear] < DEVIATIONS * anywhere
    if visible and maximum > 0.0 and near:
        anywhere = max_error(c, q, H, trial)
    for view in range(V):
        margins[image + view] -= DEVIATIONS * trial.error[view]
    margins[clear] -= DEVIATIONS * anywhere


@njit
def margins_along_into(c: Constraints, q: FloatArray, trial: "Trial", margins: FloatArray) -> None:
    """Write margins and required margins (2, k, c) along joints (k, n)."""
    for i in range(q.shape[0]):
        margins_into(c, q[i], trial)
        row_into(margins[0, i], trial.margins)
        row_into(margins[1, i], trial.demands)


@njit
def demands_into(c: Constraints, q: FloatArray, demands: FloatArray) -> None:
    """Write the required margins (c,) at joints (n,): the full ones, or less near start and goals."""
    for i in range(c.full.shape[0]):
        demands[i] = c.full[i]
    for e in range(c.ends.shape[0]):
        rise = time_between(c.limits.speed, q, c.ends[e]) / _RISE
        if rise < 1.0:
            for i in range(c.full.shape[0]):
                demands[i] = min(demands[i], c.end_demands[e, i] + rise * (c.full[i] - c.end_demands[e, i]))


@merged
def time_between(speed: FloatArray, q: FloatArray, r: FloatArray) -> float:
    """Time, s, of the straight path between joints at the speed limits (n,)."""
    maximum = 0.0
    for i in range(q.shape[0]):
        maximum = max(maximum, abs(q[i] - r[i]) / speed[i])
    return maximum


@merged
def _moved(s: FloatArray, before: FloatArray) -> float:
    """Longest way of an image point that is seen before and after, of images (V, b, 2), px."""
    maximum = 0.0
    for view in range(s.shape[0]):
        for k in range(s.shape[1]):
            du, dv = s[view, k, 0] - before[view, k, 0], s[view, k, 1] - before[view, k, 1]
            if math.isfinite(du + dv):
                maximum = max(maximum, du * du + dv * dv)
    return math.sqrt(maximum)


@merged
def _keep_images(trial: "Trial") -> None:
    for view in range(trial.s.shape[0]):
        for k in range(trial.s.shape[1]):
            row_into(trial.s_before[view, k], trial.s[view, k])


class Trial(NamedTuple):
    """Workspace of one test of joints, or of the path between two."""

    margins: FloatArray
    demands: FloatArray  # margins, demands: (c,)
    sight: FloatArray  # (3 V,) side, width and border of one tag
    excess: FloatArray  # (V,) minimum excess of these in each view
    error: FloatArray  # (V,) error of a prediction in each image, px
    worst: FloatArray  # (V,) squared error, px², along one direction
    s: FloatArray
    s_before: FloatArray  # s, s_before: (V, b, 2) px
    q: FloatArray  # (n,)
    failures: IntArray  # (c + n,) how often each margin failed; of the limits, how often each joint


def new_trial(c: Constraints) -> Trial:
    """Workspace for tests of constraints."""
    (V, n), b = (len(c.O), len(c.keep)), len(c.M)
    margins, s = np.zeros_like(c.full), np.zeros((V, b, 2))
    return Trial(
        margins=margins,
        demands=margins.copy(),
        sight=np.zeros(3 * V),
        excess=np.zeros(V),
        error=np.zeros(V),
        worst=np.zeros(V),
        s=s,
        s_before=s.copy(),
        q=np.zeros(n),
        failures=np.zeros(len(margins) + n, np.int64),
    )


@internal
def _valid(c: Constraints, q: FloatArray, trial: Trial) -> bool:
    """Tell whether joints keep all margins; count failures, write the images."""
    margins_into(c, q, trial)
    for i in range(c.full.shape[0]):
        if not trial.margins[i] > trial.demands[i]:
            trial.failures[i] += 1
            for j in range(q.shape[0] if i == JOINTS else 0):
                room = limit_distance(c.limits, q, j) / c.keep[j]
                trial.failures[c.full.shape[0] + j] += not room > trial.demands[JOINTS]
            return False
    return True


@njit
def reached(c: Constraints, start: FloatArray, end: FloatArray, trial: Trial) -> float:
    """Share of the straight path from valid joints that is valid: 1 for all of it.

    Checks are so dense that between two of them no marker moves more than ``FINE_PX`` and no joint more
    than ``_FINE_STEP``: a step that did is halved, and the next one made to do so by its speed.
    """
    n = start.shape[0]
    stride = 0.0
    for i in range(n):
        stride = max(stride, abs(end[i] - start[i]))
    if stride == 0.0:
        return 1.0
    minimum = min(1.0, 1e-6 / stride)
    maximum = _FINE_STEP / stride
    _valid(c, start, trial)
    _keep_images(trial)
    done, step = 0.0, 0.25 * maximum
    while done < 1.0:
        step = min(step, maximum, 1.0 - done)
        share = 1.0 if done + step >= 1.0 - 1e-12 else done + step
        for i in range(n):
            trial.q[i] = end[i] if share == 1.0 else start[i] + share * (end[i] - start[i])
        if not _valid(c, trial.q, trial):
            return done
        moved = _moved(trial.s, trial.s_before)
        if moved > FINE_PX and step > minimum:
            step *= max(0.25, 0.9 * FINE_PX / moved)
            continue
        _keep_images(trial)
        done = share
        step *= min(2.0, 0.9 * FINE_PX / moved) if moved > 0.0 else 2.0
    return 1.0
