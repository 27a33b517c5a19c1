"""Six operators that span the displacements, and joint motions of arms of more or fewer than six joints."""

import numpy as np
import pytest

from projservo_cli.geometry.algebra import mat
from projservo_cli.geometry.displacements import invariant_rotations
from projservo_cli.geometry.kinematics import backward, forward_kinematics, joint_operators
from projservo_cli.geometry.mechanisms import MeasuredFace, in_span, joint_motion, make_span, reach, workspace
from projservo_cli.records import WorkFailed
from tests.samples import arm, face, frame, in_frame

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


def test_no_metric_is_made_up_for_joints_that_keep_none(rng):
    with pytest.raises(WorkFailed, match="preserve no metric"):
        invariant_rotations(rng.normal(size=(5, 3, 3)))
