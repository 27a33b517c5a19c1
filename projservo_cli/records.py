"""The named arrays that pass from stage to stage, and the model every kernel reads.

Records hold plain arrays with documented shapes and units. ``array`` attaches the names of the
dimensions and the unit to a field, so that the run file can label what it stores; nothing here
knows how it is stored.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

REVOLUTE = 0
PRISMATIC = 1
FREE = 2  # a twist of a free-flying rig: its operator does not move with the others

LAWS = ("direct_three", "direct_two", "stacked", "blockwise", "euclidean_points")
METRIC_LAWS = ("euclidean_points",)  # laws that are given the metric model, as in the paper


def array(*dims: str, units: str = "1", about: str = "") -> Any:
    """Declare an array field: the names of its dimensions, its unit and what it holds."""
    return field(metadata={"dims": dims, "units": units, "about": about})


def scalar(units: str = "1", about: str = "", **default: Any) -> Any:
    """Declare a scalar or text field with its unit and what it holds."""
    return field(metadata={"units": units, "about": about}, **default)


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
    """

    P: FloatArray
    H_hat_0: FloatArray
    joint_types: IntArray
    q_reference: FloatArray
    a_inf: FloatArray


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
        "parameter", "parameter_", about="of P.ravel(), H_hat_0.ravel(), M.ravel(), gauge fixed"
    )
    excitation: FloatArray = array("joint", units="rad or m", about="range of joint motion in the data")
    weak: BoolArray = array("joint", about="joints whose operator the data hardly determine")
    operator_defect: FloatArray = array("joint", about="norm of Ĥ³ + Ĥ (revolute) or Ĥ² (prismatic) over Ĥ")
    trace_defect: FloatArray = array("joint", about="absolute trace of Ĥ")
    plane_defect: FloatArray = array("joint", about="norm of a_inf @ Ĥ, a_inf of unit norm")

    def model(self) -> Model:
        """The kernels' view of the calibration."""
        types = np.array([PRISMATIC if t == "P" else REVOLUTE for t in self.joint_types], dtype=np.int64)
        return Model(self.P, self.H_hat_0, types, self.q_reference, self.a_inf)


class InputError(ValueError):
    """Usage, configuration or data that cannot be read or make no sense (exit code 2).

    The message is one line a user can act on: where, what is wrong, what to do.
    """


class WorkFailed(RuntimeError):  # noqa: N818 - a verdict, not a programming error
    """The data were read, but the work they ask for cannot be done (exit code 1)."""
