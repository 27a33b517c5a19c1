"""Noise of images, and the table that stands in for trial motions."""

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StringConstraints

from projservo_cli.settings.sections import (
    Count,
    NotNegative,
    Number,
    Positive,
    Section,
    SizesByName,
    Text,
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
    outlier_factor: Number = Field(20.0, ge=1, description="standard deviation of outliers, over the noise")


class Data(Section):
    """A recorded run: the observation table that replaces simulated trial motions."""

    table: Text = Field(description="path of the table, relative to the configuration")
    readings: Text | None = Field(
        None,
        description="path of a table of joints, pose and q1 ... qN, or of poses of the flange, where table "
        "lists the detections of any cameras: pose, camera, marker, u, v",
    )
    joints: Annotated[str, StringConstraints(pattern=r"^[RrPp]+$"), AfterValidator(str.upper)] | None = Field(
        None,
        description="joint types, one letter R or P for each column q1 ... qN; null: the types of robot, "
        "else all R",
    )
    mount: Literal["world", "tool"] | None = Field(
        None,
        description="world: fixed cameras watch the tool; tool: they are on it and watch the "
        "scene; null: as the table states, otherwise world",
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
        description="width and height of all images, or of each view, in order or by name; null: those "
        "of cameras or rig",
    )
