"""Closed loops that measure with the body: what is lost, what is kept, what is logged."""

import numpy as np
import pytest

from tests.samples import frame
from tests.scene import Run, limits, scene, with_pins

LAWS = ("direct_three", "direct_two", "exact")


def body_run(sc, law, G=None, **given):
    return Run(sc, law, G=G, task=sc.body_task(G), **given)


@pytest.mark.parametrize("law", LAWS)
def test_without_noise_both_observations_drive_alike(law):
    """With the true model what the body says is what the points say."""
    sc = with_pins(scene())
    body, points = body_run(sc, law, frame(1)), Run(sc, law, G=frame(1))
    assert (body.verdict, body.steps) == (points.verdict, points.steps) == ("converged", points.steps)
    assert body.log.q == pytest.approx(points.log.q, abs=1e-7)
    assert (body.log.fit[:, 2] == 18).all()
    assert body.log.fit[:, :2] == pytest.approx(np.zeros((body.steps + 1, 2)), abs=1e-12)
    assert np.isnan(points.log.fit).all()


def test_the_last_residual_is_that_of_the_noise(rng):
    """Per degree of freedom; the prediction adds nothing where the joints are read exactly."""
    sc = with_pins(scene())
    bounds = limits(max_steps=120, image_error_px=1e-9)
    run = body_run(sc, "exact", bounds=bounds, noise=0.5 * rng.normal(size=(121, 2, 9, 2)))
    before, after, views = run.log.fit.T
    dof = 2 * views - 6
    # Means of 121 sums of 30 and 36 squares: four standard deviations.
    assert np.sum(after) / np.sum(dof) == pytest.approx(0.25, rel=4 * np.sqrt(2 / np.sum(dof)))
    assert np.sum(before) / np.sum(2 * views) == pytest.approx(0.25, rel=4 * np.sqrt(1 / np.sum(views)))


@pytest.mark.parametrize("shown", [9, 4], ids=["pins shown at the goal", "pins not shown at the goal"])
def test_an_opaque_face_is_measured_by_the_pins(shown):
    """The face looks away all along: its markers are hidden, the body is not."""
    sc = with_pins(scene(opaque=True))
    hidden = sc._replace(plant=sc.plant._replace(visible=-sc.plant.visible))
    task = sc.body_task()
    task.body.in_goal[:, shown:] = False
    run = Run(hidden, "exact", task=task, bounds=limits(max_steps=150))
    assert np.isnan(run.log.s[:, :, :4]).all()
    assert (run.log.fit[:, 2] == 10).all()
    # No marker of the face was seen, hence no image error; the body arrives and the run ends by it.
    assert np.isnan(run.log.error).all()
    assert run.verdict == "converged"
    assert run.log.judged[-1] <= 1e-3 < run.log.judged[-2]
    true = sc.images(run.log.q[-1]) - sc.s_star
    assert run.log.judged[-1] == pytest.approx(np.sqrt((true**2).sum() / 8), rel=1e-3)
    assert run.log.q[-1] == pytest.approx(sc.q_goal, abs=1e-5)


def test_views_that_the_goal_did_not_show_are_left_out():
    sc = with_pins(scene())
    task = sc.body_task()
    task.body.in_goal[0, 4:] = task.body.in_goal[1, 7:] = False
    run = Run(sc, "exact", task=task)
    assert run.verdict == "converged"
    assert (run.log.fit[:, 2] == 4 + 7).all()


def test_markers_lost_one_after_the_other(rng):
    """The run goes on with what is left and ends where two markers are."""
    sc = with_pins(scene())
    noise = np.zeros((41, 2, 9, 2))
    for k in range(8):
        noise[3 * k :, :, k] = np.nan
    run = body_run(sc, "direct_three", bounds=limits(max_steps=40), noise=noise)
    assert run.log.fit[:, 2].tolist() == [2 * (8 - k // 3) for k in range(run.steps + 1)]
    assert (run.verdict, run.steps) == ("markers lost", 18)
    assert np.isnan(run.log.errors[-1]).all()


def test_a_marker_beyond_the_image_is_unseen_if_it_is_a_pin():
    sc = with_pins(scene())
    low = sc.plant._replace(image_size=np.full((2, 2), [1280.0, 500.0]))
    run = body_run(sc._replace(plant=low), "direct_three", bounds=limits(stop_at_border=False))
    free = body_run(sc, "direct_three")
    v = free.log.s[: run.steps + 1, :, :, 1]
    assert (v[:, :, 4:] > 499.5).any()
    assert (np.isnan(run.log.s[0, :, 4:, 1]) == (v[0, :, 4:] > 499.5)).all()
    assert np.isfinite(run.log.s[:, :, :4]).all()
