"""Distributions of the noise of pixels."""

import math

import numpy as np
import pytest
from scipy.stats import kstest, t

from projservo_cli.simulation.random_streams import NORMAL, NoiseShape, generator


@pytest.mark.parametrize("shape", [NORMAL, NoiseShape(3.0), NoiseShape(5.0, 0.05, 20.0)])
def test_noise_has_its_tails_and_outliers_and_fewer_rows_are_the_first_of_more(shape):
    noise = shape.draw(generator(3, 1), (5_000, 2, 4, 2))
    np.testing.assert_array_equal(noise[:50], shape.draw(generator(3, 1), (50, 2, 4, 2)))
    wrong = noise[..., 0] != NoiseShape(shape.tail_dof).draw(generator(3, 1), noise.shape)[..., 0]
    assert wrong.mean() == pytest.approx(shape.outlier_share, abs=0.005)
    rest, dof = noise[~wrong].ravel(), shape.tail_dof
    unit = 1.0 if math.isinf(dof) else math.sqrt(dof / (dof - 2.0))
    assert kstest(rest * unit, t(1e9 if math.isinf(dof) else dof).cdf).pvalue > 1e-3
