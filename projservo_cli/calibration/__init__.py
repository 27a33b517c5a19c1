"""Projective kinematics from stereo images of trial motions: [RH00] section 2.

``calibrate`` runs the steps: pixels (``detections``), geometry of the rig and initial parameters
(``initial``), robust bundle adjustment (``robust_fit``, ``bundle_adjustment``), frame and covariance
(``projective``), with the ``checks`` of the data before and of the fit after. ``prediction`` has the forward
model, and predicts images and their errors from the result.
"""

from projservo_cli.calibration.checks.observability_and_verdict import WEAK_NOISE
from projservo_cli.calibration.checks.validation import cross_validate, residual_statistics
from projservo_cli.calibration.initial.initialization import Nominal
from projservo_cli.calibration.pipeline import calibrate
from projservo_cli.calibration.prediction import predict, prediction_variance
from projservo_cli.calibration.robust_fit import Solution, chi2_band

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
