"""Arguments of the public functions that make no sense: InputError, one line that says what to give."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict, prediction_variance
from projservo_cli.records import InputError
from tests.calibration.simulated_robot import random_robot, trials

ROBOT = random_robot("RPR", np.random.default_rng(6), markers=5)
OBSERVATION = ROBOT.observe(trials(ROBOT, 4), 0.5, np.random.default_rng(1))


def spoilt(name, value):
    array = getattr(OBSERVATION, name).copy()
    array.ravel()[array.size // 2] = value
    return dataclasses.replace(OBSERVATION, **{name: array})


def shaped(**given):
    return dataclasses.replace(OBSERVATION, **given)


K, M = len(OBSERVATION.pose), len(OBSERVATION.marker)
CASES = {
    "readings of fewer poses": (shaped(q=OBSERVATION.q[:-1]), "RPR", {}, "pose of shape"),
    "readings in a row": (shaped(q=OBSERVATION.q[:, 0]), "R", {}, "expected (poses, joints)"),
    "images of fewer poses": (shaped(images=OBSERVATION.images[:-1]), "RPR", {}, f"for {K} poses"),
    "fewer marker numbers": (shaped(marker=OBSERVATION.marker[:-1]), "RPR", {}, f"{M - 1} markers"),
    "a pose twice": (spoilt("pose", OBSERVATION.pose[0]), "RPR", {}, "pose number 3 occurs twice"),
    "a marker twice": (spoilt("marker", 5), "RPR", {}, "marker number 5 occurs twice"),
    "markers in a table": (shaped(marker=OBSERVATION.marker[:, None]), "RPR", {}, "one dimension"),
    "three views": (shaped(images=OBSERVATION.images[:, [0, 1, 1]]), "RPR", {}, "2 views"),
    "no image": (OBSERVATION, "RPR", {"image_size": (1280, 0)}, "positive width"),
    "negative seed": (OBSERVATION, "RPR", {"seed": -1}, "seed -1"),
    "source": (OBSERVATION, "RPR", {"source": "dreamt"}, "simulated or recorded"),
    "another letter": (OBSERVATION, "RXR", {}, "R or P"),
    "joint reading not a number": (spoilt("q", np.nan), "RPR", {}, "joint readings"),
    "infinite pixel": (spoilt("images", np.inf), "RPR", {}, "pixels"),
}


@pytest.mark.parametrize("name", CASES)
def test_calibrate_refuses(name):
    observation, types, given, word = CASES[name]
    with pytest.raises(InputError) as caught:
        calibrate(observation, types, **{"source": "recorded", **given})
    assert word in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("lens", "allowed"), [(False, 6), (True, 0)])
def test_few_pixels_of_a_view_may_be_outside_its_image(lens, allowed):
    given = {"source": "recorded", "lens": lens}
    # Of the 65 of a view 6.5 may be outside, or 0.65. The border is half a pixel beyond the middle of the
    # last one, and corners may be found a pixel farther.
    u = np.sort(OBSERVATION.images[..., 0].swapaxes(0, 1).reshape(2, -1), axis=1).max(axis=0)[::-1]
    width = u - 0.5 + 1e-6
    calibrate(OBSERVATION, "RPR", image_size=(width[allowed], 1024), **given)
    with pytest.raises(
        InputError, match=r" view are outside, .*, such as u [78][0-9.]+, v [0-9.]+ .*width before height"
    ):
        calibrate(OBSERVATION, "RPR", image_size=(width[allowed + 1], 1024), **given)


@pytest.fixture(scope="module")
def calibration():
    return calibrate(OBSERVATION, "RPR", source="recorded")


@pytest.mark.parametrize("function", [predict, prediction_variance])
def test_predictions_refuse_other_joints_and_what_is_no_number(calibration, function):
    for q in (np.zeros((4, 2)), np.zeros((4, 4)), np.zeros(3)):
        with pytest.raises(InputError, match=r"expected \(poses, 3\)"):
            function(calibration, q)
    for value in (np.nan, np.inf):
        with pytest.raises(InputError, match="finite"):
            function(calibration, np.array([[0.0, value, 0.0]]))
    assert function(calibration, np.zeros((0, 3))).shape == (0, 2, 5, 2)


def test_arguments_are_left_as_they_were():
    arrays = {name: value for name, value in vars(OBSERVATION).items() if isinstance(value, np.ndarray)}
    before = {name: value.copy() for name, value in arrays.items()}
    for name in before:
        getattr(OBSERVATION, name).setflags(write=False)
    calibrate(OBSERVATION, "RPR", source="recorded")
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(OBSERVATION, name), value)
