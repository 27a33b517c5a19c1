"""A run as an object: what its calibration predicts, against differences and limits."""

import numpy as np
import pytest

import projservo_cli


@pytest.fixture(scope="module")
def calibration(calibrated_run):
    return projservo_cli.load(calibrated_run("stanford")).calibration


def test_the_jacobian_is_the_derivative_of_the_prediction(calibration):
    q = calibration.q_reference + np.array([0.2, -0.1, 0.05, 0.3, -0.2, 0.1])
    J = calibration.jacobian(q)
    assert J.shape == (2, 10, 2, 6)
    step = 1e-5  # truncation 1e-10 px, rounding 1e-12 / 1e-5 = 1e-7 px
    for i, e in enumerate(np.eye(6) * step):
        difference = (calibration.predict(q + e) - calibration.predict(q - e)) / (2 * step)
        np.testing.assert_allclose(J[..., i], difference, atol=1e-4, rtol=1e-6)
    np.testing.assert_array_equal(calibration.jacobian(np.array([q, q]))[1], J)


def test_points_behind_a_camera_have_no_pixels_and_those_at_infinity_vanishing_points(calibration):
    centers = np.array([np.linalg.svd(P)[2][-1] for P in calibration.P])
    centers /= (centers @ calibration.a_inf)[:, None]
    behind = 2.0 * centers.mean(axis=0) - calibration.M.mean(axis=0)  # the face mirrored at the rig
    assert np.isnan(calibration.project(behind)).all()
    way = calibration.M[0] - calibration.M[1]
    far = [calibration.project(calibration.M[0] + sign * 1e9 * way) for sign in (1.0, -1.0)]
    assert (np.isnan(far[0]) != np.isnan(far[1])).all()  # one end of a line is behind each camera
    limit = np.where(np.isnan(far[0]), far[1], far[0])
    for point in (way, -way):
        np.testing.assert_allclose(calibration.project(point), limit, rtol=1e-6)
