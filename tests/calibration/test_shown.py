"""Images that show nothing a calibration could rest on: refused before any search, by every method."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate
from projservo_cli.calibration.quality import image_path, spread
from projservo_cli.calibration.readings import gather
from projservo_cli.records import WorkFailed
from tests.calibration.simulated_robot import around, random_robot, trials

TYPES = "RRRRRR"
ROBOT = random_robot(TYPES, np.random.default_rng(1), markers=6)
Q = trials(ROBOT, 4)
METHODS = ("refined", "linear", "closed_form")
DIRECTION = np.array([0.6, 0.3, 0.5]) / np.linalg.norm([0.6, 0.3, 0.5])


def noise(sigma, shape):
    return sigma * np.random.default_rng(8).standard_normal(shape)


def with_body(robot, points):
    return dataclasses.replace(robot, markers=np.c_[points, np.ones(len(points))])


def line(length, count=3):
    return np.linspace(-0.5, 0.5, count)[:, None] * length * DIRECTION


def triangle(side, height):
    across = np.cross(DIRECTION, [0.0, 0.0, 1.0])
    return np.array(
        [-0.5 * side * DIRECTION, 0.5 * side * DIRECTION, height * across / np.linalg.norm(across)]
    )


def seen(robot, seed=2, q=None, sigma=0.5):
    return robot.observe(trials(robot) if q is None else q, sigma, np.random.default_rng(seed))


def refusal(observation, method="refined", types=TYPES, **given):
    with pytest.raises(WorkFailed) as caught:
        calibrate(observation, types, method=method, **{"source": "recorded", **given})
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sigma", [0.0, 0.5])
@pytest.mark.parametrize("view", [0, 1])
def test_a_view_that_shows_one_place(method, sigma, view):
    observation = seen(ROBOT, q=Q)
    images = observation.images.copy()
    images[:, view] = 300.0 + noise(sigma, images[:, view].shape)
    message = refusal(dataclasses.replace(observation, images=images), method)
    # Without noise the first check says it, with noise the epipolar geometry has to be known.
    assert f"the {('left', 'right')[view]} images show no more than noise" in message or sigma > 0.0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sigma", [0.0, 0.5])
def test_both_views_that_show_one_place_or_one_line(method, sigma):
    observation = seen(ROBOT, q=Q)
    place = 300.0 + noise(sigma, observation.images.shape)
    message = refusal(dataclasses.replace(observation, images=place), method)
    assert "no more than noise" in message
    column = observation.images[..., 0]
    images = np.stack([column, 0.3 * column + 7.0], axis=-1) + noise(sigma, observation.images.shape)
    message = refusal(dataclasses.replace(observation, images=images), method)
    assert "left images show all markers at all poses on one line" in message


@pytest.mark.parametrize("method", METHODS)
def test_pixels_without_any_geometry(method):
    observation = seen(ROBOT, q=Q)
    images = np.random.default_rng(3).uniform(0.0, 1000.0, observation.images.shape)
    assert "no more than noise" in refusal(dataclasses.replace(observation, images=images), method)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("common", "own"), [(0.0, 0.0), (0.5, 0.0), (0.5, 0.5)])
@pytest.mark.parametrize("poses", [Q, around(ROBOT, 30, np.random.default_rng(4))])
def test_images_that_never_move(method, common, own, poses):
    observation = seen(ROBOT, q=poses, sigma=common)
    images = np.broadcast_to(observation.images[:1], observation.images.shape)
    images = images + noise(own, images.shape)
    assert "images stand still" in refusal(dataclasses.replace(observation, images=images), method)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sigma", [0.0, 0.5])
@pytest.mark.parametrize("joint", [0, 3, 5])
def test_a_joint_that_reads_but_stands_still_is_named(method, sigma, joint):
    still = Q.copy()
    still[:, joint] = Q[0, joint]
    observation = dataclasses.replace(seen(ROBOT, q=still, sigma=sigma), q=Q)
    message = refusal(observation, method)
    assert f"joint {joint + 1} stands still" in message
    assert "60°" in message


@pytest.mark.parametrize("seed", range(1, 9))
@pytest.mark.parametrize(("length", "count"), [(0.03, 3), (0.1, 3), (0.1, 6)])
def test_short_lines_of_markers(seed, length, count):
    robot = with_body(random_robot(TYPES, np.random.default_rng(seed)), line(length, count))
    assert "the markers lie on one line" in refusal(seen(robot))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sigma", [0.0, 0.5])
@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_a_line_is_seen_by_every_method_and_through_wrong_detections(method, sigma, wrong):
    observation = seen(with_body(ROBOT, line(0.15, 8)), sigma=sigma)
    images = observation.images.copy()
    images[np.random.default_rng(5).random(images.shape[:3]) < wrong] += 40.0
    message = refusal(dataclasses.replace(observation, images=images), method)
    assert "the markers lie on one line" in message


# Two and four millimetres off a line of 20 cm: 9 and 17 times the noise of that distance after the fit.
@pytest.mark.parametrize(("side", "height"), [(0.06, 0.052), (0.03, 0.026), (0.2, 0.004), (0.2, 0.008)])
@pytest.mark.parametrize("seed", [2, 3])
def test_bodies_off_a_line_are_accepted(seed, side, height):
    robot = with_body(random_robot(TYPES, np.random.default_rng(seed)), triangle(side, height))
    assert calibrate(seen(robot), TYPES, source="recorded").usable


def test_spread_is_the_deviation_along_and_across():
    rng = np.random.default_rng(6)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    pixels = (rng.standard_normal((4000, 2)) * [50.0, 3.0]) @ turn.T + [700.0, -20.0]
    # A median absolute deviation of 4000 normal values has a standard error of 1.8 %.
    np.testing.assert_allclose(spread(pixels), [50.0, 3.0], rtol=0.08)
    pixels[:400] += rng.uniform(-900.0, 900.0, (400, 2))
    np.testing.assert_allclose(spread(pixels), [50.0, 3.0], rtol=0.5)
    np.testing.assert_array_equal(spread(np.full((9, 2), 5.0)), [0.0, 0.0])


def test_path_is_the_length_of_an_even_motion_and_grows_with_the_noise_as_said():
    observation = seen(ROBOT, q=np.tile(ROBOT.q_reference, (400, 1)), sigma=0.0)
    steps = np.linspace(0.0, 30.0, 400)[:, None] * [0.6, 0.8]
    moving = observation.images + steps[:, None, None]
    poses = np.ones(400, dtype=bool)
    readings = gather(dataclasses.replace(observation, images=moving), TYPES)
    # Even steps have the variance L² K (K + 1) / (12 (K − 1)²).
    np.testing.assert_allclose(image_path(readings, poses), 900.0 * 400 * 401 / 399**2, rtol=1e-9)
    noisy = gather(
        dataclasses.replace(observation, images=observation.images + noise(0.5, moving.shape)), TYPES
    )
    # Twelve times the variance of two coordinates; 400 draws each of 12 sightings: 2 %, four of them.
    assert image_path(noisy, poses).mean() == pytest.approx(24.0 * 0.25, rel=0.08)
