"""Nonlinear least squares of many small problems at once.

K. Levenberg, Quarterly of Applied Mathematics 2, 1944; D. Marquardt, SIAM Journal 11, 1963. SciPy's solvers
take one problem at a time. Other solvers stay apart: bundle adjustment eliminates markers, the body before
one camera its poses, inverse kinematics is compiled, and robust fits without damping change their weights at
each step.
"""

from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np

from projservo_cli.records import BoolArray, FloatArray

# Damping at first, minimum and maximum: none that is larger leads down where this one does not.
_AT_FIRST, _LEAST, _HOPELESS = 1e-3, 1e-9, 1e8
# Fall of a cost by the last step, over the cost and as of round-off.
_SETTLED, _EXACT = 1e-10, 1e-16
# Second derivative over the largest, below which nothing shows a parameter.
_UNSEEN = 1e-12


class Equations(NamedTuple):
    """Normal equations of S problems with p unknowns each."""

    A: FloatArray  # (S, p, p) JᵀJ
    g: FloatArray  # (S, p) Jᵀr, half of the gradient
    cost: FloatArray  # (S,) squared norms of residuals, or a loss; NaN is worse than any

    @classmethod
    def of(cls, r: FloatArray, J: FloatArray) -> Self:
        """Return the equations of residuals r (S, N) with derivatives J (S, N, p)."""
        J_T = J.swapaxes(1, 2)
        return cls(J_T @ J, (J_T @ r[..., None])[..., 0], np.square(r).sum(axis=1))


def levenberg_marquardt(
    x: tuple[FloatArray, ...],
    equations: Callable[..., Equations],
    moved: Callable[..., tuple[FloatArray, ...]],
    steps: int,
    enough: float = _EXACT,
) -> tuple[tuple[FloatArray, ...], Equations]:
    """Minima near some states, and their equations; each state has its damping.

    x : arrays (S, …) that make up the states.
    equations : of such arrays.
    moved : the arrays after a step (S, p), which comes first; then x.
    steps : maximum number of them, rejected ones counted.
    enough : a fall of the cost that is not worth another step.
    """
    here = equations(*x)
    damping = np.full(len(here.cost), _AT_FIRST)
    identity = np.eye(here.g.shape[1])
    for _ in range(steps):
        ridge = (damping[:, None] * _units(here.A))[..., None] * identity
        step = -np.linalg.solve(here.A + ridge, here.g[..., None])[..., 0]
        expected = -(step * here.g).sum(axis=1)
        with np.errstate(all="ignore"):
            x_new = moved(step, *x)
            there = equations(*x_new)
            better = there.cost < here.cost
            fall = np.where(better, here.cost - there.cost, expected)
        x = tuple(_where(better, new, old) for new, old in zip(x_new, x, strict=True))
        ended = (fall <= _SETTLED * here.cost + enough) | (damping > _HOPELESS)
        here = Equations(*(_where(better, new, old) for new, old in zip(there, here, strict=True)))
        damping = np.where(better, np.maximum(0.1 * damping, _LEAST), 10.0 * damping)
        if ended.all():
            break
    return x, here


def _units(A: FloatArray) -> FloatArray:
    """Second derivatives (S, p) as units of the damping; the largest for unobserved parameters."""
    unit = np.diagonal(A, axis1=1, axis2=2)
    largest = unit.max(axis=1, keepdims=True, initial=0.0)
    return np.where(unit > _UNSEEN * largest, unit, np.where(largest > 0.0, largest, 1.0))


def _where(these: BoolArray, new: FloatArray, old: FloatArray) -> FloatArray:
    """Rows of the one array where these (S,) are true, else of the other."""
    return np.where(these.reshape(-1, *[1] * (new.ndim - 1)), new, old)
