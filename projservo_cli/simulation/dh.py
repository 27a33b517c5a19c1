"""Denavit–Hartenberg tables: the joint screws of an arm by the lengths and angles of its links."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import rigid
from projservo_cli.records import FloatArray
from projservo_cli.simulation.arm import twist


class Link(NamedTuple):
    """A row of the table; the joint reading adds to theta (R) or d (P)."""

    type: str  # R or P
    theta: float  # turn about z, rad
    d: float  # shift along z, m
    a: float  # shift along x, m
    alpha: float  # turn about x, rad


def screws_of(links: Sequence[Link], tool: FloatArray, *, modified: bool) -> tuple[FloatArray, FloatArray]:
    """Return the twists (n, 4, 4) of the joints at the reference, all joints zero, and the pose of the tool.

    tool : (4, 4) pose of the tool in the frame of the last joint, m.
    modified : in Craig's convention a and α come before θ and d.
    Source: P. Corke, Robotics, Vision and Control, 2nd ed., section 7.1.
    """
    T, twists = np.eye(4), []
    for link in links:
        turn = rigid(Rotation.from_rotvec([0.0, 0.0, link.theta]), [0.0, 0.0, link.d])
        tilt = rigid(Rotation.from_rotvec([link.alpha, 0.0, 0.0]), [link.a, 0.0, 0.0])
        if modified:
            T, tilt = T @ tilt, np.eye(4)
        axis = twist([0, 0, 0], [0, 0, 1]) if link.type == "P" else twist([0, 0, 1], [0, 0, 0])
        twists.append(T @ axis @ np.linalg.inv(T))
        T = T @ turn @ tilt
    return np.array(twists), T @ tool
