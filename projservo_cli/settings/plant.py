"""The robot to drive: its class, the limits of its servos, its rest, and the conditions of its runs."""

import json
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, StrictInt, WithJsonSchema

from projservo_cli import plugins
from projservo_cli.settings.disturbance import Delays
from projservo_cli.settings.sections import NotNegative, Number, Positive, Section

RENDERED = "mujoco"
"""The plant that is simulated and rendered by MuJoCo."""


def _plant(name: str) -> str:
    target = name if name == RENDERED else plugins.target_of("plant", name)
    if target is None:
        names = ", ".join((RENDERED, *plugins.registered_names("plant")))
        raise ValueError(f"must be module:Class, such as my_robot:Robot, or one of {names}")
    return target


_PlantClass = Annotated[str, AfterValidator(_plant), WithJsonSchema({"type": "string"})]


def _as_given(value: Any) -> Any:
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError("takes text, finite numbers, true, false, null, lists and mappings") from error
    return value


Plain = Annotated[Any, AfterValidator(_as_given)]


class RenderedOptions(Section):
    """Options of the plant mujoco."""

    servo: Literal["own", "position", "velocity"] = Field(
        "own",
        description="position or velocity servos; own for the actuators of robot.mjcf, otherwise position",
    )
    grey_noise: NotNegative = Field(
        2.0, description="standard deviation of the image noise, grey levels of 255"
    )
    blur_px: NotNegative = Field(0.7, description="standard deviation of the blur of the lens")
    k1: Number = Field(
        0.0, gt=-1, lt=1, description="radial distortion r (1 + k1 r²), r in units of the focal length"
    )
    light: Literal["soft", "side"] = Field(
        "soft", description="soft light from all around, or hard light from one side"
    )


class RobotClass(Section):
    """The class of the robot to drive, and how long it may take."""

    use: _PlantClass | None = Field(
        None,
        description="class of an external robot (module:Class), or mujoco for a simulated arm with "
        "rendered cameras; null for a simulated arm whose points are projected",
    )
    options: dict[str, Plain] = Field({}, description="keyword arguments of the class")
    timeout_s: Positive = Field(1.0, description="maximum time of one answer of the robot")
    open_s: Positive = Field(30.0, description="maximum time to open the robot")

    @property
    def simulated(self) -> bool:
        """Whether the robot is a simulated one, whose truth is known."""
        return self.use in (None, RENDERED)

    @property
    def target(self) -> str:
        """The class of the user's robot; empty for a simulated one."""
        return "" if self.simulated else self.use or ""

    @property
    def rendered(self) -> RenderedOptions | None:
        """Options of the plant mujoco; None where another one is driven."""
        return RenderedOptions.model_validate(self.options) if self.use == RENDERED else None


class ServoLimits(Section):
    """Limits of the servos of a robot, beyond which it does not follow."""

    max_relative_target_deg: Positive | None = Field(
        None,
        description="maximum distance of a set-point from the reading; null: from max_servo_lag_s, "
        "max_steady_state_error_deg and the speed limit",
    )
    max_servo_lag_s: NotNegative = Field(0.15, description="maximum lag of a joint behind its set-point")
    max_steady_state_error_deg: NotNegative = Field(
        1.0,
        description="maximum distance of a joint at rest from its set-point; prismatic joints: 5.24 mm "
        "per degree",
    )


class Rest(Section):
    """Rest of a robot before it is observed, and the number of images averaged then."""

    averaged_frames: StrictInt = Field(
        1, ge=1, le=1000, description="number of images of each pose that record averages"
    )
    settle_s: Positive = Field(
        0.5, description="time for which joints and images rest before a pose is recorded"
    )


class RunConditions(Section):
    """Speed of a law, models of the robot and its cameras, and conditions that end a run."""

    speed_scale: Number = Field(1.0, gt=0, le=1, description="factor of all commanded velocities")
    self_occlusion: Literal["transparent", "opaque"] = Field(
        "transparent",
        description="whether a camera behind the face sees its markers (transparent) or not (opaque)",
    )
    joint_limits: Literal["report", "stop"] = Field(
        "report", description="a joint limit is reported, or stops the run"
    )
    image_border: Literal["report", "stop"] = Field(
        "report", description="a marker outside an image is reported, or stops the run"
    )

    @property
    def opaque(self) -> bool:
        """Whether the face hides its markers from a camera behind it."""
        return self.self_occlusion == "opaque"


class PlantSettings(RunConditions, Rest, ServoLimits, RobotClass):
    """The robot to drive, and the behaviour of a simulated one at its limits.

    ``use`` names the class of an external robot and ``options`` its arguments. The loop never commands an
    external robot beyond its joint limits.
    """

    time_offset_s: Delays | None = Field(
        None,
        description="time from the middle of an exposure to the joint readings that arrive with its "
        "image; a number for all cameras, or {left, right} or other names; null: estimated",
    )
