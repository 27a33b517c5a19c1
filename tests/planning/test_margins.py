"""Margins, lattice sweeps and straightening against plain NumPy."""

import itertools

import numpy as np
import pytest

from projservo_cli.task.along import along
from projservo_cli.task.lattice import shortest, stride, view_shares, widest
from projservo_cli.task.margins import Demands, image_distance, limit_margin, view_share, visibility_margin
from projservo_cli.task.path import interpolate
from tests.planning.cases import reaching_of
from tests.samples import frame, in_frame, pixels, poe
from tests.stages.cases import case

SHARES = np.array([[0.0, 0.0, 0.0], [0.2, 0.7, 0.1], [0.6, 0.3, 0.9], [1.0, 0.0, 0.5], [1.0, 1.0, 1.0]])


def displacement(plan, mu):
    """Planned displacement from the exponentials of its parts, by Rodrigues' formula."""
    H = np.eye(4) + mu[0] * plan.tau * plan.H_hat[0]
    for share, theta, X in zip(mu[1:], (plan.theta_r, plan.theta_p), plan.H_hat[1:], strict=True):
        H = H @ (np.eye(4) + np.sin(share * theta) * X + (1 - np.cos(share * theta)) * X @ X)
    return H


@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_margins_of_the_views_are_those_of_the_displaced_face(name):
    example = case(name)
    plan, reaching = example.plan, reaching_of(name)
    size = example.truth.image_size
    for mu in SHARES:
        H = displacement(plan, mu)
        s = pixels(reaching.model.P, plan.A @ H.T)
        border = np.minimum(s + 0.5, size - 0.5 - s).min(axis=(1, 2))
        sight = plan.a @ np.linalg.inv(H) @ plan.optical_center.T / (plan.optical_center @ plan.a)
        for view in range(2):
            assert visibility_margin(reaching, view, mu[0], mu[1]) == pytest.approx(sight[view], abs=1e-12)
            found = image_distance(reaching, view, tuple(H.ravel()))
            assert found == pytest.approx(border[view], abs=1e-7)
        wanted = min(sight.min(), (border.min() - 20.0) / (0.5 * size.min() - 20.0))
        assert view_share(reaching, *mu) == pytest.approx(wanted, abs=1e-10)


def test_a_marker_behind_a_camera_is_as_far_outside_as_can_be():
    reaching = reaching_of("paper")
    H = np.eye(4)
    H[0, 3] = 3.0  # beyond the cameras, which look along −x from 2 m
    assert image_distance(reaching, 0, tuple(H.ravel())) == -1e9


def test_margin_of_joint_limits():
    demands = Demands(np.array([-1.0, -np.inf]), np.array([3.0, np.inf]), np.ones(2), np.ones(2), 0.0, 0.0)
    assert limit_margin(np.array([1.0, 99.0]), demands) == 1.0
    assert limit_margin(np.array([2.0, 99.0]), demands) == 0.5
    assert limit_margin(np.array([-1.5, 99.0]), demands) == -0.25


@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_joints_follow_the_planned_displacement(name):
    """The product of exponentials at the joints moves the face as planned, in any projective frame."""
    example = case(name)
    reaching = reaching_of(name)
    mu = np.linspace(0.0, 1.0, 5)[:, None] * np.array([1.0, 1.0, 1.0])
    found = along(reaching, mu)
    start = np.linalg.inv(poe(example.truth.model, reaching.q_start))
    plan = example.plan
    for q, share in zip(found.q, mu, strict=True):
        H = poe(example.truth.model, q) @ start
        np.testing.assert_allclose(plan.A @ H.T, plan.A @ displacement(plan, share).T, atol=1e-9)
    there = along(reaching_of(name, in_frame(example.truth.model, frame(3))), mu)
    np.testing.assert_allclose(there.q, found.q, atol=1e-7)
    np.testing.assert_allclose(there.condition, found.condition, rtol=1e-6)


@pytest.mark.volume
@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_lattice_of_the_views_holds_their_shares(name):
    reaching = reaching_of(name)
    shares = np.empty((6, 6, 6))
    view_shares(reaching, shares, np.empty((8, 7)))
    for i, j, k in itertools.product(range(6), repeat=3):
        assert shares[i, j, k] == pytest.approx(view_share(reaching, i / 5, j / 5, k / 5), abs=1e-10)


def all_paths(shape):
    """Every monotone path of nodes through a small lattice."""
    last = tuple(n - 1 for n in shape)
    steps = [np.array(step) for step in itertools.product((0, 1), repeat=3) if any(step)]

    def beyond(path):
        if path[-1] == last:
            yield path
            return
        for step in steps:
            node = tuple(int(x) for x in np.array(path[-1]) + step)
            if all(x <= y for x, y in zip(node, last, strict=True)):
                yield from beyond([*path, node])

    yield from beyond([(0, 0, 0)])


@pytest.mark.parametrize("seed", range(5))
def test_widest_and_shortest_path_among_all(seed):
    rng = np.random.default_rng(seed)
    shape = (3, 3, 2)
    margins, joints = rng.uniform(-1, 1, shape), rng.normal(size=(*shape, 2))
    weight = np.array([1.0, 0.3])
    paths = list(all_paths(shape))
    best = max(min(margins[node] for node in path) for path in paths)
    value = np.empty(shape)
    assert widest(margins, value) == best
    found = np.empty((8, 3), dtype=np.int64)
    cost, came = np.empty(shape), np.empty(shape, dtype=np.int64)
    count = shortest(value, best, joints, weight, cost, came, found)
    taken = [tuple(int(x) for x in node) for node in found[:count]]
    assert taken in paths
    assert min(margins[node] for node in taken) == best

    def duration(path):
        ends = itertools.pairwise(path)
        return sum((weight * np.abs(joints[b] - joints[a])).max() for a, b in ends)

    wide = [path for path in paths if min(margins[node] for node in path) == best]
    # Straighter paths are preferred by 1e-4 a step, at most eight of them.
    assert duration(taken) <= min(map(duration, wide)) + 1e-3
    assert stride(joints[0, 0, 0], joints[2, 2, 1], weight) == pytest.approx(
        (weight * np.abs(joints[2, 2, 1] - joints[0, 0, 0])).max()
    )


def test_interpolation_is_exact_for_a_linear_field(rng):
    x = np.linspace(0, 1, 5)
    nodes = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=3)
    W = rng.normal(size=(3, 2))
    field, value = nodes @ W, np.empty(2)
    for mu in (*rng.uniform(size=(20, 3)), np.ones(3), np.zeros(3)):
        interpolate(field, mu, value)
        np.testing.assert_allclose(value, mu @ W, atol=1e-14)
