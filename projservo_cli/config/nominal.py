"""Files that say what is known of a robot and its rig beforehand, read strictly."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from projservo_cli.calibration import Nominal
from projservo_cli.config.robot import Matrix34, Pose, ScrewJoint, Vector3
from projservo_cli.records import FloatArray, InputError


class _Screw(BaseModel):
    """A unit axis w with v = −w × point, or w zero and a unit direction v."""

    w: Vector3
    v: Vector3


class _File(BaseModel):
    """The keys that are read; others are ignored."""

    model_config = ConfigDict(extra="ignore", strict=True)

    screws: Annotated[list[_Screw], Field(min_length=1)]
    q_reference: list[FiniteFloat]
    camera_left: Matrix34
    camera_right: Matrix34
    markers_tool: Annotated[list[Vector3], Field(min_length=1)]
    marker_numbers: list[int] | None = None
    T_base_tool_at_reference: Pose


def read_nominal(path: Path | str) -> Nominal:
    """Read what is believed of a robot, its rig and its markers.

    path : JSON with ``screws`` (w and v of each joint at the reference, base frame, rad and m),
    ``q_reference`` (rad or m), ``camera_left`` and ``camera_right`` (3×4 matrices to px), ``markers_tool``
    (m) with ``T_base_tool_at_reference``, and perhaps ``marker_numbers`` (0, 1 …).
    Raises InputError ``file: key: what`` when it cannot be read or makes no sense.
    """
    found = _checked(Path(path))
    n = len(found.screws)
    if len(found.q_reference) != n:
        raise InputError(f"{path}: q_reference: {len(found.q_reference)} values for {n} screws")
    numbers = found.marker_numbers or list(range(len(found.markers_tool)))
    if len(numbers) != len(found.markers_tool) or len(set(numbers)) < len(numbers):
        raise InputError(
            f"{path}: marker_numbers: give each of the {len(found.markers_tool)} markers its own number"
        )
    cameras = np.array([found.camera_left, found.camera_right])
    for name, P in zip(("camera_left", "camera_right"), cameras, strict=True):
        if np.linalg.matrix_rank(P) < 3:
            raise InputError(f"{path}: {name}: a camera matrix has three independent rows")
    body = np.c_[np.array(found.markers_tool), np.ones(len(numbers))]
    return Nominal(
        str(path),
        cameras,
        np.array([_twist(f"{path}: screws.{i}", screw) for i, screw in enumerate(found.screws)]),
        np.array(found.q_reference, dtype=np.float64),
        np.array(numbers, dtype=np.int64),
        body @ np.array(found.T_base_tool_at_reference).T,
    )


def _checked(path: Path) -> _File:
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; expected JSON") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{path}:{error.lineno}:{error.colno}: not JSON: {error.msg}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text; expected JSON") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{path}: not JSON that can be read; expected screws, cameras, markers") from error
    try:
        return _File.model_validate_json(json.dumps(values))
    except ValidationError as error:
        key, what = _first(error)
        raise InputError(
            f"{path}: {key or 'the file'}: {what}; expected screws, q_reference, "
            "camera_left, camera_right, markers_tool and T_base_tool_at_reference"
        ) from error


def _first(error: ValidationError) -> tuple[str, str]:
    """The first key that is wrong, and what is."""
    first = error.errors(include_url=False)[0]
    what = first["msg"].removeprefix("Value error, ")
    return ".".join(map(str, first["loc"])), f"{what[:1].lower()}{what[1:]}"


def _twist(where: str, screw: _Screw) -> FloatArray:
    """Twist (4, 4) of a screw that a configured robot may have, freed of what rounding left of a pitch."""
    w, v = np.array(screw.w), np.array(screw.v)
    try:
        ScrewJoint(type="R" if w.any() else "P", w=screw.w, v=screw.v)
    except ValidationError as error:
        key, what = _first(error)
        raise InputError(f"{where}: {key} {what}") from None
    twist = np.zeros((4, 4))
    if not w.any():
        twist[:3, 3] = v / np.linalg.norm(v)
        return twist
    w = w / np.linalg.norm(w)
    twist[:3, :3] = np.cross(np.eye(3), w)
    twist[:3, 3] = v - w * (w @ v)
    return twist
