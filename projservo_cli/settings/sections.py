"""Sections of a configuration: frozen values, each with its unit in its name, and their contradictions."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, cast

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    Strict,
    StringConstraints,
    ValidationInfo,
    WithJsonSchema,
    WrapValidator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from projservo_cli.image_size import view_named
from projservo_cli.records import VIEW_NAME, VIEWS, FloatArray
from projservo_cli.settings.units import of_another_unit

Number = Annotated[float, Strict()]
Vector2 = tuple[Number, Number]
Vector3 = tuple[Number, Number, Number]
_Vector4 = tuple[Number, Number, Number, Number]
Matrix34 = tuple[_Vector4, _Vector4, _Vector4]
Matrix44 = tuple[_Vector4, _Vector4, _Vector4, _Vector4]
Positive = Annotated[float, Strict(), Field(gt=0)]
NotNegative = Annotated[float, Strict(), Field(ge=0)]
Whole = Annotated[int, Strict(), Field(ge=0, le=2**63 - 1)]
Count = Annotated[int, Strict(), Field(ge=1, le=1_000_000)]
Text = Annotated[str, StringConstraints(min_length=1)]
"""Text that is not empty, such as the path of a file."""


def _limits(limits: Vector2) -> Vector2:
    """Two limits, the lower first; otherwise ValueError."""
    low, high = limits
    if low >= high:
        raise ValueError(f"the lower limit {low:g} must be below the upper limit {high:g}")
    return limits


_TOLERANCE = 1e-6  # tolerance of rotations and unit axes written with seven digits or more


def not_rigid(T: Matrix44) -> str:
    """Return the reason why a matrix is no pose; empty if it is one."""
    R = np.array(T)[:3, :3]
    if T[3] != (0, 0, 0, 1):
        return "the last row must be [0, 0, 0, 1]"
    if abs(R).max() > 2 or abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0:
        return "the upper left 3×3 block must be a rotation, written with seven digits or more"
    return ""


def _pose(T: Matrix44) -> Matrix44:
    """A matrix that is a pose; otherwise ValueError."""
    if what := not_rigid(T):
        raise ValueError(what)
    return T


Limits = Annotated[Vector2, AfterValidator(_limits)]
Pose = Annotated[Matrix44, AfterValidator(_pose)]


def _one_or_each(value: Any, of_one: Callable[[Any], tuple[int, int]]) -> Any:
    """Width and height of all images, or, if their sizes differ, of each view."""
    several = isinstance(value, (list, tuple)) and len(value) > 0
    if not several or not all(isinstance(one, (list, tuple)) for one in value):
        return of_one(value)
    sizes = tuple(map(of_one, value))
    return sizes[0] if len({*sizes}) == 1 else sizes


def _of_each_name(value: Any, of_one: Callable[[Any], tuple[int, int]]) -> Any:
    """Width and height of all images, or of each view, in order or by its name."""
    if not isinstance(value, Mapping):
        return _one_or_each(value, of_one)
    sizes = {view_named(str(name)): of_one(size) for name, size in value.items()}
    if len(sizes) < len(value):
        raise ValueError(f"names a view twice among {', '.join(map(str, value))}")
    return sizes


_TWO = {"type": "array", "minItems": 2, "maxItems": 2}
_SIZE = {"items": {"type": "integer", "minimum": 1, "maximum": 1_000_000}, **_TWO}
_SIZES = {"items": _SIZE, "type": "array", "minItems": 1}
Sizes = Annotated[
    tuple[Count, Count],
    WrapValidator(_one_or_each),
    WithJsonSchema({"anyOf": [_SIZE, _SIZES]}),
]
SizesByName = Annotated[
    tuple[Count, Count],
    WrapValidator(_of_each_name),
    PlainSerializer(lambda sizes: sizes),  # in either form
    WithJsonSchema({"anyOf": [_SIZE, _SIZES, {"type": "object", "additionalProperties": _SIZE}]}),
]
# The path from a section to a value in it, and the error of that value.
Note = tuple[tuple[str | int, ...], str]
CONTRADICTIONS = "contradictions"  # type of the error that holds them

_Part = TypeVar("_Part", bound="Section")


class Section(BaseModel):
    """A mapping of the configuration: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def contradictions(self) -> Iterable[Note]:
        """Yield the contradictions of this section, each value of which is valid by itself."""
        return ()

    def given(self, *names: str) -> list[str]:
        """Return the keys that have a value."""
        return [name for name in names if getattr(self, name) is not None]

    def part(self, kind: type[_Part]) -> _Part:
        """Return the values that a section declares from which this one inherits."""
        return cast(_Part, kind.model_construct(**{name: getattr(self, name) for name in kind.model_fields}))


class OneOf(Section):
    """A section that gives exactly one of some keys, which is its kind."""

    one_of: ClassVar[tuple[str, ...]]

    @property
    def kind(self) -> str:
        """Return the key that it gives."""
        return self.given(*self.one_of)[0]

    def contradictions(self) -> Iterator[Note]:
        """Yield an error if none or several of the keys are given; otherwise the errors of the given one."""
        given = self.given(*self.one_of)
        if len(given) != 1:
            keys = f"{', '.join(self.one_of[:-1])} and {self.one_of[-1]}"
            yield (), f"give exactly one of {keys}; given: {', '.join(given) or 'none'}"
        else:
            yield from self.of_kind()

    def of_kind(self) -> Iterable[Note]:
        """Yield the contradictions of a section that gives one of the keys."""
        return ()


def is_view(name: str) -> bool:
    """Whether a camera may have a name."""
    return re.fullmatch(VIEW_NAME, name) is not None and name == view_named(name)


class ByView(Section):
    """A section whose further keys are names of views like ``left`` and ``right``."""

    model_config = ConfigDict(extra="allow")

    @property
    def by_view(self) -> dict[str, Any]:
        """Values by names of views: left and right first, others in the order of the file."""
        found = {name: getattr(self, name, None) for name in (*VIEWS, *(self.model_extra or {}))}
        return {name: value for name, value in found.items() if value is not None}

    def contradictions(self) -> Iterator[Note]:
        """Yield names that no column of a table can have."""
        for name in self.model_extra or ():
            if not is_view(name):
                yield (
                    (name,),
                    "is no name of a camera: take small letters, digits and single spaces, as cam 2",
                )


class Root(Section):
    """A configuration as a whole, of which all contradictions are found at once.

    The context of a validation names keys whose values are wrong by themselves, and which are left out.
    """

    @model_validator(mode="after")
    def _consistent(self, info: ValidationInfo) -> Self:
        sound = {key: value for key, value in vars(self).items() if key not in (info.context or ())}
        if found := [*_contradictions(sound.items()), *self.between(sound)]:
            text = "; ".join(f"{'.'.join(map(str, path))}: {what}" for path, what in found)
            raise PydanticCustomError(CONTRADICTIONS, "{told}", {"told": text, "found": found})
        return self

    def between(self, sound: Mapping[str, Any]) -> Iterable[Note]:
        """Yield contradictions between values by key."""
        return ()


def _contradictions(parts: Iterable[tuple[Any, Any]], path: tuple[str | int, ...] = ()) -> Iterator[Note]:
    """Those of all sections among some values by their keys, and of the sections in these."""
    for key, part in parts:
        here = (*path, key)
        each = [inner for _, inner in part] if isinstance(part, Section) else part
        if what := of_another_unit(str(key), each):
            yield here, what
        if isinstance(part, Section):
            yield from ((here + at, what) for at, what in part.contradictions())
            yield from _contradictions(part, here)
        elif isinstance(part, dict):
            yield from _contradictions(part.items(), here)
        elif isinstance(part, tuple) and part and isinstance(part[0], Section):
            yield from _contradictions(enumerate(part), here)


class JointVector(Section):
    """Joint readings; ``unit`` applies to the revolute joints, prismatic ones are in metres."""

    joints: tuple[Number, ...] = Field(min_length=1, description="one reading per joint, base to tool")
    unit: Literal["deg", "rad"] = Field(description="unit of the revolute joints; prismatic joints are in m")

    def values(self, joint_types: str) -> FloatArray:
        """Readings (n,) in rad (R) and m (P), one for each letter of ``joint_types``.

        Raises ValueError when the numbers of joints differ.
        """
        pairs = zip(self.joints, joint_types, strict=True)
        turn = math.radians if self.unit == "deg" else float
        return np.array([turn(value) if letter == "R" else float(value) for value, letter in pairs])

    def miscounted(self, joint_types: str, *path: str) -> Iterator[Note]:
        """Readings too many or too few for the joints of a robot, this vector being at a path."""
        if len(self.joints) != len(joint_types):
            what = f"{len(self.joints)} values for {len(joint_types)} joints ({joint_types})"
            yield (*path, "joints"), what


def not_a_screw(kind: str, w: Vector3, v: Vector3) -> Iterator[tuple[str, str]]:
    """Yield the reasons why w and v are no screw of a joint, R or P: which of both, and why."""
    axis = "w" if kind == "R" else "v"
    length = math.hypot(*(w if kind == "R" else v))
    if abs(length - 1) > _TOLERANCE:
        yield axis, f"must be of unit length for a joint of type {kind}, it is {length:g}"
    if kind == "P" and math.hypot(*w) > _TOLERANCE:
        yield "w", "must be zero for a joint of type P"
    if kind == "R" and abs(np.dot(w, v)) > _TOLERANCE:
        yield "v", "must be orthogonal to w: a revolute joint has no pitch"
