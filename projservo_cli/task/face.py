"""The face: its centre, its oriented plane, and what a task fixes about it."""

from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Vec4, add, meet, scale, unit, vec
from projservo_cli.geometry.jit import njit
from projservo_cli.geometry.lens import straight_views
from projservo_cli.geometry.stereo import fundamental_matrix, optical_centers, triangulate_points
from projservo_cli.records import FloatArray, IntArray, Model, WorkFailed
from projservo_cli.task.body import NO_BODY, Body
from projservo_cli.task.reference import NO_REFERENCE, Reference

MIDPOINT = -1


class Task(NamedTuple):
    """What the control laws know of the task, in the frame of their model.

    Attributes
    ----------
    s_star : (2, m, 2) target pixels of the face.
    A_star : (m, 4) target points, a_inf·A = 1.
    order : (m,) markers around the face, which orients its plane.
    center : index of the centre marker, or ``MIDPOINT``.
    F : (3, 3) fundamental matrix.
    O : (2, 4) optical centres, a_inf·O = 1.
    visible : (2,) sign of a·O on the visible side of the face, one a camera.
    body : all markers of the body, by which the face is measured; none for point by point.
    reference : the plan that is followed; none where every step plans anew.
    """

    s_star: FloatArray
    A_star: FloatArray
    order: IntArray
    center: int
    F: FloatArray
    O: FloatArray
    visible: FloatArray
    body: Body = NO_BODY
    reference: Reference = NO_REFERENCE


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

    The sum of the planes of all triangles centre–marker–next marker: for points of equal scale an
    average weighted by area, whose sign is carried along with the markers by any displacement.
    """
    m = A.shape[0]
    total = (0.0, 0.0, 0.0, 0.0)
    for k in range(m):
        total = add(total, meet(A_c, vec(A[order[k]]), vec(A[order[(k + 1) % m]])))
    return unit(total)


def cyclic_order(A: FloatArray) -> IntArray:
    """Order of the face markers around their midpoint.

    Angles within the plane of the face are measured in affine coordinates, which keep the order.

    Parameters
    ----------
    A : (m, 4) points of the face scaled to a_inf·A = 1.

    Returns
    -------
    (m,) indices.

    Raises
    ------
    WorkFailed
        If there are fewer than three points or they lie on one line.
    """
    if len(A) < 3:
        raise WorkFailed(f"a face needs three markers or more, not {len(A)}: add to markers.face")
    offsets = A - A.mean(axis=0)
    _, sizes, axes = np.linalg.svd(offsets, full_matrices=False)
    if not sizes[1] > 1e-6 * sizes[0]:
        raise WorkFailed("the face markers lie on one line: choose markers.face that span a plane")
    x, y = axes[:2] @ offsets.T
    order = np.argsort(np.arctan2(y, x), kind="stable")
    # The axes have arbitrary signs: begin with the first marker and go on to the lower of its neighbours.
    order = np.roll(order, -int(np.argmin(order)))
    if order[1] > order[-1]:
        order = np.roll(order[::-1], 1)
    return order.astype(np.int64)


def task_from_images(model: Model, s_start: FloatArray, s_star: FloatArray, center: int) -> Task:
    """What the laws know of a task, from images alone.

    Parameters
    ----------
    model : calibrated (or metric) model.
    s_start, s_star : (2, m, 2) pixels of the face at the start and at the goal.
    center : index of the centre marker, or ``MIDPOINT``.

    Raises
    ------
    WorkFailed
        If a marker cannot be triangulated, the face is degenerate, or a camera looks along it.
    """
    A = triangulate_points(model.P, model.a_inf, straight_views(model.lens, s_start))
    A_star = triangulate_points(model.P, model.a_inf, straight_views(model.lens, s_star))
    order = cyclic_order(A_star)
    O = optical_centers(model.P, model.a_inf)
    start = O @ np.array(face_plane(A, order, center_of(A, center)))
    goal = O @ np.array(face_plane(A_star, order, center_of(A_star, center)))
    visible = np.where(start > 0.0, 1.0, -1.0)
    for view, name in enumerate(("left", "right")):
        if visible[view] * goal[view] <= 0.0:
            raise WorkFailed(
                f"the {name} camera sees opposite sides of the face at the start and at the goal: "
                "choose a goal from which both cameras see the side they see at the start"
            )
    return Task(
        np.ascontiguousarray(s_star, dtype=np.float64),
        A_star,
        order,
        center,
        fundamental_matrix(model.P),
        O,
        visible,
    )
