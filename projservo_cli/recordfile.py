"""Records as groups of HDF5: each field by its metadata, and refused where it is not what it declares."""

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from projservo_cli import records as record_types
from projservo_cli.hdf5 import attribute, checksummed, text
from projservo_cli.records import SIZES, InputError

_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable. {:10d}"
_OTHER = "another version made it; use another run"
# Kind and size in bytes of the numbers of each type of array, as they are stored.
_STORED = {"float64": ("f", 8), "int64": ("i", 8), "bool": ("i", 1)}
# Keys of the mappings that a field lists.
_KEYS = {
    "claims": {"claim", "source", "measured", "criterion", "holds"},
    "left_out": {"what", "reason"},
}


def save_record(group: h5py.Group, record: Any) -> None:
    """Store each field of a record by its metadata; None is stored as nothing."""
    group.attrs["record"] = type(record).__name__
    arrays = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if value is None:
            continue
        if "dims" in field.metadata:
            arrays[field.name] = (field, np.asarray(value))
        else:
            group.attrs[field.name] = _encoded(value)
    for name, (field, value) in arrays.items():
        _save_array(group, name, value, field.metadata)
    _attach_scales(group, _distinct({name: field.metadata["dims"] for name, (field, _) in arrays.items()}))


def _encoded(value: Any) -> Any:
    """An attribute of HDF5 and netCDF: number or text; everything else as JSON text."""
    if isinstance(value, (bool, np.bool_)):
        return np.int8(value)
    if isinstance(value, (str, int, float, np.integer, np.floating)):
        return value
    return json.dumps(value)


def _save_array(group: h5py.Group, name: str, value: Any, metadata: Mapping[str, Any]) -> None:
    if value.ndim != len(metadata["dims"]):
        raise ValueError(f"{group.name}/{name}: shape {value.shape} for dimensions {metadata['dims']}")
    boolean = value.dtype == np.bool_
    stored = value.astype(np.int8) if boolean else value
    data = group.create_dataset(name, data=stored, **checksummed(value.shape))
    if boolean:  # netCDF has no booleans; this is how xarray marks them
        data.attrs["dtype"] = "bool"
    data.attrs["units"] = metadata["units"]
    data.attrs["long_name"] = metadata["about"]


def _distinct(dims: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """Dimension names that no array over other dimensions bears, since both are datasets of a group."""
    taken = {name for name, own in dims.items() if own != (name,)}
    return {name: tuple(f"{dim}_index" if dim in taken else dim for dim in own) for name, own in dims.items()}


def _attach_scales(group: h5py.Group, dims: Mapping[str, tuple[str, ...]]) -> None:
    """Name the dimensions of all arrays; an array named as its only dimension is its coordinate."""
    for name, own in dims.items():
        for axis, dim in enumerate(own):
            size = group[name].shape[axis]
            if dim not in group:
                scale = group.create_dataset(
                    dim, data=np.zeros(size, dtype=np.float32), **checksummed((size,))
                )
                scale.make_scale(_NO_VARIABLE.format(size))
            elif not group[dim].is_scale:
                group[dim].make_scale(dim)
            if group[dim].shape != (size,):
                raise ValueError(f"{group.name}/{name}: dimension {dim} has {size} entries, elsewhere others")
            if dim != name:
                group[name].dims[axis].attach_scale(group[dim])


def load_record(path: Path, group: h5py.Group) -> Any:
    """Read a record that ``save_record`` stored.

    Raises
    ------
    InputError
        Where a field is missing, of another type or of other dimensions than the record declares.
    """
    kind: Any = getattr(record_types, text(group, "record"), None)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise InputError(f"{path}: {group.name} holds a record this version does not know; use another run")
    hints = typing.get_type_hints(kind)
    sizes = dict(SIZES)
    values: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        where, hint = f"{path}: {group.name}", hints[field.name]
        present = field.name in (group if "dims" in field.metadata else group.attrs)
        if not present and _optional(hint):
            values[field.name] = None
        elif not present and field.default is not dataclasses.MISSING:
            values[field.name] = field.default  # an older version made it, which had no such field
        elif not present:
            raise InputError(f"{where} lacks {field.name}; {_OTHER}")
        elif "dims" in field.metadata:
            data = group[field.name]
            _require_dimensions(where, field, data, sizes)
            values[field.name] = _array(where, data, hint)
        else:
            values[field.name] = _value(where, field.name, attribute(group, field.name), _inner(hint))
    return kind(**values)


def _require_dimensions(
    where: str, field: dataclasses.Field[Any], data: h5py.Dataset, sizes: dict[str, int]
) -> None:
    dims = field.metadata["dims"]
    if not isinstance(data, h5py.Dataset) or data.ndim != len(dims):
        raise InputError(f"{where}: {field.name} is no array over {', '.join(dims)}; {_OTHER}")
    for dim, size in zip(dims, data.shape, strict=True):
        if sizes.setdefault(dim, size) != size:
            raise InputError(
                f"{where}: {field.name} has {size} entries along {dim}, not {sizes[dim]}; {_OTHER}"
            )


def _array(where: str, data: h5py.Dataset, hint: Any) -> Any:
    wanted = np.dtype(typing.get_args(typing.get_args(_inner(hint))[1])[0])
    if (data.dtype.kind, data.dtype.itemsize) != _STORED[wanted.name]:
        raise InputError(f"{where}: {data.name} holds {data.dtype}, not {wanted.name}; {_OTHER}")
    return np.asarray(data[()], dtype=wanted)


def _optional(hint: Any) -> bool:
    return type(None) in typing.get_args(hint)


def _inner(hint: Any) -> Any:
    """The type of a value that may be absent."""
    if _optional(hint) and typing.get_origin(hint) in (typing.Union, types.UnionType):
        return next(inner for inner in typing.get_args(hint) if inner is not type(None))
    return hint


def _value(where: str, name: str, value: Any, hint: Any) -> Any:
    wrong = InputError(f"{where}: {name} is not of type {getattr(hint, '__name__', hint)}; {_OTHER}")
    if hint is str:
        if not isinstance(value, str):
            raise wrong
        return value
    if hint in (bool, int, float):
        if isinstance(value, str) or (hint is not float and int(value) != value):
            raise wrong
        return hint(value)
    if not isinstance(value, str):
        raise wrong
    decoded = json.loads(value)
    element = typing.get_args(hint)[0]
    if not isinstance(decoded, list) or not all(_fits(name, entry, element) for entry in decoded):
        raise wrong
    return tuple(decoded)


def _fits(name: str, entry: Any, element: Any) -> bool:
    if element is str:
        return isinstance(entry, str)
    if not isinstance(entry, dict) or not _KEYS.get(name, set()) <= set(entry):
        return False
    return all(isinstance(text, (str, bool, int, type(None))) for text in entry.values())


def joints_of(record: Any) -> int | None:
    """Number of joints that the arrays of a record are about; None where it has no such array."""
    for field in dataclasses.fields(record):
        value, dims = getattr(record, field.name), field.metadata.get("dims", ())
        if value is not None and "joint" in dims:
            return int(value.shape[dims.index("joint")])
    return None
