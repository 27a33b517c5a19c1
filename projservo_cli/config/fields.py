"""Building blocks of the configuration: strict finite numbers, vectors, joint vectors."""

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, Strict, WithJsonSchema

from projservo_cli.modes import MODES

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
