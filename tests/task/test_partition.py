"""A task taken apart is put together again: exp(τĤ_t) exp(θ_r Ĥ_r) exp(θ_p Ĥ_p) A = A*."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from projservo_cli.task.face import MIDPOINT
from tests.samples import displacement, face, frame
from tests.task.cases import SQUARE, SQUARE_CENTER, Split, about, turned

HALF_IN_PLANE = about(SQUARE_CENTER, np.diag([-1.0, -1, 1]))
OPPOSITE = about(SQUARE_CENTER, np.diag([1.0, -1, -1]))
SHIFT = displacement([0, 0, 0], [0.25, -0.125, 0.5])

CASES = {
    "start is goal": np.eye(4),
    "pure translation": SHIFT,
    "tiny translation": displacement([0, 0, 0], [1e-9, 0, 2e-9]),
    "no translation, onto the plane": turned(SQUARE_CENTER, [0.4, 0.2, 0]),
    "no translation, within the plane": turned(SQUARE_CENTER, [0, 0, 0.7]),
    "no translation, both": turned(SQUARE_CENTER, [0.3, -0.5, 0.9]),
    "parallel faces": SHIFT @ turned(SQUARE_CENTER, [0, 0, -1.1]),
    "exact half turn within the plane": HALF_IN_PLANE,
    "half turn within the plane and translation": SHIFT @ HALF_IN_PLANE,
    "opposite faces": OPPOSITE,
    "opposite faces and translation": SHIFT @ OPPOSITE,
    "opposite faces, turned within": SHIFT @ OPPOSITE @ turned(SQUARE_CENTER, [0, 0, 0.6]),
    "half a turn in both": SHIFT @ OPPOSITE @ HALF_IN_PLANE,
    "general": SHIFT @ turned(SQUARE_CENTER, [0.5, -0.3, 1.9]),
    "nearly opposite": SHIFT @ turned(SQUARE_CENTER, [math.pi - 1e-3, 0, 0]),
    "nearly parallel": SHIFT @ turned(SQUARE_CENTER, [1e-7, 0, 0.3]),
    "nearly there": displacement([1e-6, -1e-6, 1e-6], [1e-6, 0, 0]),
}


def reassembled(split):
    H_t, H_r, H_p = (expm(k * H) for k, H in zip(split.amplitudes, split.H_hat, strict=True))
    return H_t @ H_r @ H_p


def check(split, accuracy=1e-10):
    """Everything a partition promises, in any frame."""
    assert split.parts.found
    assert pytest.approx(split.A_star, abs=accuracy) == split.A @ reassembled(split).T
    tau, theta_r, theta_p = split.amplitudes
    assert tau >= 0.0
    assert abs(theta_r) < 2 * math.pi
    assert abs(theta_p) < 2 * math.pi
    H_hat = split.state.work.H_hat
    for q_hat, H in zip(split.q_hat, split.H_hat, strict=True):
        assert pytest.approx(np.tensordot(q_hat, H_hat, 1), abs=1e-12) == H
    # What was anticipated: the target without the translation, and without both.
    back = expm(-tau * split.H_hat[0])
    assert split.state.A_t == pytest.approx(split.A_star @ back.T, abs=accuracy)
    back = expm(-theta_r * split.H_hat[1]) @ back
    assert split.state.A_r == pytest.approx(split.A_star @ back.T, abs=accuracy)
    # The centre is moved by the translation alone; a rotation by next to nothing has next to no axis.
    A_c = np.array(split.parts.A_c)
    assert np.abs(theta_r * split.H_hat[1] @ A_c).max() < accuracy
    assert np.abs(split.H_hat[2] @ A_c).max() < accuracy
    # The second rotation stays in the plane.
    assert np.abs(np.array(split.parts.a) @ split.H_hat[2]).max() < accuracy


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(("seed", "center"), [(None, MIDPOINT), (1, 2), (2, MIDPOINT)])
def test_square_face(name, seed, center):
    """The square and its quarter symmetries make coincidences exact in the metric frame."""
    G = None if seed is None else frame(seed, mirrored=seed == 2)
    check(Split(SQUARE, CASES[name], G, center=center))


@settings(max_examples=60)
@given(
    st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3),
    st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3),
    st.integers(0, 5),
)
def test_any_displacement(rotation_vector, translation, seed):
    T = displacement([0, 0, 0], translation) @ turned(SQUARE_CENTER, rotation_vector)
    check(Split(SQUARE, T, frame(seed)), accuracy=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_amplitudes_are_the_metric_ones(name):
    """θ_r is the angle between the normals, cos(θ_s/2) = cos(θ_r/2) cos(θ_p/2), τ q̂_t moves the centre."""
    split = Split(SQUARE, CASES[name], frame(3))
    tau, theta_r, theta_p = split.amplitudes
    R = CASES[name][:3, :3]
    between, whole = (math.acos(np.clip(cosine, -1.0, 1.0)) for cosine in (R[2, 2], (np.trace(R) - 1) / 2))
    # acos near ±1 leaves the root of the round-off.
    assert min(abs(theta_r), 2 * math.pi - abs(theta_r)) == pytest.approx(between, abs=5e-8)
    assert abs(math.cos(theta_r / 2) * math.cos(theta_p / 2)) == pytest.approx(math.cos(whole / 2), abs=1e-8)
    way = split.A_star.mean(axis=0) - split.A.mean(axis=0)
    assert tau * split.H_hat[0] @ split.A.mean(axis=0) == pytest.approx(way, abs=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_partition_does_not_depend_on_the_frame(name):
    """Joint motions τ q̂_t, θ_r q̂_r, θ_p q̂_p equal in every frame, up to which half of a turn is taken."""
    reference = Split(face(), CASES[name])
    for seed in (1, 2):
        other = Split(face(), CASES[name], frame(seed, mirrored=seed == 2))
        if "opposite faces" in name or "half" in name:
            # Exactly half a turn: its sense, and the axis of opposite planes, hang on round-off.
            assert np.abs(other.amplitudes) == pytest.approx(np.abs(reference.amplitudes), abs=1e-6)
            continue
        assert other.amplitudes == pytest.approx(reference.amplitudes, abs=1e-8)
        moved = other.amplitudes[:, None] * other.q_hat
        assert moved == pytest.approx(reference.amplitudes[:, None] * reference.q_hat, abs=1e-8)


@pytest.mark.parametrize("part", [1, 2])
def test_half_a_turn_goes_on_in_the_sense_it_began(part):
    """Noise of 1e-3 on either side of 180° must not reverse the motion of the step before."""
    axis = [1.0, 0, 0] if part == 1 else [0, 0, 1.0]

    def task(excess):
        return SHIFT @ turned(SQUARE_CENTER, (math.pi + excess) * np.array(axis))

    first = Split(SQUARE, task(-1e-3))
    driven = first.amplitudes[part] * first.q_hat[part]
    memory = first.memory.copy()
    # Exactly opposite faces leave the axis of the first rotation open: not a step of its sequence.
    for excess in (1e-3, -2e-3, 3e-3, 0.0 if part == 2 else 1e-6, 1e-3):
        following = Split(SQUARE, task(excess), memory=memory)
        memory = following.memory
        step = following.amplitudes[part] * following.q_hat[part]
        assert step @ driven > 0.99 * (driven @ driven)
        assert pytest.approx(following.A_star, abs=1e-9) == following.A @ reassembled(following).T


def test_exactly_half_a_turn_within_the_plane_has_one_sense_in_every_frame():
    """Round-off on either side of 180° must not decide."""
    wanted = Split(SQUARE, SHIFT @ HALF_IN_PLANE)
    for seed in range(4):
        split = Split(SQUARE, SHIFT @ HALF_IN_PLANE, frame(seed, mirrored=seed % 2 == 1))
        assert abs(split.parts.theta_p) == pytest.approx(math.pi, abs=1e-9)
        assert split.parts.theta_p == pytest.approx(wanted.parts.theta_p, abs=1e-9)
        assert split.q_hat[2] == pytest.approx(wanted.q_hat[2], abs=1e-9)
