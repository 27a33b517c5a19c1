"""The three classical laws against their formulas in plain NumPy."""

import numpy as np
import pytest

from projservo_cli.control.law import LOST, OK, new_state, reset
from projservo_cli.geometry.kinematics import image_jacobian
from projservo_cli.laws import CODES
from projservo_cli.loop.python import BuiltInLaw
from tests.samples import frame, operators, poe
from tests.scene import GAINS, scene

CASES = [("RRPRRR", 4, 1), ("RRRRRR", 3, 2), ("RRRRRR", 6, 3)]


def instant(types, m, seed):
    """Scene, joints between start and goal, and the pixels and points of the face there."""
    step = 0.3 * np.random.default_rng(seed).uniform(-0.5, 0.5, 6)
    sc = scene(step, types, m)
    q = sc.q_start + 0.4 * step
    return sc, q, sc.images(q), sc.plant.M @ poe(sc.model, q).T


def commanded(law, sc, s, q, G=None):
    return BuiltInLaw(CODES[law], sc.seen(G), sc.task(G), GAINS)(s, q)


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
    # It is the one baseline that is given its metric model; in another frame it commands something else.
    assert np.abs(commanded("euclidean_points", sc, s, q, frame(1))[1] - q_dot).max() > 1e-4


@pytest.mark.parametrize("law", list(CODES))
def test_unseen_markers_are_lost(law):
    sc, q, s, _ = instant("RRRRRR", 4, 5)
    for value in (np.nan, np.inf):
        for place in [(0, 0, 0), (1, 3, 1)]:
            broken = s.copy()
            broken[place] = value
            assert commanded(law, sc, broken, q)[0] == LOST


@pytest.mark.parametrize(
    "name", ["driven", "q_dot", "q_ahead", "errors", "fit", "face_px", "limited", "share", "parts", "clock"]
)
def test_a_state_that_is_reset_is_a_new_one(name):
    used, new = new_state(6, 4), new_state(6, 4)
    getattr(used, name)[:] = 7
    reset(used)
    np.testing.assert_array_equal(getattr(used, name), getattr(new, name))


def test_arrays_of_any_layout_give_the_same_command():
    sc, q, s, _ = instant("RRRRRR", 4, 1)
    apart = np.empty(12)[::2]
    apart[:] = q
    wanted, found = commanded("stacked", sc, s, q), commanded("stacked", sc, np.asfortranarray(s), apart)
    assert found[0] == wanted[0] == OK
    assert (found[1] == wanted[1]).all()
