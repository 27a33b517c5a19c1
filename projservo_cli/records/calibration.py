"""What a calibration is made from and what comes of it, and the model every kernel reads."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from projservo_cli.records.fields import BoolArray, FloatArray, IntArray, array, scalar

REVOLUTE = 0
PRISMATIC = 1
FREE = 2  # a twist of a free-flying rig: its operator does not move with the others

NO_LENS = np.array([[0.0, 0.0, 1.0, 0.0, 0.0]] * 2)


class Model(NamedTuple):
    """Robot and rig as the kernels see them, in one frame, projective or metric.

    The calibrated model lives in a projective frame; the true one in the metric frame of the robot
    base, where the operators are 4×4 twists and ``a_inf`` is (0, 0, 0, 1).

    Attributes
    ----------
    P : (2, 3, 4) cameras, left and right, to pixels.
    H_hat_0 : (n, 4, 4) joint operators at the reference, one unit of motion per rad or m.
    joint_types : (n,) ``REVOLUTE``, ``PRISMATIC`` or ``FREE``.
    q_reference : (n,) joint reading at the reference, rad or m.
    a_inf : (4,) plane at infinity, the common left null vector of the operators.
    lens : (2, 5) radial distortion of both views: image centre u, v and radius, px, then k1, k2.
    """

    P: FloatArray
    H_hat_0: FloatArray
    joint_types: IntArray
    q_reference: FloatArray
    a_inf: FloatArray
    lens: FloatArray = NO_LENS


@dataclass(frozen=True, eq=False)
class Observation:
    """Stereo images of the markers at a sequence of robot poses."""

    pose: IntArray = array("pose", about="number of the pose")
    marker: IntArray = array("marker", about="number of the marker")
    q: FloatArray = array("pose", "joint", units="rad or m", about="joint readings")
    images: FloatArray = array("pose", "view", "marker", "xy", units="px", about="pixels, NaN where unseen")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Projective kinematics of a robot seen by a stereo rig of unknown calibration.

    Points are scaled to ``a_inf @ M = 1``, so that the mean of points is their midpoint.
    """

    method: str = scalar(about="closed_form, linear or refined")
    source: str = scalar(about="simulated or recorded")
    joint_types: str = scalar(about="one letter a joint, R or P")
    usable: bool = scalar(about="whether the calibration may be used for control")
    reason: str = scalar(about="why it is usable or not, in words")
    advice: tuple[str, ...] = scalar(about="what to do next, one sentence each")
    rms_px: float = scalar(units="px", about="reprojection residual, rms per marker and view (Euclidean)")
    sigma_px: float = scalar(units="px", about="noise per image coordinate: configured, given or estimated")
    sigma_fitted_px: float = scalar(units="px", about="noise per coordinate from the residuals of the fit")
    chi2_per_dof: float = scalar(about="squared residuals over sigma_px squared, per degree of freedom")
    dof: int = scalar(about="degrees of freedom of the fit")
    seconds: float = scalar(units="s", about="time the calibration took")
    P: FloatArray = array("view", "image_row", "coordinate", units="px", about="cameras, projective frame")
    H_hat_0: FloatArray = array("joint", "row", "coordinate", about="joint operators at the reference")
    q_reference: FloatArray = array("joint", units="rad or m", about="joint reading at the reference")
    a_inf: FloatArray = array("coordinate", about="common plane at infinity")
    marker: IntArray = array("marker", about="number of the marker")
    M: FloatArray = array("marker", "coordinate", about="markers at the reference, a_inf @ M = 1")
    covariance: FloatArray = array(
        "parameter",
        "parameter_",
        about="of P.ravel(), H_hat_0.ravel(), M.ravel(), gauge fixed, and k1, k2 of both lenses if any",
    )
    excitation: FloatArray = array("joint", units="rad or m", about="range of joint motion in the data")
    weak: BoolArray = array("joint", about="joints whose operator the data hardly determine")
    operator_defect: FloatArray = array("joint", about="norm of Ĥ³ + Ĥ (revolute) or Ĥ² (prismatic) over Ĥ")
    trace_defect: FloatArray = array("joint", about="absolute trace of Ĥ")
    plane_defect: FloatArray = array("joint", about="norm of a_inf @ Ĥ, a_inf of unit norm")
    prediction_noise: FloatArray = array(
        "joint", about="noise of predicted images 0.5 rad or 0.15 m from the reference, over the pixel noise"
    )
    merged_poses: int = scalar(about="poses that the fit uses")
    merged_markers: int = scalar(about="markers that the fit uses")
    outlier: IntArray = array(
        "outlier_row",
        "outlier_column",
        about="readings left out: pose, marker, view (0 left, 1 right, 2 both)",
    )
    suspect: IntArray = array(
        "suspect_row", "suspect_column", about="joint readings that no image agrees with: pose, joint from 1"
    )
    swapped: IntArray = array(
        "swap_row", "swap_column", about="markers that changed numbers: pose, marker read, marker that it is"
    )
    worst_determined: str | None = scalar(about="direction the data determine worst, in words", default=None)
    predicted_rms_px: float | None = scalar(
        units="px",
        about="expected error of images at poses of all joints within their ranges, rms per marker and view",
        default=None,
    )
    predicted_p99_px: float | None = scalar(
        units="px", about="what that rms stays below in 99 of 100 draws of the noise", default=None
    )
    lens: FloatArray | None = array(
        "view",
        "lens_term",
        about="radial distortion, if estimated: image centre u, v and radius in px, k1, k2",
        default=None,
    )

    def model(self) -> Model:
        """The kernels' view of the calibration."""
        types = np.array([PRISMATIC if t == "P" else REVOLUTE for t in self.joint_types], dtype=np.int64)
        lens = NO_LENS if self.lens is None else self.lens
        return Model(self.P, self.H_hat_0, types, self.q_reference, self.a_inf, lens)


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Repeatability of a calibration: images at poses that the fit which predicts them has not seen.

    The statistics are of Euclidean distances, one for each marker and view, as in ``validate``.
    Readings that the calibration leaves out as outliers do not count.
    """

    folds: int = scalar(about="parts the poses were divided into, each predicted from the others")
    seed: int = scalar(about="seed of the division")
    unit: str = scalar(about="poses, or configurations: poses that differ in one joint stay together")
    failed: tuple[str, ...] = scalar(about="parts that could not be predicted, each with the reason")
    reason: str = scalar(about="how the held-out error compares with the predicted one, in words")
    count: int = scalar(about="marker-view pairs that were predicted")
    rms_px: float | None = scalar(units="px", about="held-out residual, root mean square")
    median_px: float | None = scalar(units="px", about="held-out residual, median")
    p95_px: float | None = scalar(units="px", about="held-out residual, 95th percentile")
    predicted_rms_px: float | None = scalar(
        units="px", about="the same root mean square from noise and covariance of each fit"
    )
    pose: IntArray = array("pose", about="number of the pose")
    fold: IntArray = array("pose", about="part of the pose, from 0")
    marker: IntArray = array("marker", about="number of the marker")
    residual: FloatArray = array(
        "pose", "view", "marker", "xy", units="px", about="seen minus predicted, NaN where there is none"
    )
    predicted: FloatArray = array(
        "pose",
        "view",
        "marker",
        "xy",
        units="px",
        about="deviation of the residual from noise and covariance",
    )
