"""Closed loops that measure with the body: what is lost, what is kept, what is logged."""

import numpy as np
import pytest

from tests.samples import frame
from tests.scene import Run, limits, scene, with_pins

LAWS = ("direct_three", "direct_two", "exact")


@pytest.mark.parametrize("law", LAWS)
def test_without_noise_both_observations_drive_alike(law):
    """With the true model what the body says is what the points say."""
    sc = with_pins(scene())
    body, points = (Run(sc, law, G=frame(1), task=task) for task in (sc.body_task(frame(1)), None))
    assert (body.verdict, body.steps) == (points.verdict, points.steps) == ("converged", points.steps)
    assert body.log.q == pytest.approx(points.log.q, abs=1e-7)
    assert (body.log.fit[:, 2] == 18).all()
    assert body.log.fit[:, :2] == pytest.approx(np.zeros((body.steps + 1, 2)), abs=1e-12)
    assert np.isnan(points.log.fit).all()


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
