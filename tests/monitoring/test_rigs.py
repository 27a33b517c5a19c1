"""Faults of rigs of one to three cameras of any names, fixed or on the tool: what is named, how often."""

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.calibration import calibrate, prediction
from projservo_cli.monitoring import innovation_tests
from projservo_cli.monitoring.arrival_accuracy import Posture, resting_error_mm, rigid_fit
from projservo_cli.monitoring.fault_at_rest import fault_at_rest
from projservo_cli.monitoring.frame_pairs import FramePair, Pairing, TimedImage
from projservo_cli.monitoring.hypotheses import Evidence, causes_of
from projservo_cli.monitoring.image_monitor import ImageMonitor
from projservo_cli.records import Observation, changed
from tests.calibration.simulated_robot import around, random_robot, revolute, trials
from tests.calibration.test_cameras_on_the_tool import Hand
from tests.monitoring.test_image_monitor import LOOKS, PERIOD, Arm, causes, first_alarm, look, noisy

RIGS = [(1, "world"), (2, "world"), (3, "world"), (1, "tool")]
TYPES, NAMES, ONSET = "RRPRR", ("wrist", "top", "low"), 15
NOISE = np.array([0.5, 0.5, 1.0])  # of each view, px


class Case(NamedTuple):
    """An arm with its cameras, its calibration, smooth joints (k, n) and noisy images of them."""

    robot: object
    calibration: object
    q: np.ndarray
    s: np.ndarray

    @property
    def views(self):
        return self.calibration.view

    @property
    def one(self):
        return len(self.views) == 1

    def said(self, q, s):
        """When the monitor finds a fault by joints and images, and its causes."""
        arm = Arm(self.calibration, None, None, None)
        k, fault = first_alarm(arm, q, s, sigma=self.calibration.sigma_px)
        return k, causes(fault)


@pytest.fixture(scope="module", params=RIGS, ids=lambda rig: f"{rig[0]} {rig[1]}")
def case(request):
    views, mount = request.param
    rng = np.random.default_rng(7)
    robot = random_robot(TYPES, rng, markers=8, views=views)
    robot = Hand(**vars(robot)) if mount == "tool" else robot
    q = np.concatenate([trials(robot, frames=6), around(robot, 16, rng)])
    seen = dataclasses.replace(robot.observe(q, NOISE[:views], rng), view=NAMES[:views])
    found = calibrate(seen, TYPES, source="recorded", mount=mount)
    turn = np.sin(np.linspace(0.0, 2.5, 40)[:, None] + np.arange(5.0)) - np.sin(np.arange(5.0))
    q = robot.q_reference + np.where(found.prismatic, 0.1, 0.4) * turn
    return Case(robot, found, q, noisy(robot.images(q), 1, NOISE[:views, None, None]))


def test_a_sound_run_is_no_fault_whichever_camera_is_lost(case):
    assert case.said(case.q, case.s) == (None, {})
    s = case.s.copy()
    s[ONSET:, -1] = np.nan
    assert case.said(case.q, s) == (None, {})


def test_a_camera_that_moves_is_named_by_its_name(case):
    for v, name in {0: case.views[0], len(case.views) - 1: case.views[-1]}.items():
        s = case.s.copy()
        s[ONSET:, v] += (3.0, -2.0)
        k, found = case.said(case.q, s)
        assert ONSET + 2 <= k <= ONSET + 15
        assert found["displaced_camera"].subject.views == (name,)
        assert {view for one in found.values() for view in one.subject.views} == {name}


@pytest.mark.parametrize("joint", [2, 4])
def test_a_joint_that_slips_is_named_as_a_joint(case, joint):
    by = 0.015 if TYPES[joint] == "P" else np.radians(3.0)
    read = case.q.copy()
    read[ONSET:, joint] -= by
    k, found = case.said(read, case.s)
    assert ONSET + 2 <= k <= ONSET + 15
    (one,) = found.values()
    assert (one.code, one.subject.joints) == ("slipped_joint", (joint + 1,))
    assert one.unit == {"P": "m", "R": "rad"}[TYPES[joint]]
    assert abs(one.amount) == pytest.approx(by, rel=0.1)


def test_a_joint_of_the_other_sign_that_puts_all_markers_behind_the_camera_explains_nothing():
    """The camera stands on the axis of the first joint, whose readings are near a quarter of a turn."""
    rng = np.random.default_rng(3)
    robot = random_robot("RRR", rng, markers=8, views=1)
    center = np.linalg.svd(robot.cameras[0])[2][-1]
    center = center[:3] / center[3]  # it looks at the origin
    robot.twists[0] = revolute(center, np.cross(center, rng.standard_normal(3)))
    robot.q_reference[0] = 0.5 * np.pi
    seen = robot.observe(np.concatenate([trials(robot, frames=6), around(robot, 16, rng)]), 0.5, rng)
    found = calibrate(seen, robot.joint_types, source="recorded")
    errors, noise = innovation_tests.ErrorModel(found, 0.5), np.full((1, 8), 0.5)
    pair = FramePair.at_rest(robot.q_reference, robot.images(robot.q_reference[None])[0] + 3.0, noise)
    evidence = Evidence(errors, [pair], [errors.residual(pair)], np.ones(1), errors.nothing())
    fits = evidence.explanations(causes_of(evidence, found.marker, None))
    (mirrored,) = (fit for fit in fits if (fit.cause.kind, fit.cause.which) == ("mirrored", 0))
    assert mirrored.gain < 0.0


def test_a_reading_that_moved_before_the_onset_may_stand_still_since(case):
    """Images are late, so that the first which disagree show a joint that still moved."""
    q, shape = case.q[ONSET : ONSET + 4].copy(), case.s.shape[1:3]
    q[1:, 1] = q[1, 1]
    assert abs(q[0, 1] - q[1, 1]) > 1e-6
    errors = innovation_tests.ErrorModel(case.calibration, NOISE[0])
    images = case.robot.images(case.q[ONSET : ONSET + 4])
    pairs = [FramePair.at_rest(*one, np.full(shape, NOISE[0])) for one in zip(q, images, strict=True)]
    residuals = [errors.residual(pair) for pair in pairs]
    evidence = Evidence(errors, pairs, residuals, np.ones(4), errors.nothing())
    frozen = [one.which for one in causes_of(evidence, case.calibration.marker, None) if one.kind == "frozen"]
    assert frozen == [1]


def change(case, **parts):
    """Pixels by which images change where parts of the robot are others."""
    return dataclasses.replace(case.robot, **parts).images(case.q) - case.robot.images(case.q)


def at_end(case, s):
    """Images (k, V, m, 2) where the arm stands at last."""
    return Observation.of_one(case.calibration.marker, case.q[-1], s[-1], case.views)


def test_what_moved_is_told_by_the_mount_and_in_one_posture_what_is_alike(case):
    by = np.zeros((4, 4))
    by[:3, :3], by[:3, 3] = np.cross([0.02, -0.03, 0.02], np.eye(3)).T, (0.006, 0.008, -0.006)
    body, rig = "displaced_tool", "displaced_camera" if case.one else "displaced_rig"
    moved = {"markers": case.robot.markers @ expm(by).T}, {"cameras": case.robot.cameras @ expm(by)}
    for parts, name, other in zip(moved, (body, rig), (rig, body), strict=True):
        off = change(case, **parts)
        found = case.said(case.q, case.s + off * (np.arange(40) >= ONSET).reshape(-1, 1, 1, 1))[1]
        assert name in found
        assert other not in found
        at_rest = fault_at_rest(case.calibration, at_end(case, case.s + off))
        assert {name, other} <= {*causes(at_rest)}


def test_a_marker_that_moves_is_named_and_by_one_camera_that_it_may_be_covered(case):
    by = np.zeros_like(case.robot.markers)
    by[3, :3] = 0.02, -0.015, 0.01
    s = case.s + change(case, markers=case.robot.markers + by) * (np.arange(40) >= ONSET).reshape(-1, 1, 1, 1)
    at_rest = fault_at_rest(case.calibration, at_end(case, s))
    for found in (case.said(case.q, s)[1], causes(at_rest)):
        assert found["displaced_markers"].subject.markers == (14,)
    assert fault_at_rest(case.calibration, at_end(case, case.s)) is None


def test_cameras_that_are_exchanged_are_named(case):
    V = len(case.views)
    for order in ([1, 0, *range(2, V)], [*range(V - 2), V - 1, V - 2], [1, 2, 0, *range(3, V)]):
        if len(order) == V > 1:
            found = case.said(case.q, case.s[:, order])[1]["exchanged_cameras"]
            assert found.subject.views == tuple(case.views[v] for v in range(V) if order[v] != v)


def test_two_of_several_cameras_that_move_are_named_and_a_lost_one_hides_none_that_moves(case):
    if len(case.views) < 3:
        pytest.skip("there are no others")
    s = case.s.copy()
    s[ONSET:, :2] += np.reshape([(3.0, -2.0), (4.0, 5.0)], (2, 1, 2))
    assert case.said(case.q, s)[1]["displaced_camera"].subject.views == ("wrist", "top")
    s = case.s.copy()
    s[ONSET:, -1] = np.nan
    s[ONSET + 5 :, 0] += (4.0, -3.0)
    assert case.said(case.q, s)[1]["displaced_camera"].subject.views == ("wrist",)


def test_a_hand_before_one_camera_is_no_evidence_and_of_several_holds_no_arm(case):
    """It pulls the corners that it does not hide, and they are of one view in a row of postures."""
    s = case.s.copy()
    s[ONSET : ONSET + 10, -1, :6] = np.nan
    s[ONSET - 1 : ONSET + 11, -1, 6:] += 4.0
    test, held, views = ImageMonitor(case.calibration, case.calibration.sigma_px, LOOKS), False, []
    for k, row in enumerate(case.q):
        assert look(test, k, row, s[k]) is None
        held |= test.holds
        views.append(test._detector.memory.state.views)
    assert not (held and len(case.views) > 2)
    assert (views[ONSET + 9] > views[ONSET - 2]) == (len(case.views) > 2)
    assert views[-1] > views[ONSET + 9]


def permuted(calibration, order):
    """The same calibration with its views in another order."""
    c, rows = calibration, np.arange(len(calibration.sqrt_cov_shared))
    rows[: c.P.size] = rows[: c.P.size].reshape(len(c.P), -1)[order].ravel()
    return changed(
        c,
        view=tuple(c.view[v] for v in order),
        P=c.P[order],
        sigma_view_px=None if c.sigma_view_px is None else c.sigma_view_px[order],
        sqrt_cov_shared=c.sqrt_cov_shared[rows],
        corner_squares=c.corner_squares[:, order],
    )


def one_view(fault):
    """Code, views and amounts of a fault of one cause, rounded."""
    (cause,) = fault.others
    return cause.code, cause.subject.views, round(cause.amount, 3), round(fault.amount, 3)


def test_the_order_of_the_views_does_not_matter(case):
    """Frames come one after the other; what is said, set aside and undetected is the same."""
    V, order = len(case.views), np.random.default_rng(3).permutation(len(case.views))
    q_dot, late = np.gradient(case.q, axis=0) / PERIOD, 0.005 * np.arange(V)
    there = [case.robot.images(case.q + t * q_dot)[:, v] for v, t in enumerate(late)]
    s = case.s + np.stack(there, axis=1) - case.robot.images(case.q)
    s[ONSET:, 0] += (3.0, -2.0)
    s[5, -1, 2] += 40.0
    results, sigma = [], case.calibration.sigma_px
    for which in (np.arange(V), order):
        test, said, aside = ImageMonitor(permuted(case.calibration, which), sigma, LOOKS), None, []
        for k, (q, speed) in enumerate(zip(case.q, q_dot, strict=True)):
            at = late[which]
            joints, speeds = q + at[:, None] * speed, np.repeat(speed[None], V, 0)
            new = np.ones(V, dtype=bool)
            said = said or test.observe(PERIOD * k + at, joints, speeds, np.full(V, 1e-3), s[k, which], new)
            aside.append(test.rejected[np.argsort(which)])
        results.append(
            (one_view(said), test.observations, np.array(aside), test._detector.memory.total.normal[-1, -1])
        )
    (one, count, aside, square), (other, other_count, other_aside, other_square) = results
    assert one[1] == (case.views[0],)
    assert (one, count) == (other, other_count)
    np.testing.assert_array_equal(aside, other_aside)
    assert aside.any()
    assert square == pytest.approx(other_square, rel=1e-6)


def test_residuals_of_the_model_itself_are_no_fault_more_often_than_stated(case, monkeypatch):
    """Errors of calibration, joints and instants of the first order; a chance of one run in five."""
    runs, alarms, c = 8, 0, changed(case.calibration, sigma_q=1e-3)
    monkeypatch.setattr(innovation_tests, "_FALSE_ALARM", 0.2)
    q_dot = np.gradient(case.q, axis=0) / PERIOD
    params, away = prediction.parameters_from(c), prediction.from_reference(c, case.q)
    J = prediction.dense_pixel_changes(params, prediction.errors_of(c), away)
    off = params.predict(away) - case.robot.images(case.q)
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        joint = rng.standard_normal(case.q.shape) + rng.standard_normal(case.q.shape[1])
        s, true = off.copy(), case.q + 1e-3 * joint / np.sqrt(2.0)
        for v in range(len(case.views)):
            late = 0.005 * rng.standard_normal((len(true), 1))
            s[:, v] += case.robot.images(true + late * q_dot)[:, v]
        s += J @ rng.standard_normal(J.shape[-1])
        s = noisy(s, seed, NOISE[: len(case.views), None, None])
        arm = Arm(c, None, None, None)
        alarms += first_alarm(arm, case.q, s, q_dot, 0.005, sigma=c.sigma_px)[0] is not None
    assert alarms <= 0.2 * runs


def test_goal_images_fit_a_pose_of_the_body_and_a_shifted_one_is_named(case):
    V, s, q = len(case.views), case.s[-1], case.q[-1]
    assert rigid_fit(case.calibration, q, s, np.zeros(s.shape[:2])).agrees
    for v in range(V):
        shifted = s + np.reshape(np.arange(V) == v, (-1, 1, 1)) * np.array([4.0, -5.0])
        fit = rigid_fit(case.calibration, q, shifted, np.zeros(s.shape[:2]))
        assert fit.agrees == case.one
        assert fit.view == (v if V > 2 else 0)
    M = case.robot.markers[:4, :3]
    lengths = np.linalg.norm(M[:, None] - M, axis=2)
    face = case.calibration.marker[:4].tolist()
    assert resting_error_mm(case.calibration, q, face, lengths, s) < 20.0
    posture = Posture(case.calibration.model(), q, case.calibration.M[:4], lengths)
    off = change(case, markers=case.robot.markers + 1e-4 * np.array([0.6, 0.0, 0.8, 0.0]))[-1]
    moved = posture.carry(case.calibration.M, np.isfinite(s[..., 0])) @ off.ravel()
    assert np.linalg.norm(moved) == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("views", [1, 2, 4])
def test_every_frame_is_of_one_observation_in_the_order_of_time(views):
    rng, pairing, seen = np.random.default_rng(views), Pairing(views), []
    t = np.sort(rng.uniform(0.0, 4.0, (views, 90)), axis=1)
    for now in np.arange(0.0, 5.0, PERIOD):
        for v, k in np.argwhere((t >= now - PERIOD) & (t < now)):
            image = np.array([[v, k]], dtype=float)
            pairing.add(int(v), TimedImage(t[v, k], np.zeros(2), np.zeros(2), 1e-3, image, np.ones(1)))
        pairing.reach(np.full(views, now))
        while (found := pairing.next(False)) is not None:
            rows = found.images[np.isfinite(found.images[:, 0, 0]), 0].astype(int)
            assert np.ptp(t[tuple(rows.T)]) <= 0.025
            seen += [(t[tuple(rows.T)].min(), *row) for row in rows.tolist()]
    assert [row[0] for row in seen] == sorted(row[0] for row in seen)
    assert {row[1:] for row in seen} == {(v, k) for v in range(views) for k in range(90)}
    assert len(seen) == 90 * views


@pytest.mark.parametrize(("types", "views"), [("R", 2), ("P", 2), ("RP", 1)])
def test_arms_of_one_joint_or_two_are_watched_as_others_are(types, views):
    rng = np.random.default_rng(3)
    robot = random_robot(types, rng, markers=8, views=views)
    q = np.concatenate([trials(robot, frames=8), around(robot, 10, rng)])
    known = calibrate(robot.observe(q, NOISE[0], rng), types, source="recorded")
    at = np.repeat(around(robot, 1, rng), 6, axis=0)
    for shift in (0.0, 5.0):
        seen = robot.observe(at, NOISE[0], rng)
        seen.images[:, 0] += shift
        assert (fault_at_rest(known, seen) is not None) == bool(shift)
