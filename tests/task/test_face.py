"""The face: centre, oriented plane, order of its markers, and what a task knows from images."""

import math

import numpy as np
import pytest

from projservo_cli.records import WorkFailed
from projservo_cli.task.face import MIDPOINT, center_of, cyclic_order, face_plane
from projservo_cli.task.target import TargetGoal, TaskImages
from tests.samples import arm, displacement, face, frame, in_frame, pixels
from tests.task.cases import SQUARE, SQUARE_CENTER, turned


def plane(A, order=None, center=MIDPOINT):
    A = np.ascontiguousarray(A)
    order = cyclic_order(A) if order is None else np.asarray(order)
    return np.array(face_plane(A, order, center_of(A, center)))


@pytest.mark.parametrize("seed", [None, 1, 2])
@pytest.mark.parametrize("m", [3, 4, 5, 8])
def test_order_goes_around_the_face_from_its_first_marker_to_the_lower_neighbour(seed, m, rng):
    """However markers are numbered, and in any frame: one order, and one sense of the plane, everywhere."""
    G = np.eye(4) if seed is None else frame(seed, mirrored=seed == 2)
    A = face(m) @ G.T
    for _ in range(5):
        shuffle = rng.permutation(m)
        order = cyclic_order(A[shuffle])
        assert set(np.diff(shuffle[order], append=shuffle[0]) % m) in ({1}, {m - 1})
        assert sorted(order) == list(range(m))
        assert order[0] == 0
        assert order[1] < order[-1]


def test_a_face_on_one_line_or_of_fewer_markers_is_refused():
    A = np.array([0, 0, 1.4, 1]) + np.outer([0, 1, 2.5, 4], [0.1, 0.05, 0.02, 0])
    with pytest.raises(WorkFailed, match="one line"):
        cyclic_order(A)
    with pytest.raises(WorkFailed, match="one line"):
        cyclic_order(np.repeat(A[:1], 4, axis=0))
    for m in (1, 2):
        with pytest.raises(WorkFailed, match="3 required"):
            cyclic_order(face()[:m])


def test_midpoint_is_the_mean_of_points_of_equal_scale():
    A = face()
    assert center_of(A, MIDPOINT) == pytest.approx(A.mean(axis=0), abs=1e-15)
    assert center_of(A, 2) == tuple(A[2])


@pytest.mark.parametrize("center", [MIDPOINT, 0, 3])
def test_plane_contains_a_flat_face(center):
    """A marker in the middle of the others spoils neither the order nor the plane."""
    for A in (face(5), np.vstack([SQUARE, [0.01, 0.02, 1.4, 1]])):
        a = plane(A, center=center)
        assert np.linalg.norm(a) == pytest.approx(1.0, abs=1e-15)
        assert np.abs(A @ a).max() < 1e-15


@pytest.mark.parametrize("seed", [1, 2])
def test_plane_is_oriented_and_carried_along(seed):
    """Any displacement H turns it into H⁻ᵀ a with the same sign; the reverse order reverses it."""
    A = face()
    order = cyclic_order(A)
    a = plane(A, order)
    assert plane(A, order[::-1]) == pytest.approx(-a, abs=1e-15)
    for T in (displacement([1, 2, -0.5], [3, 0, 1]), displacement([0, math.pi, 0], [0, 0, 2.8])):
        carried = a @ np.linalg.inv(T)
        assert plane(A @ T.T, order) == pytest.approx(carried / np.linalg.norm(carried), abs=1e-13)


def images_for(model, s_start, s_star):
    return TaskImages(model.q_reference, s_start, TargetGoal.at(s_star), MIDPOINT).task(model)


def images(A, T):
    model = arm()
    return model, pixels(model.P, A), pixels(model.P, A @ T.T)


def test_task_from_images_alone():
    T = displacement([0.1, 0.2, 1.0], [0.05, 0.02, -0.1])
    model, s_start, s_star = images(face(), T)
    wanted = images_for(model, s_start, s_star)
    assert wanted.A_star == pytest.approx(face() @ T.T, abs=1e-11)
    assert wanted.O[:, :3] == pytest.approx(np.array([[-0.15, 0, 0], [0.15, 0, 0]]), abs=1e-12)
    for seed in (1, 2):
        G = frame(seed, mirrored=seed == 2)
        task = images_for(in_frame(model, G), s_start, s_star)
        assert task.A_star == pytest.approx(wanted.A_star @ G.T, abs=1e-10)
        a = plane(face() @ G.T, task.order)
        assert ((task.O @ a) * task.visible > 0).all()


def test_a_goal_that_shows_the_back_is_refused():
    """To one camera or to both; the camera is named."""
    model, s_start, s_star = images(SQUARE, turned(SQUARE_CENTER, [math.pi, 0, 0]))
    with pytest.raises(WorkFailed, match="left camera sees one side of the face"):
        images_for(model, s_start, s_star)
    # Turned by 88° about the vertical the face is seen from the left only.
    model, s_start, s_star = images(SQUARE, turned(SQUARE_CENTER, [0, math.radians(88), 0]))
    with pytest.raises(WorkFailed, match=r"(left|right) camera sees one side of the face"):
        images_for(model, s_start, s_star)
