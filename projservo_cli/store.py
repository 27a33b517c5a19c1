"""The run file: everything an experiment made, as HDF5 that xarray opens with named dimensions.

One group a result (``calibrate``, ``plan``, ``servo/<law>``, ``report``), with the records in it or
in subgroups. Arrays are netCDF-4 variables with dimension scales, units and a description; scalars
and texts are attributes of the group. A file is written anew and put in place as a whole.

A field may be added to a record where it may be absent or has a default. Whatever else changes the
file raises ``SCHEMA_VERSION``; files of the version before are then read as well, or refused with
what to do.
"""

import dataclasses
import errno
import hashlib
import json
import os
import re
import shutil
import tempfile
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from projservo_cli import records as record_types
from projservo_cli.files import replacing
from projservo_cli.quarantine import copied
from projservo_cli.records import (
    SIZES,
    Calibration,
    CrossValidation,
    InputError,
    Observation,
    Plan,
    Report,
    Trace,
)

SIGNATURE = b"\x89HDF\r\n\x1a\n"
_SEAL = b"\nprojservo sha256 %s\n"
_SEAL_SIZE = len(_SEAL % bytes(64))
_SEALED = re.compile(rb"\nprojservo sha256 ([0-9a-f]{64})\n")
_VERSION = ("v110", "v110")  # that of the file format, from 2016, with checksums in its structures
_END = {0: 40, 1: 44, 2: 28, 3: 28}  # where files of each version of the format say how long they are
_HEAD = 52  # bytes, with that number in each of them
_OBJECT = 64  # bytes that a group or an array takes at least
_DEPTH = 8  # of groups
_DEFLATED = 1100  # no byte that is stored makes more; the algorithm ends at 1032
_FILTERS = {h5py.h5z.FILTER_FLETCHER32, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE}
_NUMBERS = (h5py.h5t.INTEGER, h5py.h5t.FLOAT)
_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError)


class DamagedError(ValueError):
    """What a file claims about itself does not hold."""


@contextmanager
def new_file(path: Path, size: int | None = None) -> Iterator[h5py.File]:
    """A file to be filled, that takes the place of the one at ``path`` when the block succeeds.

    It is made in memory, since the library neither survives a full disk nor tells of it in one line.

    Parameters
    ----------
    size : bytes it may have, where it is too large for that: the disk must then have them to begin with.

    Raises
    ------
    InputError
        When it cannot be written; the file that stood there stays.
    """
    with replacing(path) as temporary:
        if size is None:
            with h5py.File(temporary, "w", libver=_VERSION, driver="core", backing_store=False) as file:
                yield file
                file.flush()
                image = file.id.get_file_image()
            temporary.write_bytes(image)
        else:
            if shutil.disk_usage(temporary.parent).free < size:
                raise InputError(f"{path}: cannot be written: {os.strerror(errno.ENOSPC)}")
            with h5py.File(temporary, "w", libver=_VERSION, locking=False) as file:
                yield file
        seal(temporary)


def seal(path: Path) -> None:
    """Append the line that tells the checksum of a file's data."""
    digest = digest_of(path)
    with path.open("ab") as stream:
        stream.write(_SEAL % digest.encode())


def _raise_unwritable(path: Path, error: Exception) -> None:
    told = re.search(r"error message = '([^']*)'", str(error))
    if told is None:
        raise error
    raise InputError(f"{path}: cannot be written: {told[1]}") from error


def checksummed(shape: tuple[int, ...]) -> dict[str, Any]:
    """Options of ``create_dataset`` for an array read as a whole; one without data has no checksum."""
    return {"fletcher32": True, "chunks": shape} if prod(shape) else {}


def digest_of(path: Path, size: int | None = None) -> str:
    """SHA-256 of the first ``size`` bytes of a file, in hexadecimal; of all of it by default."""
    digest = hashlib.sha256()
    left = path.stat().st_size if size is None else size
    with path.open("rb") as stream:
        while left > 0 and (block := stream.read(min(left, 1 << 20))):
            digest.update(block)
            left -= len(block)
    return digest.hexdigest()


def sealed(path: Path, remedy: str) -> bool:
    """Whether the line behind the data of a file says that they are as they were written.

    Nothing but that line is interpreted. A file without one may be sound: another program changed it.

    Parameters
    ----------
    remedy : what to do where the file is of no use, the end of the message.

    Raises
    ------
    InputError
        When the file cannot be read, is no HDF5 file, or is cut short or changed since it was written.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
            stream.seek(max(0, size - _SEAL_SIZE))
            found = _SEALED.fullmatch(stream.read(_SEAL_SIZE))
        digest = digest_of(path, size - _SEAL_SIZE) if found else ""
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if size == 0:
        raise InputError(f"{path}: is empty; {remedy}")
    if not head.startswith(SIGNATURE):
        raise InputError(f"{path}: no HDF5 file, so not a run file or sweep of projservo; name another")
    if found is not None and found[1].decode() != digest:
        raise InputError(f"{path}: damaged: its checksum is not that of its data; {remedy}")
    if found is None and _end(head) != size:
        raise InputError(f"{path}: cut short or damaged: its size is not the one it states; {remedy}")
    return found is not None


def _end(head: bytes) -> int:
    """Where the data of a file end, by its first bytes; -1 for a version that is not known."""
    place = _END.get(head[len(SIGNATURE)]) if len(head) == _HEAD else None
    return -1 if place is None else int.from_bytes(head[place : place + 8], "little")


@contextmanager
def opened(path: Path, remedy: str) -> Iterator[h5py.File]:
    """A file to read, of which ``require_plain`` holds; everything wrong with it is an ``InputError``."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            require_plain(file, path.stat().st_size)
            yield file
    except InputError:
        raise
    except _ERRORS as error:
        what = " ".join(str(error).split())
        raise InputError(f"{path}: cut short, damaged or of another kind ({what}); {remedy}") from error


def require_plain(file: h5py.File, size: int) -> None:
    """Refuse whatever is not groups and arrays of numbers or characters that lie in the file itself.

    Links to other files and names, virtual and external data, types beside numbers and characters,
    and arrays larger than what is stored of them are refused, before anything is read.

    Raises
    ------
    DamagedError
        With the name of what is refused.
    """
    stored = 0
    for count, (name, found) in enumerate(_objects(file, "", 0), 1):
        if count * _OBJECT > size:
            raise DamagedError("more objects than a file of that size can hold")
        if isinstance(found, h5py.Dataset):
            stored += _require_plain_array(name, found)
            if stored > size:
                raise DamagedError(f"{name} claims more data than the file has")


def _objects(group: h5py.Group, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    if depth > _DEPTH:
        raise DamagedError(f"{path} is nested more than {_DEPTH} levels deep")
    for name in group:
        where = f"{path}/{name}"
        if group.id.links.get_info(name.encode("utf-8", "surrogateescape")).type != h5py.h5l.TYPE_HARD:
            raise DamagedError(f"{where} is a link to elsewhere")
        found = group[name]
        if isinstance(found, h5py.Datatype):
            raise DamagedError(f"{where} is neither a group nor an array")
        yield where, found
        if isinstance(found, h5py.Group):
            yield from _objects(found, where, depth + 1)


def _require_plain_array(name: str, data: h5py.Dataset) -> int:
    """Bytes that are stored of an array; DamagedError unless they are all of it, in this file."""
    made = data.id.get_create_plist()
    kind = data.id.get_type()
    characters = kind.get_class() == h5py.h5t.STRING and not kind.is_variable_str()
    if kind.get_class() not in _NUMBERS and not characters:
        raise DamagedError(f"{name} holds neither numbers nor characters")
    if made.get_layout() == h5py.h5d.VIRTUAL or made.get_external_count():
        raise DamagedError(f"{name} has its data elsewhere")
    filters = {made.get_filter(i)[0] for i in range(made.get_nfilters())}
    if not filters <= _FILTERS:
        raise DamagedError(f"{name} is stored by a filter of another program")
    stored = int(data.id.get_storage_size())
    most = stored * (_DEFLATED if h5py.h5z.FILTER_DEFLATE in filters else 1)
    if data.shape is None or prod(data.shape) * kind.get_size() > most:
        raise DamagedError(f"{name} claims more data than are stored of it")
    return stored


def attribute(group: h5py.Group, name: str) -> Any:
    """A text or a number among the attributes of a group or an array; a KeyError where it is none."""
    found = h5py.h5a.open(group.id, name.encode())
    kind = found.get_type()
    if found.shape != () or kind.get_class() not in (*_NUMBERS, h5py.h5t.STRING):
        raise DamagedError(f"attribute {name} of {group.name} is neither a number nor a text")
    if kind.get_size() > _longest(group):
        raise DamagedError(f"attribute {name} of {group.name} claims more data than the file has")
    return group.attrs[name]


def _longest(group: h5py.Group) -> int:
    return int(group.file.id.get_filesize())


def text(group: h5py.Group, name: str) -> str:
    """A text among the attributes of a group; a KeyError where there is none."""
    value = attribute(group, name)
    if not isinstance(value, str):
        raise DamagedError(f"attribute {name} of {group.name} is not text")
    return value


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


SCHEMA = "projservo run"
SCHEMA_VERSION = 1
SERVO = "servo/"
REMEDY = "delete it or use another"
# What results hold, by the name of the record; with a calibration, the others may be absent.
RECORDS: dict[str, dict[str, type]] = {
    "calibrate": {
        "observation": Observation,
        "calibration": Calibration,
        "cross_validation": CrossValidation,
    },
    "plan": {"": Plan},
    "servo": {"": Trace},
    "report": {"": Report},
}
_NAME = re.compile(r"calibrate|plan|report|servo/[\w.:-]+")


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
        if result not in self.results or name not in self.results[result].records:
            stage = result.split("/")[0]
            raise InputError(
                f"{self.path}: holds no {name or stage}; make it first: projservo {stage} -o {self.path}"
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
    with new_file(run.path) as file:
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
    """Read a run file, whoever made it.

    One that is as ``save`` wrote it is read here; one that another program changed is read and written
    anew by a process of its own, since damaged files can crash the library that reads them.

    Raises
    ------
    InputError
        When there is none, it is cut short, or it was not written by this version of the schema.
    """
    path = run_path(target)
    if not path.is_file():
        raise InputError(f"{path}: there is no run file; make one with: projservo calibrate -o {path.parent}")
    if sealed(path, REMEDY):
        return read(path)
    with tempfile.TemporaryDirectory(prefix="projservo-") as folder:
        copy = Path(folder) / "run.h5"
        copied(path, copy)
        return dataclasses.replace(read(copy), path=path)


def read(path: Path) -> Run:
    """Read a run file in this process; an InputError where it makes no sense."""
    with opened(path, REMEDY) as file:
        _require_version(path, file)
        results = {name: _load_result(path, file[name]) for name in _names(path, file)}
        _require_one_robot(path, results)
        return Run(path, text(file, "configuration"), results)


def _require_version(path: Path, file: h5py.File) -> None:
    """Refuse what is no run file, or one of another schema, with what to do."""
    if "schema" not in file.attrs or text(file, "schema") != SCHEMA:
        raise InputError(f"{path}: an HDF5 file, but not a run file of projservo; {REMEDY}")
    version = int(attribute(file, "schema_version"))
    if version > SCHEMA_VERSION:
        raise InputError(
            f"{path}: run file of schema {version}, this projservo reads up to {SCHEMA_VERSION}: it was made "
            "by a newer one; upgrade: pip install --upgrade projservo"
        )
    if version < SCHEMA_VERSION:
        raise InputError(
            f"{path}: run file of schema {version}, which this projservo does not read any more; make it "
            "again: projservo calibrate plan servo report -c FILE -o DIR"
        )


def _names(path: Path, file: h5py.File) -> list[str]:
    """Names of the results, in the order they were made."""
    names = _json(file, "order", list)
    for name in names:
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise InputError(f"{path}: there is no result {name!r}; {REMEDY}")
    return list(dict.fromkeys(names))


def _load_result(path: Path, group: h5py.Group) -> Result:
    known = RECORDS[group.name.split("/")[1]]
    records = {}
    for label in _json(group, "records", list):
        if label not in known:
            raise InputError(f"{path}: {group.name} holds an unknown {label!r}; {REMEDY}")
        records[label] = load_record(path, group[label] if label else group)
        if not isinstance(records[label], known[label]):
            raise InputError(f"{path}: {group.name}/{label} is no {known[label].__name__}; {REMEDY}")
    if not {"", "calibration"} & set(records):
        raise InputError(f"{path}: {group.name} lacks its record; {REMEDY}")
    inputs = _json(group, "inputs", dict)
    if not all(isinstance(value, str) for value in inputs.values()):
        raise InputError(f"{path}: inputs of {group.name} are not texts; {REMEDY}")
    provenance = _json(group, "provenance", dict)
    return Result(text(group, "key"), text(group, "configuration"), provenance, inputs, records)


def _json(group: h5py.Group, name: str, kind: type) -> Any:
    value = json.loads(text(group, name))
    if not isinstance(value, kind):
        raise ValueError(f"attribute {name} of {group.name} is no {kind.__name__}")
    return value


def _require_one_robot(path: Path, results: Mapping[str, Result]) -> None:
    """Refuse records that are about robots with different joints."""
    first: tuple[str, int] | None = None
    for name, result in results.items():
        for record in result.records.values():
            joints = joints_of(record)
            if isinstance(record, Calibration) and not re.fullmatch(f"[RP]{{{joints}}}", record.joint_types):
                raise InputError(f"{path}: joint_types are not {joints} letters R and P; {REMEDY}")
            first = first or (None if joints is None else (name, joints))
            if joints is not None and first is not None and joints != first[1]:
                raise InputError(f"{path}: {name} is of {joints} joints, {first[0]} of {first[1]}; {REMEDY}")


SWEEP_SCHEMA = "projservo sweep"
SCHEMA_VERSION = 1
TABLE = "sweep.h5"
ROWS = 16_384  # of a chunk of the file
_NO_VARIABLE_sweepfile = "This is a netCDF dimension but not a netCDF variable. {:10d}"
TRACES = "traces"

Array = npt.NDArray[Any]
# Name, NumPy type, unit and description of a column.
Heading = tuple[str, str, str, str]


def write_part(path: Path, columns: Mapping[str, Array], traces: Mapping[int, Trace]) -> None:
    """Write rows and traces, as a whole or not at all.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    with new_file(path) as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, **checksummed(values.shape))
        for run, trace in traces.items():
            save_record(file.create_group(f"{TRACES}/{run}"), trace)


def assemble(
    path: Path, parts: Sequence[Path], headings: Sequence[Heading], attributes: Mapping[str, Any]
) -> int:
    """Put parts together, in the order given, a few at a time; the number of rows.

    Parameters
    ----------
    attributes : of the file: numbers and texts, everything else as JSON.

    Raises
    ------
    InputError
        If a part is damaged or the file cannot be written; the table that stood there stays.
    """
    rows = sum(_rows(part) for part in parts)
    size = rows * sum(np.dtype(dtype).itemsize for _, dtype, _, _ in headings)
    size += sum(part.stat().st_size for part in parts)  # their traces
    with new_file(path, size) as file:
        file.attrs["schema"] = SWEEP_SCHEMA
        file.attrs["schema_version"] = SCHEMA_VERSION
        for name, value in attributes.items():
            file.attrs[name] = value if isinstance(value, (str, int, float)) else json.dumps(value)
        for heading in headings:
            _make_column(file, rows, heading)
        _attach_scales_sweepfile(file, headings)
        at = 0
        for block in _blocks(parts, headings):
            size = len(block[headings[0][0]])
            for name, dtype, _, _ in headings:
                file[name][at : at + size] = _stored(block[name], dtype)
            at += size
        _copy_traces(file, parts)
    return rows


def _make_column(file: h5py.File, rows: int, heading: Heading) -> None:
    name, dtype, units, about = heading
    width = (int(dtype[1:]),) if dtype.startswith("S") else ()
    shape = (rows, *width)
    data = file.create_dataset(
        name,
        shape,
        dtype="S1" if width else dtype,
        chunks=(max(1, min(rows, ROWS)), *width),
        compression=1,
        shuffle=True,
        fletcher32=True,
    )
    data.attrs["long_name"] = about
    if width:
        data.attrs["_Encoding"] = "utf-8"
    else:
        data.attrs["units"] = units


def _attach_scales_sweepfile(file: h5py.File, headings: Sequence[Heading]) -> None:
    file["run"].make_scale("run")
    for name, dtype, _, _ in headings:
        if name != "run":
            file[name].dims[0].attach_scale(file["run"])
        if dtype.startswith("S"):
            dimension = f"characters_{dtype[1:]}"
            if dimension not in file:
                size = int(dtype[1:])
                file.create_dataset(dimension, data=np.zeros(size, dtype=np.float32))
                file[dimension].make_scale(_NO_VARIABLE_sweepfile.format(size))
            file[name].dims[1].attach_scale(file[dimension])


def _stored(values: Array, dtype: str) -> Array:
    if not dtype.startswith("S"):
        return values
    return np.ascontiguousarray(values.astype(dtype)).view("S1").reshape(len(values), int(dtype[1:]))


def _blocks(parts: Sequence[Path], headings: Sequence[Heading]) -> Iterator[dict[str, Array]]:
    """Rows of parts in blocks of about those of a chunk of the file."""
    waiting: list[dict[str, Array]] = []
    count = 0
    for part in parts:
        waiting.append(_read_part(part, [heading[0] for heading in headings]))
        count += len(waiting[-1][headings[0][0]])
        if count >= ROWS:
            yield _joined(waiting)
            waiting, count = [], 0
    if waiting:
        yield _joined(waiting)


def _joined(blocks: Sequence[dict[str, Array]]) -> dict[str, Array]:
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _read_part(path: Path, names: Sequence[str]) -> dict[str, Array]:
    try:
        with h5py.File(path, "r", locking=False) as file:
            return {name: file[name][()] for name in names}
    except (OSError, KeyError) as error:
        what = " ".join(str(error).split())
        raise InputError(f"{path}: damaged ({what}); delete it and run the sweep again") from error


def _rows(path: Path) -> int:
    _require_whole(path)
    return len(_read_part(path, ["run"])["run"])


def _require_whole(path: Path) -> None:
    """Refuse a file that is not as it was written; nothing of it is read before."""
    remedy = "delete it and run the sweep again"
    if not sealed(path, remedy):
        raise InputError(f"{path}: changed by another program, so that its checksum is gone; {remedy}")


def _copy_traces(file: h5py.File, parts: Sequence[Path]) -> None:
    for part in parts:
        with h5py.File(part, "r", locking=False) as source:
            for run in source.get(TRACES, ()):
                # Not as they are: references to dimensions do not survive a copy to another file.
                trace = load_record(part, source[f"{TRACES}/{run}"])
                save_record(file.create_group(f"{TRACES}/{run}"), trace)


class SweepTable:
    """A table read from its file, a column at a time.

    Parameters
    ----------
    path : the file.

    Attributes
    ----------
    names : of the columns.
    attributes : of the file; JSON as its values.

    Raises
    ------
    InputError
        If there is none or it is no table of a sweep.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise InputError(f"{path}: there is no table of a sweep; make one with projservo sweep")
        _require_whole(path)
        try:
            with h5py.File(path, "r", locking=False) as file:
                if file.attrs.get("schema") != SWEEP_SCHEMA:
                    raise InputError(f"{path}: not the table of a sweep")
                if int(file.attrs["schema_version"]) != SCHEMA_VERSION:
                    raise InputError(f"{path}: written by another version of projservo; use another sweep")
                self.attributes = {name: _plain(value) for name, value in file.attrs.items()}
                self.names = tuple(json.loads(file.attrs["columns"]))
                self.rows = len(file["run"])
        except (OSError, KeyError) as error:
            what = " ".join(str(error).split())
            raise InputError(f"{path}: cut short or damaged ({what}); run the sweep again") from error

    def column(self, name: str) -> Array:
        """Values (k,) of a column; texts as Python texts would be, of fixed width."""
        with h5py.File(self.path, "r", locking=False) as file:
            values = file[name][()]
        if values.ndim == 2:
            values = np.char.decode(values.view(f"S{values.shape[1]}")[:, 0], "utf-8")
        return np.asarray(values)

    def trace(self, run: int) -> Trace:
        """Trace of a run that was kept.

        Raises
        ------
        InputError
            If it was not.
        """
        with h5py.File(self.path, "r", locking=False) as file:
            if f"{TRACES}/{run}" not in file:
                raise InputError(f"{self.path}: the trace of run {run} was not kept; list it under traces")
            found: Trace = load_record(self.path, file[f"{TRACES}/{run}"])
            return found


def _plain(value: Any) -> Any:
    if isinstance(value, str) and value[:1] in ("{", "["):
        return json.loads(value)
    return value.item() if isinstance(value, np.generic) else value
