"""The run file: everything an experiment made, as HDF5 that xarray opens with named dimensions.

One group a result (``calibrate``, ``plan``, ``servo/<law>``, ``report``), with the records in it or
in subgroups. Arrays are netCDF-4 variables with dimension scales, units and a description; scalars
and texts are attributes of the group. A file is written anew and put in place as a whole.
"""

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
from projservo_cli.files import replacing
from projservo_cli.records import Calibration, CrossValidation, InputError, Observation, Plan, Trace

SCHEMA = "projservo run"
SCHEMA_VERSION = 1
SERVO = "servo/"
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable. {:10d}"


@dataclasses.dataclass(frozen=True)
class Result:
    """What one stage (or one law of ``servo``) made, and from what.

    Attributes
    ----------
    key : hash of all the result depends on.
    configuration : resolved YAML.
    provenance : versions, host, date and so on; JSON values.
    inputs : files read and their hashes.
    records : the records by name; the name "" stands for the only one.
    """

    key: str
    configuration: str
    provenance: Mapping[str, Any]
    inputs: Mapping[str, str]
    records: Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Run:
    """A run file in memory."""

    path: Path
    configuration: str = ""
    results: Mapping[str, Result] = dataclasses.field(default_factory=dict)

    @property
    def observation(self) -> Observation:
        """What the calibration was made from."""
        found: Observation = self._record("calibrate", "observation")
        return found

    @property
    def calibration(self) -> Calibration:
        """The calibration."""
        found: Calibration = self._record("calibrate", "calibration")
        return found

    @property
    def cross_validation(self) -> CrossValidation | None:
        """Held-out errors of the calibration; None where they were not asked for."""
        result = self.results.get("calibrate")
        return None if result is None else result.records.get("cross_validation")

    @property
    def plan(self) -> Plan:
        """The plan."""
        found: Plan = self._record("plan", "")
        return found

    @property
    def traces(self) -> dict[str, Trace]:
        """Traces by law, in the order they were first made."""
        found = {name: result for name, result in self.results.items() if name.startswith(SERVO)}
        return {name.removeprefix(SERVO): result.records[""] for name, result in found.items()}

    def _record(self, result: str, name: str) -> Any:
        if result not in self.results:
            stage = result.split("/")[0]
            raise InputError(
                f"{self.path}: holds no {stage}; make it first: projservo {stage} -o {self.path}"
            )
        return self.results[result].records[name]


def run_path(target: Path | str) -> Path:
    """The run file in a folder, or the file itself."""
    target = Path(target)
    return target if target.suffix == ".h5" or target.is_file() else target / "run.h5"


def save(run: Run) -> None:
    """Write a run file in place of the one at ``run.path``, as a whole or not at all.

    Raises
    ------
    InputError
        When it cannot be written; the file that stood there stays.
    """
    with replacing(run.path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["schema"] = SCHEMA
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["configuration"] = run.configuration
        file.attrs["order"] = json.dumps(list(run.results))
        for name, result in run.results.items():
            group = file.create_group(name)
            group.attrs["key"] = result.key
            group.attrs["configuration"] = result.configuration
            group.attrs["provenance"] = json.dumps(result.provenance, sort_keys=True)
            group.attrs["inputs"] = json.dumps(result.inputs, sort_keys=True)
            group.attrs["records"] = json.dumps(list(result.records))
            for label, record in result.records.items():
                save_record(group.create_group(label) if label else group, record)


def load(target: Path | str) -> Run:
    """Read a run file.

    Raises
    ------
    InputError
        When there is none, it is cut short, or it was not written by this version of the schema.
    """
    path = run_path(target)
    if not path.is_file():
        raise InputError(f"{path}: there is no run file; make one with: projservo calibrate -o {path.parent}")
    try:
        with h5py.File(path, "r", locking=False) as file:
            _check_schema(path, file)
            names = json.loads(_text(file, "order"))
            results = {name: _load_result(path, file[name]) for name in names}
            return Run(path, _text(file, "configuration"), results)
    except InputError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        what = " ".join(str(error).split())
        raise InputError(
            f"{path}: cut short, damaged or not a run file ({what}); delete it or use another"
        ) from error


def _check_schema(path: Path, file: h5py.File) -> None:
    if _text(file, "schema", "") != SCHEMA:
        raise InputError(f"{path}: an HDF5 file, but not a run file of projservo")
    version = int(file.attrs.get("schema_version", 0))
    if version != SCHEMA_VERSION:
        raise InputError(
            f"{path}: run file of schema {version}, this projservo reads {SCHEMA_VERSION}; use another run"
        )


def _load_result(path: Path, group: h5py.Group) -> Result:
    labels = json.loads(_text(group, "records"))
    return Result(
        _text(group, "key"),
        _text(group, "configuration"),
        json.loads(_text(group, "provenance")),
        json.loads(_text(group, "inputs")),
        {label: load_record(path, group[label] if label else group) for label in labels},
    )


def _text(group: h5py.Group, name: str, default: str | None = None) -> str:
    value = group.attrs[name] if default is None else group.attrs.get(name, default)
    if not isinstance(value, str):
        raise ValueError(f"attribute {name} of {group.name} is not text")
    return value


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
    data = group.create_dataset(name, data=value.astype(np.int8) if boolean else value)
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
                scale = group.create_dataset(dim, data=np.zeros(size, dtype=np.float32))
                scale.make_scale(_NO_VARIABLE.format(size))
            elif not group[dim].is_scale:
                group[dim].make_scale(dim)
            if group[dim].shape != (size,):
                raise ValueError(f"{group.name}/{name}: dimension {dim} has {size} entries, elsewhere others")
            if dim != name:
                group[name].dims[axis].attach_scale(group[dim])


def load_record(path: Path, group: h5py.Group) -> Any:
    """Read a record that ``save_record`` stored; an InputError where it is of another version."""
    kind = getattr(record_types, _text(group, "record"), None)
    if not dataclasses.is_dataclass(kind):
        raise InputError(f"{path}: {group.name} holds a record this version does not know; use another run")
    hints = typing.get_type_hints(kind)
    values: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        present = field.name in (group if "dims" in field.metadata else group.attrs)
        if not present and not _optional(hints[field.name]):
            raise InputError(
                f"{path}: {group.name} lacks {field.name}; another version made it; use another run"
            )
        if not present:
            values[field.name] = None
        elif "dims" in field.metadata:
            values[field.name] = _load_array(path, group[field.name], field.metadata["dims"])
        else:
            values[field.name] = _decoded(group.attrs[field.name], hints[field.name])
    return kind(**values)  # type: ignore[operator]


def _load_array(path: Path, data: h5py.Dataset, dims: tuple[str, ...]) -> Any:
    if data.ndim != len(dims):
        raise InputError(f"{path}: {data.name} has {data.ndim} dimensions instead of {len(dims)}")
    value = data[()]
    return value.astype(np.bool_) if data.attrs.get("dtype") == "bool" else value


def _optional(hint: Any) -> bool:
    return type(None) in typing.get_args(hint)


def _decoded(value: Any, hint: Any) -> Any:
    if _optional(hint) and typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(inner for inner in typing.get_args(hint) if inner is not type(None))
    if hint in (bool, int, float, str):
        return hint(value)
    decoded = json.loads(value)
    return tuple(decoded) if typing.get_origin(hint) is tuple else decoded
