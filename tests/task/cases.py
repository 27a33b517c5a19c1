"""A face, its goal and the partition between them, in any frame."""

import numpy as np

from projservo_cli.control.law import make_split, new_state
from projservo_cli.geometry.algebra import as_array
from projservo_cli.geometry.stereo import fundamental_matrix, optical_centers
from projservo_cli.task.face import MIDPOINT, Task, center_of, cyclic_order, face_plane
from projservo_cli.task.partition import partition
from tests.samples import arm, displacement, in_frame, operators, pixels

SQUARE = np.array(
    [[0.06, 0.06, 1.4, 1], [-0.06, 0.06, 1.4, 1], [-0.06, -0.06, 1.4, 1], [0.06, -0.06, 1.4, 1]]
)
SQUARE_CENTER = np.array([0.0, 0, 1.4])


def about(center, R):
    """Rotation matrix (3, 3) about a point as a displacement 4×4."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = center - R @ center
    return T


def turned(center, rotation_vector):
    """Rotation vector, rad, about a point as a displacement 4×4."""
    return about(np.asarray(center), displacement(rotation_vector, np.zeros(3))[:3, :3])


def make_task(model, A, A_star, center=MIDPOINT):
    """Task from the true points, also where a camera would see the back of the face."""
    O = optical_centers(model.P, model.a_inf)
    order = cyclic_order(A_star)
    a = np.array(face_plane(np.ascontiguousarray(A), order, center_of(A, center)))
    return Task(
        pixels(model.P, A_star),
        np.ascontiguousarray(A_star),
        order,
        center,
        np.arange(2),
        fundamental_matrix(model.P),
        O,
        np.where(O @ a > 0, 1.0, -1.0),
        2,
    )


class Split:
    """Partition of one task: parts, joint motions and operators t, r, p, and the product of all three."""

    def __init__(self, A, T, G=None, types="RRRRRR", center=MIDPOINT, memory=None):
        G = np.eye(4) if G is None else G
        metric = arm(types)
        q = metric.q_reference + 0.2 * np.cos(np.arange(len(types)))
        self.model = in_frame(metric, G)
        self.A = np.ascontiguousarray(A @ G.T)
        self.A_star = np.ascontiguousarray(A @ T.T @ G.T)
        self.task = make_task(self.model, self.A, self.A_star, center)
        self.state = new_state(len(types), len(A))
        self.state.work.H_hat[:] = operators(self.model, q)
        self.state.A[:] = self.A
        if memory is not None:
            self.state.driven[:] = memory
        self.parts = partition(self.task, make_split(self.state))
        self.memory = self.state.driven
        self.q_hat = self.state.q_hat[:3].copy()
        self.H_hat = [as_array(H) for H in (self.parts.H_t, self.parts.H_r, self.parts.H_p)]

    @property
    def amplitudes(self):
        return np.array([self.parts.tau, self.parts.theta_r, self.parts.theta_p])
