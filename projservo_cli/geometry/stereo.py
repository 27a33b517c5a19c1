"""Two views of a point: epipolar geometry, optical centres and optimal triangulation."""

import math

import numpy as np

from projservo_cli.geometry.algebra import Vec4, dot, meet, scale, vec, vec_into
from projservo_cli.geometry.jit import inline, merged
from projservo_cli.records import FloatArray, IntArray, WorkFailed

NO_POINT = "marker {} of the face: its two rays do not meet in a finite point"
# Rows of a camera other than the first, second or third.
_OTHERS = np.array([[1, 2], [0, 2], [0, 1]])
# Signs of the minors.
_SIGNS = np.array([[1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, -1.0, 1.0]])


@merged
def _plane_of(P: FloatArray, l0: float, l1: float, l2: float) -> Vec4:
    """Plane Pᵀ l that a camera sees as the line l."""
    return (
        float(P[0, 0]) * l0 + float(P[1, 0]) * l1 + float(P[2, 0]) * l2,
        float(P[0, 1]) * l0 + float(P[1, 1]) * l1 + float(P[2, 1]) * l2,
        float(P[0, 2]) * l0 + float(P[1, 2]) * l1 + float(P[2, 2]) * l2,
        float(P[0, 3]) * l0 + float(P[1, 3]) * l1 + float(P[2, 3]) * l2,
    )


@merged
def triangulate(
    P: FloatArray, pair: IntArray, F: FloatArray, a_inf: FloatArray, s: FloatArray, k: int
) -> tuple[bool, Vec4]:
    """Point of minimum reprojection error from one pixel in each view, scaled to a_inf·M = 1.

    Two iterations of P. Lindstrom, "Triangulation Made Easy", CVPR 2010, move both pixels onto corresponding
    epipolar lines, within round-off of the optimum. Then the left ray meets the plane of the line through the
    right pixel that is perpendicular to its epipolar line.

    P : (V, 3, 4) cameras; pair : (2,) views, the left and the right one; F : (3, 3) their fundamental matrix.
    s : (V, m, 2) pixels, of which the pixels of marker k are taken.
    Returns false and zeros if the rays do not determine a finite point.
    """
    left, right = pair[0], pair[1]
    u = float(s[left, k, 0])
    v = float(s[left, k, 1])
    x = float(s[right, k, 0])
    y = float(s[right, k, 1])
    f00, f01, f02 = float(F[0, 0]), float(F[0, 1]), float(F[0, 2])
    f10, f11, f12 = float(F[1, 0]), float(F[1, 1]), float(F[1, 2])
    f20, f21, f22 = float(F[2, 0]), float(F[2, 1]), float(F[2, 2])
    # Normals of the epipolar lines, left then right; F maps left pixels to right lines.
    n0 = f00 * x + f10 * y + f20
    n1 = f01 * x + f11 * y + f21
    k0 = f00 * u + f01 * v + f02
    k1 = f10 * u + f11 * v + f12
    size = (n0 * n0 + n1 * n1) + (k0 * k0 + k1 * k1)
    nothing = (0.0, 0.0, 0.0, 0.0)
    # At the epipoles both normals vanish; round-off leaves 1e-32 of their natural size.
    natural = ((f00 * f00 + f01 * f01) + (f10 * f10 + f11 * f11)) * ((u * u + v * v) + (x * x + y * y))
    natural += (f02 * f02 + f12 * f12) + (f20 * f20 + f21 * f21)
    if not size > 1e-24 * natural:
        return False, nothing
    residual = x * k0 + y * k1 + (f20 * u + f21 * v + f22)
    a = k0 * (f00 * n0 + f01 * n1) + k1 * (f10 * n0 + f11 * n1)
    b = 0.5 * size
    d = math.sqrt(max(b * b - a * residual, 0.0))
    step = residual / (b + d)
    p0 = n0 - step * (f00 * k0 + f10 * k1)
    p1 = n1 - step * (f01 * k0 + f11 * k1)
    k0, k1 = k0 - step * (f00 * n0 + f01 * n1), k1 - step * (f10 * n0 + f11 * n1)
    size = (p0 * p0 + p1 * p1) + (k0 * k0 + k1 * k1)
    if not size > 0.0:
        return False, nothing
    step *= 2.0 * d / size
    u -= step * p0
    v -= step * p1
    x -= step * k0
    y -= step * k1
    M = meet(
        _plane_of(P[left], 1.0, 0.0, -u),
        _plane_of(P[left], 0.0, 1.0, -v),
        _plane_of(P[right], -k1, k0, k1 * x - k0 * y),
    )
    w = dot(vec(a_inf), M)
    if w * w <= 1e-28 * dot(M, M) or not w * w > 0.0:
        return False, nothing
    return True, scale(1.0 / w, M)


def fundamental_matrix(P: FloatArray) -> FloatArray:
    """Fundamental matrix F with rightᵀ F left = 0 of a pair of cameras (2, 3, 4).

    Of unit norm, (3, 3). Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., eq. (17.3).

    Raises WorkFailed if both cameras share one centre.
    """
    rows = np.empty((3, 3, 4, 4))
    rows[:, :, :2] = P[0][_OTHERS]
    rows[:, :, 2:] = P[1][_OTHERS][:, None]
    F: FloatArray = _SIGNS * np.linalg.det(rows)
    norm = float(np.linalg.norm(F))
    if not norm > 0.0:
        raise WorkFailed("both cameras have the same centre: a stereo rig needs a baseline")
    return F / norm


def optical_centers(P: FloatArray, a_inf: FloatArray) -> FloatArray:
    """Optical centres (V, 4) of the cameras (V, 3, 4), scaled to a_inf·O = 1."""
    centers = np.array([np.linalg.svd(camera)[2][3] for camera in P])
    result: FloatArray = centers / (centers @ a_inf)[:, None]
    return result


def triangulate_points(P: FloatArray, a_inf: FloatArray, s: FloatArray) -> FloatArray:
    """Points (m, 4) of minimum reprojection error from stereo pixels (2, m, 2), scaled to a_inf·M = 1.

    Raises WorkFailed if the rays of a marker do not determine a finite point.
    """
    M = np.empty((s.shape[1], 4))
    # Contiguous, as machine code is made for one layout of arrays alone.
    lost = points_into(P, np.arange(2), fundamental_matrix(P), a_inf, np.ascontiguousarray(s), M)
    if lost >= 0:
        raise WorkFailed(NO_POINT.format(lost))
    return M


@inline
def points_into(
    P: FloatArray, pair: IntArray, F: FloatArray, a_inf: FloatArray, s: FloatArray, M: FloatArray
) -> int:
    """Triangulate the first m pixels of a pair of views into M (m, 4); the first without a point, or −1."""
    for k in range(M.shape[0]):
        finite, point = triangulate(P, pair, F, a_inf, s, k)
        if not finite:
            return k
        vec_into(M[k], point)
    return -1
