"""Calibrations by three and four views: at the bound, whatever their order, and with a noise of each."""

import dataclasses

import numpy as np
import pytest

import projservo_cli as projservo
from projservo_cli.calibration import calibrate, cross_validate, predict, prediction_variance
from projservo_cli.calibration.checks.validation import residual_statistics
from projservo_cli.metric.frame import links
from projservo_cli.observations import Observations
from projservo_cli.records import WorkFailed
from projservo_cli.store.observation_tables import read_table
from tests.calibration.bound import Bound
from tests.calibration.simulated_robot import around, random_robot, trials

# Noise of each of three views, px.
NOISE = (0.3, 0.5, 1.2)


def recorded(views, seed=5, types="RRPR"):
    """Robot, poses of its recording with combined ones, and poses to predict."""
    rng = np.random.default_rng(seed)
    robot = random_robot(types, rng, markers=8, views=views)
    q = np.concatenate([trials(robot, frames=4), around(robot, 16, rng)])
    return robot, q, around(robot, 30, rng), rng


def of_views(observation, which):
    """Observation by some of the views, in an order."""
    names = tuple(observation.view[v] for v in which)
    return dataclasses.replace(observation, images=observation.images[:, which], view=names)


def test_predictions_err_by_the_bound_and_as_stated():
    robot, q, ahead, rng = recorded(3)
    weight = np.broadcast_to(1.0 / np.reshape(NOISE, (-1, 1, 1)), (len(q), 3, 8, 2)).ravel()
    bound, draws = Bound(robot, q, ahead, weight), 3
    squares, stated, noise = [], [], []
    for _ in range(draws):
        found = calibrate(robot.observe(q, NOISE, rng), robot.joint_types, source="recorded")
        squares.append(np.mean((predict(found, ahead) - robot.images(ahead)) ** 2))
        stated.append(np.mean(prediction_variance(found, ahead)))
        noise.append(found.sigma_view_px)
    # Weights are estimated, which costs a few per cent; three deviations of the mean over the draws.
    chance = 3.0 * bound.relative_error(draws)
    assert np.mean(squares) == pytest.approx(bound.mean_square(), rel=chance + 0.05)
    assert np.mean(stated) == pytest.approx(bound.mean_square(), rel=0.15)
    np.testing.assert_allclose(np.median(noise, axis=0), NOISE, rtol=0.05)


def test_a_camera_with_noise_of_its_own_does_not_spoil_the_others():
    """Each is left out in turn: the weights of the worst one keep it from the predictions of the others."""
    robot, q, _, rng = recorded(3, seed=3)
    seen, kept = robot.observe(q, 0.5, rng), []
    seen.images[:, 2] += 6.0 * np.sin(np.arange(len(q)))[:, None, None] * [1.0, 0.5]
    calibrate(seen, robot.joint_types, source="recorded", fitted=lambda *solved: kept.append(solved))
    found = cross_validate(*kept[0], 4, seed=0)
    assert found.others_px.shape == (3, 2)
    # With the bad camera the others are predicted as without it; without a good one the bad one still errs.
    assert found.others_px[2] == pytest.approx([found.others_px[2, 1]] * 2, rel=0.03)
    assert (found.others_px[:2] > 3.0 * found.others_px[2]).all()
    assert "no camera spoils the others" in found.reason
    assert cross_validate(*kept[0], 4, seed=0, blocks=False).others_px is None


def test_order_and_names_of_views_do_not_matter():
    robot, q, ahead, rng = recorded(4, seed=8)
    seen = robot.observe(q, 0.4, rng)
    seen.images[rng.random(seen.images.shape[:3]) < 0.1] = np.nan
    found, turned = (
        calibrate(of_views(seen, v), "RRPR", source="recorded") for v in ([0, 1, 2, 3], [2, 0, 3, 1])
    )
    assert turned.view == ("top", "left", "low", "right")
    np.testing.assert_allclose(predict(turned, ahead), predict(found, ahead)[:, [2, 0, 3, 1]], atol=1e-3)


@pytest.mark.parametrize(("types", "flat"), [("RRPR", False), ("RRRR", True)])
def test_one_camera_is_enough(types, flat):
    rng = np.random.default_rng(11)
    robot = random_robot(types, rng, markers=10, views=1)
    if flat:
        robot.markers[:, 2] = 0.0
    q, ahead = np.concatenate([trials(robot, frames=6), around(robot, 12, rng)]), around(robot, 30, rng)
    seen = robot.observe(q, 0.5, rng)
    seen.images[rng.random(seen.images.shape[:3]) < 0.02] = np.nan
    found, bound = calibrate(seen, types, source="recorded"), Bound(robot, q, ahead)
    assert found.usable
    square = np.mean((predict(found, ahead) - robot.images(ahead)) ** 2)
    chance = 3.0 * bound.relative_error(1)  # and what the missing images cost
    assert square == pytest.approx(0.25 * bound.mean_square(), rel=chance + 0.05)


def test_one_camera_believes_deviations_of_its_markers_that_are_true():
    rng = np.random.default_rng(6)
    robot = random_robot("RRRR", rng, markers=10, views=1)
    q = np.concatenate([trials(robot, frames=4), around(robot, 12, rng)])
    seen = robot.observe(q, 0.0, rng)
    sigma = np.exp(rng.uniform(np.log(0.03), np.log(3.0), seen.images.shape[:3]))
    noisy = seen.images + sigma[..., None] * rng.standard_normal(seen.images.shape)
    found = calibrate(dataclasses.replace(seen, images=noisy, sigma=sigma), "RRRR", source="recorded")
    assert found.usable
    assert found.sigma_scale == pytest.approx(1.0, abs=0.1)


def test_left_images_alone_of_data_of_others(shared_data):
    trained, held_out = (
        of_views(read_table(shared_data / "stanford" / name, "RRPRRR"), [0])
        for name in ("trials_0.5px.csv", "validation.csv")
    )
    found = calibrate(trained, "RRPRRR", source="recorded")
    error = residual_statistics(found, held_out)
    assert error["rms_px"] < 0.46
    assert error["median_px"] <= error["limit_px"]


@pytest.mark.parametrize("views", [1, 3])
def test_metres_by_another_rig(views):
    """Intrinsic matrices and distances between axes of the truth, within four of their deviations."""
    rng = np.random.default_rng(2)
    robot = random_robot("RRRR", rng, markers=8, views=views)
    q = np.concatenate([trials(robot, frames=6), around(robot, 20, rng)])
    seen = Observations.of(robot.observe(q, 0.2, rng), joint_types=robot.joint_types)
    length = float(np.linalg.norm(robot.markers[0] - robot.markers[1]))
    metric = projservo.calibrate(seen, progress=False).metric(length, (5, 8))
    K = np.array([[1200.0, 0.0, 640.0], [0.0, 1200.0, 512.0], [0.0, 0.0, 1.0]])
    deviation = np.sqrt(np.diagonal(metric.covariance("K"), axis1=-2, axis2=-1))
    off = (metric.K - K)[:, (0, 0, 0, 1, 1), (0, 1, 2, 1, 2)]
    assert (np.abs(off) <= 4.0 * deviation).all()
    w = np.stack([robot.twists[:, 2, 1], robot.twists[:, 0, 2], robot.twists[:, 1, 0]], axis=1)
    p, across = np.cross(w, robot.twists[:, :3, 3]), np.cross(w[:-1], w[1:])
    apart = np.abs((np.diff(p, axis=0) * across).sum(axis=1)) / np.linalg.norm(across, axis=1)
    np.testing.assert_allclose(links(metric.axes, metric.prismatic, metric.axes)[1], apart, atol=3e-3)


def test_views_that_cannot_be_used_are_refused():
    robot, q, _, rng = recorded(3)
    seen = robot.observe(q, 0.5, rng)
    seen.images[:, 2, 1:] = np.nan
    seen.images[10:, 2] = np.nan
    with pytest.raises(WorkFailed, match="the top camera saw 10 markers that the left and right cameras see"):
        calibrate(seen, robot.joint_types, source="recorded")
