"""Projective kinematics from stereo images of trial motions: [RH00] section 2."""

from projservo_cli.calibration.crossvalidation import cross_validate
from projservo_cli.calibration.estimate import calibrate, findings
from projservo_cli.calibration.prediction import predict, prediction_variance, residual_statistics

__all__ = ["calibrate", "cross_validate", "findings", "predict", "prediction_variance", "residual_statistics"]
