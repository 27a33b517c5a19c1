"""Faults of the simulated robot and its cameras, permanent ones and events in a run."""

import math
from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, StrictBool

from projservo_cli.records import VIEWS
from projservo_cli.settings.objects import Displacement
from projservo_cli.settings.sections import (
    ByView,
    Count,
    Note,
    NotNegative,
    Number,
    OneOf,
    Positive,
    Section,
    Vector3,
    Whole,
)


class LostMarkers(Section):
    """Markers that all cameras lose for some steps."""

    from_step: Whole = Field(description="first step at which the markers are unseen")
    steps: Count | None = Field(None, description="number of steps; null: until the end of the run")
    markers: Annotated[tuple[Whole, ...], Field(min_length=1)] | None = Field(
        None, description="numbers of the markers; null: all markers"
    )


class JointMoved(OneOf):
    """A joint that is displaced, or slips on its encoder."""

    one_of = ("by_deg", "by_m")
    at_step: Count = Field(description="step at which the joint moves")
    joint: Count = Field(description="number of the joint, from 1")
    by_deg: Number | None = Field(None, description="angle of a revolute joint")
    by_m: Number | None = Field(None, description="distance of a prismatic joint")
    encoder_slip: StrictBool = Field(
        False, description="whether the link slips on its encoder, so that the reading stays the same"
    )

    @property
    def by(self) -> float:
        """By how much it is moved, rad or m."""
        return self.by_m or 0.0 if self.by_deg is None else math.radians(self.by_deg)


class StuckEncoder(Section):
    """An encoder whose reading stays constant while its joint moves."""

    joint: Count = Field(description="number of the joint, from 1")
    from_step: Whole = Field(description="first step of the constant reading")
    steps: Count | None = Field(None, description="number of steps; null: until the end of the run")


class _CameraMoved(Section):
    """A camera that moves, which shifts its image."""

    at_step: Whole = Field(description="first step at which the image is shifted")
    view: str = Field(description="name of the camera that moves")
    by_px: Number | tuple[Number, Number] = Field(description="shift of its image along u, or along u and v")

    def shift_of(self, view: str) -> tuple[float, float]:
        """Return the shift of the image of a view along u and v."""
        shift = self.by_px if isinstance(self.by_px, tuple) else (self.by_px, 0.0)
        return shift if self.view == view else (0.0, 0.0)


class _MarkerMoved(Section):
    """A marker that moves on the tool."""

    at_step: Whole = Field(description="first step at the new position")
    marker: Whole = Field(description="number of the marker")
    by_m: Vector3 = Field(description="displacement in the frame of the tool")


class _ObjectMoved(Displacement):
    """An object that moves, in the base frame, which no calibration knows of."""

    at_step: Count = Field(description="first step at the new place")
    name: str = Field(description="name of the object")


class EachView(ByView):
    """A time for each camera, by its name, s, and for those that are not named."""

    __pydantic_extra__: dict[str, Number]
    left: Number | None = Field(None, description="value of the left camera; others by their names")
    right: Number | None = Field(None, description="value of the right camera")
    others: Number | None = Field(None, description="value of cameras that are not named")

    def of(self, view: str) -> float | None:
        """Return the time of a camera, if it is given."""
        time: float | None = getattr(self, view, None)
        return self.others if time is None else time


def _of_all(value: Any) -> Any:
    """One number holds for all cameras."""
    return dict.fromkeys((*VIEWS, "others"), value) if isinstance(value, int | float) else value


Delays = Annotated[EachView, BeforeValidator(_of_all, json_schema_input_type=Number | EachView)]


class Faults(Section):
    """Permanent faults of the simulated robot and its cameras, which a calibration has to model too."""

    camera_latency_s: Delays = Field(
        EachView(left=0.0, right=0.0, others=0.0),
        description="time from the middle of an exposure to the joint readings that arrive with its "
        "image, at least half the exposure; a number for all cameras, or {left, right} or other names",
    )
    exposure_s: NotNegative = Field(0.0, description="exposure time, over which an image is averaged")
    jitter_s: NotNegative = Field(
        0.0, description="standard deviation of the exposure times of single images"
    )
    frame_rate_hz: Positive | None = Field(
        None, description="frame rate of free-running cameras; null: each reading triggers an image"
    )
    frame_offset_s: Number = Field(
        0.0, description="delay of each camera behind the one before, left to right, with frame_rate_hz"
    )
    stamps: StrictBool = Field(
        False, description="whether images carry the time of mid-exposure, each camera by its own clock"
    )
    encoder_counts_per_turn: Count | None = Field(
        None,
        description="resolution of the joint readings, counts per turn, or per 1.885 m of a prismatic "
        "joint; null: continuous",
    )
    quantize_setpoints: StrictBool = Field(
        False, description="whether set-points are rounded to encoder counts as well"
    )
    servo_time_constant_s: NotNegative = Field(
        0.0, description="time constant of the first-order lag of the servos"
    )
    gravity_sag_deg: NotNegative = Field(
        0.0, description="steady-state error under gravity at full reach; the encoders read it"
    )
    link_deflection_deg: NotNegative = Field(
        0.0, description="deflection of a link under gravity at full reach; no encoder reads it"
    )
    backlash_deg: NotNegative = Field(
        0.0, description="backlash between each encoder and its link, from end to end"
    )

    def contradictions(self) -> Iterator[Note]:
        """Yield latencies of images not taken yet, and keys without effect because another is missing."""
        if (least := min(latency or 0.0 for _, latency in self.camera_latency_s)) < 0:
            yield ("camera_latency_s",), f"{least:g} is negative: no image comes before it was taken"
        if self.frame_offset_s and self.frame_rate_hz is None:
            yield ("frame_offset_s",), "applies to cameras that run freely: set frame_rate_hz as well"
        if self.quantize_setpoints and self.encoder_counts_per_turn is None:
            yield ("quantize_setpoints",), "takes the ticks of encoders: set encoder_counts_per_turn as well"


class Events(Section):
    """Events of the simulated robot and its cameras in a run."""

    lost_markers: LostMarkers | None = None
    joint_moved: JointMoved | None = None
    stuck_encoder: StuckEncoder | None = None
    camera_moved: _CameraMoved | None = None
    marker_moved: _MarkerMoved | None = None
    object_moved: _ObjectMoved | None = None


class Disturbance(Events, Faults):
    """Faults of the simulated robot and its cameras, permanent ones and events in a run."""
