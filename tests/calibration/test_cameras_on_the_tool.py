"""Cameras on the tool: an arm of the test's own, at the bound, in the order and sense of its readings."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.calibration import calibrate, predict, prediction_variance
from projservo_cli.calibration.prediction import error_factor, joint_derivative
from projservo_cli.records import WorkFailed
from tests.calibration.bound import Bound
from tests.calibration.simulated_robot import Robot, around, random_robot, trials

SIGMA = 0.4


class Hand(Robot):
    """Cameras that the arm carries before points of the scene: X_camera = (∏ exp(q_i Ĥ_i))⁻¹ X."""

    def projected(self, q):
        result = np.empty((len(q), len(self.cameras), 3, len(self.markers)))
        for k, row in enumerate(q):
            T = np.eye(4)
            for twist, amount in zip(self.twists, row - self.q_reference, strict=True):
                T = T @ expm(twist * amount)
            result[k] = self.cameras @ np.linalg.inv(T) @ self.markers.T
        return result

    @property
    def seen_from_the_hand(self):
        """The same images by an arm before fixed cameras, whose readings are negated and in reverse."""
        twists, q = self.twists[::-1], -self.q_reference[::-1]
        return Robot(self.joint_types[::-1], twists, self.cameras, self.markers, q)


@pytest.fixture(scope="module", params=[("RRPR", 2), ("RRRR", 1)])
def case(request):
    """Arm, poses of its recording, poses to predict, and a calibration."""
    types, views = request.param
    rng = np.random.default_rng(17)
    arm = Hand(**vars(random_robot(types, rng, markers=9, views=views)))
    q = np.concatenate([trials(arm, frames=5), around(arm, 14, rng)])
    seen = arm.observe(q, SIGMA, rng)
    return arm, q, around(arm, 30, rng), seen, calibrate(seen, types, source="recorded", mount="tool")


def test_predictions_err_by_the_bound(case):
    arm, q, ahead, _, found = case
    bound = Bound(arm.seen_from_the_hand, -q[:, ::-1], -ahead[:, ::-1])
    error = np.mean((predict(found, ahead) - arm.images(ahead)) ** 2)
    # One draw: its relative error is that of the bound's spectrum.
    assert error <= SIGMA**2 * bound.mean_square() * (1.0 + 4.0 * bound.relative_error(1))
    stated = np.mean(prediction_variance(found, ahead))
    assert stated == pytest.approx(SIGMA**2 * bound.mean_square(), rel=0.3)


def test_all_is_in_the_order_and_sense_of_the_readings(case):
    arm, q, ahead, _, found = case
    assert (found.mount, found.joint_types) == ("tool", arm.joint_types)
    np.testing.assert_allclose(found.joint_min, q.min(axis=0), atol=1e-12)
    np.testing.assert_allclose(found.excitation, np.ptp(q, axis=0), atol=1e-12)
    assert any(np.allclose(found.q_reference, row) for row in q)
    step = 1e-6 * np.eye(q.shape[1])
    ends = [predict(found, ahead[:1] + sign * step) for sign in (1, -1)]
    by_joint = np.moveaxis(ends[0] - ends[1], 0, -1) / 2e-6
    J = joint_derivative(found, ahead[:1])[0]
    np.testing.assert_allclose(J, by_joint, atol=1e-5 * np.abs(J).max())


def test_the_covariance_is_that_of_the_operators_in_this_order(case):
    arm, _, ahead, seen, found = case
    reverse = dataclasses.replace(seen, q=np.ascontiguousarray(-seen.q[:, ::-1]))
    other = calibrate(reverse, arm.joint_types[::-1], source="recorded")
    n, first = len(found.H_hat_0), found.P.size
    rows = np.arange(len(error_factor(found)))
    rows[first : first + 16 * n] = rows[first : first + 16 * n].reshape(n, 16)[::-1].ravel()
    for one, two in ((found.H_hat_0, other.H_hat_0[::-1]), (error_factor(found), error_factor(other)[rows])):
        np.testing.assert_allclose(one, two, atol=1e-9 * np.abs(two).max())
    np.testing.assert_allclose(predict(found, ahead), predict(other, -ahead[:, ::-1]), atol=1e-9)


def test_a_joint_that_does_not_move_is_named_by_its_number_along_the_arm_and_the_other_mount(case):
    arm, q, _, seen, _ = case
    still = dataclasses.replace(seen, q=np.where(np.arange(q.shape[1]) == 1, q[:1], q))
    with pytest.raises(WorkFailed, match="joint 2 has no trial motion"):
        calibrate(still, arm.joint_types, source="recorded", mount="tool")
    if len(arm.cameras) == 2:
        with pytest.raises(WorkFailed, match=r"by the images the cameras are on the tool: give --mount tool"):
            calibrate(seen, arm.joint_types, source="recorded")
