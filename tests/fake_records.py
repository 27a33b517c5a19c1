"""Records with made-up content of the right shapes, for tests of what only passes records on."""

import dataclasses
import typing
from typing import Any

import numpy as np

from projservo_cli.records import SIZES, VIEWS, WORLD

EXTENTS = {"view": len(VIEWS), "joint": 6, "marker": 4, "pose": 5, "instant": 7, "step": 6, "constraint": 4}
SCALARS = {float: 1.5, int: 3, str: "text ä", bool: True}


def fake(kind: type, seed: int = 0, sizes: dict[str, int] | None = None, **given: Any) -> Any:
    """A record of a kind: random arrays, plain scalars, and the fields that are given."""
    rng = np.random.default_rng(seed)
    extent = {**EXTENTS, **SIZES, **(sizes or {})}
    hints = typing.get_type_hints(kind)
    values: dict[str, Any] = {}
    if "joint_types" in hints:
        given.setdefault("joint_types", "R" * extent["joint"])
    if "view" in hints:
        given.setdefault("view", VIEWS)
    if "mount" in hints:
        given.setdefault("mount", WORLD)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        if field.name in given:
            values[field.name] = given[field.name]
        elif type(None) in typing.get_args(hint):
            values[field.name] = None
        elif "dims" in field.metadata:
            values[field.name] = _array(
                rng, str(hint), [extent.get(dim, 3) for dim in field.metadata["dims"]]
            )
        elif hint in SCALARS:
            values[field.name] = SCALARS[hint]
        else:
            values[field.name] = ()
    return kind(**values)


def _array(rng: np.random.Generator, hint: str, shape: list[int]) -> Any:
    if "bool" in hint:
        return rng.random(shape) > 0.5
    if "int64" in hint:
        return np.arange(np.prod(shape), dtype=np.int64).reshape(shape)
    return rng.normal(size=shape)
