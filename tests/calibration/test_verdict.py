"""What the verdict says: how far to move a joint, what limits."""

import numpy as np
import pytest

from projservo_cli.calibration import WEAK_NOISE, calibrate
from projservo_cli.calibration.detections import Detections, weak_joints
from projservo_cli.findings import LIMITS, NOTE
from projservo_cli.records import Observation
from tests.calibration.simulated_robot import random_robot, trials

SIGMA = 0.1
WEAK = 1  # the joint that moves too little


@pytest.fixture(scope="module", params=["RRR", "RPR"])
def robot(request):
    return random_robot(request.param, np.random.default_rng(3), markers=6)


def short(robot, span):
    """Trials in which one joint moves over a small range."""
    q = trials(robot, 6)
    q[:, WEAK] = robot.q_reference[WEAK] + (q[:, WEAK] - robot.q_reference[WEAK]) * span / np.ptp(q[:, WEAK])
    return q


def calibrated(robot, q, sigma=SIGMA, scale=1.0):
    found = robot.observe(q, sigma, np.random.default_rng(1))
    images = scale * found.images
    return calibrate(
        Observation(found.pose, found.marker, q, images), robot.joint_types, sigma_px=scale * sigma
    )


def least_span(robot):
    return 0.004 if robot.joint_types[WEAK] == "P" else np.radians(0.6)


@pytest.fixture(scope="module")
def weak(robot):
    found = calibrated(robot, short(robot, least_span(robot)))
    assert found.poorly_observable.tolist() == [False, True, False]
    return found


def advised(found):
    """Range in the advice about the weak joint, rad or m."""
    return next(
        one.limit for one in found.findings if one.code == "little_motion" and 2 in one.subject.joints
    )


def test_the_range_advised_is_the_one_that_suffices(robot, weak):
    """An oracle that knows nothing of how it was found: calibrate with the trial, look at the noise."""
    q = short(robot, least_span(robot))
    noise = {}
    for share in (1.0, 0.5):
        trial = np.tile(robot.q_reference, (8, 1))
        trial[:, WEAK] += share * advised(weak) * np.linspace(-0.5, 0.5, 8)
        noise[share] = calibrated(robot, np.vstack([q, trial])).prediction_noise[WEAK]
    # Found to a twentieth of the range; the noise falls with its square root at least.
    assert noise[1.0] == pytest.approx(WEAK_NOISE, rel=0.15)
    assert noise[0.5] > 1.3 * WEAK_NOISE


def test_what_limits_is_said(robot, weak):
    assert "limited by amplitude" in weak.reason
    assert "limited by noise" in calibrated(robot, trials(robot, 6)).reason


@pytest.mark.parametrize(
    ("span", "prismatic", "needed", "code"),
    [
        (0.05, False, 0.2, "little_motion"),
        (0.05, False, 0.03, "joint_in_few_poses"),
        (0.01, True, 0.05, "little_motion"),
        (1.0, False, 0.2, "joint_together"),
        (1.0, False, np.nan, "hopeless_joint"),
    ],
)
def test_a_joint_that_is_hardly_determined_and_its_remedy(span, prismatic, needed, code):
    # The fourth of four joints; the others are not in doubt.
    types = "RRR" + "RP"[prismatic]
    robot = random_robot(types, np.random.default_rng(3))
    detections = Detections.of(robot.observe(trials(robot, 2), 0.0, np.random.default_rng(0)), types)
    spans, ranges = np.full(4, 1.0), np.full(4, 0.1)
    spans[3], ranges[3] = span, needed
    (found,) = weak_joints(np.array([3]), spans, ranges, detections, np.zeros(4))
    assert (found.code, found.severity, found.subject.joints) == (code, LIMITS, (4,))
    assert (found.amount, found.unit) == (span, "m" if prismatic else "rad")
    assert found.limit == needed or np.isnan(needed)


def test_joints_that_are_off_are_told_in_px_and_no_joint_is_to_move_for_them():
    """Sharp and blurred markers, joints that move images by many times the noise of the sharp ones."""
    robot = random_robot("RRR", np.random.default_rng(3), markers=6)
    rng, q = np.random.default_rng(5), trials(robot, 4)
    found = robot.observe(q, 0.0, rng)
    sigma = np.broadcast_to(np.where(np.arange(6) < 4, 0.01, 0.5), found.images.shape[:3])
    images = found.images + sigma[..., None] * rng.standard_normal(found.images.shape)
    off = 1e-3 * rng.standard_normal(q.shape)
    effect = np.sqrt(np.mean((robot.images(q + off) - robot.images(q)) ** 2))
    observation = Observation(found.pose, found.marker, q + off, images, sigma=sigma)
    calibration = calibrate(observation, "RRR", source="recorded", joint_noise=None)
    limits = [one for one in calibration.findings if one.severity != NOTE]
    assert [one.code for one in limits] == ["coarse_joints"]
    assert limits[0].effect_px == pytest.approx(effect, rel=0.35)
