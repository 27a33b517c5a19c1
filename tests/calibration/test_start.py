"""The start: one body from partial and wrong views, axes and places, in a frame guessed from images alone."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration.adjustment import LeastSquares
from projservo_cli.calibration.epipolar import ImageFrame, epipolar_geometry
from projservo_cli.calibration.readings import Readings
from projservo_cli.calibration.start import Search, starts
from tests.calibration.simulated_robot import IMAGE_SIZE, around, random_robot, trials


def around_all(robot):
    return around(robot, 40, np.random.default_rng(6))


def first_starts(robot, observation):
    """Problem and scenes of the focal length that fits best, given the size of the images."""
    readings = Readings.of(observation, robot.joint_types)
    problem = LeastSquares.of(readings, robot.q_reference)
    rng = np.random.default_rng(1)
    epipolar = epipolar_geometry(readings, rng)
    frame = ImageFrame.of(readings, IMAGE_SIZE)
    search = Search(problem, epipolar, frame, rng, lambda what, done, total: None)
    return problem, starts(search, readings, (1.0,))


def off(problem, scene):
    """Median residual of what was seen, px."""
    return np.median(np.linalg.norm(problem.residual(scene)[problem.readings.seen], axis=1))


@pytest.mark.parametrize("types", ["RRRRRR", "RPRRPR", "PRR"])
@pytest.mark.parametrize("poses", [trials, around_all])
def test_exact_images_start_next_to_the_truth(types, poses):
    robot = random_robot(types, np.random.default_rng(5))
    problem, scenes = first_starts(robot, robot.observe(poses(robot), 0.0, np.random.default_rng(0)))
    # The rig is as guessed, but for the focal length, found to a hundredth of a step of its scan; the ridge
    # pulls axes towards the body.
    assert min(off(problem, scene) for scene in scenes) < 1.0


@pytest.mark.parametrize(("seen", "wrong"), [(0.6, 0.0), (0.9, 0.05)])
def test_a_body_is_merged_from_partial_and_wrong_views(seen, wrong):
    robot = random_robot("RRRR", np.random.default_rng(5), markers=8)
    observation = robot.observe(around_all(robot), 0.0, np.random.default_rng(0))
    rng = np.random.default_rng(2)
    images = observation.images.copy()
    images[rng.random(images.shape[:3]) > seen] = np.nan
    gross = rng.random(images.shape[:3]) < wrong
    images[gross] += rng.uniform(-50.0, 50.0, (int(gross.sum()), 2))
    problem, scenes = first_starts(robot, dataclasses.replace(observation, images=images))
    scene = min(scenes, key=lambda scene: off(problem, scene))
    assert off(problem, scene) < 3.0
    # The body is the true one up to its scale: distances agree.
    found, true = (
        np.linalg.norm(M[:, None, :3] - M[:, :3], axis=2)[np.triu_indices(8, 1)]
        for M in (scene.M, robot.markers)
    )
    ratio = found / true
    assert np.abs(ratio / np.median(ratio) - 1.0).max() < 0.02
