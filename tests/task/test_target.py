"""Teaching by showing: the goal from images of the body."""

import math

import numpy as np
import pytest

from projservo_cli.geometry.algebra import as_array, mat
from projservo_cli.records import WorkFailed
from projservo_cli.task.body_pose import SETTLED, fit_body, make_body
from projservo_cli.task.face import UNSEEN_GOAL, require_found
from projservo_cli.task.target import TargetGoal, TaskImages
from tests.samples import frame, pixels, poe
from tests.scene import scene, with_pins


def case(G=None):
    """Model of a scene in a projective frame, what it shows with the body, and the true face at the goal."""
    sc = with_pins(scene())
    M = np.concatenate([sc.plant.M, sc.plant.pins])
    model = sc.seen(G)
    body = make_body(model, M if G is None else M @ G.T)
    s = [pixels(sc.model.P, M @ poe(sc.model, q).T) for q in (sc.q_start, sc.q_goal)]
    return (
        model,
        TaskImages(sc.q_start, s[0], TargetGoal.at(s[1]), -1, 5, body),
        body.M[:4] @ poe(model, sc.q_goal).T,
    )


@pytest.mark.parametrize("seed", [None, 1])
def test_exact_images_give_the_exact_goal(seed):
    model, shown, A_star = case(None if seed is None else frame(seed))
    task = shown.task(model)
    assert task.A_star == pytest.approx(A_star, abs=1e-9)
    assert task.s_star == pytest.approx(shown.s_star[:, :4], abs=0)
    assert task.body.in_goal.all()
    assert not np.shares_memory(task.body.in_goal, shown.body.in_goal)
    # A goal that shows the face alone is enough.
    shown.s_star[:, 4:] = math.nan
    task = shown.task(model)
    assert task.A_star == pytest.approx(A_star, abs=1e-9)
    assert task.body.in_goal.tolist() == [[True] * 4 + [False] * 5] * 2


def test_the_goal_is_the_least_squares_fit_to_all_that_is_seen(rng):
    """Found from triangulated points 0.5 px off, yet the same as from the true goal."""
    model, shown, _ = case(frame(2))
    star = shown.s_star + 0.5 * rng.normal(size=shown.s_star.shape)
    star[0, 6] = math.nan
    H = mat(poe(model, scene().q_goal))
    fit = fit_body(model.P, shown.body, star, H, SETTLED, np.zeros((6, 7)))
    assert fit.settled
    wanted = shown.body.M[:4] @ as_array(fit.H).T
    assert shown.to(star).task(model).A_star == pytest.approx(wanted, abs=1e-8)


def test_images_of_no_body_are_refused():
    model, shown, _ = case()
    star = shown.s_star
    star[:, :4] = star[:, :4].mean(axis=1, keepdims=True) + 40 * (
        star[:, [2, 0, 3, 1]] - star[:, [0, 2, 1, 3]]
    )
    with pytest.raises(WorkFailed):
        shown.task(model)


def test_too_few_markers_at_a_place_are_told():
    with pytest.raises(WorkFailed, match="the images at the goal show 2 markers in all views"):
        require_found(UNSEEN_GOAL, 2)


def test_a_start_without_unique_motions_is_told():
    model, shown, _ = case()
    H_hat_0 = model.H_hat_0.copy()
    H_hat_0[3] = H_hat_0[2]
    with pytest.raises(WorkFailed, match="not unique at the start"):
        shown.task(model._replace(H_hat_0=H_hat_0))
