"""The three classical laws against their formulas in plain NumPy."""

from operator import attrgetter

import numpy as np
import pytest

from projservo_cli.control.law import LOST, OK, new_state, reset
from projservo_cli.geometry.kinematics import image_jacobian
from projservo_cli.laws import CODES
from projservo_cli.loop.python_loop import BuiltInLaw
from projservo_cli.task.body_pose import make_body
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


def stacked(sc, q, s, M):
    """The pseudo-inverse of both views together; what it may be off, as a share and in rad/s."""
    J = image_jacobian(sc.model.P, M, operators(sc.model, q)).reshape(-1, 6)
    return np.linalg.pinv(J) @ (s - sc.s_star).ravel(), (1e-9, 0.0)


def blockwise(sc, q, s, M):
    """The sum of two monocular laws: three markers make a nearly singular matrix of each view."""
    views = image_jacobian(sc.model.P, M, operators(sc.model, q)).reshape(2, -1, 6)
    both = [
        np.linalg.pinv(J) @ (seen - star).ravel() for J, seen, star in zip(views, s, sc.s_star, strict=True)
    ]
    return sum(both), (1e-13 * max(map(np.linalg.cond, views)), 1e-9)


def euclidean_points(sc, q, s, M):
    """The pseudo-inverse in metres."""
    J = np.einsum("nij,mj->min", operators(sc.model, q), M)[:, :3].reshape(-1, 6)
    return np.linalg.pinv(J) @ (M - sc.plant.M @ poe(sc.model, sc.q_goal).T)[:, :3].ravel(), (1e-9, 0.0)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("law", [stacked, blockwise, euclidean_points], ids=lambda law: law.__name__)
def test_a_command_is_that_of_the_formula(law, case):
    sc, q, s, M = instant(*case)
    solution, (share, least) = law(sc, q, s, M)
    wanted = -GAINS.gain * solution
    status, q_dot = commanded(law.__name__, sc, s, q)
    assert status == OK
    assert q_dot == pytest.approx(wanted, abs=share * np.abs(wanted).max() + least)
    if law is euclidean_points:  # it is given its metric model; in another frame it commands something else
        assert np.abs(commanded("euclidean_points", sc, s, q, frame(1))[1] - q_dot).max() > 1e-4


@pytest.mark.parametrize("law", list(CODES))
def test_unseen_markers_are_lost(law):
    sc, q, s, _ = instant("RRRRRR", 4, 5)
    for value in (np.nan, np.inf):
        for place in [(0, 0, 0), (1, 3, 1)]:
            broken = s.copy()
            broken[place] = value
            assert commanded(law, sc, broken, q)[0] == LOST


def test_a_state_that_is_reset_is_a_new_one():
    used, new = new_state(6, 4), new_state(6, 4)
    names = "driven q_dot plan.q_ahead errors fit face_px limited step.share step.parts plan.clock"
    for name in names.split():
        attrgetter(name)(used)[:] = 7
    reset(used)
    for name in names.split():
        np.testing.assert_array_equal(attrgetter(name)(used), attrgetter(name)(new), err_msg=name)


def test_arrays_of_any_layout_give_the_same_command():
    sc, q, s, _ = instant("RRRRRR", 4, 1)
    apart = np.empty(12)[::2]
    apart[:] = q
    wanted, found = commanded("stacked", sc, s, q), commanded("stacked", sc, np.asfortranarray(s), apart)
    assert found[0] == wanted[0] == OK
    assert (found[1] == wanted[1]).all()


def test_the_error_of_a_face_that_its_body_locates_is_that_of_its_images():
    """Rms over markers and views; points by themselves have none such."""
    sc, q, s, _ = instant("RRRRRR", 6, 3)
    task, wanted = sc.task(), np.sqrt(np.mean(np.sum((s - sc.s_star) ** 2, axis=-1)))
    for body, error in ((make_body(sc.model, sc.plant.M), wanted), (task.body, np.nan)):
        law = BuiltInLaw(CODES["exact"], sc.model, task._replace(body=body), GAINS)
        assert law(s, q)[0] == OK
        assert law.state.face_px[0] == pytest.approx(error, nan_ok=True)
