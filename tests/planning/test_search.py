"""Joints carried through all nodes of the lattice, and tasks that only they show a path for."""

import numpy as np
import pytest

from projservo_cli.geometry.mechanisms import span_of, workspace
from projservo_cli.stages.plan import demands_of, plan_task
from projservo_cli.stages.world import truth_of
from projservo_cli.task.lattice import near, view_shares, widest
from projservo_cli.task.margins import limit_margin
from projservo_cli.task.search import MOST_STRIDE, WAYS, best_way, carry, orientation, traced
from projservo_cli.task.trajectory import displaced
from tests.planning.arm import arm_of, feasible
from tests.planning.cases import reaching_of
from tests.planning.driven import configured, true_task
from tests.samples import arm, frame, in_frame, operators, poe

# A lattice as coarse as those that are looked at first; joints may move twice as far between its nodes.
NODES, PARTS = 11, 2
STRIDE = PARTS * MOST_STRIDE
# Tasks of the second robot, deg: the first passes beside a joint limit; in the second the turn within the
# plane has to take the longer sense.
HIDDEN = [
    (
        [168.461, -221.345, -97.337, -138.973, 70.816, 217.991],
        [85.375, 207.161, 140.25, -218.885, 208.666, 178.75],
    ),
    (
        [-92.08, -3.255, -57.914, -212.501, -3.028, 104.43],
        [55.284, 154.109, -53.146, -323.938, -186.197, -136.277],
    ),
]
# One in which joint 5 would have to pass 180°, where joints 4 and 6 are one axis.
JUMP = (
    [219.601, 156.604, 152.68, -319.261, -41.8, -140.096],
    [68.604, -184.647, 63.518, -239.498, 112.226, 100.466],
)


@pytest.mark.volume
@pytest.mark.parametrize("task", HIDDEN)
def test_a_path_that_the_coarse_lattice_does_not_show(task, truth_and_demands):
    """A grid search with the true arm finds a path; so does the planner, and its joints reach the goal."""
    truth, demands = truth_and_demands
    q_start, q_goal = np.radians(task)
    assert feasible(arm_of(truth, demands.conditioning), true_task(truth, q_start, q_goal), q_start)
    s_start, s_star = (truth.images(q, truth.M_face) for q in (q_start, q_goal))
    plan = plan_task(truth.model, q_start, s_start, s_star, truth.center, "constrained", 0.9, 101, demands)
    assert plan.feasible, plan.reason
    assert min(limit_margin(q, demands) for q in plan.q) > 0.0
    assert np.abs(np.diff(plan.q, axis=0)).max() < MOST_STRIDE
    np.testing.assert_allclose(truth.images(plan.q[-1], truth.M_face), s_star, atol=1e-4)


@pytest.fixture(scope="module")
def truth_and_demands():
    config = configured("ur5")
    return truth_of(config), demands_of(config)


@pytest.fixture(scope="module", params=["paper", "ur5"])
def carried(request):
    """A shipped task on a lattice of ``NODES``³: what carries it, and the joints, values and steps."""
    reaching = reaching_of(request.param)
    shape = (NODES, NODES, NODES)
    shares, views = np.empty(shape), np.empty(shape)
    view_shares(reaching, shares, np.empty((2 * len(reaching.A), 7)))
    widest(shares, views)
    value, came = np.empty((*shape, WAYS)), np.empty((*shape, WAYS), dtype=np.int64)
    joints = np.empty((*shape, WAYS, 6))
    work = workspace(6, 4 * len(reaching.A), span_of(reaching.model, reaching.A))
    carry(reaching, views, value, joints, came, PARTS, np.empty((6, 4, 4)), np.empty((10, 6)), work)
    return reaching, views, value, joints, came


def test_joints_at_every_node_are_those_of_its_displacement(carried):
    reaching, _, value, joints, _ = carried
    start = np.linalg.inv(poe(reaching.model, reaching.q_start))
    found = np.argwhere(value > 0.0)
    assert len(found) > 0.5 * NODES**3
    for i, j, k, way in found[::7]:
        mu = np.array([i, j, k]) / (NODES - 1)
        H = np.array(displaced(reaching.H_hat, reaching.amplitudes, *mu)).reshape(4, 4)
        # The Newton step that is the last was at most 1e-2 rad; its error is of second order.
        np.testing.assert_allclose(poe(reaching.model, joints[i, j, k, way]) @ start, H, atol=1e-3)
        assert limit_margin(joints[i, j, k, way], reaching.demands) > 0.0


def test_values_are_the_smallest_share_on_the_way(carried):
    _, views, value, joints, came = carried
    for i, j, k, way in np.argwhere(value > 0.0)[1::7]:
        step = came[i, j, k, way]
        before = (i - (step >> 2 & 1), j - (step >> 1 & 1), k - (step & 1), step >> 3)
        assert 0.0 < value[i, j, k, way] <= min(value[before], views[i, j, k])
        assert near(joints[i, j, k, way], joints[before], STRIDE)
        for other in range(way):
            assert not near(joints[before], joints[i, j, k, other], STRIDE)


def test_the_traced_path_leads_from_first_to_last(carried):
    _, _, value, _, came = carried
    path = np.empty((3 * NODES, 3), dtype=np.int64)
    path = path[: traced(value, came, path)]
    np.testing.assert_array_equal(path[[0, -1]], [[0] * 3, [NODES - 1] * 3])
    steps = np.diff(path, axis=0)
    assert ((steps == 0) | (steps == 1)).all()
    assert (steps.sum(axis=1) > 0).all()
    assert (value.max(axis=3)[tuple(path.T)] >= value[-1, -1, -1].max()).all()


def test_no_path_is_traced_where_none_arrives():
    value = np.full((3, 3, 3, WAYS), -1.0)
    path = np.empty((9, 3), dtype=np.int64)
    assert traced(value, np.zeros((3, 3, 3, WAYS), dtype=np.int64), path) == 0


def test_another_way_is_one_of_other_joints():
    """Two neighbours lead to a node: of equal joints the better one alone, of different ones both."""
    value, joints = np.full((2, 2, 2, WAYS), -1.0), np.zeros((2, 2, 2, WAYS, 6))
    value[0, 1, 1, 0], value[1, 0, 1, 1] = 0.3, 0.6
    assert best_way(value, joints, 1, 1, 1, 0, 0.5) == (0.6, 2, 1)
    assert best_way(value, joints, 1, 1, 1, 1, 0.5)[0] == 0.0
    joints[0, 1, 1, 0, 3] = 2.0 * np.pi
    assert best_way(value, joints, 1, 1, 1, 1, 0.5) == (0.3, 4, 0)
    joints[1, 1, 1, 1, 3] = 2.0 * np.pi
    assert best_way(value, joints, 1, 1, 1, 2, 0.5)[0] == 0.0


def test_orientation_changes_its_sign_where_operators_are_dependent(rng):
    """In any frame it has the sign of the determinant of the screws over that at the start."""
    model = arm()
    frames = [model, in_frame(model, frame(3, mirrored=True))]
    G = np.empty((6, 6))
    signs = []
    for _ in range(60):
        q_start, q = rng.uniform(-3.0, 3.0, (2, 6))
        wanted = np.linalg.det(screws(model, q)) * np.linalg.det(screws(model, q_start))
        for there in frames:
            found = orientation(operators(there, q), operators(there, q_start), G)
            assert np.sign(found) == np.sign(wanted)
        signs.append(wanted > 0.0)
    assert 10 < sum(signs) < 50
    assert orientation(np.zeros((7, 4, 4)), np.zeros((7, 4, 4)), G) == 1.0


def screws(model, q):
    """Axes and moments (6, 6) of the operators of a metric model."""
    H = operators(model, q)
    return np.stack([H[:, 2, 1], H[:, 0, 2], H[:, 1, 0], *H[:, :3, 3].T])


@pytest.mark.volume
def test_no_path_jumps_over_a_singular_configuration(truth_and_demands):
    """Without the sign of the determinant the joints jump from a wrist to the flipped one between nodes."""
    truth, demands = truth_and_demands
    demands = demands._replace(miss_px=0.0)
    q_start, q_goal = np.radians(JUMP)
    assert not feasible(arm_of(truth, demands.conditioning), true_task(truth, q_start, q_goal), q_start)
    s_start, s_star = (truth.images(q, truth.M_face) for q in (q_start, q_goal))
    plan = plan_task(truth.model, q_start, s_start, s_star, truth.center, "constrained", 0.9, 101, demands)
    assert not plan.feasible
