"""When a camera sees the face: neutral motions, the amplitudes of a change, and the sense of a turn."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from projservo_cli.geometry.algebra import mat
from projservo_cli.task.face import MIDPOINT, center_of, cyclic_order, face_plane
from projservo_cli.task.visibility import (
    arc_minimum,
    choose_sense,
    limited_translation,
    margin_coefficients,
    visibility_angles,
    visibility_translation,
)
from tests.samples import arm, displacement, face, frame, prismatic, revolute
from tests.task.cases import make_task

small = st.floats(-1, 1)
triples = st.lists(small, min_size=3, max_size=3)
angles = st.floats(-math.pi, math.pi)


def plane_of(A):
    return np.array(face_plane(np.ascontiguousarray(A), cyclic_order(A), center_of(A, MIDPOINT)))


def carried(a, H):
    """Plane after the displacement H."""
    return a @ np.linalg.inv(H)


def center_of_left(G):
    """Optical centre of the left camera of ``rig`` in a frame."""
    return G @ np.array([-0.15, 0, 0, 1])


@pytest.fixture(params=[None, 1, 2])
def G(request):
    return np.eye(4) if request.param is None else frame(request.param, mirrored=request.param == 2)


@settings(max_examples=50)
@given(triples, st.floats(0.01, 5), st.integers(0, 3))
def test_neutral_along_the_ray_of_a_point_of_the_face(place, farther, seed):
    """Along the ray of any of its points, in front of the camera, nearer or farther by any factor."""
    A = face()
    O = np.array([-0.15, 0, 0])
    M = A[:, :3]
    inside = M[0] + abs(place[0]) * (M[1] - M[0]) + place[1] * (M[2] - M[0])
    H = displacement([0, 0, 0], (farther - 1) * (inside - O))
    G_s = frame(seed)
    a, O_s = plane_of(A @ G_s.T), G_s @ np.append(O, 1)
    there = carried(a, G_s @ H @ np.linalg.inv(G_s))
    # The distance of camera and face along the ray grows by exactly that factor.
    assert there @ O_s / (a @ O_s) == pytest.approx(farther, rel=1e-9)


@settings(max_examples=50)
@given(triples, angles, st.integers(0, 3))
def test_neutral_about_any_axis_through_the_optical_center(axis, theta, seed):
    """For the camera whose centre it is; the other camera's margin does change."""
    assume(np.linalg.norm(axis) > 0.1)
    G = frame(seed)
    H_hat = G @ revolute([-0.15, 0, 0], axis) @ np.linalg.inv(G)
    a = plane_of(face() @ G.T)
    O = center_of_left(G)
    assert carried(a, expm(theta * H_hat)) @ O == pytest.approx(a @ O, rel=1e-10)
    assert visibility_angles(a, H_hat, O) is None


@settings(max_examples=50)
@given(triples, angles, st.lists(st.floats(-3, 3), min_size=2, max_size=2), st.integers(0, 3))
def test_neutral_parallel_to_the_face_and_within_its_plane(point, theta, shift, seed):
    """A translation along the face and Ĥ_p about any point of space: both margins stay."""
    G, A = frame(seed), face()
    M = A[:, :3]
    sides = M[1] - M[0], M[2] - M[0]
    turn = expm(theta * revolute(point, np.cross(*sides)))
    a, O = plane_of(A @ G.T), np.array([[-0.15, 0, 0, 1], [0.15, 0, 0, 1]]) @ G.T
    for H in (displacement([0, 0, 0], shift[0] * sides[0] + shift[1] * sides[1]), turn):
        assert carried(a, G @ H @ np.linalg.inv(G)) @ O.T == pytest.approx(a @ O.T, rel=1e-9)


def test_the_optical_axis_itself_is_not_neutral():
    """Erratum of section 4.2: along the optical axis an oblique face off that axis does turn its back."""
    normal, point, O = np.array([-0.9, 0, 0.43]), np.array([1.0, 0, 1.4]), np.array([-0.15, 0, 0, 1.0])
    a = np.append(normal, -normal @ point)
    margins = [carried(a, displacement([0, 0, 0], [0, 0, z])) @ O for z in (0.0, 2.0)]
    assert margins[0] > 0 > margins[1]


@pytest.mark.parametrize("direction", [[0, 0, 1], [1, 0.2, 0.5], [-0.3, 1, -1]])
def test_translation_changes_visibility_at_tau_0(G, direction):
    H_hat = G @ prismatic(direction) @ np.linalg.inv(G)
    a, O = plane_of(face() @ G.T), center_of_left(G)
    tau_0 = visibility_translation(a, H_hat, O)
    assert abs(carried(a, np.eye(4) + tau_0 * H_hat) @ O) < 1e-10
    before, after = (carried(a, np.eye(4) + k * tau_0 * H_hat) @ O / (a @ O) for k in (0.999, 1.001))
    assert before > 0 > after
    along = G @ prismatic(face()[1, :3] - face()[0, :3]) @ np.linalg.inv(G)
    assert visibility_translation(a, along, O) is None  # parallel to the face it never does


@pytest.mark.parametrize("axis", [[1, 0, 0], [0.3, 1, -0.2]])
def test_rotation_changes_visibility_at_both_theta_0(G, axis):
    H_hat = G @ revolute([0.02, -0.03, 1.4], axis) @ np.linalg.inv(G)
    a, O = plane_of(face() @ G.T), center_of_left(G)
    solutions = visibility_angles(a, H_hat, O)
    assert solutions[0] != pytest.approx(solutions[1])
    for theta in solutions:
        assert abs(carried(a, expm(theta * H_hat)) @ O) < 1e-10
        sides = [carried(a, expm((theta + d) * H_hat) @ np.eye(4)) @ O for d in (-1e-3, 1e-3)]
        assert sides[0] * sides[1] < 0


def test_margin_coefficients_describe_the_carried_plane(G, rng):
    H_hat = G @ revolute([0.1, 0.2, 1.3], [1, 2, 3]) @ np.linalg.inv(G)
    a, O = rng.normal(size=(2, 4))
    c_0, c_s, c_c = margin_coefficients(tuple(a.tolist()), mat(H_hat), tuple(O.tolist()))
    for theta in np.linspace(-6, 6, 13):
        wanted = carried(a, expm(theta * H_hat)) @ O
        assert c_0 + c_s * math.sin(theta) + c_c * math.cos(theta) == pytest.approx(wanted, abs=1e-11)


@settings(max_examples=100)
@given(small, small, small, st.floats(-2 * math.pi, 2 * math.pi))
def test_least_margin_of_an_arc_by_brute_force(c_0, c_s, c_c, theta):
    """A grid of 4001 angles over at most one turn misses the least value by 1.3e-6 of the amplitude."""
    t = np.linspace(0, theta, 4001)
    brute = (c_0 + c_s * np.sin(t) + c_c * np.cos(t)).min()
    found = arc_minimum(c_0, c_s, c_c, theta)
    assert brute - 3e-6 <= found <= brute + 1e-15 * 8


def test_translation_is_limited_by_the_camera_that_loses_sight_first():
    """The left camera alone, the right alone, and both: the smaller δ τ_0 wins; nothing else is changed."""
    A = face() @ displacement([0, 0.9, 0], [0, 0, 0]).T @ displacement([0, 0, 0], [-1.0, 0, 0.6]).T
    task = make_task(arm(), A, A)
    a = plane_of(A)
    H_t = prismatic([1, 0, 0.1])
    tau = np.array([visibility_translation(a, s * H_t, O) for s in (1, -1) for O in task.O]).reshape(2, 2)
    sign, limits = (1, tau[0]) if (tau[0] > 0).all() else (-1, tau[1])
    assert (limits > 0).all()
    assert abs(limits[0] - limits[1]) > 0.1
    arguments = tuple(a.tolist()), mat(sign * H_t)
    assert limited_translation(*arguments, 100.0, 0.9, task) == pytest.approx(0.9 * limits.min())
    assert limited_translation(*arguments, 0.5 * limits.min(), 0.9, task) == 0.5 * limits.min()
    assert limited_translation(tuple(a.tolist()), mat(-sign * H_t), 100.0, 0.9, task) == 100.0
    blind = task._replace(visible=task.visible * np.where(limits == limits.min(), -1.0, 1.0))
    assert limited_translation(*arguments, 100.0, 0.9, blind) == pytest.approx(0.9 * limits.max())


def arc_margins(a, H_hat, theta, task):
    """Least margin of each camera along an arc, over its start's, by brute force."""
    t = np.linspace(0, theta, 400)[:, None, None]
    back = np.eye(4) - np.sin(t) * H_hat + (1 - np.cos(t)) * (H_hat @ H_hat)
    values = a @ back @ task.O.T * task.visible
    return values.min(axis=0) / np.abs(values[0])


def sense_case(seed):
    """A face, its turned plane, and the operator that carries one onto the other by θ in [0, π]."""
    generator = np.random.default_rng(seed)
    A = face() @ displacement([0, 0, 0], np.r_[generator.uniform(-0.6, 0.6, 2), 0]).T
    task = make_task(arm(), A, A)
    theta = generator.uniform(0.3, 3.1)
    M = A[:, :3]
    axis = generator.normal() * (M[1] - M[0]) + generator.normal() * (M[2] - M[0])
    H_hat = revolute(M.mean(axis=0), axis)
    a = plane_of(A)
    return a, carried(a, expm(theta * H_hat)), H_hat, theta, task


def chosen(a, a_t, H_hat, theta, task, against_previous=False):
    return choose_sense(tuple(a.tolist()), tuple(a_t.tolist()), mat(H_hat), theta, task, against_previous)


def test_sense_of_the_turn_by_brute_force():
    """Fewest cameras lose sight; among equals, away from 180°, the better worst margin; in any frame."""
    other_taken = differ = 0
    for seed in range(40):
        a, a_t, H_hat, theta, task = sense_case(seed)
        result = chosen(a, a_t, H_hat, theta, task)
        assert result in (theta, theta - 2 * math.pi)
        G = frame(seed, mirrored=seed % 2 == 1)
        back = np.linalg.inv(G)
        there = task._replace(O=np.ascontiguousarray(task.O @ G.T))
        assert chosen(a @ back, a_t @ back, G @ H_hat @ back, theta, there) == result
        taken, left = (arc_margins(a, H_hat, t, task) for t in (result, theta - 2 * math.pi + theta - result))
        assert (taken <= 0).sum() <= (left <= 0).sum()
        if (taken <= 0).sum() == (left <= 0).sum() and math.pi - theta > 0.5:
            assert taken.min() >= left.min() - 1e-4
        other_taken += result < 0
        differ += (taken[0] <= 0) != (taken[1] <= 0)
    assert other_taken > 0
    assert differ > 0


@pytest.mark.parametrize("theta", [2.7, 3.1])
def test_sight_counts_more_than_the_sense_of_the_step_before(theta):
    """Near half a turn the motion goes on as it was, unless a further camera would lose sight that way."""
    A = face()
    task, a = make_task(arm(), A, A), plane_of(A)
    M = A[:, :3]
    H_hat = revolute(M.mean(axis=0), M[1] - M[0])
    a_t = carried(a, expm(theta * H_hat))
    front = a[:3] / np.linalg.norm(a[:3])
    front_t = a_t[:3] / np.linalg.norm(a_t[:3])
    between = (front + front_t) / np.linalg.norm(front + front_t)
    # One camera sees the face all along the turn; the other only before it.
    for first, second in ((between, front), (front, between)):
        O = np.array([np.append(M.mean(axis=0) + way, 1.0) for way in (first, second)])
        watched = task._replace(O=O, visible=np.ones(2))
        assert chosen(a, a_t, H_hat, theta, watched, against_previous=True) == theta
    # Neither camera sees the turned face: the step before decides.
    O = np.array([np.append(M.mean(axis=0) + front, 1.0)] * 2)
    blind = task._replace(O=O, visible=np.ones(2))
    assert chosen(a, a_t, H_hat, theta, blind, against_previous=True) == theta - 2 * math.pi
    assert chosen(a, a_t, H_hat, theta, blind, against_previous=False) == theta
