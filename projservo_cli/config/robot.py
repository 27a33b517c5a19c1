"""The robot, its rig and its markers, in metric terms: what a simulation takes as true."""

import math
from typing import Literal

from pydantic import Field

from projservo_cli.config.fields import (
    IDENTITY,
    JointType,
    JointVector,
    Matrix34,
    Matrix44,
    Number,
    Positive,
    Section,
    Vector2,
    Vector3,
    Whole,
)


class Joint(Section):
    """What joints have in common: a type, perhaps a name, perhaps limits."""

    type: JointType
    name: str | None = None
    limits_deg: Vector2 | None = None
    limits_rad: Vector2 | None = None
    limits_m: Vector2 | None = None

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest reading in rad or m; infinite where none is set."""
        if self.limits_deg is not None:
            return math.radians(self.limits_deg[0]), math.radians(self.limits_deg[1])
        return self.limits_rad or self.limits_m or (-math.inf, math.inf)


class DHJoint(Joint):
    """A row of a Denavit-Hartenberg table; the joint reading adds to theta (R) or d (P)."""

    theta_deg: Number = 0.0
    d_m: Number = 0.0
    a_m: Number = 0.0
    alpha_deg: Number = 0.0


class ScrewJoint(Joint):
    """A spatial twist (w, v) in the base frame at the reference, per rad or per m."""

    w: Vector3
    v: Vector3


class DH(Section):
    """A Denavit-Hartenberg table, standard or modified (Craig)."""

    convention: Literal["standard", "modified"] = "standard"
    joints: tuple[DHJoint, ...] = Field(min_length=1, max_length=64)
    tool: Matrix44 = IDENTITY


class Screws(Section):
    """Joint screws at a reference: T(q) = Π exp(screw_i (q_i − reference_i)) · base_tool."""

    reference: JointVector
    base_tool: Matrix44
    joints: tuple[ScrewJoint, ...] = Field(min_length=1, max_length=64)


class Robot(Section):
    """A serial arm, given by a DH table or by screws."""

    name: str = ""
    dh: DH | None = None
    screws: Screws | None = None

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The joints from base to tool."""
        return (self.dh or self.screws).joints if self.dh or self.screws else ()  # type: ignore[union-attr]

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

    matrix: Matrix34 | None = None
    focal_px: tuple[Positive, Positive] | None = None
    principal_point_px: Vector2 | None = None
    position_m: Vector3 | None = None
    target_m: Vector3 | None = None
    up: Vector3 = (0.0, 0.0, 1.0)


class Rig(Section):
    """Two cameras that look at the robot and do not move."""

    image_size_px: tuple[Whole, Whole]
    left: Camera
    right: Camera


class Markers(Section):
    """Points fixed to the tool; the face is the part of them that must stay visible."""

    positions_m: tuple[Vector3, ...] | None = Field(None, min_length=1, max_length=10_000)
    numbers: tuple[Whole, ...] | None = Field(None, min_length=1)
    face: tuple[Whole, ...] | None = Field(None, min_length=3)
    center: Literal["midpoint"] | Whole = "midpoint"

    @property
    def known(self) -> tuple[int, ...] | None:
        """Numbers of all markers, in the order of ``positions_m``; None where a table will tell."""
        if self.numbers is None and self.positions_m is not None:
            return tuple(range(len(self.positions_m)))
        return self.numbers
