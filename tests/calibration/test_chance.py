"""Quantiles of residuals, against the distributions of scipy.stats."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from projservo_cli.calibration.quality import chi2_beyond, chi2_quantile, f_beyond

# Both evaluate inverse incomplete functions that are good to a few units in the last place.
TOLERANCE = 1e-9


@pytest.mark.parametrize("freedom", [1, 2, 8, 37, 5000])
@pytest.mark.parametrize("probability", [1e-12, 1e-4, 0.05, 0.5, 0.99])
def test_chi_square(probability: float, freedom: int) -> None:
    assert chi2_quantile(probability, freedom) == pytest.approx(
        stats.chi2.ppf(probability, freedom), rel=TOLERANCE
    )
    assert chi2_beyond(probability, freedom) == pytest.approx(
        stats.chi2.isf(probability, freedom), rel=TOLERANCE
    )


@pytest.mark.parametrize(("numerator", "denominator"), [(1, 10), (5, 200), (2, 4000)])
@pytest.mark.parametrize("tail", [1e-10, 1e-4, 0.05, 0.5])
def test_f(tail: float, numerator: int, denominator: int) -> None:
    assert f_beyond(tail, numerator, denominator) == pytest.approx(
        stats.f.isf(tail, numerator, denominator), rel=1e-6
    )


def test_arrays_give_arrays() -> None:
    freedom = np.array([1, 2, 3])
    assert np.allclose(chi2_beyond(0.1, freedom), stats.chi2.isf(0.1, freedom), rtol=TOLERANCE)


def test_no_stage_imports_all_distributions() -> None:
    modules = "calibrate plan servo report sense"
    code = "".join(f"import projservo_cli.stages.{name}; " for name in modules.split())
    code += "import sys; sys.exit('scipy.stats' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
