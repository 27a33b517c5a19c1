"""The task, the motion to its goal, and regions of the images that the motion keeps out of."""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Annotated, Literal

from pydantic import Field, StrictBool, StrictInt

from projservo_cli.config.robot import (
    Count,
    Finding,
    JointVector,
    NotNegative,
    Positive,
    Section,
    Vector2,
    Whole,
)
from projservo_cli.nominal import Number, Vector3


class _Perturbation(Section):
    """A small displacement of the goal pose, in the tool frame."""

    translation_m: Vector3 = Field((0.0, 0.0, 0.0), description="along the axes of the tool")
    rotation_rad: Vector3 = Field((0.0, 0.0, 0.0), description="rotation vector in the axes of the tool")


_Pixels = tuple[Vector2 | None, ...]
_Deviations = tuple[NotNegative | None, ...]


class _GoalImages(Section):
    """Pixels of the face at the goal, perhaps of further markers, and with how sure they are."""

    markers: Annotated[tuple[Whole, ...], Field(min_length=1)] | None = Field(
        None, description="numbers of the markers that pixels are of; null for those of markers.face"
    )
    left: _Pixels = Field(description="u and v of each marker in the left image, px; null where unseen")
    right: _Pixels = Field(description="u and v of each marker in the right image, px; null where unseen")
    sigma_left_px: _Deviations | None = Field(
        None, description="standard deviation of each marker in the left image; null for noise.servo_px"
    )
    sigma_right_px: _Deviations | None = Field(None, description="the same of the right image")
    joints: JointVector | None = Field(
        None, description="joint readings there, of which a start is made where task.start names the file"
    )

    def pixels(self, face: Sequence[int]) -> dict[int, tuple[Vector2, Vector2]]:
        """Left and right pixel of each marker, NaN where unseen; ``face`` are numbers of its markers."""
        unseen = math.nan, math.nan
        each = zip(self.markers or face, self.left, self.right, strict=True)
        return {number: (left or unseen, right or unseen) for number, left, right in each}

    def deviations(self, numbers: Sequence[int], face: Sequence[int]) -> list[list[float]]:
        """Standard deviation of markers in the left and in the right image, px; NaN where it is not told."""
        own = list(self.markers or face)
        sides = [side or (None,) * len(own) for side in (self.sigma_left_px, self.sigma_right_px)]
        told = [dict(zip(own, side, strict=True)) for side in sides]
        return [[math.nan if (x := side.get(number)) is None else x for number in numbers] for side in told]

    def sigma_px(self, face: Sequence[int]) -> float | None:
        """Standard deviation of a coordinate of the markers of the face, rms; None where it is not told."""
        told = [sigma**2 for side in self.deviations(face, face) for sigma in side]
        return None if any(map(math.isnan, told)) else math.sqrt(sum(told) / len(told))


class Goal(Section):
    """The goal: joint readings, a turn about the rig's roll axis, or the face's goal images."""

    joints: JointVector | None = Field(None, description="joint readings at the goal")
    roll_deg: Number | None = Field(
        None, ge=-360, le=360, description="turn from the start about the roll axis of the rig"
    )
    perturbation: _Perturbation | None = Field(
        None, description="small displacement of a goal given by roll_deg, in the tool frame"
    )
    images: _GoalImages | None = Field(None, description="pixels of the face, recorded at the goal")

    def contradictions(self) -> Iterator[Finding]:
        """No goal, or several."""
        kinds = [name for name in ("joints", "roll_deg", "images") if getattr(self, name) is not None]
        if len(kinds) != 1:
            given = f", not {' and '.join(kinds)}" if kinds else ""
            yield (), f"give exactly one of joints, roll_deg and images{given}"
        if self.perturbation is not None and self.roll_deg is None:
            yield ("perturbation",), "belongs to a goal given by roll_deg"


class TaskSettings(Section):
    """A reaching task from ``start`` to ``goal``.

    ``start_offset`` moves the start alone: a goal that is a turn stays that of the start without it.
    """

    start: JointVector = Field(description="joint readings at the start")
    start_offset: JointVector | None = Field(
        None, description="added to the start alone; the goal stays what it is without"
    )
    goal: Goal


_Polygon = Annotated[tuple[Vector2, ...], Field(min_length=3, max_length=200)]


class KeptOut(Section):
    """What an obstacle covers in the images: simple polygons, convex or not, in pixels."""

    left: _Polygon | None = Field(None, description="corners u and v in the left image; null for none there")
    right: _Polygon | None = Field(None, description="corners u and v in the right image; null for none")
    occludes: StrictBool = Field(
        True, description="whether the obstacle may hide markers: those of the face stay beside it in both"
    )

    def contradictions(self) -> Iterator[Finding]:
        """No polygon, or one that is none."""
        if self.left is None and self.right is None:
            yield (), "give left, right or both: the corners of what the obstacle covers there"
        for side, corners in (("left", self.left), ("right", self.right)):
            if corners is not None and (what := _not_simple(corners)):
                yield (side,), what


def _not_simple(corners: Sequence[Vector2]) -> str:
    """Why corners are not those of a polygon that somebody drew; empty where they are."""
    edges = list(zip(corners, (*corners[1:], corners[0]), strict=True))
    for (i, first), (j, second) in combinations(enumerate(edges), 2):
        if 1 < j - i < len(edges) - 1 and _meet(*first, *second):
            return (
                f"the edges from corners {i + 1} and {j + 1} meet: draw an outline that does not cross itself"
            )
    if sum(a[0] * b[1] - b[0] * a[1] for a, b in edges) == 0.0:
        return "the polygon has no area: its corners lie on one line"
    return ""


def _turn(a: Vector2, b: Vector2, c: Vector2) -> float:
    """Twice the area of a triangle, with its sense."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _meet(a: Vector2, b: Vector2, c: Vector2, d: Vector2) -> bool:
    """Whether the segments a–b and c–d have a point in common."""
    boxes_apart = any(max(a[i], b[i]) < min(c[i], d[i]) or max(c[i], d[i]) < min(a[i], b[i]) for i in (0, 1))
    if boxes_apart:
        return False
    return _turn(a, b, c) * _turn(a, b, d) <= 0.0 and _turn(c, d, a) * _turn(c, d, b) <= 0.0


class _Search(Section):
    """How long the profile ``joint_space`` searches, and with which random numbers."""

    max_samples: Count = Field(20_000, description="joint vectors that two trees grow towards, at most")
    seed: Whole = Field(0, description="of the random numbers; the same seed gives the same way")


class Trajectory(Section):
    """How the planned motion is spread over σ in [0, 1], and what it keeps to where it is searched for.

    ``joint`` leads through joint space to any joints that show the goal; ``auto`` is ``linear`` where that
    keeps every constraint, else ``constrained``, else ``joint``.
    """

    profile: Literal[
        "linear",
        "exponential",
        "rotation_first",
        "translation_first",
        "planar_first",
        "constrained",
        "joint_space",
        "auto",
    ] = Field("linear", description="which part is driven when, or a way through joint space")
    visibility_fraction: Number = Field(
        0.9, gt=0, le=1, description="share of the translation at which visibility changes that is kept to"
    )
    n_samples: StrictInt = Field(101, ge=2, le=100_001, description="points of the path that are stored")
    duration_s: Positive | None = Field(
        None, description="time the motion is given; null for as little as the joint-speed limit lets it take"
    )
    acceleration_time_s: NotNegative = Field(
        0.4, description="time in which a planned motion comes up to its pace, and to rest again at its end"
    )
    border_px: NotNegative = Field(
        5.0,
        description="in the profiles constrained and joint_space: least distance of a marker from an image border",
    )
    min_reciprocal_condition: Number = Field(
        0.001,
        ge=0,
        lt=1,
        description="in the profile constrained: least reciprocal condition of the face's image Jacobian",
    )
    max_goal_configurations: Count = Field(
        64, description="joints that show the goal, nearest in time, which joint tries"
    )
    joint_margin_deg: NotNegative = Field(
        1.0, description="in the profile joint_space: least distance from a limit, revolute joints"
    )
    joint_margin_m: NotNegative = Field(
        0.002, description="in the profile joint_space: least distance from a limit, prismatic joints"
    )
    min_face_px: NotNegative = Field(
        8.0,
        description="in the profile joint_space: least width of the face in an image, seen ever more edge-on",
    )
    search: _Search = Field(
        _Search(), description="how long the profile joint_space searches, and from which seed"
    )
    keep_out: Annotated[tuple[KeptOut, ...], Field(max_length=100)] = Field(
        (),
        description="outlines of obstacles, each {left: [[u, v], ...], right: [[u, v], ...], occludes: true}, "
        "that no marker enters, nor what is between those of the face",
    )
