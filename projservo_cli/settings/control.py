"""Control laws, the robot to drive, and when a run of it ends."""

import json
import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, StrictInt, WithJsonSchema
from pydantic_core import PydanticCustomError

from projservo_cli import plugins
from projservo_cli.laws import BODY_LAWS, LAWS, PAPER_LAWS, mode_in
from projservo_cli.settings.disturbance import Delays
from projservo_cli.settings.sections import Count, Note, NotNegative, Number, Positive, Section, Whole


def _law(name: str) -> str:
    target = name if name in LAWS else plugins.target_of("law", name)
    if target is None and ":" in name:
        raise ValueError("must be module:Class, such as my_laws:Law")
    if target is None:
        if remedy := mode_in(name):
            raise ValueError(remedy)
        valid = ", ".join(map(repr, (*LAWS, *plugins.registered_names("law"))))
        raise PydanticCustomError("literal_error", "is not one of them", {"expected": valid})
    return target


RENDERED = "mujoco"
"""The plant that is simulated and rendered by MuJoCo."""


def _plant(name: str) -> str:
    target = name if name == RENDERED else plugins.target_of("plant", name)
    if target is None:
        names = ", ".join((RENDERED, *plugins.registered_names("plant")))
        raise ValueError(f"must be module:Class, such as my_robot:Robot, or one of {names}")
    return target


_TARGET = {"type": "string", "pattern": plugins.TARGET}


# A registered name is stored as the class it stands for, so that a run can be read where it is not installed.
_Law = Annotated[str, AfterValidator(_law), WithJsonSchema({"anyOf": [{"enum": list(LAWS)}, _TARGET]})]
_PlantClass = Annotated[str, AfterValidator(_plant), WithJsonSchema({"type": "string"})]


def _as_given(value: Any) -> Any:
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError("takes text, finite numbers, true, false, null, lists and mappings") from error
    return value


Plain = Annotated[Any, AfterValidator(_as_given)]


def one_or_more(value: Any) -> Any:
    """Some text stands for a list of it alone."""
    return [value] if isinstance(value, str) else value


_Mode = Literal["regulate", "track", "image_track"]
_Modes = Annotated[tuple[_Mode, ...], Field(min_length=1)]


# Accelerations that the profile joint_space takes where no limit is given, deg/s² and m/s².
_ACCELERATION_DEG_S2, _ACCELERATION_M_S2 = 500.0, 2.0


class SpeedLimits(NamedTuple):
    """Speed and acceleration limits of joints: per s and per s², rad (revolute) and m (prismatic)."""

    revolute: float = math.inf
    prismatic: float = math.inf
    turning: float = math.inf  # acceleration
    sliding: float = math.inf


class LawChoice(Section):
    """Control laws to run, their modes, and those that must converge."""

    laws: tuple[_Law, ...] = Field(
        PAPER_LAWS,
        min_length=1,
        description="control laws to run, each from the start; module:Class for a plug-in law",
    )
    mode: Annotated[_Modes, BeforeValidator(one_or_more, json_schema_input_type=_Mode | _Modes)] = Field(
        ("regulate",),
        description="regulate moves to the goal by the present images in each step; track and "
        "image_track follow the plan; a list runs each law in those of the modes that it "
        "has",
    )
    must_converge: tuple[_Law, ...] | None = Field(
        None,
        description="laws that fail the call (exit code 1) if they do not converge; null: "
        f"{', '.join(BODY_LAWS)} and plug-in laws",
    )


class LawSettings(Section):
    """Period and gains of the control laws, and what becomes of plans that no joints follow."""

    on_plan_failure: Literal["regulate", "refuse"] = Field(
        "regulate",
        description="if no joints follow the plan: regulate runs the law without it, refuse does not "
        "run the law",
    )
    max_replan_attempts: Whole = Field(
        3,
        description="maximum number of replanning attempts of a run, profiles joint_space and auto",
    )
    period_s: Positive = Field(0.04, description="control period")
    gain_t: Positive = Field(2.5, description="gain of the translation, 1/s")
    gain_r: Positive = Field(2.5, description="gain of the rotation onto the plane, 1/s")
    gain_p: Positive = Field(2.5, description="gain of the rotation within the plane, 1/s")
    gain_s: Positive = Field(
        2.5, description="gain of both rotations together, laws direct_two and exact, 1/s"
    )
    ratio_rp: Positive = Field(1.0, description="ratio λ_r/λ_p of both rotations in direct_two")
    gain: Positive = Field(2.5, description="gain of the classical laws, 1/s")
    substeps: Literal["none", "auto"] = Field(
        "auto", description="auto lets the law exact send long steps in parts, none in one"
    )


class Control(LawSettings, LawChoice):
    """Control laws, their modes and gains, and the speed limits of the joints."""

    joint_speed_limit_deg_s: Positive | None = Field(
        125.0, description="speed limit of revolute joints; null: none"
    )
    prismatic_speed_limit_m_s: Positive | None = Field(
        None, description="speed limit of prismatic joints; null: none"
    )
    joint_acceleration_limit_deg_s2: Positive | None = Field(
        None, description="acceleration limit of revolute joints, profile joint_space; null: 500"
    )
    prismatic_acceleration_limit_m_s2: Positive | None = Field(
        None, description="acceleration limit of prismatic joints, profile joint_space; null: 2"
    )
    features: Literal["points", "body"] | None = Field(
        None,
        description="image features of the direct laws: points of the face, or the body of all "
        "visible markers; null: body if the calibration is usable",
    )

    @property
    def speed_limits(self) -> SpeedLimits:
        """Limits of the joints, infinite where no speed is given."""
        turn, slide = self.joint_speed_limit_deg_s, self.prismatic_speed_limit_m_s
        return SpeedLimits(
            math.inf if turn is None else math.radians(turn),
            math.inf if slide is None else slide,
            math.radians(self.joint_acceleration_limit_deg_s2 or _ACCELERATION_DEG_S2),
            self.prismatic_acceleration_limit_m_s2 or _ACCELERATION_M_S2,
        )

    def contradictions(self) -> Iterator[Note]:
        """Gains that overshoot."""
        for name in ("gain_t", "gain_r", "gain_p", "gain_s", "gain"):
            product = getattr(self, name) * self.period_s
            if product >= 1:
                yield (
                    (name,),
                    f"gain · period_s is {product:.3g}; it must stay below 1 for the loop to be stable "
                    f"(below {1 / self.period_s:.3g} 1/s at this period)",
                )


class RenderedOptions(Section):
    """Options of the plant mujoco."""

    servo: Literal["own", "position", "velocity"] = Field(
        "own",
        description="actuators: position or velocity servos; own for those of robot.mjcf, else position",
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
        """The class of a robot of somebody's; empty for a simulated one."""
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
    """For how long a robot stands still before it is looked at, and how many images are averaged then."""

    averaged_frames: StrictInt = Field(
        1, ge=1, le=1000, description="number of images of each pose that record averages"
    )
    settle_s: Positive = Field(
        0.5, description="time for which joints and images rest before a pose is recorded"
    )


class RunConditions(Section):
    """How fast a law drives the robot, what its cameras see, and where a run of it stops."""

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


class Stop(Section):
    """Stopping rules of the closed loop."""

    image_error_px: Positive = Field(0.01, description="image error below which a run has converged, rms")
    noise_factor: NotNegative = Field(
        2.0,
        description="image_error_px grows by this factor × noise.servo_px, or × what pixels state if more",
    )
    max_steps: Count = Field(2000, description="maximum number of commands")
    diverged_factor: Number = Field(
        10.0, gt=1, description="growth of the image error or the distance at which a run has diverged"
    )
    stall_periods: Count = Field(
        20, description="periods in which the error must fall by 1 %, else the run makes no progress"
    )
    max_lost_periods: Whole = Field(
        25, description="periods for which the robot holds while markers are lost"
    )
    max_force_n: Positive | None = Field(
        None,
        description="force on the tool, N, beyond which a run stops; asks force() of the robot class, and "
        "the contacts of plant mujoco; null: any",
    )
    innovation_threshold: NotNegative = Field(
        1.0,
        description="fault detection: a fault is an innovation beyond chance and beyond this factor × "
        "the noise; 0: no detection",
    )


class ReportSettings(Section):
    """Files of the report."""

    formats: tuple[Literal["svg", "pdf", "png"], ...] = Field(
        ("svg",), min_length=1, description="file formats of each figure; the page shows SVG, else PNG"
    )
