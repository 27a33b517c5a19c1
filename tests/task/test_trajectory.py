"""Profiles μ(σ) and the displacement they plan."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.task.trajectory import PROFILES, profile_shares, trajectory_displacement
from tests.samples import frame, prismatic, revolute

SIGMA = np.linspace(0, 1, 201)


@pytest.mark.parametrize("profile", PROFILES)
def test_shares_grow_from_nothing_to_all(profile):
    mu = profile_shares(profile, SIGMA)
    assert mu.shape == (201, 3)
    assert mu[0] == pytest.approx(np.zeros(3), abs=0)
    assert mu[-1] == pytest.approx(np.ones(3), abs=1e-15)
    assert (np.diff(mu, axis=0) >= 0).all()


@pytest.mark.parametrize(
    ("profile", "first", "later"),
    [("rotation_first", [1], [0]), ("translation_first", [0], [1]), ("planar_first", [2], [0, 1])],
)
def test_what_comes_first_is_done_before_the_rest_begins(profile, first, later):
    mu = profile_shares(profile, SIGMA)
    done = np.argmax((mu[:, first] == 1).all(axis=1))
    begun = np.argmax((mu[:, later] > 0).any(axis=1))
    assert 0 < done <= begun < 200


def test_linear_and_exponential():
    assert profile_shares("linear", SIGMA) == pytest.approx(np.stack([SIGMA] * 3, axis=1), abs=0)
    mu = profile_shares("exponential", SIGMA)[:, 0]
    # What is left decays by a constant factor once its end, exp(−k), is added again: k = 5.
    left = 1 - mu * (1 - math.exp(-5))
    assert left[1:] / left[:-1] == pytest.approx(math.exp(-5 / 200) * np.ones(200), abs=1e-13)


def test_planned_displacement_is_the_product_in_the_order_of_the_paper():
    G = frame(4)
    H_hat = np.array(
        [G @ H @ np.linalg.inv(G) for H in (prismatic([1, 2, 3]), revolute([0, 0, 1], [1, 0, 0]),
                                            revolute([0, 0, 1], [0, 0, 1]))]
    )  # fmt: skip
    planned = trajectory_displacement(H_hat, (0.4, 1.2, -2.0), np.array([0.5, 0.25, 1.0]))
    wanted = expm(0.2 * H_hat[0]) @ expm(0.3 * H_hat[1]) @ expm(-2.0 * H_hat[2])
    assert planned == pytest.approx(wanted, abs=1e-12)
