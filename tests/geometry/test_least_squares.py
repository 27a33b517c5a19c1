"""Least squares of many problems at once, against SciPy's solver of one."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from projservo_cli.geometry.least_squares import Equations, levenberg_marquardt

TIMES = np.linspace(0.0, 3.0, 25)


def decays(x):
    """Exponential decays and their derivatives by level, rate and offset: x (S, 3) to (S, 25), (S, 25, 3)."""
    level, rate, offset = x.T[:, :, None]
    bell = np.exp(-rate * TIMES)
    J = np.stack([bell, -level * TIMES * bell, np.ones_like(bell)], axis=2)
    return level * bell + offset, J


def fitted(seen, start, moved=lambda step, x: (x + step,)):
    """Fits (S, 3) of decays to values (S, 25)."""

    def equations(x):
        value, J = decays(x)
        return Equations.of(value - seen, J)

    (x,), there = levenberg_marquardt((start,), equations, moved, 100)
    return x, there


def several(seed, count=6):
    """Noisy values of decays, and starts that are 30 % off."""
    rng = np.random.default_rng(seed)
    true = rng.uniform([0.5, 0.3, -1.0], [3.0, 2.0, 1.0], (count, 3))
    values = decays(true)[0] + 0.01 * rng.normal(size=(count, 25))
    return values, true * rng.uniform(0.7, 1.3, (count, 3))


@given(st.integers(0, 1000))
def test_minima_are_those_of_scipy(seed):
    seen, start = several(seed)
    x, there = fitted(seen, start)
    for one, values, first in zip(x, seen, start, strict=True):
        found = least_squares(lambda p, v=values: decays(p[None])[0][0] - v, first, xtol=1e-14, ftol=1e-14)
        # Both end where a step changes χ² by 1e-10 of itself: 1e-5 of a deviation of a parameter.
        np.testing.assert_allclose(one, found.x, atol=1e-4)
    np.testing.assert_allclose(there.cost, np.square(decays(x)[0] - seen).sum(axis=1), rtol=1e-12)


def test_problems_do_not_disturb_each_other():
    seen, start = several(3)
    together, _ = fitted(seen, start)
    for k in range(len(seen)):
        np.testing.assert_allclose(fitted(seen[k : k + 1], start[k : k + 1])[0][0], together[k], atol=1e-6)


def test_what_nothing_shows_stays_where_it_was():
    seen, start = several(4)

    def equations(x):
        value, J = decays(x[:, :3])
        return Equations.of(value - seen, np.concatenate([J, np.zeros((*J.shape[:2], 1))], axis=2))

    (x,), _ = levenberg_marquardt(
        (np.column_stack([start, np.full(len(start), 7.0)]),), equations, lambda step, x: (x + step,), 50
    )
    np.testing.assert_array_equal(x[:, 3], 7.0)
    np.testing.assert_allclose(x[:, :3], fitted(seen, start)[0], atol=1e-6)


def test_a_step_to_no_value_is_not_taken():
    seen, start = several(5)

    def equations(x):
        value, J = decays(x)
        value = np.where(x[:, 1:2] > 0.2, value, np.nan)
        return Equations.of(value - seen, J)

    (x,), there = levenberg_marquardt((start,), equations, lambda step, x: (x + 40.0 * step,), 200)
    assert (x[:, 1] > 0.2).all()
    assert (there.cost <= equations(start).cost).all()


def test_directions_that_nothing_shows_make_no_system_singular():
    """One row of ones and an exact start: the damping falls to its least."""

    def equations(x):
        return Equations.of(x.sum(axis=1)[:, None] - 1.0, np.ones((len(x), 1, x.shape[1])))

    for start in np.zeros(6), np.arange(6.0):
        (x,), there = levenberg_marquardt(
            (start[None],), equations, lambda step, x: (x + step,), 60, enough=-1.0
        )
        np.testing.assert_allclose(x.sum(), 1.0, atol=1e-12)
        assert there.cost < 1e-20
