"""A start given by a file: read strictly, tried first, never trusted."""

import copy
import json

import numpy as np
import pytest

from projservo_cli.calibration import Nominal, calibrate, predict
from projservo_cli.records import InputError
from projservo_cli.store.nominal_robot import read_nominal as fields_of
from tests.calibration.simulated_robot import around, random_robot, trials

SIGMA = 0.5


def read_nominal(path):
    return Nominal(**fields_of(path))


@pytest.fixture(scope="module")
def robot():
    return random_robot("RPRR", np.random.default_rng(3), markers=6)


@pytest.fixture(scope="module")
def observation(robot):
    return robot.observe(trials(robot, 8), SIGMA, np.random.default_rng(4))


@pytest.fixture(scope="module")
def alone(observation):
    """The calibration from the images alone."""
    return calibrate(observation, "RPRR", sigma_px=SIGMA)


def described(robot, observation):
    """What a file says about a robot."""
    twists = robot.twists
    return {
        "robot": "any",
        "screws": [{"w": [T[2, 1], T[0, 2], T[1, 0]], "v": T[:3, 3].tolist()} for T in twists],
        "T_base_tool_at_reference": np.eye(4).tolist(),
        "q_reference": robot.q_reference.tolist(),
        "camera_left": robot.cameras[0].tolist(),
        "camera_right": robot.cameras[1].tolist(),
        "markers_tool": robot.markers[:, :3].tolist(),
        "marker_numbers": observation.marker.tolist(),
    }


@pytest.fixture
def written(tmp_path):
    def write(values):
        path = tmp_path / "robot.json"
        path.write_text(values if isinstance(values, str) else json.dumps(values), encoding="utf-8")
        return path

    return write


def agree(one, other, q):
    # Both searches end when a step moves the images by 1e-7 of the residual.
    np.testing.assert_allclose(predict(one, q), predict(other, q), atol=2e-6)
    assert one.chi2_per_dof == pytest.approx(other.chi2_per_dof, rel=1e-9)


def test_the_same_optimum_as_from_the_images_alone(robot, observation, alone, written):
    values = described(robot, observation)
    rng = np.random.default_rng(1)
    # A data sheet: cameras to a percent and of another scale and sign, markers to 5 mm.
    for side, scale in (("left", -3.0), ("right", 0.01)):
        P = np.array(values[f"camera_{side}"])
        values[f"camera_{side}"] = (scale * P * (1.0 + 0.01 * rng.uniform(-1, 1, P.shape))).tolist()
    markers = np.array(values["markers_tool"])
    values["markers_tool"] = (markers + 0.005 * rng.uniform(-1, 1, markers.shape)).tolist()
    found = calibrate(observation, "RPRR", sigma_px=SIGMA, init=read_nominal(written(values)))
    assert found.advice == alone.advice
    agree(found, alone, around(robot, 20, rng))


def wrong_robot(values):
    other = random_robot("RPRR", np.random.default_rng(77), markers=6)
    return values | {
        "screws": described(other, other.observe(trials(other, 1), 0, np.random.default_rng(0)))["screws"]
    }


def wrong_zero(values):
    return values | {"q_reference": np.add(values["q_reference"], [1.0, 0.3, -1.0, 2.0]).tolist()}


def renumbered(values):
    return values | {"marker_numbers": values["marker_numbers"][::-1]}


def behind(values):
    return values | {"T_base_tool_at_reference": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -1.4], [0, 0, 0, 1]]}


@pytest.mark.parametrize("spoil", [wrong_robot, wrong_zero, renumbered, behind])
def test_a_wrong_start_leads_to_the_same_fit_all_the_same(robot, observation, alone, written, spoil):
    values = spoil(described(robot, observation))
    found = calibrate(observation, "RPRR", sigma_px=SIGMA, init=read_nominal(written(values)))
    agree(found, alone, around(robot, 20, np.random.default_rng(9)))
    note = [text for text in found.advice if "was not used as a start" in text]
    assert len(found.advice) == len(alone.advice) + len(note)
    if spoil is behind:
        assert "does not put the markers in front of both cameras" in note[0]


BAD = {
    "nothing": ("", r":1:1: not JSON: Expecting value"),
    "no camera": ({"camera_left": None}, r": camera_left: input should be a valid array"),
    "few joints": ({"q_reference": [0.0]}, r": q_reference: 1 values for 4 screws"),
    "flat camera": ({"camera_right": [[1, 0, 0, 0]] * 3}, r": camera_right: a camera matrix has three indep"),
    "twice": (
        {"marker_numbers": [1, 1, 2, 3, 4, 5]},
        r": marker_numbers: give each of the 6 markers its own",
    ),
    "no axis": ({"screws": [{"w": [0, 0, float("nan")], "v": [0, 0, 0]}] * 4}, r": screws.0.w.2: .*finite"),
    "helix": ({"screws": [{"w": [0, 0, 1], "v": [0, 0, 1]}] * 4}, r": screws.0: v must be orthogonal to w"),
    # As strict as a configured robot: what is written with three digits alone is neither.
    "few digits": (
        {"screws": [{"w": [0, 0, 1.0005], "v": [0, 0, 0]}] * 4},
        r": screws.0: w must be of unit length",
    ),
    "hardly rigid": (
        {"T_base_tool_at_reference": (np.diag([1.0004, 1, 1, 1])).tolist()},
        r": T_base_tool_at_reference: the upper left 3×3 block must be a rotation",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_one_line(robot, observation, written, name):
    change, message = BAD[name]
    values = copy.deepcopy(described(robot, observation))
    path = written(values | change if isinstance(change, dict) else change)
    with pytest.raises(InputError, match="^" + str(path) + message) as caught:
        read_nominal(path)
    assert "\n" not in str(caught.value)
