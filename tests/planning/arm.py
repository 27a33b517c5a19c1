"""Grid search for a monotone path that the joints of a true arm can follow, beside ``oracle``.

In metres and radians, by the rigid motions of the true screws; nothing here calls the code under test.
Joints are carried from node to node by Newton's method on the pose, each node from the best one before
it. They can follow where they keep their limits, move by at most ``MOST_STRIDE`` from node to node, do not
jump over a singular configuration on the way (the determinant of the twists keeps its sign), and the
image Jacobian of the face stays as well conditioned as is asked for.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from scipy.ndimage import binary_erosion

from tests.planning.oracle import NODES, connected, turn

# Most joint motion between neighbouring nodes, rad.
MOST_STRIDE = 0.5
MOST_NEWTON = 5
SETTLED = 1e-5
JOINTS = 6
compiled = numba.njit(cache=True, error_model="numpy", nogil=True)


class Arm(NamedTuple):
    """A true arm of six revolute joints.

    Attributes
    ----------
    w, v : (6, 3) axes and moments of the screws at the reference, 1 and m.
    reference, lower, upper : (6,) joints, rad.
    P : (2, 3, 4) cameras, px.
    M : (m, 3) markers of the face at the reference, m.
    conditioning : least reciprocal condition of the image Jacobian, by pivots.
    """

    w: np.ndarray
    v: np.ndarray
    reference: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    P: np.ndarray
    M: np.ndarray
    conditioning: float


def arm_of(truth, conditioning):
    """The arm, rig and face of a truth."""
    robot = truth.robot
    S = robot.H_hat_0
    w = np.stack([S[:, 2, 1], S[:, 0, 2], S[:, 1, 0]], axis=1)
    bounds = (robot.q_reference, robot.lower, robot.upper)
    M = np.ascontiguousarray(truth.M_face[:, :3])
    return Arm(w, np.ascontiguousarray(S[:, :3, 3]), *bounds, truth.P, M, conditioning)


def feasible(arm, true, q_start, cells=0):
    """Whether a monotone path stays in sight and in both images and the joints can follow it.

    Parameters
    ----------
    true : the task, a ``TrueTask``.
    q_start : (6,) joints at the start, rad.
    cells : how far the path has to keep from nodes that are not free.
    """
    for senses in true.senses():
        free = true.free(*senses)
        if not connected(free):
            continue
        x = np.linspace(0.0, 1.0, NODES)
        c = true.c + x[:, None] * (true.c_goal - true.c)
        motion = (true.c, c, turn(true.axis, x * senses[0]), turn(true.n, x * senses[1]), q_start)
        steps = np.abs(x[:, None] - x) * (NODES - 1)
        # A band around the diagonal decides most tasks that have a path.
        band = (steps[:, :, None] <= 1.5) & (steps[None] <= 1.5)
        if cells == 0 and flood(arm, free & band, *motion)[-1, -1, -1]:
            return True
        reached = flood(arm, free, *motion)
        if cells:
            reached = binary_erosion(reached, np.ones((3, 3, 3)), cells, border_value=1)
        if connected(reached):
            return True
    return False


@compiled
def flood(arm, free, c_start, c, onto, within, q_start):
    """Nodes (k, k, k) that the joints reach from the first along a monotone path of free nodes.

    Parameters
    ----------
    free : (k, k, k) nodes of t, r, p.
    c_start, c : (3,) and (k, 3) centre at the start and at the shares μ_t, m.
    onto, within : (k, 3, 3) turns at the shares μ_r and μ_p.
    """
    k = free.shape[0]
    worth = np.full((k, k, k), -1.0)
    joints = np.zeros((k, k, k, JOINTS))
    J, G, q = np.empty((6, JOINTS)), np.empty((6, JOINTS + 1)), np.empty(JOINTS)
    B = np.empty((JOINTS, 4 * arm.M.shape[0]))
    start, goal, here = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    pose(arm, q_start, start, J)
    sign = np.sign(np.linalg.det(J))
    for i in range(k):
        for j in range(k):
            for l in range(k):
                if not free[i, j, l]:
                    continue
                q[:] = q_start
                best = 1.0
                if i + j + l > 0:
                    best = -1.0
                    for code in range(7, 0, -1):
                        a, b, d = i - (code >> 2), j - ((code >> 1) & 1), l - (code & 1)
                        if a >= 0 and b >= 0 and d >= 0 and worth[a, b, d] > best:
                            best = worth[a, b, d]
                            q[:] = joints[a, b, d]
                    if best <= 0.0:
                        continue
                displaced(onto[j], within[l], c[i], c_start, start, goal)
                if solve(arm, goal, q, here, J, G) and np.linalg.det(J) * sign > 0.0:
                    worth[i, j, l] = min(best, margin(arm, q, here, J, B))
                    joints[i, j, l] = q
    return worth > 0.0


@compiled
def displaced(onto, within, c, c_start, start, goal):
    """Pose (3, 4) of the start after both turns about the centre, which is taken from c_start to c."""
    for a in range(3):
        goal[a, 3] = c[a]
        for b in range(4):
            if b < 3:
                goal[a, b] = 0.0
            for x in range(3):
                turned = 0.0
                for y in range(3):
                    turned += within[x, y] * (start[y, b] - (c_start[y] if b == 3 else 0.0))
                goal[a, b] += onto[a, x] * turned


@compiled
def pose(arm, q, H, J):
    """Rigid displacement H (3, 4) from the reference at the joints q, and the twists J (6, n)."""
    for a in range(3):
        for b in range(4):
            H[a, b] = 1.0 if a == b else 0.0
    for i in range(JOINTS):
        x, y, z = arm.w[i]
        u, v, w = arm.v[i]
        for a in range(3):
            J[a, i] = H[a, 0] * x + H[a, 1] * y + H[a, 2] * z
            J[3 + a, i] = H[a, 0] * u + H[a, 1] * v + H[a, 2] * w
        J[3, i] += H[1, 3] * J[2, i] - H[2, 3] * J[1, i]
        J[4, i] += H[2, 3] * J[0, i] - H[0, 3] * J[2, i]
        J[5, i] += H[0, 3] * J[1, i] - H[1, 3] * J[0, i]
        angle = q[i] - arm.reference[i]
        s, c = math.sin(angle), math.cos(angle)
        h = 1.0 - c
        # w × v is a point of the axis; a turn about it moves the origin by p − R p.
        p = (y * w - z * v, z * u - x * w, x * v - y * u)
        R = (
            (c + h * x * x, h * x * y - s * z, h * x * z + s * y),
            (h * x * y + s * z, c + h * y * y, h * y * z - s * x),
            (h * x * z - s * y, h * y * z + s * x, c + h * z * z),
        )
        t0 = p[0] - R[0][0] * p[0] - R[0][1] * p[1] - R[0][2] * p[2]
        t1 = p[1] - R[1][0] * p[0] - R[1][1] * p[1] - R[1][2] * p[2]
        t2 = p[2] - R[2][0] * p[0] - R[2][1] * p[1] - R[2][2] * p[2]
        for a in range(3):
            f, g, e = H[a, 0], H[a, 1], H[a, 2]
            H[a, 0] = f * R[0][0] + g * R[1][0] + e * R[2][0]
            H[a, 1] = f * R[0][1] + g * R[1][1] + e * R[2][1]
            H[a, 2] = f * R[0][2] + g * R[1][2] + e * R[2][2]
            H[a, 3] += f * t0 + g * t1 + e * t2


@compiled
def solve(arm, goal, q, H, J, G):
    """Newton's method, in place, for joints at a pose; whether they settled near where they were.

    ``H`` and ``J`` are left as of the last step but one, within ``SETTLED`` of the joints.
    """
    moved = np.zeros(JOINTS)
    for _ in range(MOST_NEWTON):
        pose(arm, q, H, J)
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            # Half the skew part of goal · here⁻¹, and what it leaves of the translation.
            twist = 0.0
            for x in range(3):
                twist += goal[c, x] * H[b, x] - goal[b, x] * H[c, x]
            G[a, JOINTS] = 0.5 * twist
            shift = goal[a, 3]
            for y in range(3):
                E = goal[a, 0] * H[y, 0] + goal[a, 1] * H[y, 1] + goal[a, 2] * H[y, 2]
                shift -= E * H[y, 3]
            G[3 + a, JOINTS] = shift
        G[:, :JOINTS] = J
        if not eliminate(G):
            return False
        most = 0.0
        for i in range(JOINTS):
            step = G[i, JOINTS]
            q[i] += step
            moved[i] += step
            most = max(most, abs(step))
            if not abs(moved[i]) <= MOST_STRIDE:
                return False
        if most < SETTLED:
            return True
    return False


@compiled
def eliminate(G):
    """Solve n equations (n, n + 1) in place by Gauss and Jordan; False where they are singular."""
    n = G.shape[0]
    for i in range(n):
        longest = i
        for a in range(i + 1, n):
            if abs(G[a, i]) > abs(G[longest, i]):
                longest = a
        if abs(G[longest, i]) < 1e-9:
            return False
        for b in range(i, n + 1):
            G[i, b], G[longest, b] = G[longest, b], G[i, b]
        inverse = 1.0 / G[i, i]
        for b in range(i, n + 1):
            G[i, b] *= inverse
        for a in range(n):
            factor = G[a, i]
            if a != i:
                for b in range(i, n + 1):
                    G[a, b] -= factor * G[i, b]
    return True


@compiled
def margin(arm, q, H, J, B):
    """Smallest margin of joint limits and conditioning; H and J are the pose and the twists at the joints."""
    least = 1.0
    for i in range(JOINTS):
        span = arm.upper[i] - arm.lower[i]
        least = min(least, 2.0 * min(q[i] - arm.lower[i], arm.upper[i] - q[i]) / span)
    if least <= 0.0:
        return least
    for m in range(arm.M.shape[0]):
        A = arm.M[m]
        X = H[0, 0] * A[0] + H[0, 1] * A[1] + H[0, 2] * A[2] + H[0, 3]
        Y = H[1, 0] * A[0] + H[1, 1] * A[1] + H[1, 2] * A[2] + H[1, 3]
        Z = H[2, 0] * A[0] + H[2, 1] * A[1] + H[2, 2] * A[2] + H[2, 3]
        for view in range(2):
            P = arm.P[view]
            depth = 1.0 / (P[2, 0] * X + P[2, 1] * Y + P[2, 2] * Z + P[2, 3])
            pixel_u = (P[0, 0] * X + P[0, 1] * Y + P[0, 2] * Z + P[0, 3]) * depth
            pixel_v = (P[1, 0] * X + P[1, 1] * Y + P[1, 2] * Z + P[1, 3]) * depth
            for i in range(JOINTS):
                dx = J[1, i] * Z - J[2, i] * Y + J[3, i]
                dy = J[2, i] * X - J[0, i] * Z + J[4, i]
                dz = J[0, i] * Y - J[1, i] * X + J[5, i]
                dw = P[2, 0] * dx + P[2, 1] * dy + P[2, 2] * dz
                du = P[0, 0] * dx + P[0, 1] * dy + P[0, 2] * dz
                dv = P[1, 0] * dx + P[1, 1] * dy + P[1, 2] * dz
                B[i, 4 * m + 2 * view] = (du - pixel_u * dw) * depth
                B[i, 4 * m + 2 * view + 1] = (dv - pixel_v * dw) * depth
    return min(least, pivot_ratio(B) - arm.conditioning)


@compiled
def pivot_ratio(B):
    """Last over first pivot of the rows of B made orthogonal, the longest left first; B is overwritten."""
    n, size = B.shape
    first = last = 0.0
    for i in range(n):
        longest, most = i, -1.0
        for j in range(i, n):
            square = 0.0
            for x in range(size):
                square += B[j, x] * B[j, x]
            if square > most:
                longest, most = j, square
        last = math.sqrt(most)
        if i == 0:
            first = last
        if last <= 1e-300:
            return 0.0
        for x in range(size):
            B[i, x], B[longest, x] = B[longest, x], B[i, x]
        for j in range(i + 1, n):
            inner = 0.0
            for x in range(size):
                inner += B[i, x] * B[j, x]
            for x in range(size):
                B[j, x] -= inner / most * B[i, x]
    return last / first
