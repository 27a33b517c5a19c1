"""The run file: everything an experiment made, one group a result, with the records in it or in subgroups.

Nothing but this package opens HDF5. The groups are ``calibrate``, ``plan``, ``servo/<law>`` and ``report``.

A field may be added to a record where it may be absent or has a default. Whatever else changes the
file raises ``SCHEMA_VERSION``; files of the version before are then read as well, or refused with
what to do.
"""

import dataclasses
import io
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import h5py

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
from projservo_cli.store.hdf5 import (
    SCHEMA_VERSION,
    attribute,
    labelled,
    load_record,
    member,
    new_file,
    opened,
    require_names,
    save_record,
)

_Record = TypeVar("_Record", Observation, Calibration, Plan)
_SCHEMA = "projservo run"
SERVO = "servo/"
# What results hold, by the name of the record; with a calibration, the others may be absent.
_RECORDS: dict[str, dict[str, type]] = {
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
_ANEW = "restore it, or make it anew in another folder"


@dataclasses.dataclass(frozen=True)
class Result:
    """What one stage (or one law of ``servo``) made, and from what."""

    key: str  # hash of all the result depends on
    configuration: str  # resolved YAML
    provenance: Mapping[str, Any]  # versions, host, date and so on; JSON values
    inputs: Mapping[str, str]  # files read and their hashes
    records: Mapping[str, Any]  # the records by name; the name "" stands for the only one


@dataclasses.dataclass(frozen=True)
class Run:
    """A run file in memory."""

    path: Path
    configuration: str = ""
    results: Mapping[str, Result] = dataclasses.field(default_factory=dict)
    # The bytes that were last written, and the results in them.
    written: tuple[bytes, Mapping[str, Result]] = dataclasses.field(
        default=(b"", {}), repr=False, compare=False
    )

    @property
    def observation(self) -> Observation:
        """What the calibration was made from."""
        return self._record("calibrate", "observation", Observation)

    @property
    def calibration(self) -> Calibration:
        """The calibration."""
        return self._record("calibrate", "calibration", Calibration)

    @property
    def cross_validation(self) -> CrossValidation | None:
        """Held-out errors of the calibration; None where they were not asked for."""
        result = self.results.get("calibrate")
        return None if result is None else result.records.get("cross_validation")

    @property
    def plan(self) -> Plan:
        """The plan."""
        return self._record("plan", "", Plan)

    @property
    def traces(self) -> dict[str, Trace]:
        """Traces by law, in the order they were first made."""
        found = {name: result for name, result in self.results.items() if name.startswith(SERVO)}
        return {name.removeprefix(SERVO): result.records[""] for name, result in found.items()}

    def _record(self, result: str, name: str, kind: type[_Record]) -> _Record:
        found = self.results[result].records.get(name) if result in self.results else None
        if isinstance(found, kind):
            return found
        raise InputError(
            f"{self.path}: holds no {name or result}; make it first: projservo {result} -o {self.path}"
        )


def run_path(target: Path | str) -> Path:
    """The run file in a folder, or the file itself."""
    target = Path(target)
    return target if target.suffix == ".h5" or target.is_file() else target / "run.h5"


def save(run: Run) -> Run:
    """Write a run file in place of the one at ``run.path``, as a whole or not at all.

    Results are added to those that were last written, where none of these went, in 0.1 s each: a chain of
    eight results spends a quarter of the time on it that writing all of them each time takes. Returns the run
    as it is written, to be added to. Raises InputError when it cannot be written.
    """
    image, held = run.written
    if not all(run.results.get(name) is result for name, result in held.items()):
        image, held = b"", {}
    stream = io.BytesIO(image)
    with new_file(run.path, image=stream) as new, labelled(new) as file:
        told = {"configuration": run.configuration, "order": json.dumps(list(run.results))}
        file.attrs.update({"schema": _SCHEMA, "schema_version": SCHEMA_VERSION, **told})
        for name, result in run.results.items():
            if name in held:
                continue
            group = file.create_group(name)
            group.attrs.update({"key": result.key, "configuration": result.configuration})
            for part in ("provenance", "inputs"):
                group.attrs[part] = json.dumps(getattr(result, part), sort_keys=True)
            group.attrs["records"] = json.dumps(list(result.records))
            for label, record in result.records.items():
                save_record(group.create_group(label) if label else group, record)
    return dataclasses.replace(run, written=(stream.getvalue(), dict(run.results)))


def load(target: Path | str) -> Run:
    """Read a run file; an InputError if there is none, it was changed since, or another version made it."""
    path = run_path(target)
    if not path.is_file():
        raise InputError(f"{path}: there is no run file; make one with: projservo calibrate -o {path.parent}")
    with opened(path, _ANEW, unchanged=True) as file:
        _require_version(path, file)
        names = list(dict.fromkeys(attribute(file, "order", list)))
        if unknown := [name for name in names if not _NAME.fullmatch(name)]:
            raise ValueError(f"there is no result {unknown[0]!r}")
        require_names(file, {name.split("/")[0] for name in names})
        sizes = dict(SIZES)
        results = {name: _load_result(member(file, name), sizes) for name in names}
        return Run(path, attribute(file, "configuration", str), results)


def _require_version(path: Path, file: h5py.File) -> None:
    """Refuse what is no run file, or one of another schema, with what to do."""
    if "schema" not in file.attrs or attribute(file, "schema", str) != _SCHEMA:
        raise InputError(f"{path}: an HDF5 file, but not a run file of projservo; name another")
    if (version := attribute(file, "schema_version", int)) != SCHEMA_VERSION:
        raise InputError(
            f"{path}: run file of schema {version}, this projservo reads {SCHEMA_VERSION}: upgrade, pip "
            "install --upgrade projservo, or make it again: projservo calibrate plan servo report -c FILE"
        )


def _load_result(group: h5py.Group, sizes: dict[str, int]) -> Result:
    known = _RECORDS[group.name.split("/")[1]]
    labels = attribute(group, "records", list)
    if not {"", "calibration"} & set(labels) or not set(labels) <= set(known):
        raise ValueError(f"{group.name} holds the records {labels}")
    groups = {label: member(group, label) if label else group for label in labels}
    records = {label: load_record(inner, known[label], sizes) for label, inner in groups.items()}
    if "" not in labels:
        require_names(group, set(labels))
    inputs = attribute(group, "inputs", dict)
    if not all(isinstance(value, str) for value in inputs.values()):
        raise ValueError(f"inputs of {group.name} are not texts")
    key, configuration = attribute(group, "key", str), attribute(group, "configuration", str)
    return Result(key, configuration, attribute(group, "provenance", dict), inputs, records)
