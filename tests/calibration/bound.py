"""Cramér–Rao bound of predictions, by complex steps through a model of its own."""

import numpy as np

STEP = 1e-30  # of the complex differentiation: exact to round-off, nothing cancels


def images(x, joint_types, m, dq):
    """Pixels (K, V, m, 2) from cameras, axes, directions and markers ravelled in x; holds for complex x.

    A screw is any (w, v): w is scaled to one and v freed of its part along w, so that the redundant
    directions of x change no image. A direction is scaled to one.
    """
    n = len(joint_types)
    cameras = len(x) - 6 * n - 3 * m
    P, x = x[:cameras].reshape(-1, 3, 4), x[cameras:]
    screws, X = x[: 6 * n].reshape(n, 6), x[6 * n :].reshape(m, 3)
    points = np.broadcast_to(X, (len(dq), m, 3))
    for i in range(n - 1, -1, -1):
        w, v, theta = screws[i, :3], screws[i, 3:], dq[:, i, None, None]
        if joint_types[i] == "P":
            points = points + theta * v / np.sqrt(v @ v)
            continue
        w = w / np.sqrt(w @ w)
        v = v - w * (w @ v)
        velocity = np.cross(w, points) + v
        points = points + np.sin(theta) * velocity + (1.0 - np.cos(theta)) * np.cross(w, velocity)
    p = np.einsum("vrc,kmc->kvmr", P[..., :3], points) + P[:, None, :, 3]
    return p[..., :2] / p[..., 2:]


def parameters(robot):
    twists = robot.twists
    w = np.stack([twists[:, 2, 1], twists[:, 0, 2], twists[:, 1, 0]], axis=1)
    screws = np.hstack([w, twists[:, :3, 3]])
    return np.concatenate([robot.cameras.ravel(), screws.ravel(), robot.markers[:, :3].ravel()])


def derivative(robot, q):
    """Derivative (pixels, parameters) at the truth."""
    x, dq = parameters(robot), q - robot.q_reference
    columns = []
    for k in range(len(x)):
        moved = x.astype(complex)
        moved[k] += 1j * STEP
        columns.append(images(moved, robot.joint_types, len(robot.markers), dq).imag.ravel() / STEP)
    return np.array(columns).T


def spread(J, ahead):
    """Factor (rows, rank) of the covariance of predictions of derivative ``ahead``, at one pixel of noise."""
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    _, s, Vt = np.linalg.svd(np.linalg.qr(J / scale, mode="r"))
    rank = int((s > 1e-10 * s[0]).sum())
    # A clear gap: what is left beyond the rank is the gauge and round-off.
    assert s[rank - 1] > 1e-7 * s[0]
    return (ahead / scale) @ (Vt[:rank].T / s[:rank])


class Bound:
    """Cramér–Rao bound of predictions: covariance factor @ factor.T per px² of noise, for visible rows.

    ``weight``: of each coordinate, one over its own noise, px.
    """

    def __init__(self, robot, trained, q, weight=1.0):
        x, dq = parameters(robot), q - robot.q_reference
        # The other model is the same robot.
        np.testing.assert_allclose(
            images(x, robot.joint_types, len(robot.markers), dq), robot.images(q), atol=1e-8
        )
        J = derivative(robot, trained)
        self.factor = spread(np.reshape(weight, (-1, 1)) * J, derivative(robot, q))
        self.rank = self.factor.shape[1]
        self.coordinates = J.shape[0]

    def mean_square(self):
        """Mean variance of a coordinate."""
        return float((self.factor**2).sum()) / len(self.factor)

    def relative_error(self, draws):
        """Standard error of the mean square over independent draws of normal errors, relative."""
        spectrum = np.linalg.svd(self.factor, compute_uv=False) ** 2
        return float(np.sqrt(2.0 * (spectrum**2).sum() / draws) / spectrum.sum())


def errors_of_the_best(mistaken):
    """Errors (K, 2, m) px of held-out images of the best estimator, to first order, from what is right alone.

    Of the very noise that is in the data: markers are eliminated one by one, so that thousands are no matter.
    """
    robot, right = mistaken.robot, mistaken.kind == 0
    by_shared, by_marker = _parts(robot, mistaken.observation.q)
    ahead_shared, ahead_marker = _parts(robot, mistaken.ahead)
    rows, back = [], []
    for j, seen in enumerate(right.T):
        A = by_shared[seen][:, :, j].reshape(-1, by_shared.shape[-1])
        B, noise = by_marker[seen][:, :, j].reshape(-1, 3), mistaken.noise[seen][:, :, j].ravel()
        inverse = np.linalg.pinv(B)
        rows.append(np.c_[A, noise] - B @ (inverse @ np.c_[A, noise]))
        back.append(inverse @ np.c_[A, noise])
    stacked, back = np.concatenate(rows), np.array(back)
    scale = np.maximum(np.linalg.norm(stacked[:, :-1], axis=0), 1e-300)
    shared = np.linalg.lstsq(stacked[:, :-1] / scale, stacked[:, -1], rcond=1e-9)[0] / scale
    marker = back[:, :, -1] - back[:, :, :-1] @ shared
    error = ahead_shared @ shared + np.einsum("kvmij,mj->kvmi", ahead_marker, marker)
    return np.linalg.norm(error, axis=-1)


def _parts(robot, q):
    """Derivatives of images (K, 2, m, 2, …) by what all markers share, and by the marker itself."""
    x, dq, m = parameters(robot), q - robot.q_reference, len(robot.markers)
    first = len(x) - 3 * m
    steps = [np.arange(len(x)) == k for k in range(first)]
    steps += [(np.arange(len(x)) >= first) & ((np.arange(len(x)) - first) % 3 == i) for i in range(3)]
    columns = [images(x + 1j * STEP * step, robot.joint_types, m, dq).imag / STEP for step in steps]
    J = np.stack(columns, axis=-1)
    return J[..., :first], J[..., first:]
