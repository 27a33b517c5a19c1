"""Motions defined by what they leave still: (8), (9), (10); spans of arms of other than six joints."""

import numpy as np
import pytest

from projservo_cli.geometry.algebra import as_array, mat
from projservo_cli.geometry.kinematics import backward, forward_kinematics, joint_operators
from projservo_cli.geometry.mechanisms import (
    MeasuredFace,
    in_span,
    joint_motion,
    make_span,
    planar_mechanism,
    reach,
    rotation_mechanism,
    translation_mechanism,
    workspace,
)
from tests.samples import arm, face, frame, in_frame, prismatic, revolute


@pytest.fixture(params=[(types, seed) for types in ("RRRRRR", "RRPRRR") for seed in (None, 1, 2)])
def setting(request):
    """Operators, plane at infinity, face and frame of an arm away from its reference."""
    types, seed = request.param
    G = np.eye(4) if seed is None else frame(seed, mirrored=seed == 2)
    model = in_frame(arm(types), G)
    q = model.q_reference + np.array([0.2, -0.3, 0.15, 0.4, -0.2, 0.3])
    return joint_operators(model, q), model.a_inf, face() @ G.T, G


def found(mechanism, H_hat, first, second):
    """Whether a mechanism is unique, its joint motion and its operator, on plain arrays."""
    work, q_hat = workspace(len(H_hat), 8), np.zeros(len(H_hat))
    work.H_hat[:] = H_hat
    unique, H = mechanism(work, tuple(first.tolist()), tuple(second.tolist()), q_hat)
    return unique, q_hat, as_array(H)


def plane_through(M):
    """Plane through three points, by the null vector of NumPy."""
    return np.linalg.svd(M[:3])[2][3]


def check(mechanism, H_hat, a_inf):
    """The operator is the combination of the joints and shares their plane at infinity."""
    unique, q_hat, H = mechanism
    assert unique
    assert pytest.approx(np.tensordot(q_hat, H_hat, 1), abs=1e-12) == H
    assert np.abs(a_inf @ H).max() < 1e-12
    return q_hat, H


def check_rotation(H):
    """Eigenvalues 0, 0, ±i: Ĥ³ = −Ĥ and trace(Ĥ²) = −2."""
    assert pytest.approx(-H, abs=1e-11) == H @ H @ H
    assert np.trace(H @ H) == pytest.approx(-2.0, abs=1e-12)
    assert np.trace(H) == pytest.approx(0.0, abs=1e-12)


def test_translation_keeps_every_plane_through_its_line(setting):
    H_hat, a_inf, A, G = setting
    mechanism = found(translation_mechanism, H_hat, A[0], A[1] - A[0])
    q_hat, H = check(mechanism, H_hat, a_inf)
    assert np.linalg.norm(q_hat) == pytest.approx(1.0, abs=1e-14)
    assert np.abs(H @ H).max() < 1e-11
    # Every point, at infinity too, moves along the line: velocity k (A_2 − A_1) for finite ones.
    for X in (*A, G @ [0.3, -0.2, 1.0, 1.0]):
        velocity = H @ X
        rate = velocity @ (A[1] - A[0]) / ((A[1] - A[0]) @ (A[1] - A[0]))
        assert velocity == pytest.approx(rate * (A[1] - A[0]), abs=1e-11)
        assert abs(rate) > 0.1
    for other in (A[2], G @ [0, 0, 0, 1.0]):
        a = plane_through(np.array([A[0], A[1], other]))
        assert np.abs(a @ H).max() < 1e-11


def test_revolution_keeps_its_axis(setting):
    H_hat, a_inf, A, G = setting
    mechanism = found(rotation_mechanism, H_hat, A[0], A[2])
    _, H = check(mechanism, H_hat, a_inf)
    check_rotation(H)
    for t in (0.0, 1.0, 0.3, -7.0):
        assert np.abs(H @ ((1 - t) * A[0] + t * A[2])).max() < 1e-11
    # In the metric frame it is the unit twist about that axis, up to its sense.
    metric = np.linalg.inv(G) @ H @ G
    M = A @ np.linalg.inv(G).T
    wanted = revolute(M[0, :3], M[2, :3] - M[0, :3])
    assert min(np.abs(metric - wanted).max(), np.abs(metric + wanted).max()) < 1e-11


@pytest.mark.parametrize("inside", [True, False])
def test_planar_revolution_keeps_its_plane_and_its_point(setting, inside):
    """About the perpendicular through the point, which need not lie in the plane."""
    H_hat, a_inf, A, G = setting
    a = plane_through(A)
    center = A[0] if inside else G @ [0.1, 0.1, 1.2, 1.0]
    mechanism = found(planar_mechanism, H_hat, a, center)
    _, H = check(mechanism, H_hat, a_inf)
    check_rotation(H)
    assert np.abs(H @ center).max() < 1e-11
    assert np.abs(a @ H).max() < 1e-11
    metric = np.linalg.inv(G) @ H @ G
    wanted = revolute((np.linalg.inv(G) @ center)[:3], (a @ G)[:3])
    assert min(np.abs(metric - wanted).max(), np.abs(metric + wanted).max()) < 1e-11


def test_an_arm_without_a_unique_motion_says_so():
    A, model = face(), arm("RRRRRRR")
    translation = translation_mechanism, A[0], A[1] - A[0]
    rotation = rotation_mechanism, A[0], A[1]
    planar = planar_mechanism, plane_through(A), A[0]
    redundant = joint_operators(model, model.q_reference + 0.2)
    two_on_one_axis = arm().H_hat_0.copy()
    two_on_one_axis[4] = -two_on_one_axis[2]
    # Translations: the kernel of (9) holds no rotation that could be scaled to radians.
    gantry = np.array([prismatic(axis) for axis in np.eye(3)])
    for operators, mechanisms in (
        (redundant, (translation, rotation, planar)),
        (two_on_one_axis, (translation,)),
        (gantry, (rotation,)),
    ):
        for mechanism, first, second in mechanisms:
            assert not found(mechanism, operators, first, second)[0]


# Arms: redundant ones, general short ones, and one whose joints turn about one direction alone.
ARMS = ("RRRRRRR", "RRPRRRR", "RRRRR", "RRPR")


def model_of(types, G=None):
    model = arm(types)
    return (model, face()) if G is None else (in_frame(model, G), face() @ np.linalg.inv(G).T)


def moved(model, rng):
    return model.q_reference + 0.3 * rng.normal(size=len(model.q_reference))


@pytest.mark.parametrize("G", [None, frame(1)], ids=["metric", "projective"])
@pytest.mark.parametrize("types", ARMS)
def test_every_motion_of_the_joints_is_in_the_span(types, G, rng):
    model, A = model_of(types, G)
    span = make_span(model, A / (A @ model.a_inf)[:, None])
    H_hat = joint_operators(model, moved(model, rng)).reshape(-1, 16)
    found = H_hat @ span.dual.T @ span.H_hat.reshape(6, 16)
    assert found == pytest.approx(H_hat, abs=1e-9 * np.abs(H_hat).max())
    assert np.linalg.matrix_rank(span.H_hat.reshape(6, 16)) == 6
    for H in span.H_hat[3:]:  # per rad: eigenvalues ±i
        assert np.trace(H @ H) == pytest.approx(-2.0, abs=1e-9)
    assert span.H_hat.transpose(0, 2, 1) @ model.a_inf == pytest.approx(0.0, abs=1e-9)


def test_six_joints_span_the_displacements_themselves():
    model, A = model_of("RRPRRR")
    assert len(make_span(model, A).H_hat) == 0


@pytest.mark.parametrize("types", ARMS)
def test_joint_motion_is_the_pseudo_inverse(types, rng):
    """Of least norm with more joints, of least squares with fewer; against NumPy's."""
    model, A = model_of(types)
    span = make_span(model, A)
    work = workspace(len(types), 16, span)
    for _ in range(20):
        work.H_hat[:] = joint_operators(model, moved(model, rng))
        J = span.dual @ work.H_hat.reshape(-1, 16).T
        xi, q_hat = rng.normal(size=6), np.zeros(len(types))
        assert joint_motion(work, xi, q_hat)
        assert q_hat == pytest.approx(np.linalg.pinv(J) @ xi, rel=1e-9, abs=1e-11)
        if len(types) > 6:
            assert J @ q_hat == pytest.approx(xi, abs=1e-12)
            assert in_span(span, model, model.q_reference, q_hat[None]).shape == (1, 6)


def test_a_singular_redundant_arm_says_so(rng):
    model, A = model_of("RRRRRRR")
    span = make_span(model, A)
    work = workspace(7, 16, span)
    work.H_hat[:] = joint_operators(model, model.q_reference)[0]  # seven times one axis
    assert not joint_motion(work, rng.normal(size=6), np.zeros(7))


@pytest.mark.parametrize("types", ["RRRRRRR", "RRPRRRR"])
def test_newton_finds_the_joints_of_a_redundant_arm(types, rng):
    """The displacement is met to round-off, near the least-norm motion for a small one."""
    model, A = model_of(types)
    span, n = make_span(model, A), len(types)
    q_start = moved(model, rng)
    A = A @ forward_kinematics(model, q_start).T
    work = workspace(n, 4 * len(A), span)
    J = span.dual @ joint_operators(model, q_start).reshape(-1, 16).T
    null = np.linalg.svd(J)[2][6:]
    for size in (1e-3, 0.1):
        goal = forward_kinematics(model, q_start + size * rng.normal(size=n))
        goal = goal @ np.linalg.inv(forward_kinematics(model, q_start))
        q = q_start.copy()
        assert reach(model, MeasuredFace(A, backward(model, q_start)), mat(goal), q, work, 1e-8)
        found = forward_kinematics(model, q) @ np.linalg.inv(forward_kinematics(model, q_start))
        assert found == pytest.approx(goal, abs=1e-12)
        # What the arm can do without moving the face is left alone, to first order.
        assert np.abs(null @ (q - q_start)).max() < 5 * size**2
