"""Tables made by other people's software and by a real robot, from pixels and joint readings alone."""

import pytest

from projservo_cli.calibration import calibrate, residual_statistics
from projservo_cli.tables import read_table

# Held-out medians and 95th percentiles to reach, px: maximum likelihood a little widened.
NUMBERS = [
    ("ur5", "RRRRRR", "0.0", 1e-4, 1e-4),
    ("ur5", "RRRRRR", "0.1", 0.035, 0.12),
    ("ur5", "RRRRRR", "0.5", 0.17, 0.6),
    ("ur5", "RRRRRR", "1.0", 0.38, 1.2),
    ("stanford", "RRPRRR", "0.0", 1e-4, 1e-4),
    ("stanford", "RRPRRR", "0.1", 0.037, 0.12),
    ("stanford", "RRPRRR", "0.5", 0.18, 0.5),
    ("stanford", "RRPRRR", "1.0", 0.38, 1.2),
]


@pytest.mark.parametrize(("robot", "types", "noise", "median", "p95"), NUMBERS)
def test_tables_of_other_simulators(shared_data, robot, types, noise, median, p95):
    calibration = calibrate(
        read_table(shared_data / robot / f"trials_{noise}px.csv", types), types, source="recorded"
    )
    found = residual_statistics(calibration, read_table(shared_data / robot / "validation.csv", types))
    assert found["count"] == 4000
    assert found["median_px"] <= median
    assert found["p95_px"] <= p95
    assert calibration.usable
    if float(noise) > 0.0:
        assert calibration.sigma_px == pytest.approx(float(noise), rel=0.1)


@pytest.mark.volume
def test_real_robot_with_arbitrary_poses(shared_data):
    calibration = calibrate(
        read_table(shared_data / "motoman" / "arm2_train.csv", "RRRRRR"), "RRRRRR", source="recorded", seed=3
    )
    found = residual_statistics(calibration, read_table(shared_data / "motoman" / "arm2_test.csv", "RRRRRR"))
    # The same optimum from every start, and the numbers to beat.
    assert found["rms_px"] == pytest.approx(0.9068, abs=5e-4)
    assert found["median_px"] <= 0.80
    assert calibration.usable
    assert "more than pixel noise is left" in calibration.reason
