"""Rows that are not what they seem: each is named by its code and subject, or left out, and no other is."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict
from projservo_cli.records import WorkFailed
from tests.calibration.simulated_robot import around, random_robot, trials

TYPES, SIGMA = "RRR", 0.3


def recorded(seed, types=TYPES, markers=7, count=20):
    """A random arm, readings of trials and combined poses, and the generator of its noise."""
    rng = np.random.default_rng(seed)
    robot = random_robot(types, rng, markers=markers)
    return robot, np.concatenate([trials(robot, frames=4), around(robot, count, rng, angle=0.6)]), rng


def refused(observation, types=TYPES):
    """The first finding on what a table is refused for."""
    with pytest.raises(WorkFailed) as caught:
        calibrate(observation, types, source="recorded")
    return caught.value.findings[0]


def test_joints_in_the_place_of_each_other_are_named():
    robot, q, rng = recorded(1, count=12)
    one = refused(dataclasses.replace(robot.observe(q, SIGMA, rng), q=q[:, [1, 0, 2]]))
    assert (one.code, one.subject.joints) == ("exchanged_joints", (1, 2))


def test_a_joint_that_keeps_the_direction_of_its_link_is_a_parallelogram():
    robot, q, rng = recorded(2, count=12)
    linked = q.copy()
    linked[:, 2] -= q[:, 1] - robot.q_reference[1]
    given = dataclasses.replace(robot.observe(linked, SIGMA, rng), q=q)
    one = refused(given)
    assert (one.code, one.subject.joints, one.amount) == ("full_coupling", (2, 3), -1.0)
    found = calibrate(given, TYPES, source="recorded", joint_model=["coupling:2-3"])
    assert found.usable
    (coupling,) = found.joint_curve
    assert coupling[3] == pytest.approx(-1.0, abs=5.0 * coupling[4])


def test_a_joint_in_degrees_is_named():
    robot, q, rng = recorded(3, "RR", count=12)
    given = q.copy()
    given[:, 1] = np.degrees(q[:, 1])
    one = refused(dataclasses.replace(robot.observe(q, SIGMA, rng), q=given), "RR")
    assert (one.code, one.subject.joints, one.subject.name) == ("joint_unit", (2,), "degrees")


@pytest.mark.parametrize(("factor", "views"), [(0.5, 2), (2.0, 2), (0.5, 1)])
def test_images_of_another_size_are_named_by_their_first_pose(factor, views):
    robot, q, rng = recorded(4)
    seen = robot.observe(q, SIGMA, rng)
    images = seen.images[:, :views].copy()
    images[20:] = factor * (images[20:] + 0.5) - 0.5
    one = refused(dataclasses.replace(seen, images=images, view=seen.view[:views]))
    assert (one.code, one.amount) == ("image_size_changed", factor)
    assert abs(one.subject.poses[0] - seen.pose[20]) <= 2  # numbers of poses are two apart


def creeping(robot, q):
    """Images of a marker that creeps on the tool by a third of its size."""
    size, rows = 0.3 * np.ptp(robot.markers[:, :3], axis=0).max(), []
    for k, shift in enumerate(np.linspace(0.0, size, len(q))):
        markers = robot.markers.copy()
        markers[3, :3] += shift
        rows.append(dataclasses.replace(robot, markers=markers).images(q[k : k + 1])[0])
    return np.array(rows)


def on_a_link(robot, q):
    """Images of a marker that does not move with the last joint."""
    still = q.copy()
    still[:, -1] = robot.q_reference[-1]
    return robot.images(still)


def standing(robot, q):
    """Images of a marker that stays where it is at first."""
    return np.broadcast_to(robot.images(q[:1]), robot.images(q).shape)


OWN = {
    "marker_drift": (creeping, ()),
    "marker_on_link": (on_a_link, (3,)),
    "standing_markers": (standing, ()),
}


@pytest.mark.parametrize("code", OWN)
def test_a_marker_that_moves_in_its_own_way_is_named_and_left_out(code):
    images_of, joints = OWN[code]
    robot, q, rng = recorded(5)
    seen = robot.observe(q, SIGMA, rng)
    images = seen.images.copy()
    noise = images[:, :, 3] - robot.images(q)[:, :, 3]
    images[:, :, 3] = images_of(robot, q)[:, :, 3] + noise
    found = calibrate(dataclasses.replace(seen, images=images), TYPES, source="recorded")
    named = [one for one in found.findings if one.subject.markers]
    assert [(one.code, one.subject.joints) for one in named] == [(code, joints)]
    number = int(seen.marker[3])
    assert named[0].subject.markers == (number,)
    assert found.usable
    assert number not in found.marker
    assert number in found.rejected_markers[:, 0]


def test_sound_tables_blame_no_row():
    for seed in range(3):
        robot, q, rng = recorded(seed)
        found = calibrate(robot.observe(q, SIGMA, rng), TYPES, source="recorded", joint_noise=None)
        assert found.usable
        assert not any(one.subject.joints or one.subject.markers for one in found.findings)
        off = predict(found, q) - robot.images(q)
        assert np.sqrt(np.mean((off**2).sum(axis=-1))) < 2.0 * found.predicted_rms_px


def test_a_level_hand_is_named_by_the_parallelogram_that_holds_it():
    """Four readings of five joints of which three are parallel."""
    robot, q, rng = recorded(6, "RRRRR", count=10)
    twists = robot.twists.copy()
    for i in (2, 3):
        twists[i, :3, :3] = twists[1, :3, :3]
        point = rng.uniform(-0.4, 0.4, 3)
        twists[i, :3, 3] = -twists[1, :3, :3] @ point
    robot = dataclasses.replace(robot, twists=twists)
    read = np.delete(q - robot.q_reference, 3, axis=1)
    true = np.column_stack([read[:, :2], read[:, 2] - read[:, 1], -read[:, 2], read[:, 3]])
    seen = robot.observe(robot.q_reference + true, SIGMA, rng)
    one = refused(dataclasses.replace(seen, q=read), "RRRR")
    assert (one.code, one.subject.joints) == ("level_hand", (2, 3))


def test_a_tracker_that_remembers_is_named_with_its_share():
    robot, q, rng = recorded(7, markers=10, count=30)
    seen = robot.observe(q, SIGMA, rng)
    images = seen.images.copy()
    for k in range(1, len(q)):
        images[k] += 0.01 * (images[k - 1] - images[k])
    found = calibrate(dataclasses.replace(seen, images=images), TYPES, source="recorded", joint_noise=None)
    (one,) = (one for one in found.findings if one.code == "memory")
    assert abs(one.amount - 0.01) < 5.0 * one.deviation + 0.001


def test_a_cyclic_error_is_named_by_its_period_and_stated():
    robot, _, rng = recorded(8)
    q = around(robot, 80, rng, angle=0.6)
    swings = np.radians(0.3) * np.sin(2.0 * np.pi * (q[:, 1] - 0.1) / 0.2)
    true = q + swings[:, None] * np.eye(3)[1]
    seen = dataclasses.replace(robot.observe(true, SIGMA, rng), q=q)
    found = calibrate(seen, TYPES, source="recorded", joint_noise=None)
    one = next(one for one in found.findings if one.code == "cyclic")
    assert one.subject.joints == (2,)
    assert one.amount == pytest.approx(np.radians(0.3), rel=0.4)
    assert one.period == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize(
    ("step", "onset", "code"),
    [(1, 25, "images_early_from"), (-1, 17, "images_late_from")],
)
def test_images_that_come_late_or_early_from_a_pose_on_are_named(step, onset, code):
    """In the last table a fit rejects no part of the poses that would tell from where on."""
    robot, q, rng = recorded(9, "RR", markers=10, count=30)
    seen = robot.observe(q, SIGMA, rng)
    images, last = seen.images.copy(), len(q) - max(step, 0)
    images[onset:last] = seen.images[onset + step : last + step]
    one = refused(dataclasses.replace(seen, images=images), "RR")
    assert one.code == code
    assert abs(one.subject.poses[0] - seen.pose[onset]) <= 1


def test_images_of_another_pose_are_named_with_the_pose_that_they_show():
    robot, q, rng = recorded(10)
    seen, at = robot.observe(q, SIGMA, rng), np.array([15, 22, 28])
    images = seen.images.copy()
    images[at, 1] = seen.images[at - 4, 1] + SIGMA * rng.standard_normal(images[at, 1].shape)
    found = calibrate(dataclasses.replace(seen, images=images), TYPES, source="recorded")
    (one,) = (one for one in found.findings if one.code == "other_pose")
    assert (one.subject.views, one.subject.poses) == (("right",), tuple(seen.pose[at]))
    assert one.others[0].subject.poses == tuple(seen.pose[at - 4])
    assert found.usable


def test_a_camera_that_moved_far_and_came_back_is_named_by_its_poses():
    robot, q, rng = recorded(11)
    seen = robot.observe(q, SIGMA, rng)
    images = seen.images.copy()
    images[14:20, 0] += 60.0
    found = calibrate(dataclasses.replace(seen, images=images), TYPES, source="recorded")
    (one,) = (one for one in found.findings if one.code == "moved_camera")
    assert (one.subject.views, one.subject.poses) == (("left",), (seen.pose[14], seen.pose[19]))
    assert found.usable


@pytest.mark.parametrize("erring", [(2,), (1, 2)])
def test_joints_that_err_by_more_than_trials_show_are_not_in_another_order(erring):
    """By a wave that is nothing where a joint moves alone; one joint that does is named."""
    robot, q, rng = recorded(12, markers=10, count=12)
    q = rng.permutation(q)
    away, true = q - robot.q_reference, q.copy()
    for i in erring:
        alone = np.unique(np.round(away[np.abs(np.delete(away, i, axis=1)).max(axis=1) < 1e-9, i], 9))
        wave = np.sin(np.pi * np.interp(away[:, i], alone, np.arange(alone.size)))
        true[:, i] += np.radians(5.0) * wave
    one = refused(dataclasses.replace(robot.observe(true, SIGMA, rng), q=q))
    if len(erring) > 1:
        assert one.code == "several_joints"
        return
    assert (one.code, one.subject.joints) == ("erring_joint", (3,))
    assert 0.3 * np.radians(5.0) < one.amount < np.radians(5.0)


def test_a_pose_at_which_all_cameras_are_off_alike_is_of_the_arm():
    robot, q, rng = recorded(13)
    true = q.copy()
    true[18] += np.radians([0.4, -0.3, 0.3])
    seen = dataclasses.replace(robot.observe(true, SIGMA, rng), q=q)
    found = calibrate(seen, TYPES, source="recorded")
    assert not [one for one in found.findings if one.code in ("moved_camera", "unsettled_camera")]
    assert not found.moved_images.size


def test_a_tracker_that_keeps_much_is_named_with_its_share():
    """Of what it keeps a fit rejects most poses: images without it fit, by the share within a tenth of it."""
    robot, q, rng = recorded(14, "RR")
    seen, share = robot.observe(rng.permutation(q), SIGMA, rng), 0.15
    images = seen.images.copy()
    for k in range(1, len(images)):
        images[k] = (1.0 - share) * seen.images[k] + share * images[k - 1]
    one = refused(dataclasses.replace(seen, images=images), "RR")
    assert one.code == "tracker_memory"
    assert one.amount == pytest.approx(share, rel=0.1)
