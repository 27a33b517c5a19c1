"""Control laws, their modes and gains, and the speed limits of joints."""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, WithJsonSchema
from pydantic_core import PydanticCustomError

from projservo_cli import plugins
from projservo_cli.laws import CONVERGING_LAWS, LAWS, PAPER_LAWS, mode_in
from projservo_cli.settings.sections import Note, Positive, Section, Whole


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


_TARGET = {"type": "string", "pattern": plugins.TARGET}


# A registered name is stored as its class, so that a run can be read if it is not installed.
_Law = Annotated[str, AfterValidator(_law), WithJsonSchema({"anyOf": [{"enum": list(LAWS)}, _TARGET]})]


def one_or_more(value: Any) -> Any:
    """A text means a list of it alone."""
    return [value] if isinstance(value, str) else value


_Mode = Literal["regulate", "track", "image_track"]
_Modes = Annotated[tuple[_Mode, ...], Field(min_length=1)]


# Accelerations that the profile joint_space takes if no limit is given, deg/s² and m/s².
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
        "image_track follow the plan; a list runs each law in the modes that it "
        "has",
    )
    must_converge: tuple[_Law, ...] | None = Field(
        None,
        description="laws that fail the call (exit code 1) if they do not converge; null: "
        f"{', '.join(CONVERGING_LAWS)} and plug-in laws",
    )


class LawSettings(Section):
    """Period and gains of the control laws, and the treatment of plans that no joints follow."""

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
        """Limits of the joints, infinite if no speed is given."""
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
