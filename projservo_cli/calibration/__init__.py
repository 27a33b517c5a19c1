"""Projective kinematics from stereo images of trial motions: [RH00] section 2.

``estimate`` runs the steps: pixels (``detections``), geometry of the rig (``epipolar``), equal numbers in
both views (``numbering``), initial parameters (``initialization``), robust bundle adjustment (``fit``,
``adjustment``), outliers (``diagnosis``), frame and covariance (``projective``), deviations from the model
(``model_error``), assessment (``quality``). ``prediction`` has the forward model, and predicts images and
their errors from the result. ``screening`` comes before, ``undecided`` after.
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
