"""Curves of joints: one function everywhere, gauge freedoms refused, faults recovered."""

import numpy as np
import pytest

from projservo_cli.geometry.displacements import twists
from projservo_cli.geometry.joint_curve import backwards, slopes, true_joints
from projservo_cli.geometry.kinematics import (
    backward,
    forward_between,
    forward_kinematics,
    joint_operators,
)
from projservo_cli.records import BASIS, JointCurve, Model

IMAGE = (1280, 960)
N = 5


def some_arm(rng, types="RRPRR"):
    """Twists (n, 4, 4), which joints slide, and a curve with every function between random joints."""
    prismatic = np.array(list(types)) == "P"
    axes = rng.normal(size=(len(types), 6))
    axes[:, :3] /= np.linalg.norm(axes[:, :3], axis=1, keepdims=True)
    axes[:, 3:] -= axes[:, :3] * (axes[:, :3] * axes[:, 3:]).sum(axis=1, keepdims=True)
    axes[prismatic, :3] = 0.0
    arm = np.concatenate([twists(axes), np.eye(4)[None]])
    arm[-1][:3, 3] = rng.normal(size=3)
    joints = rng.integers(0, len(types), (3 * len(BASIS), 2))
    terms = np.column_stack([np.tile(np.arange(len(BASIS)), 3), joints, rng.normal(0.0, 0.05, len(joints))])
    return twists(axes), prismatic, JointCurve(terms, arm)


def model_of(H_hat, prismatic, curve, q_reference):
    return Model(
        np.zeros((2, 3, 4)), H_hat, prismatic, q_reference, np.array([0.0, 0.0, 0.0, 1.0]), curve=curve
    )


@pytest.mark.parametrize("seed", range(5))
def test_kernels_and_vectors_are_one_function(seed):
    """Displacements, their interpolation and operators by readings agree, also by differences."""
    rng = np.random.default_rng(seed)
    H_hat, prismatic, curve = some_arm(rng)
    q_reference, q = rng.uniform(-1.0, 1.0, (2, N))
    bent, ideal = (
        model_of(H_hat, prismatic, curve, q_reference),
        model_of(H_hat, prismatic, JointCurve(curve.terms[:0], curve.arm[:0]), q_reference),
    )

    def true(q):
        return true_joints(curve, prismatic, (q - q_reference)[None])[0] + q_reference

    np.testing.assert_allclose(true(q_reference), q_reference, atol=1e-15)
    there = forward_kinematics(bent, q)
    np.testing.assert_allclose(there, forward_kinematics(ideal, true(q)), atol=1e-12)
    np.testing.assert_allclose(np.reshape(backward(bent, q), (4, 4)) @ there, np.eye(4), atol=1e-12)
    rows = np.stack([q, q_reference])
    between = np.reshape(forward_between(bent, rows, 0, 0.3), (4, 4))
    np.testing.assert_allclose(between, forward_kinematics(bent, 0.7 * rows[0] + 0.3 * rows[1]), atol=1e-12)
    F = slopes(curve, prismatic, (q - q_reference)[None])[0]
    operators = joint_operators(bent, q)
    np.testing.assert_allclose(
        operators, np.einsum("ij,iab->jab", F, joint_operators(ideal, true(q))), atol=1e-9
    )
    for j, step in enumerate(1e-6 * np.eye(N)):
        change = (forward_kinematics(bent, q + step) - forward_kinematics(bent, q - step)) / 2e-6
        np.testing.assert_allclose(change, operators[j] @ there, atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_backwards_is_the_same_curve_of_the_reversed_chain(seed):
    rng = np.random.default_rng(seed)
    _, prismatic, curve = some_arm(rng)
    curve = curve._replace(terms=curve.terms[curve.terms[:, 0] != BASIS.index("torque")])
    x = rng.uniform(-1.0, 1.0, (4, N))
    there = true_joints(backwards(curve, N), prismatic[::-1], -x[:, ::-1])
    np.testing.assert_allclose(-there[:, ::-1], true_joints(curve, prismatic, x), atol=1e-14)
