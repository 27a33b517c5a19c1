"""Data that cannot support a calibration: refused with the joint or the reason, in one line."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate
from projservo_cli.records import InputError, WorkFailed
from tests.calibration.simulated_robot import around, random_robot, trials

ROBOT = random_robot("RRPRRR", np.random.default_rng(5))
Q = trials(ROBOT)


def observed(robot=ROBOT, q=Q, sigma=0.5):
    return robot.observe(q, sigma, np.random.default_rng(7))


def body(points):
    return dataclasses.replace(ROBOT, markers=np.hstack([points, np.ones((len(points), 1))]))


def refused(match, observation, joint_types="RRPRRR", error=WorkFailed, **given):
    with pytest.raises(error, match=match) as caught:
        calibrate(observation, joint_types, **given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("count", "match"), [(1, "only one marker"), (2, "only two markers")])
def test_too_few_markers(count, match):
    refused(match, observed(body(ROBOT.markers[:count, :3])))


@pytest.mark.parametrize("sigma", [0.0, 0.5])
def test_markers_on_a_line(sigma):
    line = np.linspace(-0.1, 0.1, 6)[:, None] * np.array([[1.0, 0.3, 0.5]])
    refused("one line", observed(body(line), sigma=sigma), source="recorded")


@pytest.mark.parametrize("method", ["refined", "closed_form", "linear"])
def test_a_joint_without_trials(method):
    keep = np.abs(Q[:, 3] - ROBOT.q_reference[3]) < 1e-9
    refused("joint 4 has no trial motion", observed(q=Q[keep]), method=method)


@pytest.mark.parametrize("method", ["refined", "closed_form", "linear"])
def test_trials_of_zero_amplitude(method):
    q = trials(ROBOT, angle=0.0, length=0.0)
    refused("joint 1 has no trial motion", observed(q=q), method=method)


def test_motion_lost_in_the_noise_names_the_joint_and_what_to_do():
    q = Q.copy()
    moved = np.abs(Q[:, 4] - ROBOT.q_reference[4]) > 1e-9
    q[moved, 4] = ROBOT.q_reference[4] + 0.003 * np.sign(Q[moved, 4] - ROBOT.q_reference[4])
    refused(
        r"too little excitation: .* joint 5 .* moved only 0.344°: move it at least",
        observed(q=q),
        sigma_px=0.5,
    )


def test_noise_other_than_configured():
    refused("χ² per degree of freedom", observed(sigma=0.6), sigma_px=0.5)
    refused("χ² per degree of freedom", observed(sigma=0.4), sigma_px=0.5)


@pytest.mark.parametrize(
    ("types", "given"), [("RRRRRR", {"sigma_px": 0.5}), ("RPPRRR", {"source": "recorded"})]
)
def test_wrong_joint_types(types, given):
    refused("does not describe the data", observed(), types, **given)


def test_joint_readings_of_other_poses():
    robot = random_robot("RRR", np.random.default_rng(6))
    q = around(robot, 25, np.random.default_rng(1))
    wrong = dataclasses.replace(observed(robot, q), q=np.random.default_rng(0).permutation(q))
    refused("does not describe the data|contradict the joint readings", wrong, "RRR", source="recorded")


def test_readings_in_degrees():
    observation = observed(q=trials(ROBOT, frames=4))
    wrong = dataclasses.replace(observation, q=np.degrees(observation.q))
    refused("units", wrong, source="recorded")


def test_one_camera_twice_and_one_camera_blind():
    observation = observed()
    refused("without a baseline", dataclasses.replace(observation, images=observation.images[:, [0, 0]]))
    blind = observation.images.copy()
    blind[:, 1] = np.nan
    refused("the right camera saw no marker", dataclasses.replace(observation, images=blind))
    refused("no marker was seen", dataclasses.replace(observation, images=np.full_like(blind, np.nan)))


def test_a_single_pose():
    refused("only one pose", observed(q=Q[:1]))


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"method": "magic"}, "refined, linear, closed_form"),
        ({"source": "dreamt"}, "simulated or recorded"),
        ({"sigma_px": -1.0}, "positive"),
        ({"sigma_px": float("nan")}, "positive"),
    ],
)
def test_arguments_that_make_no_sense(given, match):
    refused(match, observed(), error=InputError, **given)


def test_weak_joints_are_named_but_not_refused():
    q = Q.copy()
    moved = np.abs(Q[:, 4] - ROBOT.q_reference[4]) > 1e-9
    q[moved, 4] = ROBOT.q_reference[4] + 0.012 * np.sign(Q[moved, 4] - ROBOT.q_reference[4])
    calibration = calibrate(observed(q=q), "RRPRRR", sigma_px=0.5)
    assert calibration.usable
    assert calibration.weak.tolist() == [False, False, False, False, True, False]
    assert any("joint 5 moved only 1.38°" in line for line in calibration.advice)


def test_more_than_pixel_noise_is_said():
    observation = observed(q=around(ROBOT, 50, np.random.default_rng(1)), sigma=0.5)
    jitter = 1.5e-3 * np.random.default_rng(2).standard_normal(observation.q.shape)
    calibration = calibrate(
        dataclasses.replace(observation, q=observation.q + jitter), "RRPRRR", source="recorded"
    )
    assert calibration.usable
    assert 1.15 < calibration.sigma_fitted_px / calibration.sigma_px < 3.0
    assert "more than pixel noise is left" in calibration.reason
