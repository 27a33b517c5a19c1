"""The robot, its rig and its markers, in metric terms: what a simulation takes as true."""

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, Strict, WithJsonSchema

from projservo_cli.records import MODES

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]
Whole = Annotated[int, Strict(), Field(ge=0, le=2**63 - 1)]
Count = Annotated[int, Strict(), Field(ge=1, le=1_000_000)]
Vector2 = tuple[Number, Number]
Vector3 = tuple[Number, Number, Number]
Vector4 = tuple[Number, Number, Number, Number]
Matrix34 = tuple[Vector4, Vector4, Vector4]
Matrix44 = tuple[Vector4, Vector4, Vector4, Vector4]
JointType = Literal["R", "P"]


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


Mode = Literal["replan", "track", "image_track"]
_MODE = {"enum": list(MODES)}
# One mode may stand for a list of it.
Modes = Annotated[
    tuple[Mode, ...],
    BeforeValidator(_listed),
    Field(min_length=1),
    WithJsonSchema({"anyOf": [_MODE, {"type": "array", "items": _MODE, "minItems": 1}]}),
]

IDENTITY: Matrix44 = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)


class Section(BaseModel):
    """A mapping of the configuration: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=False)


class JointVector(Section):
    """Joint readings; ``unit`` is that of the revolute joints, prismatic ones are in metres."""

    joints: tuple[Number, ...] = Field(min_length=1, description="a reading for each joint, base to tool")
    unit: Literal["deg", "rad"] = Field(description="unit of the revolute joints")

    def values(self, joint_types: str) -> tuple[float, ...]:
        """Readings in rad (R) and m (P), one for each letter of ``joint_types``.

        Raises
        ------
        ValueError
            When the numbers of joints differ.
        """
        pairs = zip(self.joints, joint_types, strict=True)
        turn = math.radians if self.unit == "deg" else float
        return tuple(turn(value) if letter == "R" else float(value) for value, letter in pairs)


class Joint(Section):
    """What joints have in common: a type, perhaps a name, perhaps limits."""

    type: JointType = Field(description="R revolute, P prismatic")
    name: str | None = Field(None, description="for messages and figures")
    limits_deg: Vector2 | None = Field(None, description="lowest and highest reading of a revolute joint")
    limits_rad: Vector2 | None = Field(None, description="the same in rad")
    limits_m: Vector2 | None = Field(None, description="lowest and highest reading of a prismatic joint")

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest reading in rad or m; infinite where none is set."""
        if self.limits_deg is not None:
            return math.radians(self.limits_deg[0]), math.radians(self.limits_deg[1])
        return self.limits_rad or self.limits_m or (-math.inf, math.inf)


class DHJoint(Joint):
    """A row of a Denavit-Hartenberg table; the joint reading adds to theta (R) or d (P)."""

    theta_deg: Number = Field(0.0, description="turn about z")
    d_m: Number = Field(0.0, description="shift along z")
    a_m: Number = Field(0.0, description="shift along x")
    alpha_deg: Number = Field(0.0, description="turn about x")


class ScrewJoint(Joint):
    """A spatial twist (w, v) in the base frame at the reference, per rad or per m."""

    w: Vector3 = Field(description="unit axis of a revolute joint, zero for a prismatic one")
    v: Vector3 = Field(description="-w × a point of the axis, m; unit direction of a prismatic joint")


class DH(Section):
    """A Denavit-Hartenberg table, standard or modified (Craig)."""

    convention: Literal["standard", "modified"] = Field("standard", description="of the table")
    joints: tuple[DHJoint, ...] = Field(min_length=1, max_length=64, description="rows, base to tool")
    tool: Matrix44 = Field(IDENTITY, description="pose of the tool in the last joint's frame, m")


class Screws(Section):
    """Joint screws at a reference: T(q) = Π exp(screw_i (q_i − reference_i)) · base_tool."""

    reference: JointVector = Field(description="joint readings at which the screws hold")
    base_tool: Matrix44 = Field(description="pose of the tool in the base frame there, m")
    joints: tuple[ScrewJoint, ...] = Field(min_length=1, max_length=64, description="screws, base to tool")


class Robot(Section):
    """A serial arm, given by a DH table or by screws."""

    name: str = Field("", description="for figures and reports")
    dh: DH | None = Field(None, description="a Denavit-Hartenberg table")
    screws: Screws | None = Field(None, description="joint screws at a reference, instead of dh")

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The joints from base to tool."""
        kinematics = self.dh or self.screws
        return kinematics.joints if kinematics is not None else ()

    @property
    def joint_types(self) -> str:
        """One letter a joint, R or P."""
        return "".join(joint.type for joint in self.joints)

    @property
    def limits(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest reading of each joint, rad or m; infinite where none is set."""
        return tuple(joint.limits for joint in self.joints)


class Camera(Section):
    """A pinhole camera: a 3×4 matrix from the base frame to pixels, or a look-at description."""

    matrix: Matrix34 | None = Field(None, description="3×4 matrix from the base frame, m, to pixels")
    focal_px: tuple[Positive, Positive] | None = Field(None, description="focal lengths along u and v")
    principal_point_px: Vector2 | None = Field(None, description="where the optical axis meets the image")
    position_m: Vector3 | None = Field(None, description="optical centre in the base frame")
    target_m: Vector3 | None = Field(None, description="point that the camera looks at")
    up: Vector3 = Field((0.0, 0.0, 1.0), description="direction that is up in the image")


class Rig(Section):
    """Two cameras that look at the robot and do not move."""

    image_size_px: tuple[Whole, Whole] = Field(description="width and height")
    left: Camera = Field(description="the left camera")
    right: Camera = Field(description="the right camera")


class Markers(Section):
    """Points fixed to the tool; the face is the part of them that must stay visible."""

    positions_m: tuple[Vector3, ...] | None = Field(
        None, min_length=1, max_length=10_000, description="in the frame of the tool"
    )
    numbers: tuple[Whole, ...] | None = Field(
        None, min_length=1, description="number of each marker; null for 0, 1, 2 ..."
    )
    face: tuple[Whole, ...] | None = Field(
        None, min_length=3, description="numbers of those in a plane that must stay visible"
    )
    center: Literal["midpoint"] | Whole = Field("midpoint", description="of the face: midpoint, or a number")

    @property
    def known(self) -> tuple[int, ...] | None:
        """Numbers of all markers, in the order of ``positions_m``; None where a table will tell."""
        if self.numbers is None and self.positions_m is not None:
            return tuple(range(len(self.positions_m)))
        return self.numbers
