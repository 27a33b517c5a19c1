"""File of a nominal robot, rig and markers, as an initial guess of a calibration."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from projservo_cli.geometry.displacements import twists
from projservo_cli.records import FloatArray, InputError
from projservo_cli.settings.sections import Matrix34, Matrix44, Vector3, not_a_screw, not_rigid
from projservo_cli.store.files_and_locks import text_of

_MAX_BYTES = 10_000_000  # maximum size of the file


class _Screw(BaseModel):
    """A unit axis w with v = −w × point, or w zero and a unit direction v."""

    model_config = ConfigDict(allow_inf_nan=False)

    w: Vector3
    v: Vector3


class _Believed(BaseModel):
    """The keys of a file that are read; others are ignored."""

    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False)

    screws: Annotated[list[_Screw], Field(min_length=1)]
    q_reference: list[float]
    camera_left: Matrix34
    camera_right: Matrix34
    markers_tool: Annotated[list[Vector3], Field(min_length=1)]
    marker_numbers: list[int] | None = None
    T_base_tool_at_reference: Matrix44

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Keys whose values do not fit together or make no sense, and why."""
        n, m = len(self.screws), len(self.markers_tool)
        if len(self.q_reference) != n:
            yield "q_reference", f"{len(self.q_reference)} values for {n} screws"
        if self.marker_numbers and not len(self.marker_numbers) == len(set(self.marker_numbers)) == m:
            yield "marker_numbers", f"give each of the {m} markers its own number"
        for name in ("camera_left", "camera_right"):
            if np.linalg.matrix_rank(np.array(getattr(self, name))) < 3:
                yield name, "a camera matrix has three independent rows"
        if what := not_rigid(self.T_base_tool_at_reference):
            yield "T_base_tool_at_reference", what


def read_nominal(path: Path | str) -> dict[str, Any]:
    """Read a nominal robot, its rig and its markers: the fields of ``calibration.Nominal``.

    path : JSON with ``screws`` (w and v of each joint at the reference, base frame, rad and m),
    ``q_reference`` (rad or m), ``camera_left`` and ``camera_right`` (3×4 matrices to px), ``markers_tool``
    (m) with ``T_base_tool_at_reference``, and perhaps ``marker_numbers`` (0, 1 …).
    Raises InputError ``file: key: what`` when it cannot be read or makes no sense.
    """
    believed = _believed(path)
    for key, what in believed.contradictions():
        raise InputError(f"{path}: {key}: {what}")
    numbers = believed.marker_numbers or range(len(believed.markers_tool))
    body = np.c_[np.array(believed.markers_tool), np.ones(len(numbers))]
    return {
        "where": str(path),
        "P": np.array([believed.camera_left, believed.camera_right]),
        "H_hat": np.array([_twist(f"{path}: screws.{i}", screw) for i, screw in enumerate(believed.screws)]),
        "q_reference": np.array(believed.q_reference, dtype=np.float64),
        "marker": np.array(numbers, dtype=np.int64),
        "M": body @ np.array(believed.T_base_tool_at_reference).T,
    }


def _once(path: Path | str, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Keys and values of an object. Raises InputError for a key that occurs twice."""
    names = [name for name, _ in pairs]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{path}: the key {twice[0]} occurs twice in one object; keep one")
    return dict(pairs)


def _believed(path: Path | str) -> _Believed:
    text = text_of(path, "screws, cameras and markers (JSON)", _MAX_BYTES)
    try:
        return _Believed.model_validate_json(
            json.dumps(json.loads(text, object_pairs_hook=partial(_once, path)))
        )
    except InputError:
        raise
    except json.JSONDecodeError as error:
        raise InputError(f"{path}:{error.lineno}:{error.colno}: not JSON: {error.msg}") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key, what = ".".join(map(str, first["loc"])), first["msg"]
        raise InputError(
            f"{path}: {key or 'the file'}: {what[:1].lower()}{what[1:]}; expected screws, q_reference, "
            "camera_left, camera_right, markers_tool and T_base_tool_at_reference"
        ) from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{path}: not JSON that can be read; expected screws, cameras, markers") from error


def _twist(where: str, screw: _Screw) -> FloatArray:
    """Twist (4, 4) of a screw that a configured robot may have, without the pitch that rounding left."""
    w, v = np.array(screw.w), np.array(screw.v)
    for key, what in not_a_screw("R" if w.any() else "P", screw.w, screw.v):
        raise InputError(f"{where}: {key} {what}")
    if not w.any():
        return twists(np.r_[w, v / np.linalg.norm(v)])
    w = w / np.linalg.norm(w)
    return twists(np.r_[w, v - w * (w @ v)])
