"""The face: its centre, its oriented plane, and what a task fixes about it."""

from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Vec4, add, meet, scale, unit, vec
from projservo_cli.geometry.jit import njit
from projservo_cli.records import FloatArray, IntArray, WorkFailed

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
    """

    s_star: FloatArray
    A_star: FloatArray
    order: IntArray
    center: int
    F: FloatArray
    O: FloatArray
    visible: FloatArray


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
    return order.astype(np.int64)
