"""What [RH00] section 2 says of a calibration: operators, plane at infinity, cameras, one common metric."""

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict
from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.records import changed
from tests.calibration.simulated_robot import around, random_robot, trials

# Operators are assembled from twists and a frame change: a few hundred roundings, no more.
EXACT = 1e-12


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(11)
    robot = random_robot("RRPRPR", rng)
    observation = robot.observe(trials(robot), 0.5, rng)
    calibration = calibrate(observation, robot.joint_types, sigma_px=0.5)
    return robot, observation, around(robot, 30, rng), calibration


def revolute_of(robot):
    return np.array([letter == "R" for letter in robot.joint_types])


def blocks(calibration):
    """Operators (n, 3, 3) and (n, 3) in an affine frame: the last coordinate is a_inf."""
    a_inf = calibration.a_inf / np.linalg.norm(calibration.a_inf)
    frame = np.vstack([np.linalg.svd(a_inf[None])[2][1:], a_inf])
    moved = frame @ calibration.H_hat_0 @ np.linalg.inv(frame)
    assert np.abs(moved[:, 3]).max() <= EXACT * np.abs(moved).max()
    return moved[:, :3, :3], moved[:, :3, 3], frame


def common_form(B):
    """Symmetric Q (3, 3) with Bᵀ Q + Q B = 0 for all blocks, and the singular values of its equations."""
    basis = np.zeros((6, 3, 3))
    for E, i, j in zip(basis, *np.triu_indices(3), strict=True):
        E[i, j] = E[j, i] = 1.0
    rows = np.array([np.concatenate([(b.T @ E + E @ b).ravel() for b in B]) for E in basis]).T
    _, s, Vt = np.linalg.svd(rows)
    Q = np.tensordot(Vt[-1], basis, axes=1)
    return Q * np.sign(np.trace(Q)), s


def test_each_operator_is_that_of_its_joint(case):
    robot, _, _, calibration = case
    a_inf = calibration.a_inf / np.linalg.norm(calibration.a_inf)
    for i, (H_hat, turns) in enumerate(zip(calibration.H_hat_0, revolute_of(robot), strict=True)):
        size = np.linalg.norm(H_hat)
        assert abs(np.trace(H_hat)) <= EXACT * size
        law = H_hat @ H_hat @ H_hat + H_hat if turns else H_hat @ H_hat
        assert np.linalg.norm(law) <= EXACT * max(size, size**3)
        s = np.linalg.svd(H_hat, compute_uv=False)
        rank = 2 if turns else 1
        assert s[rank - 1] > 1e-3 * s[0]
        assert s[rank] <= EXACT * s[0]
        # The defects stated are those of the operators.
        stated = calibration.operator_defect[i], calibration.trace_defect[i], calibration.plane_defect[i]
        true = np.linalg.norm(law) / size, abs(np.trace(H_hat)), np.linalg.norm(a_inf @ H_hat)
        np.testing.assert_allclose(stated, true, atol=1e-14 * size)


def test_all_operators_leave_one_plane_and_markers_are_scaled_by_it(case):
    _, _, _, calibration = case
    a_inf = calibration.a_inf
    sizes = np.linalg.norm(calibration.H_hat_0, axis=(1, 2))
    assert (
        np.linalg.norm(a_inf @ calibration.H_hat_0, axis=1) <= EXACT * np.linalg.norm(a_inf) * sizes
    ).all()
    # The plane is the only one: the operators beside each other have rank three.
    s = np.linalg.svd(np.hstack(list(calibration.H_hat_0 / sizes[:, None, None])), compute_uv=False)
    assert s[2] > 1e-3 * s[0]
    np.testing.assert_allclose(calibration.M @ a_inf, 1.0, rtol=EXACT)


def test_operators_are_conjugate_to_rigid_motions_by_one_matrix(case):
    robot, _, q, calibration = case
    B, v, frame = blocks(calibration)
    turns = revolute_of(robot)
    Q, s = common_form(B[turns])
    assert s[-1] <= EXACT * s[0]
    assert s[-2] > 1e-4 * s[0]  # nothing else is kept by all of them
    values = np.linalg.eigvalsh(Q)
    assert values[0] > 1e-4 * values[2]
    # Translations of one metre each are equally long in the common metric.
    speed = np.sqrt(np.einsum("ia,ab,ib->i", v[~turns], Q, v[~turns]))
    np.testing.assert_allclose(speed, speed[0], rtol=1e-11)
    model = calibration.model()
    for row in q:
        H = frame @ forward_kinematics(model, row) @ np.linalg.inv(frame)
        np.testing.assert_allclose(H[3], [0.0, 0.0, 0.0, 1.0], atol=1e-11)
        R = H[:3, :3]
        np.testing.assert_allclose(R.T @ Q @ R, Q, atol=1e-11 * values[2])
        assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-11)


def test_a_point_behind_a_camera_has_no_image(case):
    robot, _, q, calibration = case
    turned = calibration.P.copy()
    turned[1] *= -1.0
    one = predict(calibration, q)
    other = predict(changed(calibration, P=turned), q)
    np.testing.assert_array_equal(other[:, 0], one[:, 0])
    assert np.isnan(other[:, 1]).all()
    assert np.isfinite(one).all()
    assert robot.projected(q)[:, :, 2].min() > 0.0
