"""Numbers of run files and of ``--json``, read by h5py and json alone, and how two sets of them differ."""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

# What tells when, where and by whom a result was made, not what came out.
PASSING = {
    *("key", "configuration", "provenance", "inputs", "seconds", "run", "table", "path", "order"),
    *("schema_version", "CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST", "_NCProperties"),
}
PLACEHOLDER = b"This is a netCDF dimension but not a netCDF variable"
SENTENCE = re.compile(r"\w \w+[,:;]? \w")  # texts of three words or more
# Expressions on names of an earlier version, and the names that stand there now: what moves is not lost.
RENAMED: tuple[tuple[str, str], ...] = ()
NEAR = 1e-9  # of the largest number of an array: where arithmetic was touched


def passing(name: str) -> bool:
    """Whether a name stands for what differs from run to run."""
    return name in PASSING or name.startswith("_Netcdf4") or name.endswith(("_seconds", "_ms"))


def of_json(value: Any, name: str) -> Iterator[tuple[str, np.ndarray]]:
    """Every leaf of a JSON value by its path."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if not passing(key):
                yield from of_json(inner, f"{name}/{key}")
    elif isinstance(value, list):
        yield f"{name}/length", np.array(len(value))
        for i, inner in enumerate(value):
            yield from of_json(inner, f"{name}/{i}")
    else:
        yield name, np.array(value if isinstance(value, bool | int | float | str) else str(value))


def of_file(path: Path, name: str) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays of an HDF5 file, their units and dimensions, and all scalars, by their paths."""
    with h5py.File(path) as file:
        found: list[tuple[str, np.ndarray]] = []

        def visit(inner: str, item: h5py.Dataset | h5py.Group) -> None:
            if isinstance(item, h5py.Dataset):
                if item.attrs.get("NAME", b"").startswith(PLACEHOLDER):
                    return
                axes = [scale[0].name if len(scale) else "" for scale in item.dims]
                value = item.asstr()[...] if h5py.check_string_dtype(item.dtype) else item[...]
                found.append((f"{name}/{inner}", np.asarray(value)))
                found.append((f"{name}/{inner}@dimensions", np.array(" ".join(axes))))
            for key, value in item.attrs.items():
                if not passing(key):
                    text = value.decode() if isinstance(value, bytes) else value
                    found.append((f"{name}/{inner}@{key}", np.asarray(text)))

        visit("", file)
        file.visititems(visit)
    yield from found


def plain(array: np.ndarray, folder: Path) -> np.ndarray:
    """An array that numpy stores without pickling, without the folder in its text."""
    if array.dtype.kind in "OUS":
        text = json.dumps(array.tolist(), default=str)
        return np.array(text.replace(str(folder.resolve()), "FOLDER").replace(str(folder), "FOLDER"))
    return array


def renamed(name: str) -> str:
    """A name of an earlier version as it is now, by each of ``RENAMED`` in turn."""
    for pattern, now in RENAMED:
        name = re.sub(pattern, now, name)
    return name


def differences(old: Mapping[str, np.ndarray], new: Mapping[str, np.ndarray]) -> dict[str, list[str]]:
    """Names that are ``equal`` to the bit, ``near``, ``reworded``, ``apart``, ``lost`` and ``new``."""
    old = {renamed(name): value for name, value in old.items()}
    told: dict[str, list[str]] = {kind: [] for kind in ("equal", "near", "reworded", "apart", "lost", "new")}
    for name in sorted({*old, *new}):
        if name not in new or name not in old:
            told["lost" if name in old else "new"].append(name)
            continue
        a, b = old[name], new[name]
        if a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes():
            told["equal"].append(name)
        elif a.dtype.kind == b.dtype.kind == "U" and SENTENCE.search(str(a)) and SENTENCE.search(str(b)):
            told["reworded"].append(f"{name}: {a!s:.80} to {b!s:.80}")
        elif a.dtype.kind == b.dtype.kind == "f" and a.shape == b.shape:
            off = relative(a, b)
            told["near" if off <= NEAR else "apart"].append(f"{name}: by {off:.2g} of the largest")
        else:
            shown = f"{a.dtype}{a.shape} to {b.dtype}{b.shape}" if a.ndim or b.ndim else f"{a!s} to {b!s}"
            told["apart"].append(f"{name}: {shown[:160]}")
    return told


def relative(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference over the largest number; infinite where one is NaN and the other is not."""
    if not (np.isfinite(a) == np.isfinite(b)).all():
        return float("inf")
    finite = np.isfinite(a)
    if not (a[~finite].astype(str) == b[~finite].astype(str)).all():
        return float("inf")
    if not finite.any():
        return 0.0
    return float(np.abs(a - b)[finite].max() / max(np.abs(a[finite]).max(), np.finfo(float).tiny))
