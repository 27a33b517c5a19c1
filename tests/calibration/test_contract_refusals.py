"""Data that must not become a calibration, and bodies on which only the refinement succeeds."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.stats import chi2

from projservo_cli.calibration import calibrate, predict
from projservo_cli.records import Observation, WorkFailed
from tests.calibration.simulated_robot import Robot, around, random_robot, trials

SIGMA = 0.5
METHODS = ("refined", "linear", "closed_form")
TYPES = "RRRRRR"


def scene(seed=1, types=TYPES, markers=6):
    return random_robot(types, np.random.default_rng(seed), markers=markers)


def with_body(robot, points):
    return dataclasses.replace(robot, markers=np.c_[points, np.ones(len(points))])


def seen(robot, q=None, sigma=SIGMA, frames=4, seed=2):
    return robot.observe(trials(robot, frames) if q is None else q, sigma, np.random.default_rng(seed))


def some(observation, poses=slice(None), markers=slice(None)):
    return Observation(
        observation.pose[poses],
        observation.marker[markers],
        observation.q[poses],
        observation.images[poses][:, :, markers],
    )


def refusal(observation, types=TYPES, **given):
    """Message of the refusal: one line, and not a word about arrays or matrices of the implementation."""
    with pytest.raises(WorkFailed) as caught:
        calibrate(observation, types, **{"source": "recorded", **given})
    message = str(caught.value)
    assert message.strip()
    assert "\n" not in message
    assert not re.search(r"\b(nan|array|singular|svd|shape)\b", message, re.IGNORECASE)
    return message


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("count", "word"), [(0, "no marker"), (1, "one marker"), (2, "two markers")])
def test_too_few_markers(method, count, word):
    assert word in refusal(some(seen(scene()), markers=slice(count)), method=method)


@pytest.mark.parametrize("source", ["simulated", "recorded"])
@pytest.mark.parametrize("sigma", [0.0, SIGMA])
@pytest.mark.parametrize(("count", "length"), [(4, 0.16), (10, 0.2)])
def test_markers_on_a_line(source, sigma, count, length):
    direction = np.array([0.6, 0.3, 0.5]) / np.linalg.norm([0.6, 0.3, 0.5])
    robot = with_body(scene(), np.linspace(-0.5, 0.5, count)[:, None] * length * direction)
    message = refusal(seen(robot, sigma=sigma, frames=8), source=source, sigma_px=SIGMA)
    assert "line" in message
    assert "marker" in message


@pytest.mark.parametrize("joint", range(6))
def test_a_joint_without_trials_is_named(joint):
    robot = scene()
    q = trials(robot, 4)
    message = refusal(seen(robot, q[np.abs(q[:, joint] - q[0, joint]) < 1e-9]))
    assert f"joint {joint + 1} " in message
    assert not any(f"joint {other} " in message for other in range(1, 7) if other != joint + 1)


@pytest.mark.parametrize("method", METHODS)
def test_a_joint_whose_trials_no_camera_saw_is_named(method):
    observation = seen(scene())
    images = observation.images.copy()
    images[np.abs(observation.q[:, 3] - observation.q[0, 3]) > 1e-9] = np.nan
    assert "joint 4 " in refusal(dataclasses.replace(observation, images=images), method=method)


@pytest.mark.parametrize("method", METHODS)
def test_trials_of_zero_amplitude(method):
    robot = scene()
    message = refusal(seen(robot, np.tile(robot.q_reference, (20, 1))), method=method)
    assert "joint 1 " in message
    assert "motion" in message


@pytest.mark.parametrize(("types", "joint", "amplitude"), [(TYPES, 4, 5e-4), ("RRPRRR", 2, 1e-4)])
def test_trials_lost_in_the_noise(types, joint, amplitude):
    robot = scene(types=types)
    q = trials(robot, 4)
    q[:, joint] = robot.q_reference[joint] + amplitude * np.sign(q[:, joint] - robot.q_reference[joint])
    message = refusal(seen(robot, q), types)
    assert f"joint {joint + 1} " in message
    assert "excitation" in message or "determined" in message


def test_small_trials_are_accepted_but_the_joint_is_called_weak():
    robot = scene()
    q = trials(robot, 4)
    q[:, 3] = robot.q_reference[3] + 0.05 * (q[:, 3] - robot.q_reference[3])
    calibration = calibrate(seen(robot, q), TYPES, source="recorded")
    np.testing.assert_array_equal(calibration.weak, np.arange(6) == 3)
    assert any("joint 4 " in advice and "3°" in advice for advice in calibration.advice)
    assert calibration.excitation[3] == pytest.approx(np.radians(3.0))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("view", [0, 1, None])
def test_images_without_a_marker(method, view):
    observation = seen(scene())
    images = observation.images.copy()
    images[:, slice(None) if view is None else view] = np.nan
    assert "marker" in refusal(dataclasses.replace(observation, images=images), method=method)


@pytest.mark.parametrize("method", METHODS)
def test_one_image_twice_has_no_depth(method):
    observation = seen(scene())
    images = observation.images.copy()
    images[:, 1] = images[:, 0]
    assert "baseline" in refusal(dataclasses.replace(observation, images=images), method=method)


@pytest.mark.parametrize(
    ("true", "given"), [("RRRRRR", "RRPRRR"), ("RRPRRR", "RRRRRR"), ("RRPRRR", "RRRPRR")]
)
def test_wrong_joint_types_never_pass(true, given):
    message = refusal(seen(scene(types=true), frames=6), given)
    assert "does not describe the data" in message
    assert "types" in message


def test_readings_that_turn_too_far_never_pass():
    robot = scene()
    observation = seen(robot, frames=8)
    q = observation.q.copy()
    q[:, 2] = q[0, 2] + 1.3 * (q[:, 2] - q[0, 2])  # as if a gear ratio were wrong
    message = refusal(dataclasses.replace(observation, q=q))
    assert "joint readings" in message


@pytest.mark.parametrize(("method", "markers"), [("refined", 3), ("closed_form", 6)])
def test_left_and_right_exchanged_in_half_of_the_poses(method, markers):
    observation = seen(scene(types="RRR", markers=markers), frames=5)
    images = observation.images.copy()
    images[::2] = images[::2, ::-1]
    message = refusal(dataclasses.replace(observation, images=images), "RRR", method=method)
    assert "does not describe the data" in message or "correspondences" in message


def test_noise_below_that_configured_is_as_wrong_as_above():
    observation = seen(scene())
    for wrong in (0.25, 1.0):
        message = refusal(observation, source="simulated", sigma_px=wrong)
        assert "χ²" in message
        assert f"{wrong:g} px" in message
    assert calibrate(observation, TYPES, sigma_px=SIGMA).usable


@pytest.mark.parametrize("tail", [1e-4, 1.0 - 1e-4])
def test_quantiles_between_which_a_simulated_run_must_lie(tail):
    observation = seen(scene(types="RRR"))
    fitted = calibrate(observation, "RRR", sigma_px=SIGMA)
    square = fitted.chi2_per_dof * fitted.dof * SIGMA**2
    edge = np.sqrt(square / chi2.ppf(tail, fitted.dof))  # the noise for which χ² is that quantile
    inside, outside = (1.001, 0.999) if tail > 0.5 else (0.999, 1.001)
    assert calibrate(observation, "RRR", sigma_px=inside * edge).usable
    assert "χ²" in refusal(observation, "RRR", source="simulated", sigma_px=outside * edge)


def test_ratios_at_which_a_recorded_run_is_warned_of_and_refused():
    observation = seen(scene(types="RRR"))
    fitted = calibrate(observation, "RRR", sigma_px=SIGMA, source="recorded").sigma_fitted_px

    def calibrated(ratio):
        return calibrate(observation, "RRR", sigma_px=fitted / ratio, source="recorded")

    for ratio, warned in ((0.5, False), (1.14, False), (1.16, True), (2.99, True)):
        calibration = calibrated(ratio)
        assert calibration.usable
        assert ("more than pixel noise" in calibration.reason) == warned
        assert calibration.chi2_per_dof == pytest.approx(ratio**2, rel=1e-6)
    assert "3.01 times" in refusal(observation, "RRR", sigma_px=fitted / 3.01)


def test_much_data_warn_of_less():
    """Four standard errors of the fitted noise, of which 3,000 degrees of freedom know one to 1.3 %."""
    observation = seen(scene(types="RRR", markers=10), frames=25)
    fitted = calibrate(observation, "RRR", sigma_px=SIGMA, source="recorded")
    limit = 1.0 + 4.0 / np.sqrt(2.0 * fitted.dof)
    assert 1.04 < limit < 1.06
    for ratio, warned in ((0.999 * limit, False), (1.001 * limit, True)):
        given = fitted.sigma_fitted_px / ratio
        calibration = calibrate(observation, "RRR", sigma_px=given, source="recorded")
        assert calibration.usable
        assert ("more than pixel noise" in calibration.reason) == warned


# A face of four, of three markers, and a plate of eight: the motion makes up for what the body lacks.
FLAT = {
    "three": [[0.05, 0.0, 0.0], [-0.04, 0.06, 0.01], [-0.03, -0.05, 0.02]],
    "four, not in a plane": [[0.06, 0, 0], [-0.05, 0.05, 0], [-0.04, -0.06, 0], [0, 0, 0.07]],
    "plate of eight": [[x, y, 0.3 * x - 0.2 * y] for x in (-0.07, 0.0, 0.08) for y in (-0.06, 0.01, 0.07)][
        1:
    ],
}


@pytest.mark.parametrize("name", FLAT)
def test_bodies_only_the_refinement_can_use(name):
    robot = with_body(scene(), np.array(FLAT[name]))
    observation = seen(robot, frames=8)
    message = refusal(observation, method="closed_form")
    assert ("plane" if "plate" in name else "5 markers") in message
    calibration = calibrate(observation, TYPES, source="recorded")
    assert calibration.usable
    q = around(robot, 40, np.random.default_rng(3))
    rms = np.sqrt(np.mean(np.sum((predict(calibration, q) - robot.images(q)) ** 2, axis=-1)))
    # Over four noise draws of each body 0.4 to 0.9 px; a wrong operator means tens of pixels.
    assert rms < 1.5


def test_coplanar_trials_of_exact_images_are_refused_by_the_closed_form_too():
    robot = with_body(scene(), np.array(FLAT["plate of eight"]))
    assert "plane" in refusal(seen(robot, sigma=0.0), method="closed_form")


def test_motions_of_several_joints_need_the_refinement():
    robot = scene()
    q = np.vstack([robot.q_reference, around(robot, 30, np.random.default_rng(3))])
    for method in ("linear", "closed_form"):
        assert "single-joint" in refusal(seen(robot, q), method=method)
    assert calibrate(seen(robot, q), TYPES, source="recorded").usable


def test_unrefined_methods_say_when_they_do_not_reach_the_noise():
    robot = Robot(**vars(scene(markers=10)))
    for method in ("linear", "closed_form"):
        calibration = calibrate(seen(robot, frames=8), TYPES, method=method, source="recorded")
        assert not calibration.usable
        assert "use refined" in calibration.reason
        assert calibration.chi2_per_dof > 1.3
