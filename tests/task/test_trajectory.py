"""Profiles μ(σ)."""

import numpy as np
import pytest

from projservo_cli.task.trajectory import PROFILES, profile_shares

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


@pytest.mark.parametrize(("profile", "part"), [("translation_first", 0), ("rotation_first", 1)])
def test_what_comes_first_waits_where_visibility_would_change(profile, part):
    mu = profile_shares(profile, SIGMA, (0.7, 0.3))
    alone = mu[mu[:, 1 - part] == 0, part]
    assert alone.max() == pytest.approx((0.7, 0.3)[part])
    assert (np.diff(mu, axis=0) >= 0).all()
    assert mu[-1] == pytest.approx(np.ones(3), abs=1e-15)
