"""Two views: epipolar geometry, centres, and triangulation that is exact, optimal, or refused."""

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from projservo_cli.geometry.stereo import fundamental_matrix, optical_centers, triangulate, triangulate_points
from projservo_cli.records import WorkFailed
from tests.samples import displacement, frame, hat, pixels, rig

METRIC = np.array([0.0, 0, 0, 1])
PARALLEL = np.array([np.c_[np.eye(3), [side * 0.15, 0, 0]] for side in (1, -1)])


def points(rng, k=30):
    return np.c_[rng.uniform(-0.4, 0.4, (k, 2)), rng.uniform(1.0, 2.5, k), np.ones(k)]


def one(P, a_inf, left, right):
    s = np.array([[left], [right]], dtype=float)
    return triangulate(P, np.arange(2), fundamental_matrix(P), a_inf, s, 0)


def cost(P, M, s):
    return float(np.sum((pixels(P, M[None])[:, 0] - s) ** 2))


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_fundamental_matrix_and_optical_centers(rng, seed):
    """Every pair satisfies it, and both epipoles are the images of the other centre, a_inf·O = 1."""
    G = np.eye(4) if seed is None else frame(seed)
    P = rig() @ np.linalg.inv(G)
    F = fundamental_matrix(P)
    s = np.concatenate([pixels(rig(), points(rng)), np.ones((2, 30, 1))], axis=2)
    lines = s[0] @ F.T
    distance = np.sum(s[1] * lines, axis=1) / np.hypot(lines[:, 0], lines[:, 1])
    assert np.abs(distance).max() < 1e-9  # px
    assert np.linalg.norm(F) == pytest.approx(1.0, abs=1e-14)
    assert np.linalg.svd(F, compute_uv=False)[2] < 1e-14
    a_inf = METRIC @ np.linalg.inv(G)
    O = optical_centers(P, a_inf)
    assert pytest.approx(G @ [[-0.15, 0.15], [0, 0], [0, 0], [1, 1]], abs=1e-12) == O.T
    e_left, e_right = P[0] @ O[1], P[1] @ O[0]
    assert np.abs(F @ e_left).max() < 1e-9 * np.linalg.norm(e_left)
    assert np.abs(F.T @ e_right).max() < 1e-9 * np.linalg.norm(e_right)


def test_a_rig_without_a_baseline_is_refused():
    with pytest.raises(WorkFailed, match="baseline"):
        fundamental_matrix(rig()[[0, 0]])


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_clean_points_are_recovered(rng, seed):
    """Round-off of 1e3 px over a parallax of 15 %: relative error well below 1e-10."""
    G = np.eye(4) if seed is None else frame(seed, mirrored=seed == 2)
    P, a_inf = rig() @ np.linalg.inv(G), METRIC @ np.linalg.inv(G)
    # Points have no orientation: a_inf·M = 1 also where both depths are negative.
    M = np.concatenate([points(rng), [[0.1, 0.05, -1.2, 1]]])
    found = triangulate_points(P, a_inf, pixels(rig(), M))
    assert found == pytest.approx(M @ G.T, abs=1e-11)
    assert found @ a_inf == pytest.approx(np.ones(len(M)), abs=1e-12)


@pytest.mark.parametrize("sigma", [0.1, 5.0])
@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_noisy_points_have_the_least_reprojection_error(rng, sigma, turn):
    """Not beaten by a general optimiser started at the result, and stationary to its gradient."""
    P = rig()
    P[1] = P[1] @ displacement([0.0, 0.0, turn], np.zeros(3))  # rows are no epipolar lines then
    M = points(rng, 12)
    s = pixels(P, M) + sigma * rng.normal(size=(2, 12, 2))
    found = triangulate_points(P, METRIC, s)
    for k in range(len(M)):

        def residual(X, k=k):
            return (pixels(P, np.append(X, 1.0)[None])[:, 0] - s[:, k]).ravel()

        ours = cost(P, found[k], s[:, k])
        best = least_squares(residual, found[k, :3], method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        # One misplaced iteration costs a share of 1e-4 and more of the error.
        assert ours <= 2 * best.cost * (1 + 1e-9) + 1e-15
        assert ours <= cost(P, M[k], s[:, k])
        assert found[k, :3] == pytest.approx(best.x, abs=1e-6 * sigma)


def test_points_do_not_depend_on_the_frame_nor_on_the_scale_of_a_camera(rng):
    s = pixels(rig(), points(rng)) + rng.normal(size=(2, 30, 2))
    M = triangulate_points(rig(), METRIC, s)
    for seed in range(3):
        G = frame(seed, mirrored=seed == 1)
        there = triangulate_points(rig() @ np.linalg.inv(G), METRIC @ np.linalg.inv(G), s)
        assert there == pytest.approx(M @ G.T, abs=1e-10)
    for scale in (1e-6, 2.5, 1e6, -1.0):
        P = rig() * np.array([scale, 1.0])[:, None, None]
        assert triangulate_points(P, METRIC, s) == pytest.approx(M, abs=1e-10)
        assert optical_centers(P, METRIC) == pytest.approx(optical_centers(rig(), METRIC), abs=1e-13)


def test_rays_that_meet_at_infinity_are_refused():
    """Parallel rays, in the metric frame and in another, where infinity is an ordinary place."""
    for seed in (None, 1, 2):
        G = np.eye(4) if seed is None else frame(seed)
        P, a_inf = PARALLEL @ np.linalg.inv(G), METRIC @ np.linalg.inv(G)
        for u, v in [(0.0, 0.0), (0.1, -0.3), (1 / 3, 0.7)]:
            assert one(P, a_inf, (u, v), (u, v)) == (False, (0.0, 0.0, 0.0, 0.0))


def test_pixels_that_are_no_numbers_are_refused():
    for place, bad in itertools.product(range(4), (math.nan, math.inf)):
        s = np.array([600.0, 500.0, 600.0, 500.0])
        s[place] = bad
        assert one(rig(), METRIC, s[:2], s[2:]) == (False, (0.0, 0.0, 0.0, 0.0))


def test_the_marker_at_fault_is_named():
    s = pixels(PARALLEL, np.array([[0.1, 0, 1.5, 1], [0.2, 0.1, 1.4, 1]]))
    s[1, 1] = s[0, 1]
    with pytest.raises(WorkFailed, match="marker 1 of the face"):
        triangulate_points(PARALLEL, METRIC, s)


def test_pixels_at_the_epipoles_are_refused():
    """On the baseline every plane through it is seen as the same line: no point is determined."""
    turn = hat([0, 0.4, 0], [0, 0, 0])[:3, :3] + np.eye(3)
    P = np.array([np.c_[turn, turn @ [0.15, 0, 0]], np.c_[np.eye(3), [-0.15, 0, 0.1]]])
    O = optical_centers(P, METRIC)
    left, right = P[0] @ O[1], P[1] @ O[0]
    found, _ = one(P, METRIC, left[:2] / left[2], right[:2] / right[2])
    assert not found
