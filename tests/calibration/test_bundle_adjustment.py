"""The vectorised forward model, its derivatives, and the search: against differences, scipy, the kernels."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projservo_cli.calibration import bundle_adjustment
from projservo_cli.calibration.bundle_adjustment import LeastSquares, StatedIntrinsics, minimize
from projservo_cli.calibration.detections import Detections
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.geometry.displacements import displacements
from projservo_cli.geometry.invariant_forms import UPPER, intrinsics_of
from projservo_cli.geometry.kinematics import forward_kinematics, image_jacobian, joint_operators
from projservo_cli.records import Model, no_lenses, prismatic_of
from tests.calibration.simulated_robot import Robot, around, random_robot
from tests.samples import METRIC_A_INF

LENS = np.array([[640.0, 512.0, 640.0, -0.06, 0.01], [640.0, 512.0, 640.0, 0.03, -0.01]])


def problem_of(robot: Robot, count: int = 5, unseen: float = 0.0, lens=None):
    rng = np.random.default_rng(1)
    observation = robot.observe(around(robot, count, rng), 0.0, rng)
    if unseen:
        observation.images[rng.random(observation.images.shape[:3]) < unseen] = np.nan
    readings = Detections.of(observation, robot.joint_types)
    terms = 0 if lens is None else 4
    problem = LeastSquares.of(readings, robot.q_reference, terms)
    return problem, Parameters(
        robot.cameras, robot.twists, readings.prismatic, robot.markers, lens, lens_terms=terms
    )


def full_jacobian(problem, J):
    """Compact derivative spread over all parameters, (4 N, size)."""
    return problem.dense(J, np.ones(J.shape[:2], dtype=bool))


@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize("types", ["RPR", "RRP", "PPR"])
def test_derivatives_agree_with_central_differences(types, lens):
    robot = random_robot(types, np.random.default_rng(4), markers=4)
    problem, scene = problem_of(robot, lens=lens)
    J = problem.derivative(scene)
    analytic = full_jacobian(problem, J)
    scale = np.linalg.norm(analytic, axis=0)
    for k in range(problem.size):
        step = np.zeros(problem.size)
        # A step that moves images by 1e-2 px: truncation and round-off of the quotient are both below 1e-6.
        step[k] = min(0.05 / scale[k], 0.2)  # the centre of a weak lens hardly moves them
        ahead, behind = (problem.residual(problem.retract(scene, s)) for s in (step, -step))
        numeric = (ahead - behind).ravel() / (2.0 * step[k])
        assert np.abs(numeric - analytic[:, k]).max() < 1e-6 * scale[k]
    by_joint = problem.joint_derivative(scene)
    for i in range(len(types)):
        dq = 1e-5 * np.eye(len(types))[i]
        ahead, behind = (dataclasses.replace(problem, q=problem.q + d).pixels(scene)[0] for d in (dq, -dq))
        assert np.abs((ahead - behind) / 2e-5 - by_joint[..., i]).max() < 1e-4


def test_gauge_directions_change_no_image():
    for types, dimension, lens in (("RRR", 9, None), ("RPR", 8, None), ("RRPR", 8, LENS)):
        problem, scene = problem_of(random_robot(types, np.random.default_rng(5)), lens=lens)
        J = problem.derivative(scene)
        G = problem.gauge(scene)
        assert G.shape[1] == dimension
        dense = full_jacobian(problem, J)
        assert np.abs(dense @ G).max() < 1e-11 * np.abs(dense).max()
        singular = np.linalg.svd(dense / np.linalg.norm(dense, axis=0), compute_uv=False)
        # Nothing else is free: the next singular value stands far above round-off.
        assert singular[-dimension] < 1e-13 < 1e-6 < singular[-dimension - 1]


def stated(scene, rng):
    """Intrinsics of a scene, changed by their deviations, but for one that is not known."""
    spread = rng.uniform(1.0, 3.0, (len(scene.P), 5))
    spread[0, 1] = np.inf
    K = intrinsics_of(scene.P)
    K[:, *UPPER] += np.where(np.isfinite(spread), spread, 0.0) * rng.standard_normal(spread.shape)
    return StatedIntrinsics(K, spread)


def test_derivatives_of_intrinsics_agree_with_central_differences():
    """To the truncation and round-off of the quotient; they move with no gauge."""
    problem, scene = problem_of(random_robot("RRR", np.random.default_rng(4)))
    problem = dataclasses.replace(problem, stated=stated(scene, np.random.default_rng(0)))
    D, numeric = problem.departure_derivative(scene), []
    for k in range(scene.P.size):
        step = np.zeros(problem.size)
        step[k] = 1e-6 * max(np.abs(scene.P.ravel()[k]), 1e-3)
        ahead, behind = (problem.departure(problem.retract(scene, s)).ravel() for s in (step, -step))
        numeric.append((ahead - behind) / (2.0 * step[k]))
    scale = np.linalg.norm(D, axis=0)[: scene.P.size]
    assert np.abs(np.transpose(numeric) - D[:, : scene.P.size]).max(axis=0) == pytest.approx(
        0.0, abs=1e-6 * scale.max()
    )
    assert np.abs(D @ problem.gauge(scene)[: problem.shared]).max() < 1e-9 * np.abs(D).max()
    assert problem.free == problem.size - 9


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(("joint_noise", "poses"), [(False, 9), (True, 4), (True, 30)])
def test_steps_of_blocks_are_those_of_the_dense_equations(joint_noise, poses, known, monkeypatch):
    """Markers eliminated, with offsets of joints or without; offsets eliminated; in one part and in many."""
    problem, scene = problem_of(random_robot("RPR", np.random.default_rng(6)), unseen=0.3, count=poses)
    rng = np.random.default_rng(0)
    if joint_noise:
        problem = problem.with_noise(np.array([2e-3, 1e-3, 2e-3]))
        scene = dataclasses.replace(scene, offsets=1e-3 * rng.standard_normal(problem.q.shape))
    if known:
        problem = dataclasses.replace(problem, stated=stated(scene, rng))
    departure, D = problem.departure(scene).ravel(), problem.departure_derivative(scene)
    weight = rng.uniform(0.1, 1.0, problem.detections.seen.shape)
    residual = problem.residual(scene) + rng.standard_normal((*weight.shape, 2))
    strain, damping = problem.strain(scene), 1e-2
    J = full_jacobian(problem, problem.derivative(scene))
    if joint_noise:
        K, n = problem.q.shape
        G = np.zeros((*weight.shape, 2, K, n))
        by_joint = problem.joint_derivative(scene) * problem.tau
        G[:, np.arange(weight.shape[1]), :, problem.detections.pose_of] = by_joint.swapaxes(0, 1)
        J = np.hstack([J, G.reshape(len(J), -1)])
    root = np.sqrt(np.repeat(weight.ravel(), 2))[:, None]
    A = (root * J).T @ (root * J)
    g = J.T @ (root[:, 0] ** 2 * residual.ravel())
    A[problem.size :, problem.size :] += np.eye(strain.size)
    g[problem.size :] += strain.ravel()
    A[: problem.shared, : problem.shared] += D.T @ D
    g[: problem.shared] += D.T @ departure
    scale = np.append(np.sqrt(np.diagonal(A)[: problem.size]), np.ones(strain.size))
    tied = np.linalg.qr(scale[: problem.size, None] * problem.gauge(scene))[0]
    A /= np.outer(scale, scale)
    A[: problem.size, : problem.size] += tied @ tied.T + damping * np.eye(problem.size)
    wanted = -np.linalg.solve(A, g / scale) / scale
    for at_once, kept in ((bundle_adjustment._AT_ONCE, bundle_adjustment._MAX_KEPT), (7, 0)):
        monkeypatch.setattr(bundle_adjustment, "_AT_ONCE", at_once)
        monkeypatch.setattr(bundle_adjustment, "_MAX_KEPT", kept)
        here = bundle_adjustment._Expansion(problem, scene, residual, weight, np.zeros(problem.size))
        assert here.by_pose == (joint_noise and poses == 30)
        found = here._whole(here.solved(damping)(residual, strain, departure))
        assert np.abs((found - wanted) * scale).max() < 1e-9 * np.abs(wanted * scale).max()
        assert np.allclose(here.change(wanted).ravel(), J @ wanted, rtol=1e-9, atol=1e-9)


def test_memory_of_a_search_grows_by_little_a_sighting(monkeypatch):
    """Ten sightings a marker: derivatives alone, of all at once, would take 1,250 bytes each."""
    monkeypatch.setattr(bundle_adjustment, "_AT_ONCE", 256)
    monkeypatch.setattr(bundle_adjustment, "_MAX_KEPT", 0)
    most = []
    for markers in (200, 800):
        robot = random_robot("RRRRRR", np.random.default_rng(3), markers=markers)
        problem, scene = problem_of(robot, count=10)
        tracemalloc.start()
        minimize(problem, scene, problem.detections.seen, robust=True, max_steps=2)
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert most[1] - most[0] < 900 * 10 * 600  # bytes


def test_twin_of_the_kernels():
    robot = random_robot("RPRR", np.random.default_rng(7))
    prismatic = prismatic_of(robot.joint_types)
    model = Model(robot.cameras, robot.twists, prismatic, robot.q_reference, METRIC_A_INF, no_lenses(2))
    problem, scene = problem_of(robot, count=3)
    E = displacements(scene.H_hat, problem.detections.prismatic, problem.q)
    for k, q in enumerate(problem.detections.q):
        H = np.linalg.multi_dot(list(E[:, k]))
        assert np.abs(H - forward_kinematics(model, q)).max() < 1e-12
    J = problem.joint_derivative(scene)
    moved = scene.images(problem.q, problem.detections.pose_of, problem.detections.marker_of).points[0]
    for row in range(0, len(moved), 7):
        q = problem.detections.q[problem.detections.pose_of[row]]
        kernel = image_jacobian(robot.cameras, moved[row : row + 1], joint_operators(model, q))
        assert np.abs(J[:, row] - kernel[:, 0]).max() < 1e-12 * np.abs(kernel).max() * 10


@given(st.integers(0, 10**6), st.floats(0.01, 3.0))
def test_a_step_of_any_length_keeps_the_constraints(seed, length):
    rng = np.random.default_rng(seed)
    problem, scene = problem_of(random_robot("RPRP", rng, markers=3), count=2)
    step = length * rng.standard_normal(problem.size)
    H_hat = problem.retract(scene, step).H_hat
    slides = problem.detections.prismatic
    turning = H_hat[~slides]
    assert np.abs(turning @ turning @ turning + turning).max() < 1e-11 * (1.0 + np.abs(turning).max() ** 3)
    assert np.all(H_hat[slides] @ H_hat[slides] == 0.0)
    # One common speed of all prismatic joints: they are conjugate to metres by one matrix.
    assert np.allclose(np.linalg.norm(H_hat[slides, :3, 3], axis=1), 1.0, atol=1e-12)
    assert np.all(H_hat[:, 3] == 0.0)


def test_cameras_stay_where_they_are_held():
    robot = random_robot("RRR", np.random.default_rng(9))
    problem, scene = problem_of(robot, count=10)
    start = dataclasses.replace(scene, M=scene.M + np.array([0.01, 0.0, 0.0, 0.0]))
    fit = minimize(problem, start, problem.detections.seen, robust=False, cameras=False)
    assert np.array_equal(fit.params.P, scene.P)
    assert fit.cost < 1e-9
