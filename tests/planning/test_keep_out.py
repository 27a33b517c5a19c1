"""Regions that are kept out of: distances by another library, and a box in space."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from scipy.spatial import ConvexHull

from projservo_cli.planning.keep_out import keep_out_of, outside_polygon
from projservo_cli.planning.rrt_connect import SearchLimits, find_path, margins_at
from projservo_cli.planning.time_parameterization import joints_at
from projservo_cli.records import Spread
from tests.planning.columns import CLEAR
from tests.planning.joint_space_cases import COUNT, case


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
        found = outside_polygon(corners, 0, len(corners), (u, v))
        assert abs(found) == pytest.approx(np.hypot(*(outline - (u, v)).T).min(), abs=0.1)
        if abs(found) > 1e-6:
            assert (found < 0.0) == Outline(corners).contains_point((u, v))


def outside(s, corners):
    """Distances (k,) of pixels (k, 2) from a polygon, negative within, by its edges one by one."""
    ends = np.roll(corners, -1, axis=0) - corners
    x = ((s[:, None] - corners) * ends).sum(axis=-1) / (ends**2).sum(axis=-1)
    away = s[:, None] - corners - np.clip(x, 0.0, 1.0)[..., None] * ends
    far = np.linalg.norm(away, axis=-1).min(axis=1)
    return np.where(Outline(corners).contains_points(s), -far, far)


@pytest.mark.parametrize("k", range(6))
def test_the_margin_is_that_of_every_point_of_every_segment(k):
    """Held against thousands of points, of thin regions too, which markers alone would not meet."""
    found, rng = case("paper", k), np.random.default_rng(k)
    truth, size = found.truth, np.asarray(found.c.image_size)[:, None]
    for _ in range(8):
        q = found.q_start + rng.uniform(-0.05, 0.05, 6)
        face = truth.M_face @ truth.displacement(q).T
        x = np.linspace(0.0, 1.0, 3001)[:, None]
        pairs = [(i, j) for i in range(len(face)) for j in range(i)]
        points = np.vstack([(1 - x) * face[i] + x * face[j] for i, j in pairs])
        s = truth.images(q, truth.M_face)
        drawn = []
        for view in range(2):
            middle, far = s[view].mean(axis=0) + rng.normal(0.0, 40.0, 2), rng.uniform(2.0, 60.0)
            turn = rng.uniform(0.0, np.pi)
            along, across = (
                far * np.array([np.cos(turn), np.sin(turn)]),
                np.array([-np.sin(turn), np.cos(turn)]),
            )
            drawn.append(np.array([middle - along, middle + across, middle + along, middle - across]))
        m = points @ np.swapaxes(truth.P, 1, 2)
        pixels = m[..., :2] / m[..., 2:]
        border = np.minimum(pixels + 0.5, size - 0.5 - pixels).min(axis=-1)
        seen = np.array([outside(pixels[v], drawn[v]) for v in range(2)])
        one = np.minimum(seen, border).max(axis=0).min()
        margin = margins_at(found.c._replace(keep_out=keep_out_of([(drawn, False)])), q)[0][CLEAR]
        assert margin <= one + 1e-2
        assert margin >= one - max(1.0, 0.5 * abs(one))
        # What predictions may be off is that of these joints, not the most that it is anywhere.
        spread = Spread(
            *(x[None] for x in (truth.P, found.c.model.H_hat_0, found.c.M)), rest=1.0, max_sigma=9.0
        )
        off = found.c._replace(keep_out=keep_out_of([(drawn, False)]), spread=spread)
        if one > 8.0:
            assert margins_at(off, q)[0][CLEAR] == pytest.approx(margin - 3.0, abs=0.3 * margin)
        both = min(outside(s[v], drawn[v]).min() for v in range(2))
        hides = margins_at(found.c._replace(keep_out=keep_out_of([(drawn, True)])), q)[0][CLEAR]
        assert hides == pytest.approx(min(both, margin))


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
        free = find_path(found.c, found.aim, found.q_start, nothing, SearchLimits())
        middle, (left, right) = box_of(
            found, joints_at(free.timing, np.array([0.5 * free.timing.time[-1]]))[0], 0.02
        )
        c = found.c._replace(keep_out=keep_out_of([((left, right), False)]))
        ends = [found.truth.images(q, found.truth.M_face) for q in (found.q_start, found.q_goal)]
        if any(
            Outline(drawn).contains_points(s[v]).any() for s in ends for v, drawn in enumerate((left, right))
        ):
            continue
        tried += 1
        way = find_path(c, found.aim, found.q_start, nothing, SearchLimits())
        if len(way.corners) == 0:
            continue
        around += 1
        for q in joints_at(way.timing, np.linspace(0.0, way.timing.time[-1], 400)):
            X = (found.truth.M_face @ found.truth.displacement(q).T)[:, :3]
            x = np.linspace(0.0, 1.0, 20)[:, None, None]
            segments = (1 - x) * X + x * np.roll(X, -1, axis=0)
            assert (np.abs(segments - middle).max(axis=-1) > 0.02).all()
    assert tried >= 4
    assert around >= 0.7 * tried
