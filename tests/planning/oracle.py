"""Grid search for a monotone path in sight and in both images, from true geometry in plain NumPy.

Nothing here calls the code under test. The task is partitioned anew, in metres and radians: the centre
moves along a line, the face turns about the line in which start and translated goal plane meet, then
within its plane. The lattice has 41³ nodes; a path steps by one along one axis or more.
"""

import itertools
import math

import numpy as np
from scipy.ndimage import binary_erosion

NODES = 41


def turn(axis, angle):
    """Rotation matrices (…, 3, 3) about a unit axis."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.asarray(angle)[..., None, None]
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


class TrueTask:
    """Points of the face (m, 3) at start and goal, the cameras and the image size, all true."""

    def __init__(self, P, image_size, start, goal):
        self.P, self.size, self.start = P, image_size, start
        self.O = np.array([-np.linalg.solve(camera[:, :3], camera[:, 3]) for camera in P])
        self.c, self.c_goal = start.mean(axis=0), goal.mean(axis=0)
        U, _, Vt = np.linalg.svd((start - self.c).T @ (goal - self.c_goal))
        R = Vt.T @ np.diag([1, 1, np.sign(np.linalg.det(Vt.T @ U.T))]) @ U.T
        n = np.cross(start[1] - start[0], start[2] - start[0])
        self.n = n / np.linalg.norm(n)
        turned = R @ self.n
        axis = np.cross(self.n, turned)
        if np.linalg.norm(axis) < 1e-12:
            axis = start[0] - self.c
        self.axis = axis / np.linalg.norm(axis)
        self.theta_r = math.atan2(np.linalg.norm(np.cross(self.n, turned)), self.n @ turned)
        within = turn(self.axis, -self.theta_r) @ R
        e = start[0] - self.c
        self.theta_p = math.atan2(np.cross(e, within @ e) @ self.n, e @ within @ e)

    def senses(self):
        """The four choices of senses of both rotations, the shorter ones first."""
        r = (self.theta_r, self.theta_r - 2 * math.pi)
        p = (self.theta_p, self.theta_p - math.copysign(2 * math.pi, self.theta_p))
        return sorted(itertools.product(r, p), key=lambda pair: abs(pair[0]) + abs(pair[1]))

    def along(self, mu, theta_r, theta_p):
        """Smallest sight over the start's, and border distance in px, (s,) each along shares (s, 3)."""
        c = self.c + mu[:, :1] * (self.c_goal - self.c)
        R_r = turn(self.axis, mu[:, 1] * theta_r)
        R = R_r @ turn(self.n, mu[:, 2] * theta_p)
        X = c[:, None] + np.einsum("sab,mb->sma", R, self.start - self.c)
        sight = [np.einsum("sa,sa->s", R_r @ self.n, O - c) / (self.n @ (O - self.c)) for O in self.O]
        inside = []
        for P in self.P:
            m = X @ P[:, :3].T + P[:, 3]
            uv = m[..., :2] / m[..., 2:]
            distance = np.minimum(uv + 0.5, self.size - 0.5 - uv).min(axis=(1, 2))
            inside.append(np.where((m[..., 2] > 0).all(axis=1), distance, -np.inf))
        return np.min(sight, axis=0), np.min(inside, axis=0)

    def free(self, theta_r, theta_p, nodes=NODES):
        """Nodes (k, k, k) of t, r, p at which both cameras see the face and all its markers."""
        x = np.linspace(0, 1, nodes)
        c = self.c + x[:, None] * (self.c_goal - self.c)
        R_r = turn(self.axis, x * theta_r)
        R = R_r[:, None] @ turn(self.n, x * theta_p)[None]
        arm = np.einsum("jkab,mb->mjka", R, self.start - self.c)
        free = np.ones((nodes, nodes, nodes), dtype=bool)
        for P, O in zip(self.P, self.O, strict=True):
            seen = np.einsum("ja,ia->ij", R_r @ self.n, O - c) * (self.n @ (O - self.c)) > 0
            free &= seen[:, :, None]
            base = c @ P[:, :3].T + P[:, 3]
            for lever in arm @ P[:, :3].T:
                u, v, w = (base[:, None, None, a] + lever[None, :, :, a] for a in range(3))
                free &= (w > 0) & (u >= -0.5 * w) & (u <= (self.size[0] - 0.5) * w)
                free &= (v >= -0.5 * w) & (v <= (self.size[1] - 0.5) * w)
        return free

    def feasible(self, nodes=NODES, cells=0):
        """Whether a monotone path exists in any choice of senses, ``cells`` away from what is not free."""
        for senses in self.senses():
            free = self.free(*senses, nodes)
            if cells:
                free = binary_erosion(free, np.ones((3, 3, 3)), cells, border_value=1)
            if connected(free):
                return True
        return False


def connected(free):
    """Whether a monotone path leads through free nodes from the first to the last."""
    if not (free[0, 0, 0] and free[-1, -1, -1]):
        return False
    reached = np.zeros(tuple(n + 1 for n in free.shape), dtype=bool)
    reached[1, 1, 1] = True
    count = 0
    while count != (count := int(reached.sum())):
        came = reached[1:, 1:, 1:] | reached[:-1, 1:, 1:] | reached[1:, :-1, 1:] | reached[1:, 1:, :-1]
        # Steps along several axes at once, which a path between blocked nodes may need.
        came |= reached[:-1, :-1, 1:] | reached[:-1, 1:, :-1] | reached[1:, :-1, :-1] | reached[:-1, :-1, :-1]
        reached[1:, 1:, 1:] = came & free
    return bool(reached[-1, -1, -1])
