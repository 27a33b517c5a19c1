"""Data that must not become a calibration: refused in one line that names the joint, view or remedy."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.stats import chi2

from projservo_cli.calibration import calibrate
from projservo_cli.records import Observation, WorkFailed
from tests.calibration.simulated_robot import random_robot, trials

SIGMA = 0.5
TYPES = "RRRRRR"
METHODS = ("bundle_adjustment", "closed_form")
ROBOT = random_robot(TYPES, np.random.default_rng(1), markers=6)
SMALL = random_robot("RRR", np.random.default_rng(1), markers=6)
Q = trials(ROBOT, 4)
DIRECTION = np.array([0.6, 0.3, 0.5]) / np.linalg.norm([0.6, 0.3, 0.5])


def with_body(robot, points):
    return dataclasses.replace(robot, markers=np.c_[points, np.ones(len(points))])


def line(length, count):
    return np.linspace(-0.5, 0.5, count)[:, None] * length * DIRECTION


def seen(robot=ROBOT, q=None, sigma=SIGMA, seed=2):
    return robot.observe(trials(robot, 4) if q is None else q, sigma, np.random.default_rng(seed))


def changed(observation, **arrays):
    return dataclasses.replace(observation, **arrays)


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


def noise(sigma, shape):
    return sigma * np.random.default_rng(8).standard_normal(shape)


@pytest.mark.parametrize(
    ("count", "words"), [(0, "no marker"), (1, "only one marker"), (2, "only two markers")]
)
def test_too_few_markers(count, words):
    assert words in refusal(some(seen(), markers=slice(count)))


def test_a_single_pose():
    assert "only one pose" in refusal(some(seen(), poses=slice(1)))


@pytest.mark.parametrize("method", METHODS)
def test_a_joint_without_trials_is_named(method):
    moved = np.abs(Q - Q[0]) > 1e-9
    for joint in (0, 3, 5):
        message = refusal(some(seen(), poses=~moved[:, joint]), method=method)
        assert f"joint {joint + 1} has no trial motion" in message
    # … nor one whose trials no camera saw.
    images = np.where(moved[:, 3, None, None, None], np.nan, seen().images)
    assert "joint 4 has no trial motion" in refusal(changed(seen(), images=images), method=method)


@pytest.mark.parametrize(
    ("types", "joint", "amplitude", "words"),
    [
        (TYPES, 4, 3e-3, "too little excitation: .* joint 5 .* moved only 0.344°: move it at least"),
        (TYPES, 4, 5e-4, "excitation|determined"),
        ("RRPRRR", 2, 1e-4, "excitation|determined"),
    ],
)
def test_motion_lost_in_the_noise_names_the_joint_and_what_to_do(types, joint, amplitude, words):
    robot = random_robot(types, np.random.default_rng(1), markers=6)
    q = trials(robot, 4)
    q[:, joint] = robot.q_reference[joint] + amplitude * np.sign(q[:, joint] - robot.q_reference[joint])
    message = refusal(seen(robot, q), types)
    assert f"joint {joint + 1} " in message
    assert re.search(words, message)


def test_a_view_that_sees_nothing_or_what_the_other_sees():
    images = seen().images
    blind = images.copy()
    blind[:, 1] = np.nan
    assert "the right camera saw no marker" in refusal(changed(seen(), images=blind))
    assert "no marker was seen" in refusal(changed(seen(), images=np.full_like(images, np.nan)))
    assert "without a baseline" in refusal(changed(seen(), images=images[:, [0, 0]]))


@pytest.mark.parametrize("sigma", [0.0, SIGMA])
def test_images_that_show_one_place_or_one_line(sigma):
    observation = seen()
    shape = observation.images.shape
    images = observation.images.copy()
    images[:, 1] = 300.0 + noise(sigma, images[:, 1].shape)
    message = refusal(changed(observation, images=images))
    # Without noise the first check says it, with noise the epipolar geometry has to be known.
    assert "the right images show no more than noise" in message or sigma > 0.0
    assert "no more than noise" in refusal(changed(observation, images=300.0 + noise(sigma, shape)))
    column = observation.images[..., 0]
    images = np.stack([column, 0.3 * column + 7.0], axis=-1) + noise(sigma, shape)
    message = refusal(changed(observation, images=images))
    assert "left images show all markers at all poses on one line" in message


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sigma", [0.0, SIGMA])
def test_a_joint_that_reads_but_stands_still_is_named(method, sigma):
    for joint in (0, 3, 5):
        still = Q.copy()
        still[:, joint] = Q[0, joint]
        message = refusal(changed(seen(q=still, sigma=sigma), q=Q), method=method)
        assert f"joint {joint + 1} stands still" in message
        assert "60°" in message


@pytest.mark.parametrize("sigma", [0.0, SIGMA])
@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_markers_on_a_line_are_seen_through_wrong_detections(sigma, wrong):
    observation = seen(with_body(ROBOT, line(0.15, 8)), trials(ROBOT), sigma)
    images = observation.images.copy()
    images[np.random.default_rng(5).random(images.shape[:3]) < wrong] += 40.0
    for method in METHODS:
        assert "the markers lie on one line" in refusal(changed(observation, images=images), method=method)


def test_joint_readings_and_types_that_are_not_the_robots():
    """Joint readings in degrees, and exchanged views; others in ``test_diagnosis``."""
    observation = seen(SMALL, trials(SMALL, 4))
    assert "units" in refusal(changed(observation, q=np.degrees(observation.q)), "RRR")
    images = observation.images.copy()
    images[::2] = images[::2, ::-1]
    for method in METHODS:
        message = refusal(changed(observation, images=images), "RRR", method=method)
        assert "does not describe the data" in message or "correspondences" in message


@pytest.mark.parametrize("tail", [1e-4, 1.0 - 1e-4])
def test_quantiles_between_which_a_simulated_run_must_lie(tail):
    observation = seen(SMALL)
    fitted = calibrate(observation, "RRR", sigma_px=SIGMA)
    square = fitted.chi2_per_dof * fitted.dof * SIGMA**2
    edge = np.sqrt(square / chi2.ppf(tail, fitted.dof))  # the noise for which χ² is that quantile
    inside, outside = (1.001, 0.999) if tail > 0.5 else (0.999, 1.001)
    assert calibrate(observation, "RRR", sigma_px=inside * edge).usable
    message = refusal(observation, "RRR", source="simulated", sigma_px=outside * edge)
    assert "χ² per degree of freedom" in message
    assert f"{outside * edge:g} px" in message


@pytest.mark.parametrize(("markers", "frames"), [(6, 4), (10, 19)])
def test_ratios_at_which_a_recorded_run_is_warned_of_and_refused(markers, frames):
    """1.15, or four standard errors of the fitted noise, of which much data know one to 1.3 %."""
    robot = random_robot("RRR", np.random.default_rng(1), markers)
    observation = seen(robot, trials(robot, frames))
    found = calibrate(observation, "RRR", sigma_px=SIGMA, source="recorded")
    limit = min(1.15, 1.0 + 4.0 / np.sqrt(2.0 * found.dof))
    assert (limit < 1.06) == (frames > 4)
    for ratio, warned in ((0.999 * limit, False), (1.001 * limit, True), (2.99, True)):
        given = found.sigma_fitted_px / ratio
        calibration = calibrate(observation, "RRR", sigma_px=given, source="recorded")
        assert calibration.usable
        assert ("more than pixel noise" in calibration.reason) == warned
        assert calibration.chi2_per_dof == pytest.approx(ratio**2, rel=1e-6)
    assert "3.01 times" in refusal(observation, "RRR", sigma_px=found.sigma_fitted_px / 3.01)
