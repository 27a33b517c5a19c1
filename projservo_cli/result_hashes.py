"""Keys of results: hashes of the canonical bytes of the records that stages read.

Equal values have equal bytes, so that the inputs of a stage alone decide whether its result is outdated.
They contain files by their content, and plug-ins by their sources, which are found without running any.
"""

import ast
import dataclasses
import hashlib
import json
import os
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.passwords import masked
from projservo_cli.records import InputError

# Types whose records are keyed by their first module: one that moves keeps its name here,
# so that results of users stay valid. Other types are keyed by their own names, each of which must be unique.
_FIRST_MODULES = {
    "control.law": "Gains",
    "detection": "Board",
    "display": "About",
    "records": "JointLimits",
    "robots.settings": "Following JointSettings SpeedLimits",
    "settings.cameras": "Cameras Source",
    "settings.control": "RenderedOptions Stop",
    "settings.disturbance": (
        "Disturbance EachView Events Faults JointMoved LostMarkers StuckEncoder _CameraMoved "
        "_MarkerMoved _ObjectMoved"
    ),
    "settings.markers": "Tag",
    "settings.features": "Feature Pair",
    "settings.objects": "Displacement ObjectSettings Objects",
    "settings.sections": "JointVector",
    "settings.task": (
        "DisplacedAlong Goal GoalImages KeptOut TaskSettings TaskStep Trajectory _Approach "
        "_ObjectImages _Perturbation _Search"
    ),
    "simulation.arm": "SerialArm",
    "simulation.faults": "SimulatedRobot",
    "simulation.rendering": "RenderedScene",
    "simulation.streams": "NoiseShape",
    "simulation.workspace": "SceneObject Truth",
    "stages.stage_inputs": (
        "CalibrationInputs CarryingObject Contract Drive Estimation KnownLengths Motions OwnRobot "
        "PlanInputs PreflightInputs RecordingInputs RefitInputs ReportInputs Scenery ServoInputs "
        "SuggestionInputs Table TeachInputs Trials"
    ),
    "task.incidences": "Incidence",
    "task.stand_off": "StandOff",
}
# Fields that records had not at first: they count where they are not as by default, so that older keys hold.
_ADDED: dict[str, dict[str, Any]] = {
    "Contract": {"ideal": False},
    "Estimation": {"boards": (), "intrinsics": (), "focal_std_fraction": 0.005, "center_std_fraction": 0.01},
    "Markers": {"boards": None},
    **{name: {"staggered": False} for name in ("KnownBoard", "StatedBoard")},
    "ObjectSettings": {
        "follow": False,
        "acceleration": 20.0,
        "max_acceleration": 1000.0,
        "max_speed_mm_s": None,
        "lost_s": 0.5,
        "approach_mm": 0.0,
        "velocity": None,
        "path": None,
    },
    "RenderedScene": {"moving": ()},
    "SceneObject": {"motion": None},
    "Stop": {"follow_s": 2.0},
    **{name: {"flange_chart": None} for name in ("JointSettings", "OwnRobot", "Table")},
}
# Records whose fields count as those of the record that holds them, as they did at first.
_PARTS = ("Described", "ToolMarkers")
_KINDS = {
    name: f"projservo_cli.{module}:{name}"
    for module, names in _FIRST_MODULES.items()
    for name in names.split()
}


class File(NamedTuple):
    """A file that a stage reads, which may lie anywhere."""

    path: str
    sha256: str  # hash of its content

    @classmethod
    def of(cls, path: str, expected: str, gone: str = "", further: Sequence[str] = ()) -> "File":
        """Return the file at a path; InputError with the ``expected`` file if it cannot be read.

        gone : hash that it had, which holds if there is no such file any more.
        further : files that it names, whose content counts too.
        """
        if gone and not Path(path).exists():
            return cls(path, gone)
        contents = []
        for name in (path, *further):
            try:
                contents.append(digest(Path(name).read_bytes()))
            except OSError as error:
                reason = f"cannot be read: {error.strerror or error}; expected {expected}"
                raise InputError(f"{name}: {reason}") from error
        return cls(path, digest("".join(contents).encode()) if further else contents[0])


def digest(content: bytes) -> str:
    """Return the SHA-256 of bytes, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def key_of(inputs: Any, **more: Any) -> str:
    """Return the hash of the inputs of a stage, and of further values: its predecessors and its law."""
    return digest(encoded([inputs, more]))


def encoded(record: Any) -> bytes:
    """Return the canonical bytes of a record of plain values, arrays, files and further records."""
    return json.dumps(_canonical(record), separators=(",", ":"), ensure_ascii=False).encode()


def _fields(record: Any) -> dict[str, Any]:
    """Values of a dataclass, a named tuple or a section by their names; none of other values."""
    if dataclasses.is_dataclass(record):
        found = dict[str, Any]()
        for name in (field.name for field in dataclasses.fields(record)):
            value = getattr(record, name)
            found |= _fields(value) if type(value).__name__ in _PARTS else {name: value}
        return found
    if hasattr(type(record), "model_fields"):
        return dict(record)  # with keys that are names of views
    return {name: getattr(record, name) for name in getattr(record, "_fields", ())}


def _canonical(value: Any) -> Any:
    """A value as JSON, in which every mapping has one key, its type."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return masked(value)  # as in a run file, whose configuration has the same key
    if isinstance(value, File):
        return {"file": value.sha256}
    if isinstance(value, np.ndarray):
        return {"array": [value.dtype.str, value.shape, value.tobytes().hex()]}
    if (fields := _fields(value)) or hasattr(type(value), "model_fields"):
        name = type(value).__qualname__
        added = _ADDED.get(name, {})
        fields = {
            key: inner
            for key, inner in fields.items()
            if key not in added or (isinstance(inner, np.ndarray) or inner != added[key])
        }
        return {_KINDS.get(name, name): {key: _canonical(inner) for key, inner in fields.items()}}
    if isinstance(value, dict):
        return {"mapping": {key: _canonical(value[key]) for key in sorted(value)}}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_canonical(inner) for inner in value]}
    raise TypeError(f"{type(value).__name__} has no canonical bytes")


# Folders of installed modules, which are no plug-ins' own.
_INSTALLED = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})


def source_hash(target: str) -> str:
    """Return a hash of the module of a class and of all modules of its author that it imports.

    Modules of the author are in the same package, or were not installed. They are found by
    the import statements of each; one that is imported by a name made at run time is not.

    target : ``module:Class``.
    The hash is empty if the module is not found, or has no source.
    """
    module = target.split(":")[0]
    top = module.split(".")[0]
    sources: dict[str, bytes] = {}
    due = [module]
    while due:
        for spec in _specs(due.pop()):
            if spec.name not in sources and (source := _source(spec, top)) is not None:
                sources[spec.name] = source
                due += _imports(spec, source)
    if module not in sources:
        return ""
    digest = hashlib.sha256()
    for name, source in sorted(sources.items()):
        digest.update(f"{name}\0{len(source)}\0".encode() + source)
    return digest.hexdigest()


def _specs(module: str) -> Iterator[ModuleSpec]:
    """Specifications of the packages of a module and of itself, as far as there are any."""
    parts, path = module.split("."), None
    for i in range(len(parts)):
        name = ".".join(parts[: i + 1])
        finders = (finder.find_spec(name, path) for finder in sys.meta_path)
        spec = next((candidate for candidate in finders if candidate is not None), None)
        if spec is None and path is None:
            spec = PathFinder.find_spec(name, [os.getcwd()])
        if spec is None:
            return
        yield spec
        path = spec.submodule_search_locations
        if path is None:
            return


def _source(spec: ModuleSpec, top: str) -> bytes | None:
    """Source of a module of the author whose package is ``top``; None if it is of another or has none."""
    if not spec.has_location or not (spec.origin or "").endswith(".py"):
        return None
    file = Path(spec.origin or "")
    own = spec.name.split(".")[0]
    if own != top and (own == "projservo_cli" or any(file.is_relative_to(folder) for folder in _INSTALLED)):
        return None
    try:
        return file.read_bytes()
    except OSError:
        return None


def _imports(spec: ModuleSpec, source: bytes) -> Iterator[str]:
    """Names of modules that a source imports, or may: a name from a package may be a module of it."""
    try:
        statements = list(ast.walk(ast.parse(source)))
    except (SyntaxError, ValueError):  # its import reports it
        return
    package = spec.name.split(".") if spec.submodule_search_locations else spec.name.split(".")[:-1]
    for statement in statements:
        if isinstance(statement, ast.Import):
            yield from (alias.name for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom):
            above = package[: len(package) + 1 - statement.level] if statement.level else []
            base = ".".join([*above, *(statement.module or "").split(".")]).strip(".")
            if base:
                yield base
                yield from (f"{base}.{alias.name}" for alias in statement.names)
