"""Robots, rigs, faces and frames that tests share, built from NumPy and SciPy alone.

Nothing here calls the code under test except its record ``Model``; ``poe`` and ``operators`` are
the oracles of the kinematics.
"""

import numpy as np
from scipy.linalg import expm

from projservo_cli.records import Model, no_lenses, prismatic_of

METRIC_A_INF = np.array([0.0, 0.0, 0.0, 1.0])


def hat(w, v):
    """Twist 4×4 of an angular velocity and a velocity of the origin."""
    return np.array([[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0.0]])


def revolute(point, direction):
    """Twist of one rad about the axis through a point."""
    w = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    return hat(w, np.cross(point, w))


def prismatic(direction):
    """Twist of one metre along a direction."""
    return hat(np.zeros(3), np.asarray(direction, dtype=float) / np.linalg.norm(direction))


def rig(baseline=0.3, focal=1000.0):
    """Two cameras (2, 3, 4) on the x axis that look along +z and converge slightly, px."""
    cameras = []
    for side in (-0.5, 0.5):
        turn = expm(hat([0, -0.1 * np.sign(side), 0], [0, 0, 0]))[:3, :3]
        K = np.array([[focal, 0, 640.0], [0, focal, 512.0], [0, 0, 1]])
        cameras.append(K @ turn.T @ np.c_[np.eye(3), [-side * baseline, 0, 0]])
    return np.array(cameras)


def arm(types="RRRRRR"):
    """Metric model of an arm with axes in general position, seen by ``rig``; q_reference is not zero.

    Six joints, all revolute or the third prismatic, stay away from singularities within ±0.4 of it.
    """
    axes = [
        ([-0.16, 0.09, 2.16], [0.1, 1.0, 0.3]),
        ([0.26, 0.41, 2.19], [1.4, 0.9, 0.3]),
        ([0.14, -0.36, 2.04], [0.5, 0.5, -0.6]),
        ([-0.08, 0.21, 1.54], [-0.8, 0.1, 0.5]),
        ([-0.02, 0.0, 1.42], [0.8, 0.7, 0.8]),
        ([0.09, -0.05, 1.41], [0.2, 1.3, 0.2]),
        ([0.2, 0.1, 1.8], [1.0, 1.0, 0.3]),
    ]
    twists = [
        prismatic(direction) if kind == "P" else revolute(point, direction)
        for kind, (point, direction) in zip(types, axes, strict=False)
    ]
    return Model(
        rig(),
        np.array(twists),
        prismatic_of(types),
        np.linspace(-0.4, 0.5, len(types)),
        METRIC_A_INF.copy(),
        no_lenses(2),
    )


def face(m=4):
    """Points (m, 4) of a plane face before ``rig`` at the reference of ``arm``, an irregular polygon."""
    angle = 0.3 + 2 * np.pi * np.arange(m) / m + 0.1 * np.sin(np.arange(m))
    radius = 0.07 + 0.01 * np.cos(3 * np.arange(m))
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(m), np.ones(m)], axis=1)
    return flat @ displacement([0.2, -0.3, 0.1], [0.02, -0.03, 1.4]).T


def displacement(rotation_vector, translation):
    """Rigid displacement 4×4."""
    T = np.eye(4)
    T[:3, :3] = expm(hat(rotation_vector, [0, 0, 0]))[:3, :3]
    T[:3, 3] = translation
    return T


def frame(seed, mirrored=False):
    """Projective change of frame 4×4, condition number 4, of positive determinant unless mirrored."""
    generator = np.random.default_rng(seed)
    U = np.linalg.qr(generator.normal(size=(4, 4)))[0]
    V = np.linalg.qr(generator.normal(size=(4, 4)))[0]
    G = U @ np.diag([2.0, 1.3, 0.8, 0.5]) @ V
    if (np.linalg.det(G) < 0) != mirrored:
        G[0] = -G[0]
    return G


def in_frame(model, G):
    """The same robot and rig in another projective frame: points M become G M."""
    back = np.linalg.inv(G)
    return Model(
        np.ascontiguousarray(model.P @ back),
        np.ascontiguousarray(G @ model.H_hat_0 @ back),
        model.prismatic,
        model.q_reference,
        model.a_inf @ back,
        model.lens,
    )


def poe(model, q):
    """Product of exponentials, each by the matrix exponential of SciPy."""
    H = np.eye(4)
    for operator, amount in zip(model.H_hat_0, np.asarray(q) - model.q_reference, strict=True):
        H = H @ expm(amount * operator)
    return H


def operators(model, q):
    """Operators at q: each joint's twist carried along by the joints before it."""
    H = np.eye(4)
    result = []
    for operator, amount in zip(model.H_hat_0, np.asarray(q) - model.q_reference, strict=True):
        H = H @ expm(amount * operator)
        result.append(H @ operator @ np.linalg.inv(H))
    return np.array(result)


def pixels(P, M):
    """Pixels (2, m, 2) of points (m, 4) in both views."""
    m = M @ np.swapaxes(P, 1, 2)
    return np.ascontiguousarray(m[..., :2] / m[..., 2:])
