"""When a run of a law ends, and which files a report has."""

from typing import Literal

from pydantic import Field

from projservo_cli.settings.sections import Count, NotNegative, Number, Positive, Section, Whole


class Stop(Section):
    """Stopping rules of the closed loop."""

    image_error_px: Positive = Field(0.01, description="image error below which a run has converged, rms")
    noise_factor: NotNegative = Field(
        2.0,
        description="image_error_px grows by this factor × noise.servo_px, × stated deviations if larger",
    )
    max_steps: Count = Field(2000, description="maximum number of commands")
    diverged_factor: Number = Field(
        10.0, gt=1, description="growth of the image error or the distance at which a run has diverged"
    )
    stall_periods: Count = Field(
        20, description="periods in which the error must fall by 1 %, otherwise the run makes no progress"
    )
    max_lost_periods: Whole = Field(
        25, description="periods for which the robot holds while markers are lost"
    )
    max_force_n: Positive | None = Field(
        None,
        description="force on the tool, N, beyond which a run stops; asks force() of the robot class, and "
        "the contacts of plant mujoco; null: any",
    )
    follow_s: Positive = Field(
        2.0, description="time for which a goal that moves must be followed, from the first arrival on"
    )
    innovation_threshold: NotNegative = Field(
        1.0,
        description="fault detection: a fault is an innovation beyond chance and beyond this factor × "
        "the noise; 0: no detection",
    )


class ReportSettings(Section):
    """Files of the report."""

    formats: tuple[Literal["svg", "pdf", "png"], ...] = Field(
        ("svg",), min_length=1, description="file formats of each figure; the page shows SVG, otherwise PNG"
    )
