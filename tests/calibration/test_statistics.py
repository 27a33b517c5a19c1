"""Draws on the noise-free table of another simulator: errors against the bound."""

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict, prediction_variance
from projservo_cli.records import Observation
from projservo_cli.store.tables import read_table
from tests.calibration.bound import derivative, robot_of, spread

DRAWS = 4


def within_20_deg(offset):
    return np.abs(offset).max(axis=1) <= np.radians(20.0) + 1e-9


def every(offset):
    return np.ones(len(offset), dtype=bool)


@pytest.mark.volume
@pytest.mark.parametrize(
    ("arm", "poses", "sigma", "removed"),
    [
        ("ur5", within_20_deg, 1.0, 0.0),
        ("ur5", every, 0.5, 0.4),
        ("stanford", every, 0.5, 0.0),
    ],
)
def test_data_of_another_lab_are_used_as_well_as_can_be(
    shared_data, reference_truth, arm, poses, sigma, removed
):
    """Fresh noise on a noise-free table, calibrated from scratch as a recorded one."""
    robot = robot_of(reference_truth(arm))
    table, ahead = (
        read_table(shared_data / arm / f"{name}.csv", robot.joint_types)
        for name in ("trials_0.0px", "validation")
    )
    kept = poses(table.q - robot.q_reference)
    J, J_ahead = derivative(robot, table.q[kept]), derivative(robot, ahead.q)
    square, bound, stated = [], [], []
    for seed in range(DRAWS):
        rng = np.random.default_rng([seed, 4])
        images = table.images[kept] + sigma * rng.standard_normal(table.images[kept].shape)
        gone = np.broadcast_to(rng.random((len(images), 1, images.shape[2], 1)) < removed, images.shape)
        seen = Observation(table.pose[kept], table.marker, table.q[kept], np.where(gone, np.nan, images))
        found = calibrate(seen, robot.joint_types, source="recorded", seed=seed)
        square.append(np.mean((predict(found, ahead.q) - ahead.images) ** 2))
        stated.append(prediction_variance(found, ahead.q).mean())
        bound.append(sigma**2 * (spread(J[~gone.ravel()], J_ahead) ** 2).sum() / len(J_ahead))
    square, bound = np.array(square), np.array(bound)
    # The variance is scaled by the noise that was estimated, to some 5 % each.
    assert np.mean(stated) == pytest.approx(bound.mean(), rel=0.15)
    again = np.random.default_rng(0).integers(0, DRAWS, (2000, DRAWS))  # bootstrap of the ratio
    error = np.sqrt(square[again].mean(axis=1) / bound[again].mean(axis=1)).std()
    assert np.sqrt(square.mean() / bound.mean()) <= 1.10 + 2.0 * error
    # Nothing wrong without a word: of normal errors in a few directions no draw errs twice the bound.
    assert np.sqrt(square / bound).max() <= 2.0
