"""Teaching by showing: the goal from images of the body."""

import math

import numpy as np
import pytest

from projservo_cli.geometry.algebra import as_mat
from projservo_cli.records import WorkFailed
from projservo_cli.task.body import body_of, new_normal
from projservo_cli.task.face import UNSEEN_GOAL, require_found
from projservo_cli.task.target import TOO_FEW, settled, task_from_body
from tests.samples import frame, pixels, poe
from tests.scene import scene, with_pins


class Shown:
    """A scene in a projective frame, and what both cameras show at the start and at the goal."""

    def __init__(self, G=None):
        self.sc = with_pins(scene())
        M = np.concatenate([self.sc.plant.M, self.sc.plant.pins])
        self.model = self.sc.seen(G)
        self.body = body_of(self.model, M if G is None else M @ G.T)
        self.start, self.star = (
            pixels(self.sc.model.P, M @ poe(self.sc.model, q).T) for q in (self.sc.q_start, self.sc.q_goal)
        )
        self.A_star = self.body.M[:4] @ poe(self.model, self.sc.q_goal).T

    def task(self, start=None, star=None):
        start = self.start if start is None else start
        star = self.star if star is None else star
        return task_from_body(self.model, self.body, self.sc.q_start, start, star, -1, 4)


def fitted(shown, star):
    """How the fit to images of the goal ends, begun where the goal truly is."""
    H = as_mat(poe(shown.model, shown.sc.q_goal))
    return settled(shown.model.P, shown.body, star, H, new_normal())


@pytest.mark.parametrize("seed", [None, 1])
def test_exact_images_give_the_exact_goal(seed):
    shown = Shown(None if seed is None else frame(seed))
    task = shown.task()
    assert task.A_star == pytest.approx(shown.A_star, abs=1e-9)
    assert task.s_star == pytest.approx(shown.star[:, :4], abs=0)
    assert len(task.body.M) == 9


def test_a_goal_that_shows_the_face_alone_is_enough():
    shown = Shown(frame(1))
    star = shown.star.copy()
    star[:, 4:] = math.nan
    assert shown.task(star=star).A_star == pytest.approx(shown.A_star, abs=1e-9)


def test_the_goal_is_the_least_squares_fit_to_all_that_is_seen(rng):
    """Found from triangulated points 0.5 px off, yet the same as from the true goal."""
    shown = Shown(frame(2))
    star = shown.star + 0.5 * rng.normal(size=shown.star.shape)
    star[0, 6] = math.nan
    H = np.array(fitted(shown, star)[2]).reshape(4, 4)
    assert shown.task(star=star).A_star == pytest.approx(shown.body.M[:4] @ H.T, abs=1e-8)


def test_images_of_no_body_are_refused():
    shown = Shown()
    star = shown.star.copy()
    star[:, :4] = star[:, :4].mean(axis=1, keepdims=True) + 40 * (
        star[:, [2, 0, 3, 1]] - star[:, [0, 2, 1, 3]]
    )
    with pytest.raises(WorkFailed):
        shown.task(star=star)


def test_too_few_markers_at_a_place_are_told():
    shown = Shown()
    few = np.full_like(shown.star, math.nan)
    few[0, :2] = shown.star[0, :2]
    ended, views, _ = fitted(shown, few)
    assert (ended, views) == (TOO_FEW, 2)
    with pytest.raises(WorkFailed, match="the images at the goal show too few markers, 2 in both views"):
        require_found(UNSEEN_GOAL, views)


def test_a_start_without_unique_motions_is_told():
    shown = Shown()
    H_hat_0 = shown.model.H_hat_0.copy()
    H_hat_0[3] = H_hat_0[2]
    shown.model = shown.model._replace(H_hat_0=H_hat_0)
    with pytest.raises(WorkFailed, match="not unique at the start"):
        shown.task()
