"""What the simulated plant shows: pixels, sides of the face, depths, and the object around it."""

import numpy as np
import pytest

from projservo_cli.geometry.algebra import mat
from projservo_cli.simulation.analytic_plant import observe
from tests.samples import displacement
from tests.scene import scene


def observed(plant, H):
    M, s, hidden = np.zeros_like(plant.M), np.zeros((2, len(plant.M), 2)), np.zeros(2)
    in_front = observe(plant, mat(H), M, s, hidden)
    return in_front, M, s, hidden


def around_the_vertical(angle):
    """Turn about the vertical through the middle of the sample face."""
    middle = displacement([0, 0, 0], [0.02, -0.03, 1.4])
    return middle @ displacement([0, angle, 0], [0, 0, 0]) @ np.linalg.inv(middle)


@pytest.mark.parametrize("opaque", [False, True])
def test_a_turning_face_hides_from_one_camera_before_the_other(opaque):
    """By the signed volume of face and optical centre; an opaque face takes its markers along."""
    plant = scene(opaque=opaque).plant
    seen = set()
    for angle in np.linspace(0, 2 * np.pi, 73):
        _, M, s, hidden = observed(plant, around_the_vertical(angle))
        normal = np.cross(M[1, :3] - M[0, :3], M[2, :3] - M[0, :3])
        start = np.cross(*(plant.M[i, :3] - plant.M[0, :3] for i in (1, 2)))
        sides = (plant.O[:, :3] - M[0, :3]) @ normal * ((plant.O[:, :3] - plant.M[0, :3]) @ start)
        assert (hidden > 0).tolist() == (sides <= 0).tolist()
        for view in range(2):
            assert np.isnan(s[view]).all() == (opaque and hidden[view] > 0)
        seen.add(tuple(hidden.tolist()))
    assert seen == {(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)}


def test_a_marker_behind_a_camera_has_no_pixel():
    plant = scene().plant
    in_front, _, s, _ = observed(plant, displacement([0, 0, 0], [0, 0, -1.4]))
    assert not in_front
    assert np.isnan(s).any()
