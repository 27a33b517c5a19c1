"""A motion planned once, as what a law follows from period to period: [RH00] sections 4, 4.3."""

from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Mat4, mat, mul
from projservo_cli.geometry.displacement import rotation, translation
from projservo_cli.geometry.jit import internal, merged
from projservo_cli.records import FloatArray
from projservo_cli.task.trajectory import displaced


class Reference(NamedTuple):
    """A planned motion at k instants, one control period apart but for the last, where it arrives.

    Attributes
    ----------
    H_hat : (3, 4, 4) operators t, r, p of the plan.
    amplitudes : (3,) τ in the unit of Ĥ_t, θ_r and θ_p in rad.
    mu : (k, 3) shares that are done; k is 0 where nothing is followed, else at least 2.
    q : (k, n) joints that follow, rad or m.
    A : (k, m, 4) points of the face, a_inf·A = 1, before the displacement that is planned until then.
    s : (k, 2, m, 2) its pixels as projective cameras see them.
    s_ahead : (k, 2, m, 2) their motion in the next period to first order, velocity times time, px.
    rate : periods of the plan that a period of the loop is worth: less than 1 where commands are scaled.
    """

    H_hat: FloatArray
    amplitudes: FloatArray
    mu: FloatArray
    q: FloatArray
    A: FloatArray
    s: FloatArray
    s_ahead: FloatArray
    rate: float


# Every step plans anew.
NO_REFERENCE = Reference(
    np.zeros((3, 4, 4)),
    np.zeros(3),
    np.zeros((0, 3)),
    np.zeros((0, 0)),
    np.zeros((0, 0, 4)),
    np.zeros((0, 2, 0, 2)),
    np.zeros((0, 2, 0, 2)),
    1.0,
)


@merged
def following(reference: Reference) -> bool:
    """Whether there is a plan to follow."""
    return bool(reference.mu.shape[0] > 0)


@merged
def place(reference: Reference, clock: float) -> tuple[int, float]:
    """Row before a time in periods, and how far on towards the next; the plan stays where it arrived."""
    last = reference.mu.shape[0] - 1
    i = min(int(clock), last - 1)
    return i, min(clock, float(last)) - i


@merged
def between(column: FloatArray, i: int, x: float) -> float:
    """Value between two rows; the rows themselves to the bit."""
    return (1.0 - x) * float(column[i]) + x * float(column[i + 1])


@internal
def planned(reference: Reference, clock: float) -> Mat4:
    """Displacement from the start that is planned until a time in periods, [RH00] eqs. (17), (18)."""
    i, x = place(reference, clock)
    mu_t = between(reference.mu[:, 0], i, x)
    mu_r = between(reference.mu[:, 1], i, x)
    mu_p = between(reference.mu[:, 2], i, x)
    return displaced(reference.H_hat, reference.amplitudes, mu_t, mu_r, mu_p)


@merged
def planned_step(reference: Reference, clock: float, share: float) -> Mat4:
    """Displacement that the plan makes from a time on in a share of a period."""
    mu = reference.mu
    i, x = place(reference, clock)
    H_r, H_p = mat(reference.H_hat[1]), mat(reference.H_hat[2])
    theta_r = between(mu[:, 1], i, x) * float(reference.amplitudes[1])
    theta_p = between(mu[:, 2], i, x) * float(reference.amplitudes[2])
    tau = between(mu[:, 0], i, x) * float(reference.amplitudes[0])
    turned_back = mul(rotation(H_p, mul(H_p, H_p), -theta_p), rotation(H_r, mul(H_r, H_r), -theta_r))
    return mul(
        planned(reference, clock + share), mul(turned_back, translation(mat(reference.H_hat[0]), -tau))
    )
