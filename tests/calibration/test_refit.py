"""A camera that moved and is fitted again: any rig, errors as stated, and no wrong joint reading in it."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from projservo_cli.calibration import calibrate, predict
from projservo_cli.calibration.prediction import (
    dense_pixel_changes,
    errors_of,
    from_reference,
    parameters_from,
)
from projservo_cli.calibration.refit import refit, view_errors
from projservo_cli.geometry.lens import distort
from projservo_cli.records import InputError, WorkFailed
from tests.calibration.simulated_robot import Robot, around, random_robot, trials
from tests.calibration.test_cameras_on_the_tool import Hand
from tests.calibration.test_views import of_views
from tests.studies.refit import knocked

SIGMA = 0.4
LENS = np.array([640.0, 512.0, 640.0, -0.12, 0.03])
RIGS = [("RRPRR", 3, "world"), ("RRRRR", 1, "world"), ("RRPRR", 2, "tool")]


@pytest.fixture(scope="module", params=RIGS, ids=str)
def case(request):
    """Arm, the arm with its left camera knocked, its calibration before, and a generator."""
    types, views, mount = request.param
    rng = np.random.default_rng(8)
    kind = Hand if mount == "tool" else Robot
    arm = kind(**vars(random_robot(types, rng, markers=8, views=views)))
    q = np.concatenate([trials(arm, frames=5), around(arm, 16, rng)])
    found = calibrate(arm.observe(q, SIGMA, rng), types, source="recorded", mount=mount)
    return arm, knocked(arm, rng), found, rng


def test_errors_of_all_cameras_are_those_of_the_covariance(case):
    arm, moved, before, rng = case
    after = refit(before, moved.observe(around(arm, 20, rng, 0.7, 0.2), SIGMA, rng), "left")
    ahead = around(arm, 12, rng)
    np.testing.assert_array_equal(predict(after, ahead)[:, 1:], predict(before, ahead)[:, 1:])
    error, squares = predict(after, ahead) - moved.images(ahead), []
    for q, off in zip(from_reference(after, ahead), error, strict=True):
        F = dense_pixel_changes(parameters_from(after), errors_of(after), q[None]).reshape(off.size, -1)
        values, axes = np.linalg.eigh(F @ F.T)
        known = values > 1e-9 * values[-1]
        squares.append(chi2.cdf(((axes.T @ off.ravel())[known] ** 2 / values[known]).sum(), known.sum()))
    # Of one calibration the poses share their errors: their median alone is held to a region.
    assert 1e-3 < np.median(squares) < 0.999
    assert after.refit == ("left",)
    poses, now, was = after.refit_numbers[0]
    assert (poses, now > 0.7 * was, now < 4.0 * was) == (20, True, True)


def test_a_camera_that_has_not_moved_is_kept(case):
    arm, _, before, rng = case
    with pytest.raises(WorkFailed, match=r"the left camera has not moved, .*the left images are .*allowed\)"):
        refit(before, arm.observe(around(arm, 6, rng), SIGMA, rng), "left")


def test_a_limit_of_the_error_holds_for_a_refit_as_for_a_calibration(case):
    arm, moved, before, rng = case
    seen = moved.observe(around(arm, 16, rng, 0.7, 0.2), SIGMA, rng)
    strict, strays = (
        refit(before, seen, "left", None, 0.01),
        dataclasses.replace(seen, images=seen.images.copy()),
    )
    assert (refit(before, seen, "left").usable, strict.usable) == (True, False)
    assert "more than calibration.max_predicted_px = 0.01" in strict.reason
    strays.images[0, 0, :2] = 1e6  # what does not fit makes no image larger
    few = of_views(strays, [0]) if len(arm.cameras) == 1 else strays
    assert refit(before, few, "left").refit_numbers[0, 1] < 2.0 * strict.refit_numbers[0, 1]


def test_wrong_detections_change_little(case):
    arm, moved, before, rng = case
    seen = moved.observe(around(arm, 16, rng, 0.7, 0.2), SIGMA, rng)
    spoilt = dataclasses.replace(seen, images=seen.images.copy())
    spoilt.images[rng.random(seen.images.shape[:3]) < 0.08] += rng.uniform(20.0, 200.0, 2)
    ahead, off = around(arm, 30, rng), []
    for some in (seen, spoilt):
        off.append(np.sqrt(np.mean((predict(refit(before, some, "left"), ahead) - moved.images(ahead)) ** 2)))
    assert off[1] < 1.5 * off[0] + 0.1


@pytest.mark.parametrize("part", [1.0, 0.5])
def test_a_wrong_joint_does_not_pass_into_the_camera(case, part):
    """Of one camera, an offset of the joint before it turns it: readings with this offset are then right."""
    arm, moved, before, rng = case
    n, alone, slipped = len(arm.twists), len(arm.cameras) == 1, []
    for i in range(n):
        seen, off = moved.observe(around(arm, 16, rng, 0.7, 0.2), SIGMA, rng), np.zeros(n)
        off[i] = part * (0.02 if arm.joint_types[i] == "P" else np.radians(2.0))
        wrong = dataclasses.replace(seen, q=seen.q + off)
        if alone and i == 0:
            ahead, after = around(arm, 10, rng), refit(before, wrong, "left")
            assert np.abs(predict(after, ahead + off) - moved.images(ahead)).mean() < 3.0 * SIGMA
            continue
        with pytest.raises(WorkFailed) as refused:
            refit(before, wrong, "left")
        (one,) = refused.value.findings
        slipped.append(one.code == "other_view_off" or one.subject.joints == (i + 1,))
    assert all(slipped)


def test_a_joint_that_slipped_a_little_is_named_and_no_camera_is_said_to_have_moved(case):
    """By a degree of the last joints, which moves images by less than a view must be off to have moved."""
    arm, _, before, rng = case
    n = len(arm.twists)
    for i in (n - 2, n - 1):
        seen = arm.observe(around(arm, 16, rng, 0.7, 0.2), SIGMA, rng)
        wrong = dataclasses.replace(seen, q=seen.q + np.radians(1.0) * np.eye(n)[i])
        with pytest.raises(WorkFailed) as refused:
            refit(before, wrong, "left")
        (one,) = refused.value.findings
        assert one.code == "other_view_off" or one.subject.joints == (i + 1,)


def test_few_poses_of_one_camera_confirm_no_readings_and_another_camera_does(case):
    arm, moved, before, rng = case
    seen = moved.observe(around(arm, 3, rng, 0.03, 0.01), SIGMA, rng)
    with pytest.raises(
        WorkFailed, match=r"could pass into the left camera unnoticed \(.*allowed\)|determine"
    ):
        refit(before, of_views(seen, [0]), "left")
    if len(arm.cameras) > 1:
        assert refit(before, seen, "left").refit_numbers[0, 0] == 3
        found = {one.view: one.disagrees for one in view_errors(before, seen)}
        assert found == {name: name == "left" for name in before.view}


def test_a_lens_is_fitted_again_with_its_camera():
    rng = np.random.default_rng(5)
    arm = random_robot("RRRRR", rng, markers=10)
    moved = knocked(arm, rng)

    def bent(robot, q):
        seen = robot.observe(q, 0.0, rng)
        images = distort(LENS, seen.images)
        return dataclasses.replace(seen, images=images + 0.2 * rng.standard_normal(images.shape))

    q = np.concatenate([trials(arm, frames=6), around(arm, 20, rng)])
    before = calibrate(bent(arm, q), "RRRRR", source="recorded", lens=True, image_size=(1280, 1024))
    after, ahead = refit(before, bent(moved, around(arm, 25, rng, 0.6)), "left"), around(arm, 30, rng)
    off = np.sqrt(np.mean((predict(after, ahead) - distort(LENS, moved.images(ahead))) ** 2, axis=(0, 2, 3)))
    assert off[0] < 3.0 * off[1] + 0.1
    assert not np.array_equal(after.lens[0], before.lens[0])
    np.testing.assert_array_equal(after.lens[1], before.lens[1])


def test_what_cannot_be_fitted_is_refused_in_a_line(case):
    arm, moved, before, rng = case
    seen = moved.observe(around(arm, 2, rng), SIGMA, rng)
    with pytest.raises(InputError, match="no camera 'up': the calibration has left"):
        refit(before, seen, "up")
    with pytest.raises(InputError, match="the images have right"):
        refit(before, dataclasses.replace(of_views(seen, [0]), view=("right",)), "left")
    seen.images[1:, 0] = np.nan
    seen.images[0, 0, 4:] = np.nan
    with pytest.raises(
        WorkFailed, match=r"4 detections of the left camera at 1 poses determine no camera \(12"
    ):
        refit(before, seen, "left")
