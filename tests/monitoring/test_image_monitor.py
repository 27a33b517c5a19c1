"""The test of images in the loop: what it does not mind, what it finds, and whom it blames."""

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest

from projservo_cli.calibration import calibrate as calibrated
from projservo_cli.calibration.prediction import (
    Parameters,
    image_points,
    moved_points,
)
from projservo_cli.geometry.displacements import displacements
from projservo_cli.monitoring import innovation_tests
from projservo_cli.monitoring.arrival_accuracy import Posture
from projservo_cli.monitoring.fault_at_rest import fault_at_rest
from projservo_cli.monitoring.frame_pairs import FramePair
from projservo_cli.monitoring.image_monitor import ImageMonitor
from projservo_cli.monitoring.innovation_tests import WINDOW, Detector, ErrorModel
from projservo_cli.records import Observation, changed
from tests.calibration.simulated_robot import random_robot, trials
from tests.configured import calibrate, truth_of
from tests.known import configured

SIGMA, PERIOD = 0.5, 0.04
TICK = 2.0 * np.pi / 4096
STEPS, REST = 60, 15
LOOKS = 200  # for which the thresholds are set


class Arm(NamedTuple):
    """A simulated arm, and its calibration from noisy trials."""

    calibration: object
    scene: Parameters
    reference: np.ndarray
    image_size: np.ndarray

    def with_joint_noise(self, sigma_q, model_px=0.0):
        noisy = changed(self.calibration, sigma_q=sigma_q, model_px=model_px)
        return self._replace(calibration=noisy)

    def way(self, seed):
        """Joints (k, n) from rest to rest that keep all markers in both images, and their velocities."""
        rng = np.random.default_rng(seed)
        x = np.linspace(0.0, 1.0, STEPS)
        share = np.concatenate([np.zeros(3), x * x * (3.0 - 2.0 * x), np.ones(REST)])[:, None]
        while True:
            start, end = self.reference + rng.uniform(-0.7, 0.7, (2, len(self.reference)))
            q = start + share * (end - start)
            s = self.scene.predict(q - self.reference)
            if ((s > 0.0) & (s < self.image_size[:, None])).all():
                return q, np.gradient(q, axis=0) / PERIOD

    def images(self, q, moved=None):
        """Pixels (k, 2, m, 2) at joints (k, 2, n) of both views, of markers (k, m, 4) where some moved."""
        s = np.empty((len(q), 2, len(self.scene.M), 2))
        for v in (0, 1):
            E = displacements(self.scene.H_hat, self.scene.prismatic, q[:, v] - self.reference)
            Y = moved_points(E, np.repeat(self.scene.M[None], len(q), 0) if moved is None else moved)[0]
            p = image_points(self.scene.P, Y)[:, v]
            s[:, v] = p[..., :2] / p[..., 2:]
        return s


@pytest.fixture(scope="module")
def arm():
    config = configured("ur5", f"noise.calibration_px={SIGMA}")
    truth = truth_of(config)
    model = truth.model
    scene = Parameters(model.P, model.H_hat_0, model.prismatic, truth.M)
    return Arm(calibrate.run(config)[1], scene, model.q_reference, truth.image_size)


@pytest.fixture(scope="module")
def sharp():
    """The arm at a tenth of the noise, with joint readings that err by 0.6 px."""
    config = configured("ur5", f"noise.calibration_px={0.1 * SIGMA}")
    truth = truth_of(config)
    scene = Parameters(truth.model.P, truth.model.H_hat_0, truth.model.prismatic, truth.M)
    made = Arm(calibrate.run(config)[1], scene, truth.model.q_reference, truth.image_size)
    return made.with_joint_noise(5e-4)


def look(test, k, q, s):
    """What a test says of still joints (n,) and images (V, m, 2)."""
    still, new = np.zeros((len(s), len(q))), np.ones(len(s), dtype=bool)
    return test.observe(np.full(len(s), PERIOD * k), np.stack([q] * len(s)), still, np.zeros(len(s)), s, new)


def first_alarm(arm, read, s, q_dot=None, delay_sigma=0.0, fresh=None, sigma=SIGMA, stated=None):
    """When a fault is found by looks at readings (k, n) and images (k, V, m, 2), and which."""
    test, V = ImageMonitor(arm.calibration, sigma, LOOKS), s.shape[1]
    for k in range(len(read)):
        speed = np.zeros(read.shape[1]) if q_dot is None else q_dot[k]
        new = np.ones(V, dtype=bool) if fresh is None else fresh[k]
        at_once, t = (np.stack([row] * V) for row in (read[k], speed)), np.full(V, PERIOD * k)
        fault = test.observe(t, *at_once, np.full(V, delay_sigma), s[k], new, stated=stated)
        if fault:
            return k, fault
    return None, None


def causes(fault):
    """Causes of a fault by their codes."""
    return {} if fault is None else {one.code: one for one in fault.others}


def noisy(s, seed, sigma=SIGMA):
    return s + sigma * np.random.default_rng([seed, 1]).standard_normal(s.shape)


def at_once(q):
    return np.repeat(q[:, None], 2, axis=1)


def test_single_slips_of_the_detector_and_unseen_markers_are_no_disturbance(arm):
    q, _ = arm.way(2)
    s = noisy(arm.images(at_once(q)), 2)
    s[10::5] += 40.0
    s[3::7] = np.nan
    s[4::7, 1] = np.nan
    s[12::9, :, 4] += 30.0
    assert first_alarm(arm, q, s) == (None, None)


def test_a_marker_is_tested_by_the_deviation_it_states(arm):
    """Two that are seen badly disturb nothing, stated or not, and what a sharp one shows is not hidden."""
    q, _ = arm.way(0)
    stated = np.full((2, len(arm.scene.M)), 0.1)
    stated[:, :2] = 5.0
    s = arm.images(at_once(q))
    s += stated[..., None] * np.random.default_rng(9).standard_normal(s.shape)
    assert first_alarm(arm, q, s, stated=stated) == (None, None)
    assert first_alarm(arm, q, s) == (None, None)
    moved = np.repeat(arm.scene.M[None], len(q), 0)
    loose(Struck(None, None, moved[20:]), (4,))  # by less than what the others are off
    s += arm.images(at_once(q), moved) - arm.images(at_once(q))
    assert 20 <= first_alarm(arm, q, s, stated=stated)[0] < 40
    s[20:, 1, 4] = np.nan  # something may hide what a single camera shows
    assert first_alarm(arm, q, s, stated=stated) == (None, None)


def test_a_frame_that_comes_twice_is_no_second_measurement(arm):
    """A slip of the statistics, shown again and again, stays one; a camera that shows it anew was moved."""
    q, _ = arm.way(4)
    s = noisy(arm.images(at_once(q)), 4)
    s[20:32, 0] += 30.0
    fresh = np.ones((len(q), 2), dtype=bool)
    fresh[21:32, 0] = False
    assert first_alarm(arm, q, s, fresh=fresh) == (None, None)
    assert causes(first_alarm(arm, q, s)[1])["displaced_camera"].subject.views == ("left",)


class Struck(NamedTuple):
    """What a fault changes from its onset on."""

    q: np.ndarray  # (k, n) true joints, rad
    read: np.ndarray  # (k, n) readings, rad
    moved: np.ndarray  # (k, m, 4) markers


def slipped(struck, joint):
    struck.q[:, joint] += np.radians(3.0)


def frozen(struck, joint):
    struck.read[:, joint] = struck.read[0, joint]


def loose(struck, markers, by=0.004):
    for j in markers:
        struck.moved[:, j, :3] += by * np.array([0.6, -0.48, 0.64]) * (-1.0) ** j


FAULTS = [
    (slipped, (5,), "slipped_joint", (6,)),
    (frozen, (1,), "frozen_reading", (2,)),
    (frozen, (slice(None),), "frozen_reading", ()),
    (loose, ((2, 5), 0.006), "displaced_markers", ()),
]


@pytest.mark.parametrize(("strikes", "where", "code", "joints"), FAULTS)
def test_each_fault_is_named_soon(arm, strikes, where, code, joints):
    """With 4,096 ticks; struck at a third of the way."""
    seed = 5
    q, _ = arm.way(seed)
    onset = STEPS // 3
    read = TICK * np.round(q / TICK)
    moved = np.repeat(arm.scene.M[None], len(q), 0)
    strikes(Struck(q[onset:], read[onset:], moved[onset:]), *where)
    s = noisy(arm.images(at_once(q), moved), seed)
    k, fault = first_alarm(arm.with_joint_noise(TICK / np.sqrt(12.0)), read, s)
    first = fault.others[0]
    assert (first.code, first.subject.joints) == (code, joints)
    assert onset + WINDOW - 1 <= k <= onset + 30
    if code == "slipped_joint":
        # By five looks of 0.5 px noise, most of one view.
        assert np.degrees(first.amount) == pytest.approx(3.0, abs=0.4)
    if code == "displaced_markers":
        assert first.subject.markers == tuple(arm.calibration.marker[[2, 5]])


def test_a_corner_that_trembles_at_rest_is_no_alarm_and_hides_no_marker_that_moves(arm):
    """By eight times what the finder errs elsewhere, in one view, as under a slant never calibrated."""
    q, _ = arm.way(1)
    q = q[:1].repeat(70, axis=0)
    s = noisy(arm.images(at_once(q)), 1)
    s[:, 0, 4] += 8.0 * SIGMA * np.random.default_rng([1, 1]).standard_normal((len(q), 2))
    assert first_alarm(arm, q, s) == (None, None)
    s[40:, :, 4] += 60.0
    k, fault = first_alarm(arm, q, s)
    assert 40 <= k < 60
    assert causes(fault)["displaced_markers"].subject.markers == (4,)


@pytest.mark.parametrize(("backlash", "slip", "sign"), [(0.0, 0, 1), (0.022, 1, 1), (0.05, 1, 0)])
def test_a_mirrored_reading_near_zero_and_a_small_slip_are_both_said(arm, backlash, slip, sign):
    noisy_arm, q = arm.with_joint_noise(0.002), arm.way(3)[0][:1]
    q[0, -1] = 0.03
    true = q.copy()
    true[0, -1] = -0.03 - backlash
    s = noisy(arm.images(at_once(np.repeat(true, 20, axis=0))), 5)
    found = causes(first_alarm(noisy_arm, np.repeat(q, 20, axis=0), s)[1])
    assert ("slipped_joint" in found) == slip
    assert ("mirrored_joint" in found) == sign
    assert {one.subject.joints for one in found.values()} == {(6,)}


@pytest.mark.parametrize("shift", [0.0, 6.0])
def test_a_view_of_which_many_sightings_stay_aside_is_off_where_chance_does_not_explain_it(
    arm, monkeypatch, shift
):
    q, _ = arm.way(3)
    read = np.repeat(q[:1], 60, axis=0)
    s = noisy(arm.images(at_once(read)), 3)
    s[:, 1, :, 0] += shift

    def some_aside(self, residual):
        """As play in the joints lets them: some sightings are off, and the view is not."""
        aside = np.zeros_like(residual.seen)
        aside[1, : aside.shape[1] // 3] = True
        return innovation_tests.Tested(False, aside)

    monkeypatch.setattr(innovation_tests.Detector, "tested", some_aside)
    monkeypatch.setattr(innovation_tests.Detector, "significant", lambda *_: None)
    _, fault = first_alarm(arm, read, s)
    assert (fault is not None) == bool(shift)
    assert {one.subject.views for one in causes(fault).values()} <= {("right",)}


def test_a_marker_that_was_off_and_is_gone_is_not_judged(arm):
    """By no two looks alike, so that nothing is named while it is seen; the looks since do not show it."""
    q, _ = arm.way(1)
    q = q[:1].repeat(40, axis=0)
    s = noisy(arm.images(at_once(q)), 1)
    s[5:10, :, 4] += 30.0 * np.random.default_rng(2).standard_normal((5, 2, 2))
    s[10:, :, 4] = np.nan
    assert first_alarm(arm, q, s) == (None, None)


def test_a_camera_that_moves_by_two_pixels_in_motion_is_named_before_the_end(arm):
    """No two looks in motion are of one view: all differences count that tell how long corners err alike."""
    q, _ = arm.way(4)
    q = np.concatenate([q[:1].repeat(4, axis=0), q[3 : 3 + STEPS : 3], q[-1:].repeat(12, axis=0)])
    s = noisy(arm.images(at_once(q)), 4)
    assert first_alarm(arm, q, s) == (None, None)
    s[4 + STEPS // 9 :, 0] += (2.0, 1.0)
    assert causes(first_alarm(arm, q, s)[1])["displaced_camera"].subject.views == ("left",)


@pytest.mark.parametrize("shift", [0.0, 15.0])
def test_errors_of_corners_excuse_only_what_joints_in_error_do_not_cover(arm, shift):
    """Both cameras moved alike, where joints are uncertain by 0.003 rad: most of a score is theirs."""
    errors = ErrorModel(arm.with_joint_noise(0.003).calibration, SIGMA)
    detector, sigma_t = Detector(errors, LOOKS), np.full(2, innovation_tests.LEAST_ERROR)
    q = arm.way(2)[0][[0, STEPS // 2, -1]]
    s = arm.images(at_once(q))
    s[..., 0] += shift
    noise = np.full((2, len(arm.scene.M)), SIGMA)
    for k in range(len(q)):
        t, both, still = np.full(2, PERIOD * k), at_once(q)[k], np.zeros((2, 6))
        look = FramePair(t=t, q=both, q_dot=still, sigma_t=sigma_t, images=s[k], noise=noise, curved=still[0])
        detector.memory.keep(errors.residual(look), PERIOD * k, True)
    assert (detector.significant(len(q), sigma_t, [], True) is not None) == bool(shift)


# Of four corners of a slanted tag of an emulated arm, px, left and right.
BENT_TAG = [
    [[-0.15, 0.2], [-0.4, 0.1], [0.6, -0.8], [0.5, 0.15]],
    [[-0.05, 0.5], [-0.6, 0.1], [0.1, -0.5], [0.1, 0.3]],
]


@pytest.mark.parametrize(
    ("seed", "tags", "off", "shift", "code"),
    [
        (6, (1,), 1.2, 0.0, None),
        (6, (1,), 1.2, 3.0, "displaced_camera"),
        (6, (0, 1), 2.0, 0.0, "displaced_markers"),  # of three tags
        (0, (1,), 3.0, 0.0, "unexplained_images"),
    ],
)
def test_a_tag_that_is_off_by_less_than_a_pixel_in_one_posture_is_no_fault(arm, seed, tags, off, shift, code):
    """One view does not tell a slanted tag from one that moved by as little, which hides no moved camera."""
    sharp = changed(arm.calibration, sigma_px=0.1, sigma_fitted_px=0.1)
    q = arm.way(seed)[0][-1]
    s = noisy(arm.images(at_once(q[None])), seed, 0.1)[0]
    for tag in tags:
        s[:, 4 * tag : 4 * tag + 4] += off * np.array(BENT_TAG)
    s[0] += shift
    fault = fault_at_rest(sharp, Observation.of_one(sharp.marker, q, s, sharp.view), arm.image_size)
    named = None if fault is None else fault.others[0] if fault.others else fault
    assert (named and named.code) == code


@pytest.mark.parametrize(
    ("seed", "sigma_deg", "by_mm"), [(0, 0.0, 0.0), (0, 0.0, 0.3), (1, 0.3, 1.0), (1, 0.3, 3.0)]
)
def test_a_tool_that_moved_by_less_than_a_test_tells_from_none_is_stated(arm, seed, sigma_deg, by_mm):
    doubtful, q = arm.with_joint_noise(np.radians(sigma_deg)), arm.way(seed)[0]
    by = np.random.default_rng(seed).standard_normal(3)
    moved = arm.scene.M.copy()
    moved[:, :3] += 1e-3 * by_mm * by / np.linalg.norm(by)
    s = noisy(arm.images(at_once(q), np.repeat(moved[None], len(q), 0)), seed)
    test, fault = ImageMonitor(doubtful.calibration, SIGMA, LOOKS), None
    for k, row in enumerate(q):
        fault = fault or look(test, k, row, s[k])
    used = np.ones((2, len(moved)), dtype=bool)
    M = arm.scene.M[:4, :3]
    lengths = np.linalg.norm(M[:, None] - M, axis=2)
    posture = Posture(arm.calibration.model(), q[-1], arm.calibration.M[:4], lengths)
    assert fault or by_mm <= 1.5 * test.undetected_mm(q[-1], used, posture)
    assert not (fault and by_mm == 0.0)


def test_in_one_posture_links_that_flex_are_said_beside_cameras_that_moved_alike(arm):
    """Small deflections of six joints are a rigid motion there; what is far off is none."""
    seed = 5
    q = np.repeat(arm.way(seed)[0][:1], REST + 10, axis=0)
    deflection = np.radians(np.random.default_rng([seed, 17]).uniform(-0.6, 0.6, q.shape[1]))
    small = causes(first_alarm(arm, q, noisy(arm.images(at_once(q + deflection)), seed))[1])
    assert {"displaced_rig", "cropped_images"} & {*small}
    assert "flexing_links" in small
    large = causes(first_alarm(arm, q, noisy(arm.images(at_once(q)), seed) + np.array([40.0, -40.0]))[1])
    assert {"displaced_rig", "cropped_images"} & {*large}
    assert "flexing_links" not in large


def test_looks_in_which_a_hand_comes_and_goes_are_not_kept(arm):
    """It hides three markers of a view, then all but three, and three again; pulled corners hardly show."""
    q, _ = arm.way(3)
    q = q[:: len(q) // 24][:24]
    s = noisy(arm.images(at_once(q)), 3)
    s[8:12, 1, :3] = s[16:18, 1, :3] = np.nan
    s[12:16, 1, :7] = np.nan
    test, views = ImageMonitor(arm.calibration, SIGMA, LOOKS), []
    for k in range(len(q)):
        look(test, k, q[k], s[k])
        views.append(test._detector.memory.state.views)
    assert views[7] < views[11]
    assert views[12] == views[17] == views[7]
    assert views[-1] > views[17]


@pytest.mark.parametrize(("unanswered", "code"), [(3.0, "frozen_reading"), (0.5, "slipped_joint")])
def test_a_slip_by_what_the_set_point_went_without_the_reading_is_a_frozen_one(arm, unanswered, code):
    """The arm is held since: images show the same of both."""
    q = arm.way(3)[0][-1:].repeat(20, axis=0)
    slip = np.radians(3.0) * np.eye(6)[1]
    s = noisy(arm.images(at_once(q - slip)), 3)
    test = ImageMonitor(arm.calibration, SIGMA, LOOKS)
    test.unanswered = -unanswered / 3.0 * slip
    fault = next(filter(None, (look(test, k, q[k], s[k]) for k in range(len(q)))))
    (one,) = fault.others
    assert (one.code, one.subject.joints) == (code, (2,))


def test_the_verdict_does_not_depend_on_the_unit_of_pixels():
    """A fixed least noise would hide a bump in images measured in other units than pixels."""
    robot = random_robot("RRPR", np.random.default_rng(3))
    observation = robot.observe(trials(robot), SIGMA, np.random.default_rng(4))
    turn = np.sin(np.linspace(0.0, 2.0, 50)[:, None] + np.arange(4.0)) - np.sin(np.arange(4.0))
    q, found = robot.q_reference + np.where(np.arange(4) == 2, 0.1, 0.4) * turn, []
    s = noisy(robot.images(q), 7)
    s[30:, 0] += (2.0, -1.5)
    for unit in (1.0, 1e-3):
        scaled = dataclasses.replace(observation, images=unit * observation.images)
        calibration = calibrated(scaled, "RRPR", source="recorded", sigma_px=unit * SIGMA)
        found.append(first_alarm(Arm(calibration, None, None, None), q, unit * s, sigma=unit * SIGMA))
        assert causes(found[-1][1])["displaced_camera"].subject.views == ("left",)
    assert abs(found[0][0] - found[1][0]) <= 2  # what counts as standing still is in pixels


@pytest.mark.parametrize("moved", ["camera", "tool", "marker"])
def test_sizes_are_lengths_of_shifts_in_the_image(sharp, moved):
    """Errors of joints that images allow take no part of a size, nor do its coordinates or still views."""
    q, _ = sharp.way(3)
    before, which = sharp.images(at_once(q)), {"marker": [4]}.get(moved, slice(None))

    def shifted(far):
        if moved == "camera":
            return before + far * np.where(np.arange(2) == 0, 1.0, 0.0)[:, None, None] * [0.6, 0.8]
        M = np.repeat(sharp.scene.M[None], len(q), 0)
        M[:, which, :3] += far * np.array([1.0, 0.5, 0.0]) * M[:, which, 3:]
        return sharp.images(at_once(q), M)

    def size(far):
        off = np.linalg.norm(shifted(far) - before, axis=-1)[20:24, :, which]
        return np.sqrt(np.square(off[off > 0.0]).mean())

    for px in (1.5, 5.0):
        s = shifted(px * 1e-4 / size(1e-4))
        s[:20] = before[:20]
        _, fault = first_alarm(sharp, q, noisy(s, 3, 0.05), sigma=0.05)
        code = {"marker": "displaced_markers"}.get(moved, f"displaced_{moved}")
        assert code in causes(fault) or px < 5.0  # small ones look like joints that slipped
        assert next(one.amount for one in fault.others if one.unit == "px") == pytest.approx(px, rel=0.1)
        if moved != "marker":
            assert fault.amount == pytest.approx(px, rel=0.1)
