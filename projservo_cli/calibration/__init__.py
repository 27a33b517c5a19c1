"""Projective kinematics from stereo images of trial motions: [RH00] section 2.

The path of a calibration: what was seen (``readings``) → the rig (``epipolar``) → a start (``start``) →
bundle adjustment (``adjustment``) of the ``forward`` model, robustly (``fit``) → what was left out
(``diagnosis``) → its frame and covariance (``projective``) → the verdict (``quality``); ``estimate`` leads
through it, and ``prediction`` is what the result is for, with how far it errs.
"""

from projservo_cli.calibration.estimate import calibrate
from projservo_cli.calibration.fit import Solution, chi2_band
from projservo_cli.calibration.initialization import Nominal
from projservo_cli.calibration.prediction import (
    predict,
    prediction_variance,
    residual_statistics,
)
from projservo_cli.calibration.quality import WEAK_NOISE, cross_validate

__all__ = [
    "WEAK_NOISE",
    "Nominal",
    "Solution",
    "calibrate",
    "chi2_band",
    "cross_validate",
    "predict",
    "prediction_variance",
    "residual_statistics",
]
