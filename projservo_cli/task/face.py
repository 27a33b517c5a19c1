"""The face: its centre, its oriented plane, and the task that control laws read."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry import stereo
from projservo_cli.geometry.algebra import Vec4, add, axpy, dot, meet, scale, sub, unit, vec
from projservo_cli.geometry.jit import inline, merged, njit
from projservo_cli.geometry.stereo import fundamental_matrix, optical_centers, points_into
from projservo_cli.records import VIEWS, FloatArray, IntArray, Model, WorkFailed
from projservo_cli.task.body_pose import NO_BODY, Body
from projservo_cli.task.incidences import NO_INCIDENCES, Incidences
from projservo_cli.task.trajectory import NO_REFERENCE, Reference

# Index of the centre if it is the mean of all markers.
MIDPOINT = -1
# Offset across the longest one, over its length, below which markers lie on one line.
_ON_A_LINE = 1e-6
# No axis, in a search for the longest offset.
_NO_AXIS: Vec4 = (0.0, 0.0, 0.0, 0.0)

# Codes of the check of a task's images: no problem.
FOUND = 0
# A marker cannot be triangulated.
_NO_POINT = 1
# The markers lie on one line.
ONE_LINE = 2
# A camera sees other sides of the face at start and goal.
_OTHER_SIDE = 3
# A joint motion of the task is not unique at the start.
NOT_UNIQUE = 5
# The images at the start show too few markers of the body.
UNSEEN_START = 6
# Those at the goal do.
UNSEEN_GOAL = 7
# The markers at the start do not fit the body.
MISFIT_START = 8
# Those at the goal do not.
MISFIT_GOAL = 9
# The face cannot be triangulated at the start.
NOT_MEASURED = 10
_SIDES = (
    "the {} camera sees one side of the face at the start and the other at the goal, by the order of its "
    "markers: move the goal, or the start, to where that camera sees the printed side"
)
_UNSEEN = (
    "the images at the {} show {{}} markers in all views together, too few to locate the body: show three "
    "or more, not on one line"
)
_MISFIT = (
    "the images at the {} fit no pose of the calibrated body: check the marker numbers, or measure point by "
    "point with control.features: points"
)
_PROBLEMS = {
    _NO_POINT: stereo.NO_POINT,
    _OTHER_SIDE: _SIDES,
    ONE_LINE: "the face markers lie on one line: choose markers.face that span a plane",
    NOT_UNIQUE: "the joint motion of the task is not unique at the start: the robot is near a singularity or "
    "moves the face in fewer than six directions",
    UNSEEN_START: _UNSEEN.format("start"),
    UNSEEN_GOAL: _UNSEEN.format("goal"),
    MISFIT_START: _MISFIT.format("start"),
    MISFIT_GOAL: _MISFIT.format("goal"),
    NOT_MEASURED: "the face cannot be triangulated at the start: both cameras must see all its markers",
}


class Task(NamedTuple):
    """Task of the control laws, in the frame of their model."""

    s_star: FloatArray  # (V, m, 2) target pixels of the face
    A_star: FloatArray  # (m, 4) target points, a_inf·A = 1
    order: IntArray  # (m,) markers around the face, which orients its plane
    center: int  # index of the centre marker, or ``MIDPOINT``
    pair: IntArray  # (2,) views from which the face is triangulated; none of one view
    F: FloatArray  # (3, 3) fundamental matrix of the pair
    O: FloatArray  # (V, 4) optical centres, a_inf·O = 1
    visible: FloatArray  # (V,) sign of a·O on the visible side of the face, one per camera
    min_views: int  # number of views that are to see the face
    body: Body = NO_BODY  # all markers of the body, to measure the face with; none for point by point
    reference: Reference = NO_REFERENCE  # plan to follow; none to regulate to the goal
    incidences: Incidences = NO_INCIDENCES  # that are to hold at the goal; none for the pose


@njit
def center_of(A: FloatArray, center: int) -> Vec4:
    """Centre of the face: a marker, or the mean of points scaled to a_inf·A = 1."""
    if center >= 0:
        return vec(A[center])
    m = A.shape[0]
    total = vec(A[0])
    for k in range(1, m):
        total = add(total, vec(A[k]))
    return scale(1.0 / m, total)


@njit
def face_plane(A: FloatArray, order: IntArray, A_c: Vec4) -> Vec4:
    """Oriented plane of unit norm through the centre that fits the face.

    The sum of the planes of all triangles centre–marker–next marker, which for points of equal scale is an
    average weighted by area. Any displacement carries its sign along with the markers.
    """
    m = A.shape[0]
    total = (0.0, 0.0, 0.0, 0.0)
    for k in range(m):
        total = add(total, meet(A_c, vec(A[order[k]]), vec(A[order[(k + 1) % m]])))
    return unit(total)


@inline
def order_into(A: FloatArray, order: IntArray, angle: FloatArray) -> bool:
    """Order the markers around their midpoint; False if they lie on one line.

    Angles are in affine coordinates of the plane of the face, which preserve the order: along the longest
    offset from the midpoint, and along the one farthest off it. The order begins with the first marker and
    its neighbour of lower index, in any frame.

    A : (m, 4) points scaled to a_inf·A = 1, three or more; order : (m,) on return the indices; angle : (≥m,)
        workspace.
    """
    m = A.shape[0]
    middle = center_of(A, MIDPOINT)
    x_axis = _longest_offset(A, middle, _NO_AXIS)
    y_axis = _longest_offset(A, middle, x_axis)
    if not dot(y_axis, y_axis) > _ON_A_LINE * _ON_A_LINE * dot(x_axis, x_axis):
        return False
    x_axis, y_axis = unit(x_axis), unit(y_axis)
    for k in range(m):
        offset = sub(vec(A[k]), middle)
        angle[k] = math.atan2(dot(offset, y_axis), dot(offset, x_axis))
    order[0] = 0
    for k in range(1, m):
        angle[k] -= angle[0]
        if angle[k] < 0.0:
            angle[k] += 2.0 * math.pi
        place = k
        while place > 1 and angle[order[place - 1]] > angle[k]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
    if order[1] > order[m - 1]:
        for i in range(1, (m + 1) // 2):
            order[i], order[m - i] = order[m - i], order[i]
    return True


@inline
def _longest_offset(A: FloatArray, middle: Vec4, axis: Vec4) -> Vec4:
    """Longest component perpendicular to an axis, if any, of the offsets of points (m, 4) from the middle."""
    size = dot(axis, axis)
    longest = _NO_AXIS
    for k in range(A.shape[0]):
        offset = sub(vec(A[k]), middle)
        if size > 0.0:
            offset = axpy(-dot(offset, axis) / size, axis, offset)
        if dot(offset, offset) > dot(longest, longest):
            longest = offset
    return longest


def cyclic_order(A: FloatArray) -> IntArray:
    """Order (m,) of markers around their midpoint, as of ``order_into``, for points (m, 4), a_inf·A = 1.

    Raises WorkFailed if there are fewer than three points or they lie on one line.
    """
    _require_three(len(A))
    order = np.zeros(len(A), dtype=np.int64)
    if not order_into(A, order, np.zeros(len(A))):
        raise WorkFailed(_PROBLEMS[ONE_LINE])
    return order


def _require_three(m: int) -> None:
    if m < 3:
        raise WorkFailed(f"a face of {m} markers (3 required): add markers to markers.face")


@inline
def task_into(
    model: Model, images: FloatArray, task: Task, A: FloatArray, angle: FloatArray
) -> tuple[int, int]:
    """Complete a task from images at start and goal: target points, order of the markers, visible side.

    With a body ``body_task_into`` completes points and side; without a pair of views that show the face all.

    images : (2, V, ≥m, 2) undistorted pixels at the start and at the goal, the m markers of the face first.
    task : as of ``new_task``; on return complete.
    A : (m, 4) on return the face at the start.
    angle : (≥m,) workspace.
    Returns the code of a problem, ``FOUND`` if there is none, and the marker it concerns.
    """
    if task.pair.shape[0] == 0:
        return FOUND, 0
    lost = points_into(model.P, task.pair, task.F, model.a_inf, images[0], A)
    if lost < 0:
        lost = points_into(model.P, task.pair, task.F, model.a_inf, images[1], task.A_star)
    if lost >= 0:
        return _NO_POINT, lost
    if not order_into(task.A_star, task.order, angle):
        return ONE_LINE, 0
    if task.body.M.shape[0] > 0:  # the body determines the plane better than points do edge-on
        return FOUND, 0
    return sides_into(task, A, images[0])


@merged
def sides_into(task: Task, A: FloatArray, s: FloatArray) -> tuple[int, int]:
    """Record the side of the face A (m, 4) that each camera sees at the start, by its images s (V, ≥m, 2).

    The side of a camera that shows none of it follows from another one. Returns a code if more cameras than
    may be left out see another side at the goal, and the first of them.
    """
    a = face_plane(A, task.order, center_of(A, task.center))
    a_star = face_plane(task.A_star, task.order, center_of(task.A_star, task.center))
    V = task.O.shape[0]
    side = 0.0
    for view in range(V - 1, -1, -1):
        if _shows(s, view, A.shape[0]):
            side = 1.0 if dot(vec(task.O[view]), a) > 0.0 else -1.0
    count, first = V, -1
    for view in range(V):
        O = vec(task.O[view])
        task.visible[view] = 1.0 if dot(O, a) > 0.0 else -1.0
        if side != 0.0 and not _shows(s, view, A.shape[0]):
            task.visible[view] = side
        if task.visible[view] * dot(O, a_star) <= 0.0:
            count -= 1
            first = view if first < 0 else first
    return (FOUND, 0) if count >= task.min_views else (_OTHER_SIDE, first)


@inline
def _shows(s: FloatArray, view: int, m: int) -> bool:
    """Whether a view of images (V, ≥m, 2) has one of the first m markers."""
    for k in range(m):
        if math.isfinite(s[view, k, 0]):
            return True
    return False


def require_found(status: int, detail: int, view: Sequence[str] = VIEWS) -> None:
    """Raise WorkFailed with the message of a code other than ``FOUND``; ``view`` are the names of views."""
    if status != FOUND:
        raise WorkFailed(_PROBLEMS[status].format(view[detail] if status == _OTHER_SIDE else detail))


def new_task(
    model: Model, s_star: FloatArray, center: int, pair: IntArray | None = None, min_views: int = 0
) -> Task:
    """Task with pixels (V, m, 2) of the face at the goal, without target points yet.

    pair : (2,) views from which the face is triangulated, (0,) for none; None for the only two.
    min_views : that are to see the face, 0 for all.
    Raises WorkFailed if there are fewer than three markers, or both cameras have the same centre.
    """
    m, pair = s_star.shape[1], np.arange(2) if pair is None else pair
    _require_three(m)
    return Task(
        s_star=np.array(s_star, dtype=np.float64, order="C"),
        A_star=np.zeros((m, 4)),
        order=np.zeros(m, dtype=np.int64),
        center=center,
        pair=pair,
        F=fundamental_matrix(model.P[pair]) if len(pair) else np.zeros((3, 3)),
        O=optical_centers(model.P, model.a_inf),
        visible=np.zeros(len(model.P)),
        min_views=min_views or len(model.P),
    )
