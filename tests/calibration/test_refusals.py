"""Data that must not become a calibration: refused in one line that names the joint, view or remedy."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.stats import chi2

from projservo_cli.calibration import calibrate
from projservo_cli.records import InputError, Observation, WorkFailed
from tests.calibration.simulated_robot import NAMES, around, random_robot, trials
from tests.studies.combined_mistakes import ENDS, ending

SIGMA = 0.5
TYPES = "RRRRRR"
ROBOT = random_robot(TYPES, np.random.default_rng(1), markers=6)
SMALL = random_robot("RRR", np.random.default_rng(1), markers=6)
Q = trials(ROBOT, 4)
LINE = np.array([0.6, 0.3, 0.5]) / np.linalg.norm([0.6, 0.3, 0.5])


def seen(robot=ROBOT, q=None, sigma=SIGMA):
    return robot.observe(trials(robot, 4) if q is None else q, sigma, np.random.default_rng(2))


def changed(observation, **arrays):
    return dataclasses.replace(observation, **arrays)


def some(poses=slice(None), markers=slice(None)):
    observation = seen()
    images = observation.images[poses][:, :, markers]
    return Observation(observation.pose[poses], observation.marker[markers], observation.q[poses], images)


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


IMAGES = seen().images
BLIND = np.where(np.arange(2)[:, None, None] == 1, np.nan, IMAGES)
LITTLE = {
    "no marker": some(markers=slice(0)),
    "only one marker": some(markers=slice(1)),
    "only two markers": some(markers=slice(2)),
    "only one pose": some(poses=slice(1)),
    "the right camera saw no marker": changed(seen(), images=BLIND),
    "no marker was seen": changed(seen(), images=np.full_like(IMAGES, np.nan)),
    "without a baseline": changed(seen(), images=IMAGES[:, [0, 0]] + np.reshape([0.0, 1.0], (1, 2, 1, 1))),
}


@pytest.mark.parametrize("words", LITTLE)
def test_what_shows_too_little_says_what_lacks(words):
    assert words in refusal(LITTLE[words])


@pytest.mark.parametrize(("types", "count", "enough"), [("RRPRRR", 5, 6), ("RRR", 3, 4)])
def test_as_few_numbers_as_the_joints_have_are_refused(types, count, enough):
    robot, q = random_robot(types, np.random.default_rng(3)), []
    for number in (count, enough + 2):
        q.append(around(robot, number, np.random.default_rng(3)))
    for copies in (1, 4):  # copies show nothing more
        message = refusal(seen(robot, np.repeat(q[0], copies, axis=0)), types)
        assert re.match(rf"{count} poses show .* record {enough} or more", message)
    calibrate(seen(robot, q[1]), types, source="recorded")


def test_a_joint_without_trials_is_named():
    moved = np.abs(Q - Q[0]) > 1e-9
    for joint in (0, 5):
        message = refusal(some(poses=~moved[:, joint]))
        assert f"joint {joint + 1} has no trial motion" in message
    # … nor one whose trials no camera saw.
    images = np.where(moved[:, 3, None, None, None], np.nan, IMAGES)
    assert "joint 4 has no trial motion" in refusal(changed(seen(), images=images))


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


@pytest.mark.parametrize("sigma", [0.0, SIGMA])
def test_images_that_show_one_place_or_one_line(sigma):
    images = IMAGES.copy()
    images[:, 1] = 300.0 + noise(sigma, images[:, 1].shape)
    message = refusal(changed(seen(), images=images))
    # Without noise the first check says it, with noise the epipolar geometry has to be known.
    assert "the right images show no more than noise" in message or sigma > 0.0
    column = IMAGES[..., 0]
    images = np.stack([column, 0.3 * column + 7.0], axis=-1) + noise(sigma, IMAGES.shape)
    message = refusal(changed(seen(), images=images))
    assert "left images show all markers at all poses on one line" in message


@pytest.mark.parametrize(("views", "hangs"), [(2, 0), (2, 1), (3, 2)])
@pytest.mark.parametrize("sigma", [0.0, SIGMA])
def test_a_camera_that_hangs_is_named_and_neither_another_nor_the_joints(views, hangs, sigma):
    """The image of one pose at all of them, or markers that stand still under the numbers of others."""
    robot = random_robot("RRR", np.random.default_rng(views), 10, views)
    observation = seen(robot, trials(robot, 5))
    images = observation.images.copy()
    images[:, hangs] = images[3, hangs] + noise(sigma, images[:, hangs].shape)
    message = refusal(changed(observation, images=images), "RRR")
    assert message.startswith(f"the {NAMES[hangs]} images stand still")


def test_views_that_show_little_depth_are_not_taken_for_late():
    """Joints to and fro pair images of other poses as well as their own."""
    robot = random_robot("P", np.random.default_rng(3), markers=4)
    q = trials(robot, 12, length=0.03)
    assert "without a baseline" in refusal(seen(robot, q), "P")


@pytest.mark.parametrize("seed", [10, 115, 159, 257, 3356, 3924])
def test_mistakes_together_end_in_a_calibration_or_a_refusal(seed):
    """Of three views one that is late, copies of a pose, a view that ends, a camera that hangs, few markers
    an image, four poses."""
    assert ending(seed)[1] in ENDS


@pytest.mark.parametrize("sigma", [0.0, SIGMA])
@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_markers_on_a_line_are_seen_through_wrong_detections(sigma, wrong):
    points = np.linspace(-0.5, 0.5, 8)[:, None] * 0.15 * LINE
    observation = seen(changed(ROBOT, markers=np.c_[points, np.ones(8)]), trials(ROBOT), sigma)
    images = observation.images.copy()
    images[np.random.default_rng(5).random(images.shape[:3]) < wrong] += 40.0
    assert "the markers lie on one line" in refusal(changed(observation, images=images))


@pytest.mark.parametrize("sigma", [0.0, SIGMA])
def test_a_joint_that_reads_but_stands_still_is_named(sigma):
    still = Q.copy()
    still[:, 3] = Q[0, 3]
    message = refusal(changed(seen(q=still, sigma=sigma), q=Q))
    assert "joint 4 does not move" in message
    assert "60°" in message


def combined(types, poses):
    """A robot, and poses of all joints at once."""
    robot = random_robot(types, np.random.default_rng(3), markers=6)
    return robot, around(robot, poses, np.random.default_rng(1))


def test_a_joint_that_stands_still_in_poses_of_all_joints_is_named():
    robot, q = combined("RRP", 12)
    true = q.copy()
    true[:, 1] = robot.q_reference[1]
    message = refusal(changed(seen(robot, true), q=q), "RRP")
    assert "joint 2 stands still" in message
    assert "its readings" in message


def test_what_no_single_joint_explains_names_none():
    robot, q = combined("RPR", 20)
    geared = q.copy()
    geared[:, 0] = q[0, 0] + 1.3 * (q[:, 0] - q[0, 0])
    message = refusal(changed(seen(robot, q), q=geared), "RPR")
    assert "by the images" not in message
    assert "does not describe the data" in message or "contradict the joint readings" in message


def test_readings_in_degrees_and_views_exchanged_now_and_then_are_told():
    observation = seen(random_robot("R", np.random.default_rng(1), markers=6))
    assert "units" in refusal(changed(observation, q=np.degrees(observation.q)), "R")
    observation = seen(random_robot("R", np.random.default_rng(2), markers=6))
    images = observation.images.copy()
    images[::2] = images[::2, ::-1]
    message = refusal(changed(observation, images=images), "R")
    assert "does not describe the data" in message or "correspondences" in message


@pytest.mark.parametrize(("types", "joint", "single"), [("RPR", 1, True), ("RPR", 0, False)])
def test_a_joint_of_the_wrong_type_is_named(types, joint, single):
    robot, q = combined(types, 20)
    right, wrong = ("revolute", "prismatic") if types[joint] == "R" else ("prismatic", "revolute")
    flipped = types[:joint] + ("P" if types[joint] == "R" else "R") + types[joint + 1 :]
    message = refusal(seen(robot, trials(robot) if single else q), flipped)
    assert message.startswith(f"by the images joint {joint + 1} is {right}, not {wrong}: check the types")


@pytest.mark.parametrize(("kinds", "length", "single"), [("PRR", 0.05, True), ("RRP", 0.02, False)])
def test_a_prismatic_joint_whose_fit_as_revolute_would_pass_is_named(kinds, length, single):
    """With an axis far away, three to eleven times the stated error."""
    robot = random_robot(kinds, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    poses = trials(robot, length=length) if single else around(robot, 30, rng, length=length)
    observation = robot.observe(poses, 0.3, rng)
    message = refusal(observation, "R" * len(kinds), joint_noise=None)
    assert re.search(rf"joint {kinds.index('P') + 1} is prismatic, .*{kinds} would fit", message)
    assert calibrate(observation, kinds, source="recorded", joint_noise=None).usable


@pytest.mark.parametrize("copied", ["joints", "views"])
def test_a_column_that_is_a_copy_of_another_is_named(copied):
    observation = seen()
    if copied == "joints":
        observation.q[:, 4] = observation.q[:, 1]
        message = "joints 2 and 5 are the same at all"
    else:
        observation.images[:, 1] = observation.images[:, 0]
        message = "views left and right are the same in all"
    with pytest.raises(InputError, match=message):
        calibrate(observation, TYPES)


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
    for ratio, warned in ((0.999 * limit, False), (1.001 * limit, True), (2.99, True))[: 2 + (frames == 4)]:
        given = found.sigma_fitted_px / ratio
        calibration = calibrate(observation, "RRR", sigma_px=given, source="recorded")
        assert calibration.usable
        assert ("more than pixel noise" in calibration.reason) == warned
        assert calibration.chi2_per_dof == pytest.approx(ratio**2, rel=1e-6)
    if frames == 4:  # beyond the warning all is as with much data, which are slow
        assert "3.01 times" in refusal(observation, "RRR", sigma_px=found.sigma_fitted_px / 3.01)


def test_two_markers_in_most_images_of_one_camera_are_too_few_and_no_line():
    """Any two lie on one line: only images of three or more show that the body does."""
    rng = np.random.default_rng(3)
    robot = random_robot("RRR", rng, markers=6, views=1)
    q = np.vstack([trials(robot, 6), around(robot, 8, rng)])
    observation = robot.observe(q, SIGMA, rng)
    for k, image in enumerate(observation.images):
        image[:, 3 if k % 4 == 0 else 2 :] = np.nan
        image[:, 2] = image[:, :2].mean(axis=1) if k % 4 == 0 else np.nan
    assert "saw 4 markers at once in 0 poses" in refusal(observation, "RRR")
