"""Boards whose numbering turns between images: turned right by joints and views, as if it had not been."""

import dataclasses

import numpy as np
import pytest

import projservo_cli as projservo
from projservo_cli.calibration import calibrate, predict
from projservo_cli.calibration.checks.board_corner_numbering import BoardNumbering
from projservo_cli.calibration.checks.validation import residual_statistics
from projservo_cli.observations import Observations
from projservo_cli.store.observation_tables import read_table
from tests.calibration.simulated_robot import Robot, around, random_robot, trials
from tests.calibration.test_cameras_on_the_tool import Hand

CELL_M, SIGMA = 0.02, 0.2


def with_board(kind, types, shape, views, rng):
    """An arm whose markers are the corners of a board of so many rows and columns."""
    arm = random_robot(types, rng, views=views)
    places = CELL_M * np.indices(shape)[::-1].reshape(2, -1).T
    body = np.c_[places - places.mean(axis=0), np.zeros(len(places)), np.ones(len(places))]
    return kind(**(vars(arm) | {"markers": body}))


def seen_turned(arm, q, shape, rng):
    """What cameras see at joints, numbered alike, and from any end; how far each image is turned."""
    seen = arm.observe(q, SIGMA, rng)
    right = dataclasses.replace(seen, marker=np.arange(len(arm.markers)))
    index, step = np.arange(len(arm.markers)).reshape(shape), 1 if shape[0] == shape[1] else 2
    turn = step * rng.integers(0, 4 // step, right.images.shape[:2])
    order = np.stack([np.rot90(index, k).ravel() for k in range(4)])[turn]
    images = np.take_along_axis(right.images, order[..., None], axis=2)
    return right, dataclasses.replace(right, images=images), turn


CASES = [
    (Robot, "RRPRR", (6, 4), 3),
    (Hand, "RRRRR", (5, 3), 2),
    (Robot, "RRR", (4, 4), 2),
    (Robot, "RRRR", (3, 5), 1),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[1]}-{case[2]}-{case[3]}")
def test_neighbours_prove_which_images_are_turned(case):
    kind, types, shape, views = case
    rng = np.random.default_rng(0)
    arm = with_board(kind, types, shape, views, rng)
    q = np.concatenate([trials(arm, frames=3), around(arm, 12, rng, angle=0.3)])
    right, turned, turn = seen_turned(arm, q, shape, rng)
    found = BoardNumbering.by_joints(turned, types)
    # One turn is common to all images: no image shows which end is the first.
    ways = 4 if shape[0] == shape[1] else 2
    left = (turn // (4 // ways) + found.turn) % ways
    assert (left == left[0, 0]).all()
    again = dataclasses.replace(found, given=right, turn=left).observation.images
    np.testing.assert_array_equal(found.observation.images, again)
    assert len(found.images) == np.count_nonzero(found.turn)
    as_is = BoardNumbering.by_joints(right, types)
    assert as_is.observation is right
    assert as_is.findings == ()


def test_a_wrist_that_turns_by_half_a_turn_is_no_turned_board():
    """Poses far apart that show the board the other way round, numbered right: nothing proves a turn."""
    rng = np.random.default_rng(4)
    arm = with_board(Robot, "RRRRRR", (7, 9), 2, rng)
    q = around(arm, 24, rng)
    q[:, 5] += np.pi * rng.integers(0, 2, len(q))
    right, _, _ = seen_turned(arm, q, (7, 9), rng)
    assert not BoardNumbering.by_joints(right, "RRRRRR").turn.any()


def test_a_fit_decides_on_images_without_neighbours():
    rng = np.random.default_rng(6)
    arm = with_board(Robot, "RRRR", (4, 5), 2, rng)
    q = np.concatenate([trials(arm, frames=5), around(arm, 6, rng, angle=1.3)])
    right, turned, _ = seen_turned(arm, q, (4, 5), rng)
    images = right.images.copy()
    images[-6:] = images[-6:, :, ::-1]  # far from all others
    wrong = dataclasses.replace(right, images=images)
    assert not BoardNumbering.by_joints(wrong, "RRRR").decided[-6:].all()
    found = projservo.calibrate(Observations.of(wrong, joint_types="RRRR"), progress=False)
    expected = calibrate(right, "RRRR", source="recorded")
    np.testing.assert_allclose(predict(found, q), predict(expected, q), atol=1e-3)
    assert set(found.turned_images[:, 0]) == set(right.pose[-6:])
    assert any("of 54 images number it from another end" in text for text in found.advice)
    error = residual_statistics(expected, turned)  # of another detector
    assert error["median_px"] < 2.0 * SIGMA
    assert "were turned right" in error["advice"][0]


def test_a_real_board_as_the_detector_numbered_it(shared_data):
    """Turned in 11 and 10 of 30 images, all found; the table is then that which was turned right by hand."""
    folder = shared_data / "ur3e"
    by_hand, raw = (
        read_table(folder / name, "RRRRRR", "deg")
        for name in ("cam12_train.csv", "raw_order_cam12_train.csv")
    )
    found = BoardNumbering.by_joints(raw, "RRRRRR")
    assert found.turn.sum(axis=0).tolist() == [11, 10]
    np.testing.assert_array_equal(found.observation.images, by_hand.images[:, :, ::-1])
    assert not BoardNumbering.by_joints(by_hand, "RRRRRR").turn.any()
