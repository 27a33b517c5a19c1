"""Kinds of motion of an object: at rest, along a line, about an axis, or free, by its places over time.

A motion along a line, or about an axis, is a line in the coordinates of the group, whatever its speed: belts
and turntables may stop and start again. The likeliest kind is found by Schwarz's criterion.
"""

import math
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import eigh

from projservo_cli.records import FloatArray

# Degree of a motion over time, terms of a logarithm, norm of a linear part less the identity from which they
# do not do, and number of steps to an axis.
_DEGREE, _TERMS, _NEAR, _STEPS = 3, 24, 0.6, 6
# Deviation of trace, determinant or pitch of a rotation by 1 rad, below which it is rounding.
_ROUNDING = 1e-8


class MotionKind(NamedTuple):
    """Kind of a motion, and the operator (4, 4) of its direction, per unit, or of its axis, per rad."""

    name: str  # still, belt, turntable or free
    operator: FloatArray | None = None

    @classmethod
    def of(cls, t: FloatArray, T: FloatArray, N: FloatArray, change: FloatArray, E: FloatArray) -> Self:
        """Return the likeliest kind of a motion of steps T exp(ξ E).

        t : (n,) times; T : (n, 4, 4) displacements, each of the inverse covariance N (g, g).
        change : (g, c) errors by which they seem to move from the first to the last.
        E : (g, 4, 4) generators.
        """
        L = np.linalg.solve(T[-1], T)
        near = np.linalg.norm(L[:, :3, :3] - np.eye(3), axis=(1, 2)) < _NEAR
        z, (n, g) = _coordinates(L[near], E), (near.sum(), len(E))
        time = (t[near] - t[near].mean()) / np.ptp(t)
        basis = np.linalg.qr(np.vander(time, _DEGREE + 1, increasing=True))[0]
        moments = basis[:, 1:].T @ z  # of the course over time, whatever the first place
        W = np.linalg.inv(np.linalg.inv(N) + change @ change.T * (n / 12.0))
        M = W @ moments.T @ moments @ W
        whole = float(np.trace(np.linalg.solve(W, M)))
        (*_, along), screws = eigh(M, W)
        (*_, straight), lines = eigh(M[:3, :3], W[:3, :3])
        axis, missed = _about_an_axis(screws[:, -1], np.linalg.inv(W) / max(along, 1e-12), E)
        belt = np.r_[lines[:, -1], np.zeros(g - 3)]
        each = math.log(n * g)
        turns = 4 if g == 6 else 8  # coordinates of a line, and of the metric across it
        costs = {
            "still": (whole, None),
            "belt": (whole - straight + each * (2 + _DEGREE), belt / np.linalg.norm(belt)),
            "turntable": (whole - along + missed + each * (turns + _DEGREE), axis),
            "free": (each * g * _DEGREE, None),
        }
        name = min(costs, key=lambda kind: costs[kind][0])
        if (xi := costs[name][1]) is None:
            return cls(name)
        forward = xi * np.sign(moments[0] @ W @ xi)
        return cls(name, T[-1] @ np.tensordot(forward, E, 1) @ np.linalg.inv(T[-1]))

    def in_frame(self, G: FloatArray) -> "MotionKind":
        """Return it in the frame that G (4, 4) leads from."""
        return self if self.operator is None else MotionKind(self.name, np.linalg.solve(G, self.operator) @ G)


STILL = MotionKind("still")


def _coordinates(T: FloatArray, E: FloatArray) -> FloatArray:
    """Coordinates (L, g) of displacements (L, 4, 4) near the identity, by the series of the logarithm."""
    X, log = T - np.eye(4), np.zeros_like(T)
    for n in range(_TERMS, 0, -1):
        log = X @ (np.eye(4) / n - log)
    return np.asarray(np.linalg.lstsq(E.reshape(len(E), -1).T, log.reshape(len(T), -1).T)[0].T)


def _about_an_axis(screw: FloatArray, covariance: FloatArray, E: FloatArray) -> tuple[FloatArray, float]:
    """Rotation (g,) about an axis, per rad, that is next to a screw (g,), and the χ² between both."""
    L = np.tensordot(screw, E, 1)[:3, :3]
    along, angle = np.linalg.svd(L)[0][:, 2], math.sqrt(max(-0.5 * np.trace(L @ L), 1e-24))
    screw, covariance = screw / angle, covariance / angle**2

    def misses(xi: FloatArray) -> FloatArray:
        """Trace, determinant and translation along the axis, which a rotation does not have."""
        X = np.tensordot(xi, E, 1)
        null = np.linalg.svd(X[:3, :3])[0][:, 2]
        pitch = null @ X[:3, 3] * np.sign(null @ along)
        return np.array([np.trace(X[:3, :3]), np.linalg.det(X[:3, :3]), pitch])

    axis, step = screw, 1e-6 * np.linalg.norm(screw)
    for _ in range(_STEPS):
        J = np.array([misses(axis + one) - misses(axis - one) for one in step * np.eye(len(E))]).T
        J /= 2.0 * step
        # Rigid motions have neither trace nor determinant: their rows are rounding.
        size = np.maximum(np.sqrt(np.einsum("ij,jk,ik->i", J, covariance, J)), _ROUNDING)[:, None]
        of_unit = J / size
        gain = covariance @ of_unit.T @ np.linalg.pinv(of_unit @ covariance @ of_unit.T, rcond=1e-6)
        axis = screw - gain @ ((misses(axis) + J @ (screw - axis)) / size[:, 0])
    apart, L = axis - screw, np.tensordot(axis, E, 1)[:3, :3]
    per_rad = axis / math.sqrt(max(-0.5 * np.trace(L @ L), 1e-24))
    return per_rad, float(apart @ np.linalg.solve(covariance, apart))
