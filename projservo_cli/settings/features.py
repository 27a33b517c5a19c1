"""Points, lines and planes that incidences of a goal name."""

import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, WithJsonSchema

from projservo_cli.records import KINDS, MEET, PARALLEL, PERPENDICULAR
from projservo_cli.settings.sections import Note, Number, OneOf, Whole

_TOOL, _SCENE = "tool", "scene"
_RELATIONS = (MEET, PARALLEL, PERPENDICULAR)
_MOST = 100  # markers of which a point is the middle
_NAME, _LONGEST = r"^[a-z][a-z0-9_]*$", 40


def is_name(name: str) -> bool:
    """Whether messages and figures can write a name."""
    return re.fullmatch(_NAME, name) is not None and len(name) <= _LONGEST


def _name(name: str) -> str:
    """A name; otherwise ValueError."""
    if not is_name(name):
        raise ValueError("must be a name of small letters, digits and _, which begins with a letter")
    return name


Name = Annotated[
    str,
    AfterValidator(_name),
    WithJsonSchema({"maxLength": _LONGEST, "pattern": _NAME, "type": "string"}),
]


def _numbers_or_name(min_count: int, max_count: int) -> BeforeValidator:
    """Refuse, in one line, a value that is neither such a number of markers nor a name."""

    def checked(value: Any) -> Any:
        whole = isinstance(value, (list, tuple)) and all(type(x) is int and x >= 0 for x in value)
        if not (value is None or isinstance(value, str) or (whole and min_count <= len(value) <= max_count)):
            count = str(min_count) if min_count == max_count else f"{min_count} to {max_count}"
            raise ValueError(f"must be numbers of {count} markers, or the name of a feature of the tool")
        return value

    return BeforeValidator(checked)


_Point = Annotated[tuple[Whole, ...], Field(min_length=1, max_length=_MOST)]
_Line = Annotated[tuple[Whole, ...], Field(min_length=2, max_length=2)]
_Plane = Annotated[tuple[Whole, ...], Field(min_length=3, max_length=3)]


class Feature(OneOf):
    """A point, line or plane through markers of the tool or an object, or as a feature of the tool was."""

    one_of = KINDS
    on: Name = Field(
        description="carrier of the feature: tool, scene, which is fixed, or the name of an object"
    )
    point: Annotated[_Point | Name | None, _numbers_or_name(1, _MOST)] = Field(
        None,
        description="numbers of markers of the tool or object, whose middle it is; or the point of the "
        "tool that was there when the goal was taught",
    )
    line: Annotated[_Line | Name | None, _numbers_or_name(2, 2)] = Field(
        None, description="numbers of two markers, in the sense of the line; or as for a point"
    )
    plane: Annotated[_Plane | Name | None, _numbers_or_name(3, 3)] = Field(
        None, description="numbers of three markers, in the sense of the plane; or as for a point"
    )

    def of_kind(self) -> Iterator[Note]:
        """Markers of the scene or twice the same, and a tool that names another feature."""
        if self.on == _TOOL and isinstance(self.source, str):
            yield (self.kind,), "of the tool are numbers of its markers; a name means one of the scene"
        if self.on == _SCENE and not isinstance(self.source, str):
            yield (self.kind,), "of the scene is the name of a feature of the tool that was there when taught"
        if isinstance(self.source, tuple) and len(set(self.source)) < len(self.source):
            yield (self.kind,), "a marker occurs here twice"

    @property
    def source(self) -> tuple[int, ...] | str:
        """Numbers of markers, or the name of the feature of the tool that it coincided with."""
        source: tuple[int, ...] | str = getattr(self, self.kind)
        return source

    def flat(self, features: Mapping[str, "Feature"]) -> tuple[tuple[int, ...], ...]:
        """Numbers of the markers of each point that spans it, of its own or of a named feature."""
        if isinstance(self.source, str):
            return features[self.source].flat(features)
        return (self.source,) if self.kind == KINDS[0] else tuple((number,) for number in self.source)


def _pair(value: Any) -> Any:
    """A pair of names, perhaps with their relation; otherwise ValueError."""
    if not (isinstance(value, (list, tuple)) and len(value) in (2, 3)) or not all(
        isinstance(name, str) for name in value[:2]
    ):
        raise ValueError("must be [feature of the tool, feature of the scene], perhaps with how both lie")
    if len(value) == 3 and value[2] not in _RELATIONS:
        angle = value[2]
        if isinstance(angle, bool) or not isinstance(angle, int | float) or not 0.0 < angle < 180.0:
            known = f"{', '.join(_RELATIONS)}, or an angle between 0 and 180 deg"
            raise ValueError(f"{angle!r} does not say how both lie: {known}")
    return value


_Relation = Literal["meet", "parallel", "perpendicular"] | Annotated[Number, Field(gt=0, lt=180)]
# A pair of features of the tool and of the scene; by default they meet.
Pair = Annotated[tuple[Name, Name] | tuple[Name, Name, _Relation], BeforeValidator(_pair)]


def misplaced(pair: Pair, features: Mapping[str, Feature]) -> str:
    """Return the reason why a pair is no incidence of these features; empty if it is one."""
    for name, of_tool in zip(pair[:2], (True, False), strict=True):
        if name not in features:
            return f"there is no feature {name}; features: {', '.join(features) or 'none'}"
        if (features[name].on == _TOOL) != of_tool:
            return f"{name} is on the {features[name].on}: name a feature of the tool, then one of the scene"
        if len(pair) == 3 and pair[2] != MEET and features[name].given(*KINDS) == [KINDS[0]]:
            return f"{name} is a point, which has no direction: leave {pair[2]} out, or name lines and planes"
    return ""
