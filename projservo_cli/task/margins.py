"""How far a planned instant is from what must not happen: the margins of a plan.

Each margin is a number, positive where its constraint holds:

- visibility: a·O of the face and a camera over its value at the start, in closed form over the shares
  μ_t, μ_r, [RH00] section 4.2; 0 where the camera looks along the face;
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

from projservo_cli.geometry.algebra import Mat4, apply, axpy, dot, mat, put_vec, vec
from projservo_cli.geometry.jit import internal, njit
from projservo_cli.geometry.kernels import orthogonalize
from projservo_cli.geometry.kinematics import image_velocity, row
from projservo_cli.geometry.lens import bend
from projservo_cli.geometry.mechanisms import COORDINATES, Work
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.trajectory import displaced
from projservo_cli.task.visibility import margin_coefficients

CONSTRAINTS = ("visibility", "image", "joints", "conditioning")
VISIBILITY, IMAGE, JOINTS, CONDITIONING = range(4)
# A margin this bad is as bad as it gets: a marker behind the camera, joints out of reach.
WORST = -10.0


class Demands(NamedTuple):
    """What a planned motion must keep to.

    Attributes
    ----------
    lower, upper : (n,) joint limits, rad or m.
    speed : (n,) most joint motion per second, rad/s or m/s; infinite for none.
    image_size : (2,) width and height of both images, px; infinite where an image has no border.
    border_px : least distance of a marker from the border of an image, px.
    conditioning : least reciprocal condition of the image Jacobian of the face.
    miss_px : how far the images of the face may stay behind the planned ones where the joints cannot
        follow them, px; 0 where they have to.
    """

    lower: FloatArray
    upper: FloatArray
    speed: FloatArray
    image_size: FloatArray
    border_px: float
    conditioning: float
    miss_px: float = 0.0


def within(lower: FloatArray, upper: FloatArray) -> Demands:
    """Demands of joint limits alone, (n,) rad or m."""
    endless = np.full(len(lower), math.inf)
    return Demands(lower, upper, endless, np.full(2, math.inf), 0.0, 0.0)


class Reaching(NamedTuple):
    """A partitioned task as the planner sees it.

    Attributes
    ----------
    model : calibrated model; a_inf·M keeps its scale under all displacements.
    demands : what the motion must keep to.
    H_hat : (3, 4, 4) operators t, r, p.
    amplitudes : (3,) τ in the unit of Ĥ_t, θ_r and θ_p in rad.
    A : (m, 4) face at the start.
    a : (4,) its plane.
    O : (2, 4) optical centres.
    q_start : (n,) joints at the start, rad or m.
    scale : (4,) margin of each of ``CONSTRAINTS`` at the worse of both ends; 1 where that fails it.
    """

    model: Model
    demands: Demands
    H_hat: FloatArray
    amplitudes: FloatArray
    A: FloatArray
    a: FloatArray
    O: FloatArray
    q_start: FloatArray
    scale: FloatArray


@njit
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
def border_distance(
    m: tuple[float, float, float], depth: float, image_size: FloatArray, lens: FloatArray
) -> float:
    """Distance of a pixel from the nearest border, px, negative outside; −1e9 where no camera shows it.

    Parameters
    ----------
    m : homogeneous pixel.
    depth : third coordinate of the marker at the start, where it is in front of the camera.
    lens : (5,) radial distortion of the view.
    """
    if not m[2] * depth > 1e-9 * depth * depth:
        return -1e9
    u, v = bend(lens, m[0] / m[2], m[1] / m[2])
    if not (math.isfinite(u) and math.isfinite(v)):
        return -1e9
    across = min(u + 0.5, float(image_size[0]) - 0.5 - u)
    return min(across, min(v + 0.5, float(image_size[1]) - 0.5 - v))


@njit
def image_margin(distance: float, demands: Demands) -> float:
    """Margin of a distance from the border, px; 1 where images have no border."""
    half = 0.5 * min(float(demands.image_size[0]), float(demands.image_size[1]))
    if not math.isfinite(half):
        return 1.0 if distance > 0.0 else WORST
    return max(WORST, (distance - demands.border_px) / (half - demands.border_px))


@njit
def image_distance(reaching: Reaching, view: int, H: Mat4) -> float:
    """Least distance of the displaced markers from the border of one image, px."""
    P, lens = reaching.model.P[view], reaching.model.lens[view]
    least = math.inf
    for k in range(reaching.A.shape[0]):
        A = vec(reaching.A[k])
        M = apply(H, A)
        m = (row(P, 0, M), row(P, 1, M), row(P, 2, M))
        least = min(least, border_distance(m, row(P, 2, A), reaching.demands.image_size, lens))
    return least


@njit
def view_share(reaching: Reaching, mu_t: float, mu_r: float, mu_p: float) -> float:
    """Smallest share of visibility and image over both cameras."""
    H = displaced(reaching.H_hat, reaching.amplitudes, mu_t, mu_r, mu_p)
    least = math.inf
    for view in range(2):
        least = min(least, visibility_margin(reaching, view, mu_t, mu_r) / reaching.scale[VISIBILITY])
        distance = image_distance(reaching, view, H)
        least = min(least, image_margin(distance, reaching.demands) / reaching.scale[IMAGE])
    return least


@njit
def limit_margin(q: FloatArray, demands: Demands) -> float:
    """Smallest margin of the joint limits; 1 where there are none."""
    least = 1.0
    for i in range(q.shape[0]):
        span = float(demands.upper[i]) - float(demands.lower[i])
        if math.isfinite(span):
            least = min(least, 2.0 * min(q[i] - demands.lower[i], demands.upper[i] - q[i]) / span)
    return max(WORST, least)


@internal
def image_jacobian(reaching: Reaching, H: Mat4, jacobian: Work, M: FloatArray) -> None:
    """Image Jacobian of the displaced face in the workspace, a column a joint, [RH00] eq. (7).

    Parameters
    ----------
    H : displacement from the start.
    jacobian : workspace of 4m rows with the operators at the current joints in ``H_hat``.
    M : (2, 4) workspace.
    """
    for k in range(reaching.A.shape[0]):
        put_vec(M[0], apply(H, vec(reaching.A[k])))
        for i in range(jacobian.H_hat.shape[0]):
            put_vec(M[1], apply(mat(jacobian.H_hat[i]), vec(M[0])))
            for view in range(2):
                _, _, du, dv = image_velocity(reaching.model.P[view], M[0], M[1])
                jacobian.B[i, 4 * k + 2 * view] = du
                jacobian.B[i, 4 * k + 2 * view + 1] = dv


@internal
def reciprocal_condition(
    reaching: Reaching, H: Mat4, jacobian: Work, M: FloatArray, norms: FloatArray
) -> float:
    """Reciprocal condition of the image Jacobian of the displaced face.

    The ratio of the last to the first pivot of an orthogonalisation, which no projective frame changes.

    Parameters
    ----------
    H, jacobian, M : as of ``image_jacobian``.
    norms : (n,) workspace.
    """
    n = jacobian.H_hat.shape[0]
    m = reaching.A.shape[0]
    image_jacobian(reaching, H, jacobian, M)
    first, _, last = orthogonalize(
        jacobian.B, 4 * m, n, norms, jacobian.z, jacobian.pivot, jacobian.rhs, False
    )
    if n > COORDINATES:  # further joints add no motion of the face
        sixth = jacobian.B[COORDINATES - 1, COORDINATES - 1]
        last = 1.0 / sixth if sixth > 0.0 else 0.0
    return last / first if first > 0.0 else 0.0
