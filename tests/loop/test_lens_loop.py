"""Closed loops through bent images: a model with the lens drives as through straight ones."""

import numpy as np
import pytest

from projservo_cli.geometry.lens import distort
from projservo_cli.laws import LAW_SPECS, LAWS
from tests.samples import frame
from tests.scene import STEP, Run, limits, with_pins
from tests.scene import scene as scene_of

# Centres away from the face, where a lens bends more.
LENS = np.array([[300.0, 300.0, 640.0, -0.08, 0.01], [900.0, 300.0, 640.0, 0.05, -0.01]])


def scene():
    """A motion short enough for the image-based laws to go straight to the goal, as others do."""
    return scene_of(0.4 * STEP)


def through_lenses(sc, lens=LENS):
    """The same scene seen through lenses, by the plant and in the images of start and goal."""
    model = sc.model._replace(lens=lens)
    return sc._replace(
        plant=sc.plant._replace(model=model),
        s_start=distort(lens[:, None], sc.s_start),
        s_star=distort(lens[:, None], sc.s_star),
    )


@pytest.mark.parametrize("law", LAWS)
def test_the_joints_move_as_through_straight_images(law):
    G = None if LAW_SPECS[law].metric else frame(3)
    bounds = limits(max_steps=40)
    straight, lensed = (
        Run(scene(), law, bounds=bounds, G=G),
        Run(through_lenses(scene()), law, bounds=bounds, G=G),
    )
    assert lensed.steps == straight.steps
    # Pixels straightened are the straight ones to 1e-12 px; feedback does not enlarge that.
    assert lensed.log.q == pytest.approx(straight.log.q, abs=1e-9)
    # What is logged is what the cameras see.
    assert lensed.log.s[0] == pytest.approx(distort(LENS[:, None], straight.log.s[0]), abs=1e-9)
    assert np.abs(lensed.log.s - straight.log.s).max() > 1.0


def test_the_body_is_measured_through_the_lens():
    straight, lensed = (with_pins(sc) for sc in (scene(), through_lenses(scene())))
    G, bounds = frame(1), limits(max_steps=40)
    runs = [Run(sc, "direct_two", G=G, bounds=bounds, task=sc.body_task(G)) for sc in (straight, lensed)]
    assert (runs[1].log.fit[:, 2] == 18).all()
    # The fit of the body stops within 1e-7 rad of where it would settle.
    assert runs[1].log.q == pytest.approx(runs[0].log.q, abs=1e-7)


def test_markers_beyond_the_turn_of_a_lens_are_lost():
    folded = LENS.copy()
    folded[0, 3:] = (-4.0, 0.0)  # turns at a radius of 185 px; the face is seen some 400 px away
    sc = scene()
    run = Run(
        sc._replace(plant=sc.plant._replace(model=sc.model._replace(lens=folded))),
        "direct_two",
        task=sc.task(),
    )
    assert run.verdict == "markers lost"
