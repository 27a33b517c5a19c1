"""Objects of the scene that goals are taught on, identified by their markers."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Discriminator, Field, StrictBool
from pydantic import Tag as Kind
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import rigid
from projservo_cli.records import CORNERS, MM, FloatArray
from projservo_cli.settings.features import is_name
from projservo_cli.settings.markers import Tag
from projservo_cli.settings.sections import (
    Note,
    NotNegative,
    Number,
    OneOf,
    Positive,
    Section,
    Vector3,
    Whole,
)

WORLD_AND_TOOL = ("scene", "tool")
"""Carriers of features besides objects; objects cannot have these names."""
_MOST = Field(max_length=250)  # tags
_LEAST = 3  # markers that show how an object is turned
_ENDLESS_S = 1e6  # longer than any run, s


_NUMBERS, _PLACED = "tuple[int]", "tuple[Tag]"  # as pydantic calls kinds of lists, which messages leave out


def _kind(tags: Any) -> str | None:
    """The kind of list that some tags are, of two; None for other values."""
    each = tags if isinstance(tags, (list, tuple)) else ()
    if each and all(isinstance(one, (dict, Tag)) for one in each):
        return _PLACED
    return _NUMBERS if each and all(type(one) is int for one in each) else None


_Tags = Annotated[
    Annotated[tuple[Whole, ...], _MOST, Kind(_NUMBERS)] | Annotated[tuple[Tag, ...], _MOST, Kind(_PLACED)],
    Discriminator(
        _kind,
        custom_error_type="tags",
        custom_error_message="must be numbers of tags, or {number, size_m, pose} of each where it is "
        "simulated",
    ),
]


class Displacement(Section):
    """A motion of an object, in the base frame."""

    translation_m: Vector3 = Field((0.0, 0.0, 0.0), description="of the middle of its markers")
    rotation_deg: Vector3 = Field((0.0, 0.0, 0.0), description="rotation vector, about that middle")

    def about(self, middle: FloatArray) -> FloatArray:
        """Return it as a matrix (4, 4), the middle (3,) of the markers given, m."""
        R = Rotation.from_rotvec(self.rotation_deg, degrees=True)
        return rigid(R, middle - R.apply(middle) + self.translation_m)


class Velocity(Section):
    """A steady motion of an object, in the base frame."""

    translation_mm_s: Vector3 = Field((0.0, 0.0, 0.0), description="of the middle of its markers")
    rotation_deg_s: Vector3 = Field((0.0, 0.0, 0.0), description="about that middle")


_Row = tuple[Number, Number, Number, Number, Number, Number, Number]


class ObjectSettings(OneOf):
    """Markers of an object, whether it is followed, and where it is in a simulation."""

    one_of = ("tags", "markers")
    tags: _Tags | None = Field(
        None,
        description="numbers of its tags; in a simulation {number, size_m, pose} of each, the pose in the "
        "base frame when the goal was taught",
    )
    markers: tuple[Whole, ...] | None = Field(None, description="instead of tags: numbers of its markers")
    positions_m: tuple[Vector3, ...] | None = Field(
        None, description="in a simulation: these markers in the base frame when the goal was taught"
    )
    displacement: Displacement = Field(
        Displacement(), description="in a simulation: how it has moved since the goal was taught"
    )
    follow: StrictBool = Field(
        False,
        description="whether a goal on it is carried along while a law runs, so that the object may move: "
        "a belt, a turntable",
    )
    acceleration: Positive = Field(
        20.0,
        description="expected changes of its velocity, standard deviation after 1 s: mm/s² if a length on "
        "the tool is known, otherwise px/s²",
    )
    max_acceleration: Positive = Field(
        1000.0, description="acceleration, likewise, beyond which it was pushed or taken, so that a run ends"
    )
    max_speed_mm_s: Positive | None = Field(
        None,
        description="speed of the object, px/s if no length is known, beyond which a run ends as too fast; "
        "null: any",
    )
    lost_s: NotNegative = Field(
        0.5, description="time for which its motion is predicted while no camera shows it"
    )
    approach_mm: NotNegative = Field(
        0.0, description="distance of the tool from the goal within which its motion is not predicted"
    )
    velocity: Velocity | None = Field(None, description="in a simulation: its velocity from the start on")
    path: Annotated[tuple[_Row, ...], Field(min_length=2)] | None = Field(
        None,
        description="in a simulation, instead of velocity: rows t_s, x_mm, y_mm, z_mm, rx_deg, ry_deg, "
        "rz_deg of its displacement since the start, in the base frame, straight in between",
    )

    @property
    def motion(self) -> FloatArray | None:
        """Rows (k, 7) of a time, s, and its displacement since the start, m and rad; None if it rests."""
        units = np.array([1.0, *[1.0 / MM] * 3, *[np.radians(1.0)] * 3])
        if (steady := self.velocity) is not None:
            each_s = np.array([1.0, *steady.translation_mm_s, *steady.rotation_deg_s])
            return np.asarray(np.stack([0.0 * each_s, _ENDLESS_S * each_s]) * units)
        return None if self.path is None else np.asarray(np.array(self.path) * units)

    @property
    def placed(self) -> tuple[Tag, ...]:
        """Tags whose places are given."""
        return tuple(tag for tag in self.tags or () if isinstance(tag, Tag))

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of its markers."""
        tags = [tag.number if isinstance(tag, Tag) else tag for tag in self.tags or ()]
        return self.markers or tuple(CORNERS * tag + k for tag in tags for k in range(CORNERS))

    @property
    def is_placed(self) -> bool:
        """Whether its place in a simulation is given."""
        return bool(self.placed) or self.positions_m is not None

    @property
    def points(self) -> FloatArray | None:
        """Its markers (k, 4) when the goal was taught, in the base frame, m; None if not given."""
        if not self.is_placed:
            return None
        points = np.concatenate([tag.corners for tag in self.placed]) if self.placed else self.positions_m
        return np.asarray(np.c_[points, np.ones(len(self.numbers))])

    @property
    def normals(self) -> FloatArray:
        """Directions (k, 3) that its tags look in; zero for markers that are seen from anywhere."""
        if not self.placed:
            return np.zeros((len(self.numbers), 3))
        return np.repeat([tag.normal for tag in self.placed], CORNERS, axis=0)

    @property
    def moved(self) -> FloatArray:
        """Its displacement (4, 4) since the goal was taught, in the base frame."""
        assert self.points is not None
        return self.displacement.about(self.points[:, :3].mean(axis=0))

    def of_kind(self) -> Iterator[Note]:
        """Too few markers or the same twice, and places of others than these."""
        if len({*self.numbers}) < len(self.numbers):
            yield (self.kind,), "a number occurs here twice"
        if len(self.numbers) < _LEAST:
            what = f"{len(self.numbers)} markers do not show how it is turned: name {_LEAST} or more"
            yield (self.kind,), what
        elif self.positions_m is not None and len(self.positions_m) != len(self.numbers):
            yield ("positions_m",), f"{len(self.positions_m)} positions_m for {len(self.numbers)} markers"
        yield from self._of_motion()

    def _of_motion(self) -> Iterator[Note]:
        """Yield a motion of an object that is nowhere, one given twice, and times that do not grow."""
        if moves := self.given("velocity", "path"):
            if not self.is_placed:
                yield (moves[0],), "moves an object of a simulation: give size_m and pose of its tags"
            if len(moves) > 1:
                yield ("path",), "gives its motion as velocity does: leave one out"
        if self.path is not None and (np.diff([row[0] for row in self.path]) <= 0.0).any():
            yield ("path",), "its times must grow from row to row"


class Objects(Section):
    """Objects by their names, and how far they may be from where the goal was taught.

    Any other key is the name of an object.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, ObjectSettings]

    max_displacement_m: Positive = Field(
        0.5,
        description="displacement of an object beyond which servo asks first (--confirm) or refuses; needs a "
        "known length on the tool",
    )
    max_rotation_deg: Positive = Field(90.0, description="rotation of an object, likewise")
    max_goal_deviation_mm: Positive = Field(
        5.0, description="standard deviation of a carried goal that plan accepts, if a length is known"
    )
    max_goal_deviation_px: Positive = Field(
        5.0, description="likewise of its images, rms per marker and view"
    )

    @property
    def named(self) -> Mapping[str, ObjectSettings]:
        """Return the objects by their names."""
        return self.model_extra or {}

    def contradictions(self) -> Iterator[Note]:
        """Yield names that are none, and markers of two objects."""
        owner = dict[int, str]()
        for name, one in self.named.items():
            if name in WORLD_AND_TOOL or not is_name(name):
                yield (name,), "is no name of an object: small letters, digits and _, and not scene or tool"
            for number in one.numbers:
                if owner.setdefault(number, name) != name:
                    yield (name,), f"marker {number} is of {owner[number]} as well: name others"
                    break
