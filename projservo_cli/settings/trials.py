"""Trial motions, the table that stands in for them, and how they are evaluated."""

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StrictBool, StrictInt, StringConstraints

from projservo_cli.deviations import CURVES
from projservo_cli.settings.sections import (
    Count,
    JointVector,
    NotNegative,
    Number,
    Positive,
    Section,
    SizesByName,
    Text,
    Whole,
)


class LoopNoise(Section):
    """Noise of the closed loop, and of the images of start and goal."""

    servo_px: NotNegative = Field(
        0.0, description="pixel noise of the closed loop, and of the images of start and goal"
    )
    averaged_frames: Count = Field(
        1, description="number of images averaged at the start and at the goal, where the robot rests"
    )

    @property
    def at_rest_px(self) -> float:
        """Standard deviation of a coordinate in the averaged images of start and goal."""
        return self.servo_px / math.sqrt(self.averaged_frames)


class Noise(LoopNoise):
    """Standard deviation of simulated pixel noise, per coordinate."""

    calibration_px: NotNegative = Field(0.5, description="pixel noise of the trial motions")
    tail_dof: Number | None = Field(
        None, gt=2, description="degrees of freedom of Student's t, of the same deviation; null: normal noise"
    )
    outlier_share: Number = Field(
        0.0, ge=0, lt=1, description="share of the markers of an image that are outliers"
    )
    outlier_factor: Number = Field(
        20.0, ge=1, description="standard deviation of outliers, over that of the noise"
    )


class Refit(Section):
    """A camera of a calibration that moved, and a table of images by which it is fitted again."""

    view: str = Field(description="name of the camera")
    table: Text = Field(description="path of the observation table, relative to the configuration")
    readings: Text | None = Field(None, description="path of a table of joints, where table lists detections")
    joint_unit: Literal["deg", "rad"] | None = Field(
        None, description="unit of revolute joints; null: that of data"
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
        description="trial poses of all joints at once, within the amplitudes, after those of single "
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
        """Standard deviation of joint readings, rad; None where it is not given."""
        return None if self.joint_noise_deg is None else math.radians(self.joint_noise_deg)


class Data(Section):
    """A recorded run: the observation table that stands in for simulated trial motions."""

    table: Text = Field(description="path of the table, relative to the configuration")
    readings: Text | None = Field(
        None,
        description="path of a table of joints, pose and q1 ... qN, where table lists the detections of any "
        "cameras: pose, camera, marker, u, v",
    )
    joints: Annotated[str, StringConstraints(pattern=r"^[RrPp]+$"), AfterValidator(str.upper)] | None = Field(
        None,
        description="joint types, one letter R or P for each column q1 ... qN; null: those of robot, "
        "else all R",
    )
    mount: Literal["world", "tool"] | None = Field(
        None,
        description="world: cameras stand still and watch the tool; tool: they are on it and watch the "
        "scene; null: as the table states, else world",
    )
    joint_unit: Literal["deg", "rad"] | None = Field(
        None,
        description="unit of revolute joints; null: rad, and readings that look like degrees are refused",
    )
    joint_order: Literal["stated"] | None = Field(
        None,
        description="stated: q1 ... qN are known to follow each other from base to tool; null: servo drives "
        "an external robot only if poses show it",
    )
    noise_px: Positive | None = Field(None, description="pixel noise per coordinate; null: estimated")
    image_size_px: SizesByName | None = Field(
        None,
        description="width and height of all images, or those of each view, in order or by name; null: those "
        "of cameras or rig",
    )
