"""Goals carried by objects: exact images, OpenCV, errors against whole estimates, and what is not seen."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from projservo_cli.records import InputError, WorkFailed, changed
from projservo_cli.task.objects.displaced_object import DisplacedObject
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView
from tests.calibration.simulated_robot import Robot, random_robot, rig
from tests.metric.test_frame import calibrated
from tests.samples import displacement, frame, pixels, prismatic, revolute
from tests.studies.carried_goals import tags

NUMBERS = range(40, 48)
# Object of two tags of 60 mm before the rig, its displacement by 0.11 m and 41°, and the tool at the goal.
OBJECT = tags(0.06)[0] @ displacement([0.3, 2.8, -0.2], [0.03, 0.02, 0.05]).T
MOVED = displacement([0.5, -0.3, 0.4], [0.06, -0.05, 0.08])
AT_GOAL = displacement([-0.2, 0.3, 0.5], [-0.05, 0.04, -0.03])
Z = [0.0, 0.0, 1.0]
UPRIGHT = [revolute(at, Z) for at in ([0.3, 0.1, 0.0], [-0.2, 0.2, 0.0], [0.1, 0.0, 0.0])]
BODY = random_robot("RR", np.random.default_rng(4)).markers
SCARA = Robot("RRRP", np.array([*UPRIGHT, prismatic(Z)]), rig(), BODY, np.zeros(4))


@pytest.fixture(scope="module")
def arm():
    return random_robot("RRRPRR", np.random.default_rng(20000626))


@pytest.fixture(scope="module")
def c(arm):
    """The arm calibrated exactly, in a projective frame."""
    return calibrated(arm, frame(1))


def looks(arm, *motions, X=OBJECT):
    """Exact looks at an object before and after motions (4, 4)."""
    return [ObjectView(pixels(arm.cameras, X @ T.T)) for T in (np.eye(4), *motions)]


def goal_of(arm, H=AT_GOAL):
    return ObjectView(pixels(arm.cameras, arm.markers @ H.T))


@pytest.mark.parametrize(("seed", "types", "views"), [(None, "RRRRRR", 2), (1, "RPRR", 3), (3, "RR", 2)])
def test_exact_images_give_the_exact_goal(seed, types, views, rng):
    arm, G = random_robot(types, rng, views=views), np.eye(4) if seed is None else frame(seed)
    c = calibrated(arm, G)
    c = dataclasses.replace(c, view=("left", "right", "top")[:views])
    length = np.linalg.norm(arm.markers[1] - arm.markers[0])
    seen = looks(arm, displacement([0, 0, 0.1], [0.01, 0, 0]), MOVED)
    seen[0].s[0, 1] = seen[2].s[1, 6] = math.nan  # one that two views see but at the second look, and one now
    found = DisplacedObject.of(c, NUMBERS, seen, c.metric(length, (0, 10)))
    back = np.linalg.inv(G)
    assert pytest.approx(G @ MOVED @ back, abs=1e-9) == found.D
    M = OBJECT @ G.T
    assert pytest.approx(M / (M @ c.a_inf)[:, None], abs=1e-9) == found.M
    assert found.marker == tuple(NUMBERS)
    assert found.coordinates == 6
    assert found.angle_deg == pytest.approx(np.degrees(Rotation.from_matrix(MOVED[:3, :3]).magnitude()))
    assert found.shift_mm == pytest.approx(1e3 * np.linalg.norm((OBJECT @ MOVED.T - OBJECT).mean(axis=0)))
    carried = found.carry(goal_of(arm))
    assert carried.s == pytest.approx(pixels(arm.cameras, arm.markers @ (MOVED @ AT_GOAL).T), abs=1e-9)
    assert pytest.approx(G @ MOVED @ AT_GOAL @ back, abs=1e-9) == carried.H


def test_one_view_has_the_pose_of_opencv(arm, rng):
    """Of an object whose shape is known exactly, with 0.5 px of noise now."""
    taught, now = looks(arm, MOVED)
    now = now._replace(s=now.s + 0.5 * rng.standard_normal(now.s.shape))
    now.s[0] = math.nan
    K, R, center, *_ = cv2.decomposeProjectionMatrix(arm.cameras[1])
    given = OBJECT[:, :3].copy(), now.s[1].copy(), K / K[2, 2], None
    _, *start = cv2.solvePnP(*given, flags=cv2.SOLVEPNP_SQPNP)
    turn, t = cv2.solvePnPRefineLM(*given, *start, (cv2.TERM_CRITERIA_COUNT, 100, 0.0))
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = R, -R @ (center[:3] / center[3])[:, 0]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], t[:, 0]
    sure = taught._replace(sigma=np.full((2, 8), 1e-6))
    found = DisplacedObject.of(calibrated(arm, np.eye(4)), NUMBERS, [sure, now])
    assert pytest.approx(np.linalg.solve(camera, pose), abs=1e-6) == found.D


def off_by(arm, step, rng):
    """An arm with other cameras, axes and markers: each is displaced, and so remains what it is."""

    def move():
        return displacement(step * rng.standard_normal(3), step * rng.standard_normal(3))

    moves = [move() for _ in arm.twists]
    twists = [T @ H @ np.linalg.inv(T) for T, H in zip(moves, arm.twists, strict=True)]
    markers = (
        arm.markers + step * np.c_[rng.standard_normal((len(arm.markers), 3)), np.zeros(len(arm.markers))]
    )
    return dataclasses.replace(
        arm, twists=np.array(twists), cameras=np.array([P @ move() for P in arm.cameras]), markers=markers
    )


def test_errors_are_those_of_whole_estimates(arm, rng):
    """To first order: by images of the object and the goal, and by a calibration that is off."""
    G, step, std = frame(1), 1e-7, 1e-3
    c, other = (calibrated(one, G) for one in (arm, off_by(arm, step, rng)))
    change = [(b - a).reshape(-1, 1) for a, b in ((c.P, other.P), (c.H_hat_0, other.H_hat_0))]
    c = changed(
        c,
        sqrt_cov_shared=std * np.concatenate(change) / step,
        sqrt_cov_marker=std * (other.M - c.M)[..., None] / step,
    )
    seen, goal = looks(arm, MOVED), goal_of(arm)
    carried = DisplacedObject.of(c, NUMBERS, seen).carry(goal)

    def estimate(calibration, noise, of_goal):
        moved = [ObjectView(look.s + part) for look, part in zip(seen, noise, strict=True)]
        return DisplacedObject.of(calibration, NUMBERS, moved).carry(ObjectView(goal.s + of_goal)).s

    noise, of_goal = rng.standard_normal((2, 2, 8, 2)), rng.standard_normal(goal.s.shape)
    plain = carried.s
    by_images = (estimate(c, 1e-4 * noise, 1e-4 * of_goal) - plain) / 1e-4
    count = noise.size + of_goal.size
    unit = np.r_[noise.ravel(), of_goal.ravel()] / c.sigma_px
    assert np.einsum("c,cvmu->vmu", unit, carried.changes[: len(unit)]) == pytest.approx(
        by_images, rel=1e-3, abs=1e-3
    )
    by_calibration = (estimate(other, 0.0 * noise, 0.0) - plain) * (std / step)
    assert carried.changes[count] == pytest.approx(by_calibration, rel=1e-3, abs=1e-3)
    # An object that has not moved leaves the goal where it was, whatever the calibration.
    still = DisplacedObject.of(c, NUMBERS, looks(arm, np.eye(4))).carry(goal)
    assert np.linalg.norm(still.pose_changes[count]) < 1e-6 * np.linalg.norm(carried.pose_changes[count])


def test_more_looks_refine_the_shape(arm, c):
    more = displacement([0.1, 0.2, 0.3], [0.02, 0.05, -0.03])
    std = [
        DisplacedObject.of(c, NUMBERS, looks(arm, *Ts)).carry(goal_of(arm)).rms_px
        for Ts in ((MOVED,), (more, MOVED))
    ]
    assert std[1] < 0.97 * std[0]


def hidden(look, *where):
    for at in where:
        look.s[at] = math.nan
    return look


def test_joints_without_a_metric_leave_twelve_coordinates():
    """Of the object; the tool is where its parallel joints take it. Six would have smaller errors."""
    H, seen, std = displacement([0.0, 0.0, 0.5], [-0.05, 0.04, -0.03]), looks(SCARA, MOVED), []
    for twists in (SCARA.twists, [revolute([0.0, 0.1, 0.0], [1.0, 0.0, 0.0]), *SCARA.twists[1:]]):
        arm = dataclasses.replace(SCARA, twists=np.array(twists))
        found = DisplacedObject.of(calibrated(arm, frame(1)), NUMBERS, seen)
        assert pytest.approx(frame(1) @ MOVED @ np.linalg.inv(frame(1)), abs=1e-9) == found.D
        carried = found.carry(goal_of(arm, H))
        assert carried.s == pytest.approx(pixels(arm.cameras, arm.markers @ (MOVED @ H).T), abs=1e-8)
        std.append((found.coordinates, math.isnan(found.angle_deg), carried.rms_px))
    assert [one[:2] for one in std] == [(12, True), (6, False)]
    assert std[0][2] > 1.5 * std[1][2]


LINE = np.c_[np.linspace(-0.05, 0.05, 8), np.zeros((8, 2)), np.ones(8)]
FLAT = np.c_[np.random.default_rng(0).uniform(-0.05, 0.05, (8, 2)), np.zeros(8), np.ones(8)]
E = np.s_
REFUSED = {
    "nothing": (OBJECT, [E[:, :]], "object_hidden", (), ()),
    "one": (OBJECT, [E[:, 1:]], "object_hidden", (40,), ()),
    "two": (OBJECT, [E[:, 2:]], "object_hidden", (40, 41), ()),
    "a line": (LINE, [], "object_turned", tuple(range(40, 48)), ("object_line",)),
    "one view of a plane": (OBJECT, [E[0], E[:, 4:]], "object_in_two_places", (40, 41, 42, 43), ()),
}


def refused(c, numbers, seen):
    with pytest.raises(WorkFailed) as caught:
        DisplacedObject.of(c, numbers, seen)
    (one,) = caught.value.findings
    return one


@pytest.mark.parametrize(("X", "unseen", "code", "markers", "others"), REFUSED.values(), ids=REFUSED)
def test_what_is_not_seen_is_named(X, unseen, code, markers, others, arm, c):
    taught, now = looks(arm, MOVED, X=X)
    one = refused(c, NUMBERS, [taught, hidden(now, *unseen)])
    assert (one.code, one.subject.markers, one.subject.name) == (code, markers, "now")
    assert tuple(other.code for other in one.others) == others
    if code == "object_hidden":
        assert (one.amount, one.limit) == (len(markers), 3)


def test_a_marker_that_is_off_by_itself_is_left_out_of_its_look(arm, c):
    taught, now = looks(arm, MOVED)
    off = ObjectView(now.s + np.where(np.arange(8) == 3, 20.0, 0.0)[:, None], now.sigma)
    found = DisplacedObject.of(c, NUMBERS, [taught, off])
    gone = DisplacedObject.of(c, NUMBERS, [taught, hidden(now, E[:, 3])])
    assert (found.left_out, gone.left_out) == ((43,), ())
    np.testing.assert_allclose(found.D, gone.D, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("tag", [0, 1])
def test_a_tag_that_slipped_by_itself_is_named_before_all_residuals_tell(tag, arm, c):
    """Growing slips are refused by the corners of a tag first, by which half of them are found."""
    own = slice(4 * tag, 4 * tag + 4)
    for slip in np.linspace(0.0, 0.05, 51):
        X = OBJECT.copy()
        X[own, 0] += slip
        seen = [looks(arm)[0], looks(arm, MOVED, X=X)[1]]
        try:
            DisplacedObject.of(c, NUMBERS, seen)
        except WorkFailed as error:
            (one,) = error.findings
            break
    assert one.code == "object_deformed"
    assert one.subject.markers in {(40, 41, 42, 43), (44, 45, 46, 47)}  # two tags that move apart
    assert one.amount > one.limit
    assert slip > 0.001


def test_what_is_no_displaced_object_is_named(arm, c):
    taught, now = looks(arm, MOVED)
    deformed = ObjectView(now.s + np.where(np.arange(8) >= 5, 40.0, 0.0)[:, None])
    one = refused(c, NUMBERS, [taught, deformed])
    assert (one.code, len({*one.subject.markers} & {*NUMBERS})) == ("object_deformed", 1)
    assert one.amount > one.limit
    few = [
        ObjectView(np.where(np.arange(8)[:, None] < 6 + (np.arange(2) > 0)[:, None, None], look.s, math.nan))
        for look in (taught, now)
    ]
    few[0].s[1, :4] = few[1].s[1, :4] = math.nan
    one = refused(c, NUMBERS, few)
    assert (one.code, one.subject.markers, one.subject.poses) == ("object_without_shape", (44, 45), (1,))
    alone = changed(c, P=c.P[:1], view=("left",), sqrt_cov_shared=c.sqrt_cov_shared[12:])
    one = refused(alone, NUMBERS, [ObjectView(look.s[:1]) for look in (taught, now)])
    assert one.code == "object_without_size"
    found, goal = DisplacedObject.of(c, NUMBERS, [taught, now]), goal_of(arm)
    with pytest.raises(WorkFailed) as caught:
        found.carry(hidden(goal, E[:, 2:]))
    assert [(one.code, one.amount) for one in caught.value.findings] == [("goal_few_markers", 2)]
    single = calibrated(random_robot("R", np.random.default_rng(1)), frame(1))
    assert refused(single, NUMBERS, [taught, now]).code == "object_open_infinity"
    assert refused(calibrated(SCARA, frame(1)), NUMBERS, looks(SCARA, MOVED, X=FLAT)).limit in (4, 0.3)
    with pytest.raises(InputError, match="cameras on the tool"):
        DisplacedObject.of(changed(c, mount="tool"), NUMBERS, [taught, now])
