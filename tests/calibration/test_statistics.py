"""Draws on the noise-free table of another simulator, and random robots: errors against the bound."""

import pytest

from tests.calibration.bound import robot_of
from tests.calibration.statistics import CASES, noise_draws, random_robots

DRAWS, ROBOTS = 4, 5


@pytest.mark.volume
@pytest.mark.parametrize("case", CASES)
def test_little_data_is_used_as_well_as_can_be(reference_truth, case):
    draws = noise_draws(case, robot_of(reference_truth("ur5")), DRAWS)
    assert draws.refused == []
    assert draws.ratio <= 1.10 + 2.0 * draws.error
    # Nothing wrong without a word: of normal errors in a few directions no draw errs twice the bound.
    assert draws.worst <= 2.0


@pytest.mark.volume
def test_random_robots_are_calibrated_to_the_bound_or_refused():
    found = random_robots(ROBOTS)
    assert found.good == len(found.ratio)
    assert len(found.refused) <= 1
    assert found.rejected <= 0.2 * (ROBOTS + found.rejected)
