"""The run file: everything an experiment made, as HDF5 that xarray opens with named dimensions.

One group a result (``calibrate``, ``plan``, ``servo/<law>``, ``report``), with the records in it or
in subgroups. Arrays are netCDF-4 variables with dimension scales, units and a description; scalars
and texts are attributes of the group. A file is written anew and put in place as a whole.

A field may be added to a record where it may be absent or has a default. Whatever else changes the
file raises ``SCHEMA_VERSION``; files of the version before are then read as well, or refused with
what to do.
"""

import dataclasses
import json
import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py

from projservo_cli.hdf5 import attribute, new_file, opened, sealed, text
from projservo_cli.quarantine import copied
from projservo_cli.recordfile import joints_of, load_record, save_record
from projservo_cli.records import Calibration, CrossValidation, InputError, Observation, Plan, Report, Trace

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
