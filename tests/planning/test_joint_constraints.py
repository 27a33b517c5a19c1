"""Margins against what the metric truth says, and edges against dense samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.planning.joint_constraints import new_trial, reached, width
from projservo_cli.planning.rrt_connect import margins_at, with_ends
from projservo_cli.records import NO_SPREAD, Spread
from tests.planning.columns import FRONT, IMAGE, JOINTS, VISIBILITY, WIDTH
from tests.planning.joint_space_cases import case


@pytest.mark.parametrize("name", ["paper", "stanford"])
def test_signs_are_those_of_the_metric_truth(name):
    found = case(name, 1)
    truth, c = found.truth, found.c
    centers = optical_centers(truth.P, np.array([0.0, 0.0, 0.0, 1.0]))[:, :3]
    rng = np.random.default_rng(0)

    def sides(q):
        X = (truth.M_face @ truth.displacement(q).T)[:, :3]
        normal = np.cross(X[1] - X[0], X[2] - X[0])
        return (centers - X[0]) @ normal, (np.c_[X, np.ones(len(X))] @ truth.P[:, 2].T).min(axis=0)

    start, _ = sides(found.q_start)
    signs = set()
    for q in rng.uniform(c.limits.lower, c.limits.upper, (200, len(c.limits.lower))):
        margins, s = margins_at(c, q)
        side, depth = sides(q)
        np.testing.assert_array_equal(margins[VISIBILITY : VISIBILITY + 2] > 0.0, side * start > 0.0)
        if (depth > 0.0).all():
            np.testing.assert_array_equal(margins[FRONT : FRONT + 2] > 0.0, True)
            np.testing.assert_allclose(s, truth.images(q, truth.M_face), atol=1e-6)
            inside = np.minimum(s + 0.5, truth.image_size[:, None] - 0.5 - s).min(axis=(1, 2))
            np.testing.assert_allclose(margins[IMAGE : IMAGE + 2], inside, atol=1e-6)
        signs.add((*(margins[VISIBILITY : VISIBILITY + 2] > 0.0), *(depth > 0.0)))
        nearest = np.minimum(q - c.limits.lower, c.limits.upper - q) / c.keep
        assert margins[JOINTS] == pytest.approx(nearest.min())
    assert len(signs) > 3


@given(st.integers(3, 8), st.integers(0, 10_000))
def test_width_is_the_least_over_all_directions(m, seed):
    points = np.random.default_rng(seed).uniform(0.0, 100.0, (m, 2))
    found = width(points, np.arange(m))
    # Along each edge of the hull, by another library; no direction is narrower.
    corners = points[ConvexHull(points).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.c_[-edges[:, 1], edges[:, 0]] / np.linalg.norm(edges, axis=1)[:, None]
    assert found == pytest.approx(np.ptp(corners @ normals.T, axis=0).min(), abs=1e-9)
    assert width(points[:1] + np.arange(m)[:, None] * [3.0, 4.0], np.arange(m)) == pytest.approx(
        0.0, abs=1e-9
    )
    angle = np.linspace(0.0, np.pi, 60)
    assert found <= np.ptp(points @ np.array([np.cos(angle), np.sin(angle)]), axis=0).min() + 1e-9


def test_edges_are_valid_where_dense_samples_are():
    verdicts = set()
    for k in range(10):
        found = case("stanford", k)
        c = with_ends(found.c, np.stack([found.q_start, found.q_goal]))
        trial = new_trial(c)
        share = reached(c, found.q_start, found.q_goal, trial)
        # Without the demands, which rise in between: at every sample before it what must hold does.
        x = np.linspace(0.0, share, 400)[:, None]
        margins = np.array([margins_at(c, q)[0] for q in (1.0 - x) * found.q_start + x * found.q_goal])
        assert margins[:, [JOINTS, VISIBILITY, VISIBILITY + 1, WIDTH, WIDTH + 1]].min() > 0.0
        verdicts.add(share == 1.0)
    assert verdicts == {True, False}


def test_ends_that_have_twice_what_is_asked_for_are_asked_for_all_of_it():
    # Predictions that are off by up to 25 px leave a quarter of the distance from the border.
    found = case("paper", 3)
    c = found.c
    off = c.model.P.copy()
    off[0, 0] += 25.0 * off[0, 2]
    twice = (np.stack([part, part]) for part in (c.model.H_hat_0, c.M))
    c = c._replace(spread=Spread(np.stack([c.model.P, off]), *twice, 0.0, 25.0), full=c.full.copy())
    there, seen = (margins_at(one, found.q_start)[0] for one in (c, c._replace(spread=NO_SPREAD)))
    assert 0.0 < there[IMAGE] < 0.5 * seen[IMAGE]
    c.full[IMAGE], c.full[IMAGE + 1] = full = 0.5 * there[IMAGE], 1e4
    asked = with_ends(c, found.q_start[None])
    assert asked.end_demands[0, IMAGE] == full[0]


def test_start_and_goal_are_asked_for_no_more_than_they_have():
    # A distance from the border that no image has: the ends are valid all the same, what lies between is not.
    found = case("paper", 3)
    full = found.c.full.copy()
    full[IMAGE : IMAGE + 2] = 1e4
    asked = with_ends(found.c._replace(full=full), np.stack([found.q_start, found.q_goal]))
    trial = new_trial(asked)
    near = found.q_start + 1e-4 * (found.q_goal - found.q_start)
    assert reached(asked, found.q_start, near, trial) == 1.0
    assert reached(asked, found.q_start, found.q_goal, trial) < 1.0
    assert trial.failures[IMAGE : IMAGE + 2].sum() == trial.failures.sum() == 1
