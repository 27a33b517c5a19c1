"""The robot and its rig, in metric terms: the truth of a simulation."""

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from projservo_cli.geometry.displacements import screws
from projservo_cli.geometry.flange import FLANGE_TYPES, FlangeChart
from projservo_cli.records import MM, TWO_TURNS
from projservo_cli.settings.sections import (
    ByView,
    JointVector,
    Limits,
    Matrix34,
    Note,
    NotNegative,
    Number,
    OneOf,
    Pose,
    Positive,
    Section,
    Sizes,
    Text,
    Vector2,
    Vector3,
    not_a_screw,
)

_IDENTITY: Pose = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)
# Limits in rad of two turns to a side or less; limits of continuous joints in files exceed any in degrees.
_MOST_DEG = 1000.0


def like_degrees(low: float, high: float) -> str:
    """Return a reason if limits of a revolute joint look like degrees, not rad; otherwise an empty text."""
    alike = TWO_TURNS < max(abs(low), abs(high)) <= _MOST_DEG
    return f"{low:g} to {high:g} rad is more than two turns to a side: degrees?" if alike else ""


class _Joint(Section):
    """Common keys of joints: a type, optional name and limits."""

    type: Literal["R", "P"] = Field(description="R: revolute, P: prismatic")
    name: str | None = Field(None, description="name in messages and figures")
    limits_deg: Limits | None = Field(None, description="minimum and maximum reading of a revolute joint")
    limits_rad: Limits | None = Field(None, description="minimum and maximum reading of a revolute joint")
    limits_m: Limits | None = Field(None, description="minimum and maximum reading of a prismatic joint")

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest reading in rad or m; infinite if none is set."""
        if self.limits_deg is not None:
            return math.radians(self.limits_deg[0]), math.radians(self.limits_deg[1])
        return self.limits_rad or self.limits_m or (-math.inf, math.inf)

    def contradictions(self) -> Iterator[Note]:
        """Limits in two units, or of the other type of joint."""
        given = self.given("limits_deg", "limits_rad", "limits_m")
        if len(given) > 1:
            yield (given[1],), f"{given[0]} is set as well; keep one"
        for name in given:
            if (name == "limits_m") != (self.type == "P"):
                units = "limits_m" if self.type == "P" else "limits_deg or limits_rad"
                yield (name,), f"a joint of type {self.type} takes {units}"
        if self.limits_rad is not None and (what := like_degrees(*self.limits_rad)):
            yield ("limits_rad",), f"{what} set limits_deg"


class _DHJoint(_Joint):
    """A row of a Denavit-Hartenberg table; the joint reading adds to theta (R) or d (P)."""

    theta_deg: Number = Field(0.0, description="rotation about z")
    d_m: Number = Field(0.0, description="translation along z")
    a_m: Number = Field(0.0, description="translation along x")
    alpha_deg: Number = Field(0.0, description="rotation about x")


class _ScrewJoint(_Joint):
    """A spatial twist (w, v) in the base frame at the reference, per rad or per m."""

    w: Vector3 = Field(description="unit axis of a revolute joint, zero for a prismatic one")
    v: Vector3 = Field(description="-w × a point of the axis, m; unit direction of a prismatic joint")

    def contradictions(self) -> Iterator[Note]:
        """Wrong limits, an axis that is not of unit length, or a joint that turns and slides."""
        yield from super().contradictions()
        yield from (((key,), what) for key, what in not_a_screw(self.type, self.w, self.v))


class DHTable(Section):
    """A Denavit-Hartenberg table, standard or modified (Craig)."""

    convention: Literal["standard", "modified"] = Field(
        "standard", description="convention of the table; modified is Craig's"
    )
    joints: tuple[_DHJoint, ...] = Field(
        min_length=1, max_length=64, description="rows of the table, base to tool"
    )
    tool: Pose = Field(_IDENTITY, description="pose of the tool in the frame of the last joint, m")


class Screws(Section):
    """Joint screws at a reference: T(q) = Π exp(screw_i (q_i − reference_i)) · base_tool."""

    reference: JointVector = Field(description="joint readings of the pose in which the screws are given")
    base_tool: Pose = Field(description="pose of the tool in the base frame at the reference, m")
    joints: tuple[_ScrewJoint, ...] = Field(
        min_length=1, max_length=64, description="joint screws, base to tool"
    )

    def contradictions(self) -> Iterator[Note]:
        """A reading too many or too few."""
        yield from self.reference.miscounted("".join(joint.type for joint in self.joints), "reference")


class FlangeSettings(Section):
    """A controller that takes poses of the flange in the base, p_base = T p_flange, instead of joints.

    Readings are the shift from home along the axes of the base, m, then turns through the flange about its
    x, y and z at home: two that tilt its axis, and a spin about it.
    """

    home: Pose = Field(description="pose of the flange from which readings count, m: its middle, if any")
    box_mm: tuple[Limits, Limits, Limits] = Field(
        description="minimum and maximum x, y, z of the flange in the base"
    )
    max_tilt_deg: Annotated[Positive, Field(le=80.0)] = Field(
        45.0, description="maximum tilt about x and about y of the flange, from home"
    )
    max_spin_deg: Annotated[Positive, Field(le=180.0)] = Field(
        180.0, description="maximum turn about z of the flange, from home"
    )
    max_speed_mm_s: Positive = Field(100.0, description="maximum speed along each axis")
    max_turn_deg_s: Positive = Field(30.0, description="maximum speed of each turn")

    @property
    def chart(self) -> FlangeChart:
        """Chart of its readings."""
        home = np.array(self.home)
        return FlangeChart(home[:3, :3], home)

    def contradictions(self) -> Iterator[Note]:
        """A home outside the box."""
        for i, (low, high) in enumerate(self.box_mm):
            if not low < MM * self.home[i][3] < high:
                at = f"home has {'xyz'[i]} {MM * self.home[i][3]:g} mm"
                yield ("box_mm",), f"{at}, which is not between {low:g} and {high:g}"


@lru_cache(maxsize=32)  # asked for wherever the joints of a robot are
def _screws_of(flange: FlangeSettings) -> Screws:
    """Readings of poses of the flange as joints of an arm."""
    place = np.array(flange.home)[:3, 3]
    slides = ((np.array(flange.box_mm) / MM - place[:, None]) + 0.0).tolist()
    turns = [[-turn, turn] for turn in (flange.max_tilt_deg, flange.max_tilt_deg, flange.max_spin_deg)]
    joints = [
        {"type": kind, "name": name, "w": w.tolist(), "v": v.tolist(), unit: limits}
        for kind, name, (w, v), unit, limits in zip(
            FLANGE_TYPES,
            ("x", "y", "z", "tilt about x", "tilt about y", "spin"),
            screws(flange.chart.H_hat).reshape(6, 2, 3),
            ["limits_m"] * 3 + ["limits_deg"] * 3,
            slides + turns,
            strict=True,
        )
    ]
    reference = {"joints": [0.0] * 6, "unit": "rad"}
    return Screws.model_validate({"reference": reference, "base_tool": flange.home, "joints": joints})


class LimitSettings(OneOf):
    """Joint limits of a robot without kinematics in the configuration."""

    one_of = ("joints", "from_data")
    joints: Annotated[tuple[Limits, ...], Field(min_length=1, max_length=64)] | None = Field(
        None, description="minimum and maximum reading of each joint, base to tool"
    )
    unit: Literal["deg", "rad"] | None = Field(None, description="unit of the revolute joints")
    from_data: NotNegative | None = Field(
        None,
        description="limits from recorded data: the range of each joint, extended at both ends by "
        "this fraction",
    )

    def contradictions(self) -> Iterator[Note]:
        """Two ways to say them or none, or a unit too many or too few."""
        yield from super().contradictions()
        if (self.joints is None) != (self.unit is None):
            yield ("unit",), "applies to joints: give both or neither"

    def values(self, joint_types: str) -> tuple[tuple[float, float], ...]:
        """Those that are given, in rad (R) and m (P), one for each letter of ``joint_types``.

        Raises ValueError when the numbers of joints differ.
        """
        turned = {"R": math.radians if self.unit == "deg" else float, "P": float}
        pairs = zip(self.joints or (), joint_types, strict=True)
        return tuple((turned[letter](low), turned[letter](high)) for (low, high), letter in pairs)


class RobotSettings(Section):
    """A serial arm, given by a DH table, by screws or in a file; limits alone for an external robot.

    The screws of a file are added to ``mjcf``, or replace ``urdf``.
    """

    name: str = Field("", description="name in figures and reports")
    dh: DHTable | None = Field(None, description="Denavit-Hartenberg table")
    screws: Screws | None = Field(None, description="joint screws at a reference")
    mjcf: Text | None = Field(
        None, description="path of a MuJoCo model, which the plant mujoco simulates and renders"
    )
    urdf: Text | None = Field(None, description="path of a URDF, of which only the screws are read")
    flange: FlangeSettings | None = Field(
        None, description="limits of a controller that takes poses of the flange instead of joints"
    )
    tip: str | None = Field(None, description="body or site of mjcf, or link of urdf, that carries the tool")
    limits: LimitSettings | None = Field(None, description="joint limits of a robot without dh and screws")

    @property
    def joints(self) -> tuple[_Joint, ...]:
        """The joints from base to tool."""
        return self.kinematics.joints if self.kinematics is not None else ()

    @property
    def kinematics(self) -> DHTable | Screws | None:
        """The description of its joints; None for limits alone, or before a file is read."""
        return self.dh or self.twists

    @property
    def twists(self) -> Screws | None:
        """Joint screws, as given or of poses of the flange."""
        return self.screws if self.flange is None else _screws_of(self.flange)

    @property
    def joint_types(self) -> str:
        """One letter a joint, R or P."""
        return "".join(joint.type for joint in self.joints)

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest reading of each joint of dh or screws, rad or m; infinite if none is set."""
        return tuple(joint.limits for joint in self.joints)

    def contradictions(self) -> Iterator[Note]:
        """Yield missing or several descriptions of joints and limits; a file without a tip."""
        screws = None if self.mjcf is not None else self.screws  # screws of the file
        if (self.dh, screws, self.mjcf, self.urdf, self.limits, self.flange).count(None) != 5:
            yield (), "give exactly one of dh, screws, mjcf, urdf, flange and, for an external robot, limits"
        if (self.tip is None) != (self.mjcf is None and self.urdf is None):
            yield ("tip",), "names the body of mjcf, or the link of urdf, that holds the tool: give both"


class Camera(Section):
    """A pinhole camera: a 3×4 matrix from the base frame to pixels, or a look-at description."""

    matrix: Matrix34 | None = Field(
        None, description="3×4 projection matrix from the base frame, m, to pixels"
    )
    focal_px: tuple[Positive, Positive] | None = Field(None, description="focal lengths along u and v")
    principal_point_px: Vector2 | None = Field(None, description="principal point")
    position_m: Vector3 | None = Field(None, description="optical centre in the base frame")
    target_m: Vector3 | None = Field(None, description="point at which the camera looks, in the base frame")
    up: Vector3 = Field((0.0, 0.0, 1.0), description="direction in the base frame that is up in the image")
    lens: Vector2 = Field(
        (0.0, 0.0),
        description="radial distortion k1 and k2 of a simulated camera that sees points, in units of the "
        "focal length",
    )

    def contradictions(self) -> Iterator[Note]:
        """Two descriptions, half a one, or one that is no camera."""
        wanted = ("focal_px", "principal_point_px", "position_m", "target_m")
        given = self.given(*wanted)
        missing = [name for name in wanted if name not in given]
        if self.matrix is not None:
            if given:
                yield (given[0],), "matrix is set as well; keep one description of the camera"
            P = np.array(self.matrix)
            if not P.any() or abs(np.linalg.det(P[:, :3] / abs(P).max())) < 1e-12:
                yield ("matrix",), "its left 3×3 block is singular: no finite pinhole camera"
        elif missing:
            missing_text = f" (missing: {', '.join(missing)})" if given else ""
            yield (), f"give matrix, or all of {', '.join(wanted)}{missing_text}"
        elif self.position_m == self.target_m:
            yield ("target_m",), "is the position of the camera; it must look somewhere"
        else:
            sight, up = np.array(self.target_m) - np.array(self.position_m), np.array(self.up)
            if abs(sight @ up) >= (1 - 1e-9) * np.linalg.norm(sight) * np.linalg.norm(up):
                yield ("up",), "must not be zero or along the line of sight"


class Rig(ByView):
    """Cameras by their names, which watch the robot, or are on its tool and watch the scene."""

    __pydantic_extra__: dict[str, Camera]

    image_size_px: Sizes = Field(description="width and height of all images, or of each")
    mount: Literal["world", "tool"] = Field(
        "world",
        description="world: fixed cameras, given in the base frame; tool: they are on it, given in its "
        "frame, and markers belong to the scene, given in the base frame",
    )

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras by their names."""
        return self.by_view

    def contradictions(self) -> Iterator[Note]:
        """No camera, a name that no column can have, or sizes of other numbers of images."""
        yield from super().contradictions()
        names = [*self.cameras]
        if not names:
            yield (), "has no camera: give one or more by their names, such as left and right"
        if np.ndim(self.image_size_px) > 1 and len(self.image_size_px) != len(names):
            yield ("image_size_px",), f"{len(self.image_size_px)} sizes for {len(names)} cameras"
