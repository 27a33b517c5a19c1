"""Regions that are kept out of: distances by another library, and a box in space."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from scipy.spatial import ConvexHull

from projservo_cli.guidance.keep_out import keep_out_of, outside_polygon
from projservo_cli.guidance.timing import joints_at
from projservo_cli.guidance.way import Search, find_way
from tests.guidance.cases import COUNT, case


@settings(deadline=None)
@given(st.integers(3, 9), st.integers(0, 10_000))
def test_the_distance_from_a_polygon_is_that_to_its_outline(k, seed):
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, k))
    corners = 100.0 * rng.uniform(0.3, 1.0, k)[:, None] * np.c_[np.cos(angle), np.sin(angle)]
    x = np.linspace(0.0, 1.0, 4001)[:, None]
    outline = np.vstack(
        [(1 - x) * a + x * b for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    for u, v in rng.uniform(-120.0, 120.0, (8, 2)):
        found = outside_polygon(corners, 0, len(corners), u, v)
        assert abs(found) == pytest.approx(np.hypot(*(outline - (u, v)).T).min(), abs=0.1)
        if abs(found) > 1e-6:
            assert (found < 0.0) == Outline(corners).contains_point((u, v))


def box_of(found, q, half):
    """A box in space around where the middle of the face is at joints, and its outlines in both images."""
    truth = found.truth
    middle = (truth.M_face @ truth.displacement(q).T)[:, :3].mean(axis=0)
    corners = middle + half * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    m = np.c_[corners, np.ones(8)] @ np.swapaxes(truth.P, 1, 2)
    pixels = m[..., :2] / m[..., 2:]
    return middle, [view[ConvexHull(view).vertices] for view in pixels]


def test_no_marker_enters_a_box_that_stands_on_the_straight_way():
    tried = around = 0
    for k in range(COUNT):
        found = case("paper", k)
        nothing = np.empty((0, 6))
        free = find_way(found.c, found.aim, found.q_start, nothing, Search(), found.acceleration)
        middle, (left, right) = box_of(
            found, joints_at(free.pace, np.array([0.5 * free.pace.time[-1]]))[0], 0.02
        )
        c = found.c._replace(keep_out=keep_out_of([(left, right, False)]))
        ends = [found.truth.images(q, found.truth.M_face) for q in (found.q_start, found.q_goal)]
        if any(
            Outline(drawn).contains_points(s[v]).any() for s in ends for v, drawn in enumerate((left, right))
        ):
            continue
        tried += 1
        way = find_way(c, found.aim, found.q_start, nothing, Search(), found.acceleration)
        if len(way.corners) == 0:
            continue
        around += 1
        for q in joints_at(way.pace, np.linspace(0.0, way.pace.time[-1], 400)):
            X = (found.truth.M_face @ found.truth.displacement(q).T)[:, :3]
            x = np.linspace(0.0, 1.0, 20)[:, None, None]
            segments = (1 - x) * X + x * np.roll(X, -1, axis=0)
            assert (np.abs(segments - middle).max(axis=-1) > 0.02).all()
    assert tried >= 4
    assert around >= 0.7 * tried


def test_a_region_of_one_image_bars_that_image():
    found = case("paper", 0)
    nothing = np.empty((0, 6))
    everywhere = np.array([[-1e4, -1e4], [1e4, -1e4], [1e4, 1e4], [-1e4, 1e4]])
    c = found.c._replace(keep_out=keep_out_of([(everywhere, None, True)]))
    way = find_way(c, found.aim, found.q_start, nothing, Search(samples=200), found.acceleration)
    assert len(way.corners) == 0
    assert way.failures[9] == way.failures.max()
