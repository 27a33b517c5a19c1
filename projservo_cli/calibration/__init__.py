"""Projective kinematics from stereo images of trial motions: [RH00] section 2.

The path of a calibration: what was seen (``readings``) → the rig (``epipolar``) → a start (``start``) →
bundle adjustment (``adjustment``), robustly (``fit``) → what was left out (``outliers``, ``distortion``) →
``covariance`` → the verdict (``quality``); ``estimate`` leads through it.
"""

from projservo_cli.calibration.estimate import calibrate
from projservo_cli.calibration.fit import Solution, chi2_band
from projservo_cli.calibration.outliers import findings
from projservo_cli.calibration.prediction import (
    WINDOW,
    Innovation,
    predict,
    prediction_variance,
    residual_statistics,
)
from projservo_cli.calibration.quality import WEAK_NOISE, cross_validate
from projservo_cli.calibration.readings import REACH_M, REACH_RAD
from projservo_cli.calibration.start import Nominal
from projservo_cli.calibration.suggestions import Region, Suggestion, suggest

__all__ = [
    "REACH_M",
    "REACH_RAD",
    "WEAK_NOISE",
    "WINDOW",
    "Innovation",
    "Nominal",
    "Region",
    "Solution",
    "Suggestion",
    "calibrate",
    "chi2_band",
    "cross_validate",
    "findings",
    "predict",
    "prediction_variance",
    "residual_statistics",
    "suggest",
]
