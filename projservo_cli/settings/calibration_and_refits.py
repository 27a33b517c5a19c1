"""Trial motions, how they are evaluated, and which camera is fitted again."""

import math
from typing import Literal

from pydantic import Field, StrictBool, StrictInt

from projservo_cli.deviations import CURVES
from projservo_cli.settings.sections import (
    JointVector,
    NotNegative,
    Number,
    Positive,
    Section,
    Text,
    Whole,
)


class Refit(Section):
    """A camera of a calibration that moved, and a table of images by which it is fitted again."""

    view: str = Field(description="name of the camera")
    table: Text = Field(description="path of the observation table, relative to the configuration")
    readings: Text | None = Field(None, description="path of a table of joints, where table lists detections")
    joint_unit: Literal["deg", "rad"] | None = Field(
        None, description="unit of revolute joints; null: the unit of data"
    )


class CalibrationSettings(Section):
    """Trial motions of one joint each around a reference, and how they are evaluated."""

    method: Literal["bundle_adjustment"] = Field(
        "bundle_adjustment", description="maximum likelihood, the only one"
    )
    frames_per_joint: StrictInt = Field(
        8, ge=0, le=10_000, description="trial poses of each joint, in addition to the reference"
    )
    amplitude_deg: Number = Field(
        30.0, ge=0, lt=180, description="maximum trial motion to each side, revolute joints"
    )
    amplitude_m: NotNegative = Field(0.15, description="maximum trial motion to each side, prismatic joints")
    reference: JointVector | None = Field(
        None, description="joint readings of the reference pose; null: task.start"
    )
    cross_validate: StrictInt | None = Field(
        None,
        ge=2,
        le=10_000,
        description="number of folds of the poses, each predicted from the others; null: no cross-validation",
    )
    max_predicted_px: Positive | None = Field(
        None,
        description="error of predictions by deviations of arm and rig from the model above which the "
        "calibration is not usable, px; null: 1 % of the image size",
    )
    init: Text | None = Field(
        None, description="JSON file of a known robot and rig, the first initial guess of the fit"
    )
    random_poses: StrictInt | None = Field(
        None,
        ge=0,
        le=10_000,
        description="trial poses of all joints at once, within the amplitudes, after poses of single "
        "joints; null: 12 if readings or images may have faults, 0 for the ideal plant",
    )
    joint_noise_deg: NotNegative | None = Field(
        None,
        description="standard deviation of joint readings (prismatic joints: × 0.3 m/rad); null: "
        "estimated, 0 for the ideal plant",
    )
    seed: Whole | None = Field(
        None, description="seed of the noise of the trial motions; null: seed of the run"
    )
    lens: StrictBool = Field(
        False,
        description="whether to estimate radial distortion: two coefficients a camera, and its centre",
    )
    intrinsics: dict[str, Text] | None = Field(
        None,
        description="YAML file of each camera by its name, as OpenCV or ROS writes it: its lens is taken, "
        "and its intrinsics are priors of the fit unless the images contradict them",
    )
    focal_std_fraction: Positive = Field(
        0.005, description="standard deviation of focal lengths, and of the skew, of intrinsics, over these"
    )
    center_std_fraction: Positive = Field(
        0.01, description="standard deviation of the centres of intrinsics, over the size of the image"
    )
    joint_model: Literal["auto"] | tuple[str, ...] | None = Field(
        None,
        description=f"curves of joints to fit: auto, or a list of {', '.join(CURVES)}, of all joints or of "
        "one, as scale:2 or coupling:4-5; null: joints are as they read",
    )

    refits: tuple[Refit, ...] = Field(
        (),
        description="cameras that moved since, each fitted again, in this order, as calibrate --refit does",
    )

    @property
    def amplitudes(self) -> tuple[float, float]:
        """Maximum trial motion to each side, revolute joints, rad, and prismatic ones, m."""
        return math.radians(self.amplitude_deg), self.amplitude_m

    @property
    def joint_noise(self) -> float | None:
        """Standard deviation of joint readings, rad; None if it is not given."""
        return None if self.joint_noise_deg is None else math.radians(self.joint_noise_deg)
