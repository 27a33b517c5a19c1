"""Run file (HDF5): all that an experiment made, one group a result, with the records in it or in subgroups.

Only this package opens HDF5. The groups are ``calibrate``, ``plan``, ``servo/<law>`` and ``report``, of a
sequence ``plan/<step>`` and ``servo/<step>/<law>``, or ``servo/<step>`` of one that no law drives. Arrays
are netCDF-4 variables, by h5netcdf; scalars and texts are attributes of their group. Files are written as a
whole, and a line behind the HDF5 data has their checksum, which reading requires.

A new field of a record must be optional or have a default. Any other change of the file raises
``SCHEMA_VERSION``; files of the previous version are then read too, or refused with a remedy.
"""

import dataclasses
import errno
import hashlib
import io
import json
import os
import re
import shutil
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter, ValidationError

from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, from_columns, from_text, sparse
from projservo_cli.messages import sentence, sentence_and_remedy, setup_of
from projservo_cli.messages.verdict_causes import arrived
from projservo_cli.records import (
    SIZES,
    VIEWS,
    Action,
    Calibration,
    CrossValidation,
    InputError,
    Observation,
    Plan,
    Report,
    Trace,
    changed,
    composed,
    flat_fields,
    has_default,
    is_list,
    is_optional,
    optional_names,
    part_of,
    scalars_of,
)
from projservo_cli.store.files_and_locks import replacing

if typing.TYPE_CHECKING:
    import h5netcdf

SCHEMA_VERSION = 3  # version of the layout of a file
_SIGNATURE = b"\x89HDF\r\n\x1a\n"  # first bytes of an HDF5 file
_FLAGS = 3  # bytes from it to the flags of a file that is open (HDF5 File Format 3.0, superblock version 3)
_SEAL = b"\nprojservo sha256 %s\n"  # last line of a file, with its checksum
_SEAL_SIZE = len(_SEAL % bytes(64))  # bytes of that line
_AT_ONCE = 2**23  # bytes that are written or hashed together
_FORMAT = ("v110", "v110")  # format of HDF5 since 2016, with checksums in its structures
_ERRORS = (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError)
# Stored kind and size in bytes of the numbers of each type of array.
_STORED = {"float64": ("f", 8), "int64": ("i", 8), "bool": ("i", 1), "uint8": ("u", 1)}
_Record = TypeVar("_Record", Observation, Calibration, Plan)
_SCHEMA = "projservo run"  # value of the attribute ``schema``
SWEEP = "sweep.h5"  # name of the table of a sweep
SERVO = "servo/"  # prefix of the groups of laws
# Types of the records of results, by name; with a calibration the others are optional.
_RECORDS: dict[str, dict[str, type]] = {
    "calibrate": {
        "observation": Observation,
        "calibration": Calibration,
        "cross_validation": CrossValidation,
    },
    "plan": {"": Plan},
    "servo": {"": Trace, "action": Action},
    "report": {"": Report},
}
_NAME = re.compile(r"calibrate|plan(/[\w-]+)?|report|servo/([\w-]+/)?[\w.:-]+")
_OLDER = "make it again in another folder: projservo calibrate plan servo report -c FILE -o FOLDER"
_REMEDY = "restore it, or make it again in another folder"


@dataclasses.dataclass(frozen=True)
class Result:
    """Result of one stage, or of one law of ``servo``, and its inputs."""

    key: str  # hash of all inputs of the result
    configuration: str  # resolved YAML
    provenance: Mapping[str, Any]  # versions, host, date and so on; JSON values
    inputs: Mapping[str, str]  # files read and their hashes
    records: Mapping[str, Any]  # the records by name; the name "" means the only one


@dataclasses.dataclass(frozen=True)
class Run:
    """A run file in memory."""

    path: Path
    configuration: str = ""
    results: Mapping[str, Result] = dataclasses.field(default_factory=dict)
    refuted: str = ""  # a later contradiction of its calibration's recording, in words
    # Bytes of the last write, and the results in them.
    written: tuple[bytes, Mapping[str, Result]] = dataclasses.field(
        default=(b"", {}), repr=False, compare=False
    )

    @property
    def observation(self) -> Observation:
        """Observation that the calibration was made from."""
        return self._record("calibrate", "observation", Observation)

    @property
    def calibration(self) -> Calibration:
        """Calibration of the run. Raises InputError if there is none."""
        return self._record("calibrate", "calibration", Calibration)

    @property
    def cross_validation(self) -> CrossValidation | None:
        """Held-out errors of the calibration; None if there was no cross-validation."""
        result = self.results.get("calibrate")
        return None if result is None else result.records.get("cross_validation")

    @property
    def plan(self) -> Plan:
        """Plan of the run. Raises InputError if there is none."""
        return self._record("plan", "", Plan)

    @property
    def traces(self) -> dict[str, Trace]:
        """Traces by law, of a sequence by step and law, in the order of their first runs."""
        found = {name: result for name, result in self.results.items() if name.startswith(SERVO)}
        found = {name: result for name, result in found.items() if "" in result.records}
        return {name.removeprefix(SERVO): result.records[""] for name, result in found.items()}

    def at_step(self, step: str) -> "Run":
        """Return the calibration of a sequence with plan and trace of one of its steps."""
        each = {(*name.split("/"), ""): one for name, one in self.results.items()}
        found = {"/".join(name[::2]).rstrip("/"): one for name, one in each.items() if name[1] == step}
        return dataclasses.replace(self, results={"calibrate": self.results["calibrate"], **found})

    def _record(self, result: str, name: str, kind: type[_Record]) -> _Record:
        found = self.results[result].records.get(name) if result in self.results else None
        if isinstance(found, kind):
            return found
        raise InputError(
            f"{self.path}: holds no {name or result}; make it first: projservo {result} -o {self.path}"
        )


def run_path(target: Path | str) -> Path:
    """Path of the run file in a folder, or the file itself."""
    target = Path(target)
    return target if target.suffix == ".h5" or target.is_file() else target / "run.h5"


def save(run: Run) -> Run:
    """Replace the run file at ``run.path``, and return the run with the bytes written.

    A save adds results to the last write if none of these changed, in 0.1 s each: a chain of eight
    results spends a quarter of the time of complete writes.
    """
    image, written = run.written
    if not all(run.results.get(name) is result for name, result in written.items()):
        image, written = b"", {}
    stream = io.BytesIO(image)
    with new_file(run.path, image=stream) as new, labelled(new) as file:
        attributes = {"configuration": run.configuration, "order": json.dumps(list(run.results))}
        if run.refuted or "refuted" in file.attrs:
            attributes["refuted"] = run.refuted
        file.attrs.update({"schema": _SCHEMA, "schema_version": SCHEMA_VERSION, **attributes})
        for name, result in run.results.items():
            if name in written:
                continue
            group = file.create_group(name)
            group.attrs.update({"key": result.key, "configuration": result.configuration})
            for part in ("provenance", "inputs"):
                group.attrs[part] = json.dumps(getattr(result, part), sort_keys=True)
            group.attrs["records"] = json.dumps(list(result.records))
            for label, record in result.records.items():
                save_record(group.create_group(label) if label else group, record)
    return dataclasses.replace(run, written=(stream.getvalue(), dict(run.results)))


def stored(target: Path | str) -> Run:
    """Read a run file as ``load`` does; an empty run if there is none yet."""
    path = run_path(target)
    return load(path) if path.exists() or (path.parent / SWEEP).is_file() else Run(path)


def load(target: Path | str) -> Run:
    """Read a run file. Raises InputError if it is missing, changed, or of another version."""
    path = run_path(target)
    if not path.is_file() or path.name == SWEEP:
        if (path.parent / SWEEP).is_file():
            raise InputError(
                f"{path.parent}: holds a sweep and no run; see projservo report {path.parent}, or repeat a "
                f"run of it: projservo servo --from {path.parent}:INDEX"
            )
        raise InputError(f"{path}: there is no run file; make one with: projservo calibrate -o {path.parent}")
    with opened(path, _REMEDY, unchanged=True) as file:
        if "schema" not in file.attrs or attribute(file, "schema", str) != _SCHEMA:
            raise InputError(f"{path}: an HDF5 file, but not a run file of projservo; name another")
        if (version := attribute(file, "schema_version", int)) != SCHEMA_VERSION:
            raise InputError(
                f"{path}: run file of schema {version}, this projservo reads {SCHEMA_VERSION}: "
                + ("upgrade: pip install --upgrade projservo" if version > SCHEMA_VERSION else _OLDER)
            )
        names = list(dict.fromkeys(attribute(file, "order", list)))
        if unknown := [name for name in names if not _NAME.fullmatch(name)]:
            raise ValueError(f"there is no result {unknown[0]!r}")
        _require_names(file, {name.split("/")[0] for name in names})
        sizes = dict(SIZES)
        results = {name: _load_result(_member(file, name), sizes) for name in names}
        refuted = attribute(file, "refuted", str) if "refuted" in file.attrs else ""
        return Run(path, attribute(file, "configuration", str), results, refuted)


def _load_result(group: h5py.Group, sizes: dict[str, int]) -> Result:
    known = _RECORDS[group.name.split("/")[1]]
    labels = attribute(group, "records", list)
    if not {"", "calibration", "action"} & set(labels) or not set(labels) <= set(known):
        raise ValueError(f"{group.name} holds the records {labels}")
    groups = {label: _member(group, label) if label else group for label in labels}
    records = {label: load_record(inner, known[label], sizes) for label, inner in groups.items()}
    if "" not in labels:
        _require_names(group, set(labels))
    inputs = attribute(group, "inputs", dict)
    if not all(isinstance(value, str) for value in inputs.values()):
        raise ValueError(f"inputs of {group.name} are not texts")
    key, configuration = attribute(group, "key", str), attribute(group, "configuration", str)
    return Result(key, configuration, attribute(group, "provenance", dict), inputs, records)


@contextmanager
def new_file(path: Path, size: int | None = None, image: io.BytesIO | None = None) -> Iterator[h5py.File]:
    """Yield a new HDF5 file that replaces the one at ``path`` when the block succeeds.

    It is made in memory, as HDF5 handles no full disk; a file too large for that on a disk with enough space.

    size : expected size of a file to make on disk, bytes; None to make it in memory.
    image : bytes of a file to extend.
    """
    with replacing(path) as temporary:
        if size is not None and shutil.disk_usage(temporary.parent).free < size:
            raise InputError(f"{path}: cannot be written: {os.strerror(errno.ENOSPC)}")
        image = image or io.BytesIO()
        mode = "r+" if image.getbuffer().nbytes else "w"
        target = image if size is None else temporary
        with h5py.File(target, mode, libver=_FORMAT, track_order=True) as file:  # order as netCDF has it
            yield file
        if size is None:
            temporary.write_bytes(image.getbuffer())
        digest = _digest(temporary, temporary.stat().st_size)
        with temporary.open("ab") as stream:
            stream.write(_SEAL % digest.encode())


def labelled(file: h5py.File) -> "h5netcdf.File":
    """Open a new file as netCDF-4; close it before the file. Variables with dimensions take 1.5 ms each."""
    import h5netcdf  # reading does not need it

    return h5netcdf.File(file, "a" if len(file) else "w")


def _digest(path: Path, size: int) -> str:
    """SHA-256 of the first ``size`` bytes of a file, in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while size > 0 and (block := stream.read(min(size, _AT_ONCE))):
            digest.update(block)
            size -= len(block)
    return digest.hexdigest()


def _require_unchanged(path: Path, remedy: str) -> None:
    """Refuse a file whose last line is not the checksum of its other bytes, before HDF5 reads it."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head, _, flags = stream.read(len(_SIGNATURE)), stream.read(_FLAGS), ord(stream.read(1) or b"\0")
        stream.seek(max(0, size - _SEAL_SIZE))
        last = stream.read()
    if size and head != _SIGNATURE[:size]:
        raise InputError(f"{path}: no HDF5 file, so not a run file or sweep of projservo; name another")
    if last != _SEAL % _digest(path, size - _SEAL_SIZE).encode():
        if head == _SIGNATURE and flags & 1:
            raise InputError(f"{path}: is open for writing {_holder(path)}: close it there, and try again")
        raise InputError(
            f"{path}: cut short or changed since it was written, as by opening it for writing; {remedy}"
        )


def _holder(path: Path) -> str:
    """Tell who holds an HDF5 file open, as far as this process knows."""
    opened = [h5py.h5f.get_name(one) for one in h5py.h5f.get_obj_ids(types=h5py.h5f.OBJ_FILE)]
    here = any(Path(os.fsdecode(name)).resolve() == path.resolve() for name in opened)
    return "in this process, such as by h5py or xarray" if here else "by another program, such as a viewer"


@contextmanager
def opened(path: Path, remedy: str, *, unchanged: bool = False) -> Iterator[h5py.File]:
    """Yield a file to read, its checksum verified if ``unchanged``. Raises InputError for any error."""
    try:
        if unchanged:
            _require_unchanged(path, remedy)
        try:
            file = h5py.File(path, "r", locking=False)
        except OSError:
            if not _holder(path).startswith("in this"):
                raise
            file = h5py.File(io.BytesIO(path.read_bytes()), "r")  # past whoever holds it otherwise
        with file:
            yield file
    except InputError:
        raise
    except _ERRORS as error:
        what = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise InputError(f"{path}: cannot be read, or another version made it ({what}); {remedy}") from error


def _member(group: h5py.Group, name: str) -> Any:
    """Group or array in the file itself. Raises ValueError for a link to elsewhere."""
    for part in name.split("/"):
        if not isinstance(group.get(part, getlink=True), h5py.HardLink):
            raise ValueError(f"{group.name} lacks {part}")
        group = group[part]
    return group


def _require_names(group: h5py.Group, known: set[str]) -> None:
    """Raise ValueError for a group with unknown members."""
    if unknown := sorted(set(group) - known):
        raise ValueError(f"{group.name} holds an unknown {unknown[0]}")


def attribute(group: h5py.Group, name: str, kind: type = object) -> Any:
    """Attribute of a group, a text or a number; lists and dictionaries are stored as JSON."""
    if name not in group.attrs:
        raise ValueError(f"{group.name} lacks {name}")
    value = group.attrs[name]
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.item()  # netCDF makes numbers arrays of one entry
    if kind in (list, dict):
        value = json.loads(value)
    if not isinstance(value, kind):
        raise ValueError(f"{name} of {group.name} is no {kind.__name__}")
    return value


def save_record(group: "h5netcdf.Group", record: Any) -> None:
    """Store each field of a record that is not None; of a list the parts after the first as groups."""
    group.attrs["record"] = type(record).__name__
    sizes, arrays = dict(SIZES), {}
    for field in flat_fields(type(record)):
        value = getattr(record, field.name)
        if value is not None and "dims" in field.metadata:
            arrays[field] = np.asarray(value)
            _require_sizes(field.name, field.metadata["dims"], arrays[field].shape, sizes)
    for name, scalar in scalars_of(record).items():
        if scalar is not None:
            group.attrs[name] = as_attribute(scalar)
    group.dimensions.update({dim: sizes[dim] for field in arrays for dim in field.metadata["dims"]})
    for field, value in arrays.items():
        boolean = value.dtype == np.bool_
        data = group.create_variable(
            field.name,
            field.metadata["dims"],
            data=value.astype(np.int8) if boolean else value,
            **_checked(value),
        )
        data.attrs.update({"units": field.metadata["units"], "long_name": field.metadata["about"]})
        if boolean:  # netCDF has no booleans; xarray marks them so
            data.attrs["dtype"] = "bool"
    for place, part in further_parts(record):
        save_record(group.create_group(place), part)
    if isinstance(record, Trace):  # a coordinate, which reading makes of the period again
        seconds = record.period * np.arange(sizes["time"])
        time = group.create_variable("time", ("time",), data=seconds, **_checked(seconds))
        time.attrs.update({"units": "s", "long_name": "time since the first instant"})


def further_parts(record: Any) -> Iterator[tuple[str, Any]]:
    """Parts of the lists of a record after the first, with the names of their groups."""
    for entry in filter(is_list, dataclasses.fields(record)):
        for k, part in enumerate(getattr(record, entry.name)[1:], 2):
            yield f"{entry.name}_{k}", part


def dataset_of(record: Any) -> Any:
    """Convert a record to the xarray Dataset that its group in a run file opens as."""
    import xarray

    image = io.BytesIO()
    with h5py.File(image, "w", libver=_FORMAT, track_order=True) as new, labelled(new) as file:
        save_record(file.create_group("record"), record)
    return xarray.load_dataset(image, engine="h5netcdf", group="record")


def _checked(value: npt.NDArray[Any]) -> dict[str, Any]:
    """Options of an array with a checksum, in chunks of as many rows as ``_AT_ONCE`` bytes hold."""
    if not value.size:
        return {}
    rows = len(value) * _AT_ONCE // value.nbytes
    return {"chunks": (min(max(1, rows), len(value)), *value.shape[1:]), "fletcher32": True}


def _require_sizes(name: str, dims: tuple[str, ...], shape: tuple[int, ...], sizes: dict[str, int]) -> None:
    """Raise ValueError for an array over other dimensions than declared, or of other sizes than before."""
    if len(shape) != len(dims):
        raise ValueError(f"{name} of shape {shape} is no array over {', '.join(dims)}")
    for dim, size in zip(dims, shape, strict=True):
        if sizes.setdefault(dim, size) != size:
            raise ValueError(f"{name} has {size} entries along {dim}, not {sizes[dim]}")


def as_attribute(value: Any) -> Any:
    """Encode an attribute of HDF5 and netCDF: number or text; other values as JSON."""
    if isinstance(value, (bool, np.bool_)):
        return np.int8(value)
    if isinstance(value, (str, int, float, np.number)):
        return value
    return json.dumps(value, default=sparse)


def load_record(group: h5py.Group, kind: Any, sizes: dict[str, int]) -> Any:
    """Read a record; ``sizes`` has the sizes of common dimensions, and gets the number of joints."""
    if attribute(group, "record", str) != kind.__name__:
        raise ValueError(f"{group.name} is no {kind.__name__}")
    own, lacking = dict(sizes), optional_names(kind)
    views = attribute(group, "view", list) if "view" in group.attrs else VIEWS
    values: dict[str, Any] = {}
    lists: dict[str, Any] = {}
    groups: set[str] = set()
    for field in flat_fields(kind):
        name, dims, optional = field.name, field.metadata.get("dims"), is_optional(field)
        inner = typing.get_args(field.type)[0] if optional else field.type
        stored = name in (group.attrs if dims is None else group)
        if "by_view" in field.metadata:
            each, names = typing.get_args(inner)[0], (f"{name}_{view}" for view in views)
            values[name] = tuple(_value(one, attribute(group, one), each) for one in names)
        elif not stored and (optional or has_default(field)):
            values[name] = field.default if has_default(field) else None
        elif not stored and name in lacking:
            continue  # read with its part, or the part cannot be made
        elif dims is None:
            values[name] = _value(name, attribute(group, name), inner)
        else:
            values[name] = _array(_member(group, name), dims, inner, own)
    for entry in filter(is_list, dataclasses.fields(kind)):
        more = dict[str, Any]()
        while (place := f"{entry.name}_{len(more) + 2}") in group:
            more[place] = load_record(group[place], part_of(entry), dict(sizes))
        lists[entry.name], groups = tuple(more.values()), {*groups, *more}
    _require_names(group, {*values, *own, *groups})
    if "view" in values and len(values["view"]) != own.get("view", len(values["view"])):
        raise ValueError(f"{group.name} has arrays of {own['view']} views, named {', '.join(views)}")
    if "joint" in own:
        sizes["joint"] = own["joint"]
    if "joint_types" in values and not re.fullmatch(f"[RP]{{{own['joint']}}}", values["joint_types"]):
        raise ValueError(f"joint_types are not {own['joint']} letters R and P")
    if values.get("method") == "closed_form":  # it has no covariance, which all others have
        raise ValueError("its calibration is by the method closed_form, which is retired")
    record = composed(kind, values | lists)
    if "findings" in values and "findings" not in group.attrs:
        return changed(record, findings=_earlier_findings(record))
    return record


def _earlier_findings(record: Any) -> tuple[Finding, ...]:
    """Findings of a record of an earlier version, which stored sentences alone."""
    if isinstance(record, Calibration):
        return _earlier_findings_of_calibration(record)
    fails = isinstance(record, Plan) and not record.feasible
    fails |= isinstance(record, Trace) and not arrived(record.verdict)
    return (from_text(record.reason, REFUSES if fails else NOTE),)


def _earlier_findings_of_calibration(c: Calibration) -> tuple[Finding, ...]:
    """Findings of a calibration of an earlier version, which had columns of deviations, too."""
    units, setup = ["m" if letter == "P" else "rad" for letter in c.joint_types], setup_of(c)
    found = [from_text(c.reason, NOTE if c.usable else REFUSES)]
    rows = () if c.model_error_numbers is None else c.model_error_numbers.tolist()
    found += [from_columns(*one, units) for one in zip(c.model_error, rows, strict=True)]
    found += c.open_order
    if c.unshown_numbers is not None:
        hidden = from_columns(c.unshown_error[0], c.unshown_numbers.tolist(), units)
        found.append(Finding("unshown", effect_px=hidden.effect_px, others=(hidden,)))
    known = {text for one in found for text in (sentence_and_remedy(one, setup), sentence(one, setup))}
    for text in c.advice:
        if text not in known:
            found.append(from_text(text, NOTE if text in c.notes else LIMITS))
    return tuple(found)


def _array(data: Any, dims: tuple[str, ...], hint: Any, sizes: dict[str, int]) -> npt.NDArray[Any]:
    """Read an array of the declared type and dimensions, stored in the file itself."""
    if not isinstance(data, h5py.Dataset):
        raise ValueError(f"{data.name} is no array")
    _require_sizes(data.name, dims, data.shape, sizes)
    wanted = np.dtype(typing.get_args(typing.get_args(hint)[1])[0])
    if (data.dtype.kind, data.dtype.itemsize) != _STORED[wanted.name]:
        raise ValueError(f"{data.name} holds {data.dtype}, not {wanted.name}")
    if data.external or data.nbytes > data.id.get_storage_size():
        raise ValueError(f"{data.name} claims data that are not stored in it")
    return np.asarray(data[()], dtype=wanted)


def _value(name: str, value: Any, hint: Any) -> Any:
    """Decode a number, a text, or JSON, by the type of the field."""
    adapter = _adapter(hint)
    validate = adapter.validate_json if typing.get_origin(hint) is tuple else adapter.validate_python
    try:
        return validate(value)
    except ValidationError as error:
        raise ValueError(f"{name} is not of type {getattr(hint, '__name__', hint)}") from error


_adapter = cache(TypeAdapter)
