"""Margins and lattice sweeps against plain NumPy."""

import itertools
import math

import numpy as np
import pytest

from projservo_cli.image_size import BEHIND
from projservo_cli.planning.joint_constraints import constraints_of
from projservo_cli.planning.motion_margins import (
    along_joints,
    along_shares,
    image_margin,
    joint_margin,
    limit_margin,
    limits_alone,
)
from projservo_cli.planning.product_space import shortest, widest
from projservo_cli.planning.rrt_connect import margins_at
from projservo_cli.planning.time_parameterization import minimum_time
from projservo_cli.records import position_limits
from tests.planning.cases import reaching_of
from tests.planning.columns import FRONT, IMAGE, VISIBILITY
from tests.samples import pixels
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
    found = along_shares(reaching, SHARES).along
    for i, mu in enumerate(SHARES):
        H = displacement(plan, mu)
        s = pixels(reaching.model.P, plan.A @ H.T)
        np.testing.assert_allclose(found.H_d[i], H, atol=1e-12)
        np.testing.assert_allclose(found.s[i], s, atol=1e-7)
        border = np.minimum(s + 0.5, size[:, None] - 0.5 - s).min(axis=(1, 2))
        np.testing.assert_allclose(found.distance[i], border, atol=1e-7)
        sight = plan.a @ np.linalg.inv(H) @ plan.optical_center.T / (plan.optical_center @ plan.a)
        np.testing.assert_allclose(found.visibility[i], sight, atol=1e-12)
        wanted = (border.min() - 20.0) / (0.5 * size.min() - 20.0)
        assert image_margin(reaching.demands, found.distance[i].min()) == pytest.approx(wanted, abs=1e-9)
        assert found.margins[i, 1] == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_margins_of_a_motion_are_those_of_its_joints(name):
    """What profiles of the paper are measured against is what a search through joint space keeps to."""
    example, reaching = case(name), reaching_of(name)
    task, start = example.ends.task(example.truth.model), reaching.q_start
    c = constraints_of(reaching.model, reaching.A, task, start, reaching.demands)
    q = start + np.random.default_rng(4).uniform(-0.5, 0.5, (200, len(start)))
    found, shown = along_joints(reaching, q).along, 0
    for k, margins in enumerate(margins_at(c, joints)[0] for joints in q):
        np.testing.assert_allclose(found.visibility[k], margins[VISIBILITY : VISIBILITY + 2], atol=1e-9)
        if (margins[FRONT : FRONT + 2] > 0.0).all():
            np.testing.assert_allclose(found.distance[k], margins[IMAGE : IMAGE + 2], atol=1e-7)
            shown += 1
    assert shown > 100


def test_a_marker_behind_a_camera_is_as_far_outside_as_can_be():
    """Beyond the cameras, which look along −x from 2 m; cameras have no sign of their own."""
    reaching = reaching_of("paper")
    X = np.zeros((4, 4))
    X[0, 3] = 1.0
    there = reaching._replace(H_hat=np.stack([X, *reaching.H_hat[1:]]), amplitudes=np.array([3.0, 0.0, 0.0]))
    for sign in (1.0, -1.0):
        model = there.model._replace(P=sign * there.model.P)
        shares = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        found = along_shares(there._replace(model=model), shares).along
        assert found.distance[0].min() > 0.0
        assert found.distance[1, 0] == BEHIND


def test_margin_of_joint_limits():
    demands = limits_alone(position_limits(np.array([-1.0, -np.inf]), np.array([3.0, np.inf])))
    for q_0, wanted in ((1.0, 1.0), (2.0, 0.5), (-1.5, -0.25)):
        q = np.array([q_0, 99.0])
        assert [joint_margin(demands, q, i) for i in range(2)] == [wanted, 1.0]
        assert limit_margin(demands, q) == wanted


def test_joints_that_cannot_follow_are_none_from_there_on():
    """Twice the translation leads out of reach; the margin of conditioning says so."""
    reaching = reaching_of("ur5")
    far = reaching._replace(amplitudes=reaching.amplitudes * np.array([8.0, 0.0, 0.0]))
    found = along_shares(far, np.linspace(0.0, 1.0, 11)[:, None] * np.ones(3)).along
    lost = np.isnan(found.q).any(axis=1)
    assert not lost[0]
    assert lost[-1]
    assert (np.diff(lost.astype(int)) >= 0).all()
    np.testing.assert_array_equal(found.margins[lost, 3], -10.0)
    np.testing.assert_array_equal(np.isnan(found.condition), lost)


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
    shape = (3, 3, 3)
    margins, joints = rng.uniform(-1, 1, shape), rng.normal(size=(*shape, 2))
    speed = np.array([1.0, 3.0])
    paths = list(all_paths(shape))
    best = max(min(margins[node] for node in path) for path in paths)
    value = widest(margins.ravel())
    assert value[-1] == best
    nodes = shortest(value >= best, joints.reshape(-1, 2), speed)
    taken = [tuple(int(x) for x in np.unravel_index(node, shape)) for node in nodes]
    assert taken in paths
    assert min(margins[node] for node in taken) == best

    def duration(path):
        return sum((np.abs(joints[b] - joints[a]) / speed).max() for a, b in itertools.pairwise(path))

    wide = [path for path in paths if min(margins[node] for node in path) == best]
    # Straighter paths are preferred by 1e-4 a step, at most eight of them.
    assert duration(taken) <= min(map(duration, wide)) + 1e-3
    q = np.array([joints[node] for node in taken])
    assert minimum_time(speed, q)[-1] == pytest.approx(duration(taken))
    unlimited = minimum_time(np.full(2, math.inf), q)
    assert unlimited[1] == np.abs(q[1] - q[0]).max()
