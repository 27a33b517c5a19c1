"""Records with made-up content of the right shapes, for tests of what only passes records on."""

from typing import Any

import numpy as np

from projservo_cli.records import (
    SIZES,
    VIEWS,
    WORLD,
    changed,
    composed,
    flat_fields,
    is_optional,
    optional_names,
)

EXTENTS = {"view": len(VIEWS), "joint": 6, "marker": 4, "pose": 5, "instant": 7, "step": 6, "constraint": 4}
SCALARS = {float: 1.5, int: 3, str: "text ä", bool: True}


def fake(kind: type, seed: int = 0, sizes: dict[str, int] | None = None, **given: Any) -> Any:
    """A record of a kind: random arrays, plain scalars, and the fields that are given."""
    rng = np.random.default_rng(seed)
    extent = {**EXTENTS, **SIZES, **(sizes or {})}
    names = {field.name for field in flat_fields(kind)}
    values: dict[str, Any] = {}
    if "joint_types" in names:
        given.setdefault("joint_types", "R" * extent["joint"])
    if "view" in names:
        extent["view"] = len(given.setdefault("view", VIEWS))
    extent["margin_kind"] = 2 + 4 * extent["view"]
    if "mount" in names:
        given.setdefault("mount", WORLD)
    for field in flat_fields(kind):
        hint = field.type
        if field.name in given:
            values[field.name] = given[field.name]
        elif is_optional(field) or field.name in optional_names(kind):
            values[field.name] = None
        elif "by_view" in field.metadata:
            values[field.name] = tuple(range(extent["view"]))
        elif "dims" in field.metadata:
            values[field.name] = _array(
                rng, str(hint), [extent.get(dim, 3) for dim in field.metadata["dims"]]
            )
        elif hint in SCALARS:
            values[field.name] = SCALARS[hint]
        else:
            values[field.name] = ()
    return composed(kind, values)


def seen_by(record: Any, names: tuple[str, ...]) -> Any:
    """A record of two views as cameras of other names had it: the first and the second in turn."""
    chosen, values = [v % 2 for v in range(len(names))], {"view": names}
    for field in flat_fields(type(record)):
        value, dims = getattr(record, field.name), field.metadata.get("dims", ())
        if value is not None and "view" in dims:
            values[field.name] = np.take(value, chosen, axis=dims.index("view"))
        elif value is not None and "margin_kind" in dims:  # one, four of each view, one
            pairs = np.take(value[:, 1:-1].reshape(len(value), 4, 2), chosen, axis=2)
            values[field.name] = np.c_[value[:, :1], pairs.reshape(len(value), -1), value[:, -1:]]
        elif "by_view" in field.metadata:
            values[field.name] = tuple(value[v] for v in chosen)
    if getattr(record, "frame_jpeg", None) is not None:
        files = np.split(record.frame_jpeg, np.cumsum(record.frame_size)[:-1])
        kept = [files[2 * k + v] for k in range(len(record.frame_size)) for v in chosen]
        values["frame_jpeg"] = np.concatenate(kept)
    return changed(record, **values)


def _array(rng: np.random.Generator, hint: str, shape: list[int]) -> Any:
    if "bool" in hint:
        return rng.random(shape) > 0.5
    if "int64" in hint:
        return np.arange(np.prod(shape), dtype=np.int64).reshape(shape)
    return rng.normal(size=shape)
