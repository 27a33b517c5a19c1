"""The three classical laws against their formulas in plain NumPy."""

import numpy as np
import pytest

from projservo_cli.control import CODES, command
from projservo_cli.control.law import LOST, OK, SINGULAR, new_state
from projservo_cli.geometry.kinematics import image_jacobian
from tests.samples import frame, in_frame, operators, poe
from tests.scene import GAINS, scene

CASES = [("RRRRRR", 4, 0), ("RRPRRR", 4, 1), ("RRRRRR", 3, 2), ("RRRRRR", 6, 3)]


def instant(types, m, seed):
    """Scene, joints between start and goal, and the pixels and points of the face there."""
    step = 0.3 * np.random.default_rng(seed).uniform(-0.5, 0.5, 6)
    sc = scene(step, types, m)
    q = sc.q_start + 0.4 * step
    return sc, q, sc.images(q), sc.plant.M @ poe(sc.model, q).T


def commanded(law, sc, s, q, G=None, gains=GAINS):
    state = new_state(len(q), s.shape[1])
    status = command(CODES[law], sc.seen(G), sc.task(G), gains, s, q, state)
    return status, state.q_dot


@pytest.mark.parametrize("case", CASES)
def test_stacked_is_the_pseudo_inverse_of_both_views(case):
    sc, q, s, M = instant(*case)
    J = image_jacobian(sc.model.P, M, operators(sc.model, q)).reshape(-1, 6)
    wanted = -GAINS.gain * np.linalg.pinv(J) @ (s - sc.s_star).ravel()
    status, q_dot = commanded("stacked", sc, s, q)
    assert status == OK
    assert q_dot == pytest.approx(wanted, rel=1e-9, abs=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("case", CASES)
def test_blockwise_is_the_sum_of_two_monocular_laws(case):
    """With three markers each view has as many equations as joints and a nearly singular matrix."""
    sc, q, s, M = instant(*case)
    J = image_jacobian(sc.model.P, M, operators(sc.model, q))
    views = [J[v].reshape(-1, 6) for v in range(2)]
    wanted = -GAINS.gain * sum(np.linalg.pinv(views[v]) @ (s[v] - sc.s_star[v]).ravel() for v in range(2))
    status, q_dot = commanded("blockwise", sc, s, q)
    assert status == OK
    condition = max(np.linalg.cond(view) for view in views)
    assert q_dot == pytest.approx(wanted, abs=1e-13 * condition * np.abs(wanted).max() + 1e-9)


@pytest.mark.parametrize("case", CASES)
def test_euclidean_points_is_the_pseudo_inverse_in_metres(case):
    sc, q, s, M = instant(*case)
    goal = sc.plant.M @ poe(sc.model, sc.q_goal).T
    J = np.einsum("nij,mj->min", operators(sc.model, q), M)[:, :3].reshape(-1, 6)
    wanted = -GAINS.gain * np.linalg.pinv(J) @ (M - goal)[:, :3].ravel()
    status, q_dot = commanded("euclidean_points", sc, s, q)
    assert status == OK
    assert q_dot == pytest.approx(wanted, rel=1e-9, abs=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("law", ["stacked", "blockwise", "euclidean_points"])
def test_commands_are_proportional_to_the_gain(law):
    sc, q, s, _ = instant(*CASES[0])
    _, slow = commanded(law, sc, s, q, gains=GAINS._replace(gain=0.5))
    _, fast = commanded(law, sc, s, q, gains=GAINS._replace(gain=2.0))
    assert fast == pytest.approx(4 * slow, rel=1e-12)


@pytest.mark.parametrize("law", ["direct_three", "direct_two", "stacked", "blockwise"])
@pytest.mark.parametrize("types", ["RRRRRR", "RRPRRR"])
def test_laws_need_no_metric_frame(law, types):
    """The same command from the model in any projective frame, and from cameras of any scale."""
    sc, q, s, _ = instant(types, 4, 5)
    wanted = commanded(law, sc, s, q)[1]
    for seed in (1, 2, 3):
        status, q_dot = commanded(law, sc, s, q, frame(seed, mirrored=seed == 2))
        assert status == OK
        assert q_dot == pytest.approx(wanted, abs=1e-8 * np.abs(wanted).max())
    scaled = sc.model._replace(P=sc.model.P * np.array([-3.0, 1e-3])[:, None, None])
    state = new_state(6, 4)
    command(CODES[law], scaled, sc.task(), GAINS, s, q, state)
    assert state.q_dot == pytest.approx(wanted, abs=1e-8 * np.abs(wanted).max())


def test_the_euclidean_law_does_need_the_metric_frame():
    """It is the one baseline that is given its metric model; elsewhere it commands something else."""
    sc, q, s, _ = instant("RRRRRR", 4, 5)
    wanted = commanded("euclidean_points", sc, s, q)[1]
    assert np.abs(commanded("euclidean_points", sc, s, q, frame(1))[1] - wanted).max() > 1e-3


@pytest.mark.parametrize("law", list(CODES))
def test_unseen_markers_are_lost(law):
    sc, q, s, _ = instant("RRRRRR", 4, 5)
    for value in (np.nan, np.inf):
        for place in [(0, 0, 0), (0, 2, 1), (1, 3, 0), (1, 0, 1)]:
            broken = s.copy()
            broken[place] = value
            assert commanded(law, sc, broken, q)[0] == LOST


@pytest.mark.parametrize("law", list(CODES))
def test_coaxial_joints_are_singular(law):
    """A wrist singularity: two joints do the same, and no law may pick one at random."""
    sc, q, s, _ = instant("RRRRRR", 4, 5)
    H_hat_0 = sc.model.H_hat_0.copy()
    H_hat_0[3] = H_hat_0[2]
    model = sc.model._replace(H_hat_0=H_hat_0)
    state = new_state(6, 4)
    q = sc.model.q_reference + 0.3 * np.eye(6)[5]
    assert command(CODES[law], model, sc.task(), GAINS, s, q, state) == SINGULAR


@pytest.mark.parametrize("law", list(CODES))
def test_at_the_goal_nothing_moves(law):
    sc, _, _, _ = instant("RRRRRR", 4, 5)
    for G in (None, frame(1)):
        if G is not None and law == "euclidean_points":
            continue
        status, q_dot = commanded(law, sc, sc.s_star, sc.q_goal, G)
        assert status == OK
        # Round-off of 1e3 px in metres and rad, times the gain.
        assert np.abs(q_dot).max() < 1e-8


def test_in_frame_keeps_the_robot():
    """The check of frames above is one: the transformed model draws the same pixels."""
    sc, _q, s, M = instant("RRRRRR", 4, 5)
    G = frame(1)
    there = in_frame(sc.model, G)
    m = (M @ G.T) @ np.swapaxes(there.P, 1, 2)
    assert m[..., :2] / m[..., 2:] == pytest.approx(s, abs=1e-9)
    assert np.abs(there.H_hat_0 - sc.model.H_hat_0).max() > 0.1
