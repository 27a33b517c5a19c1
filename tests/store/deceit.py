"""Run files made with h5py to deceive, with the checksum that ``projservo`` writes."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from tests.store.sound import sound_file

Edit = Callable[[h5py.File, np.random.Generator], object]
GROUPS = ("calibrate/calibration", "calibrate/observation", "plan", "servo/stacked", "report")
# Attributes of groups, and what stands there instead; None where nothing does.
HEADS = (
    *(("/", "schema", value) for value in ("other", np.zeros(2))),
    *(("/", "schema_version", value) for value in (0, 99, "x", np.nan)),
    *(("/", "order", value) for value in ("[1]", '["../../plan"]', '["nothing"]', "{}", None)),
    ("/", "configuration", np.zeros(3)),
    *(("calibrate", "records", value) for value in ('["calibration", "x"]', "[]", '[["calibration"]]')),
    *(("plan", name, value) for name, value in (("records", '["x"]'), ("inputs", '{"a": 3}'), ("key", 3.0))),
    *(("plan", "provenance", value) for value in ("[1]", "{")),
    *((group, "record", value) for group in GROUPS for value in ("Path", "Model", None)),
    ("calibrate/calibration", "joint_types", "RRX"),
    *(("calibrate/calibration", "advice", value) for value in ('{"a": 1}', "[3]")),
    *(("report", "claims", value) for value in ('["x"]', None)),
    ("report", "figures", "[[]]"),
    *(("servo/stacked", "steps", value) for value in (np.inf, 0.5)),
    *((group, name, None) for group, name in (("plan", "tau"), ("servo/stacked", "law"))),
)


def head(group: str, name: str, value: object) -> Edit:
    """Another attribute, or none."""

    def edit(file: h5py.File, rng: np.random.Generator) -> None:
        del file[group].attrs[name]
        if value is not None:
            file[group].attrs[name] = value

    return edit


def _attribute(file: h5py.File, rng: np.random.Generator) -> None:
    group = file[GROUPS[rng.integers(len(GROUPS))]]
    names = sorted({*group.attrs} - {"configuration", "provenance", "inputs"})
    name = names[rng.integers(len(names))]
    text = isinstance(group.attrs[name], str)
    group.attrs[name] = [np.zeros(3), 1.5, np.zeros((2, 2), "S3")][rng.integers(3)] if text else "{]"


def _instead(make: Callable[[h5py.Group, str, tuple[int, ...]], object]) -> Edit:
    """Something else of the same shape under the name of an array of numbers."""

    def edit(file: h5py.File, rng: np.random.Generator) -> None:
        group = file[GROUPS[rng.integers(len(GROUPS))]]
        own = [name for name, data in group.items() if "units" in data.attrs and data.dtype == "f8"]
        name = own[rng.integers(len(own))] if own else "images"
        shape = group[name].shape
        del group[name]
        make(group, name, shape)

    return edit


def _dataset(**given: object) -> Edit:
    return _instead(lambda group, name, shape: group.create_dataset(name, **{"shape": shape} | given))


def _linked(link: Callable[[h5py.File], object]) -> Edit:
    """A link to an array that would fit."""

    def edit(file: h5py.File, rng: np.random.Generator) -> None:
        del file["plan/a"]
        file["plan/a"] = link(file)

    return edit


def _virtual(group: h5py.Group, name: str, shape: tuple[int, ...]) -> None:
    layout = h5py.VirtualLayout(shape, "f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", shape)
    group.create_virtual_dataset(name, layout)


def _huge(file: h5py.File, rng: np.random.Generator) -> None:
    del file["calibrate/calibration/outlier"], file["calibrate/calibration/outlier_row"]
    file.create_dataset("calibrate/calibration/outlier", (2**40, 3), "i8", chunks=(16, 3), fletcher32=True)


def _bomb(file: h5py.File, rng: np.random.Generator) -> None:
    """As many zeros as the dimensions of a record may have, all of which agree."""
    group, size = file["calibrate/calibration"], 3_000
    for name in ("error", "parameter", "sqrt_cov_shared", "sqrt_cov_marker"):
        del group[name]
    group.create_dataset("sqrt_cov_shared", data=np.zeros((size, size)), compression=1, chunks=(size, size))
    shape = *group["M"].shape, size
    group.create_dataset("sqrt_cov_marker", data=np.zeros(shape), compression=1, chunks=shape)


EDITS: dict[str, Edit] = {
    "attribute of another type": _attribute,
    "array of another shape": _instead(lambda g, n, shape: g.create_dataset(n, data=np.zeros((*shape, 2)))),
    "array of complex numbers": _instead(lambda g, n, shape: g.create_dataset(n, data=np.ones(shape, "c16"))),
    "array of short numbers": _instead(lambda g, n, shape: g.create_dataset(n, data=np.ones(shape, "f4"))),
    "array of texts": _dataset(dtype=h5py.string_dtype()),
    "array lost": _instead(lambda group, name, shape: None),
    "soft link": _linked(lambda file: h5py.SoftLink("/plan/a_star")),
    "link to a file": _linked(lambda file: h5py.ExternalLink(file.filename, "/plan/a_star")),
    "virtual array": _instead(_virtual),
    "array in a file": _dataset(dtype="f8", external=[("/etc/passwd", 0, 10**6)]),
    "huge shape": _huge,
    "compressed zeros": _bomb,
    "group instead of an array": _instead(lambda group, name, shape: group.create_group(name)),
    "circle of groups": lambda file, rng: file["plan"].__setitem__("again", file["plan"]),
    "deep groups": lambda file, rng: file.create_group("/".join("d" * 200)),
}


def resealed(path: Path) -> None:
    """Append the line that tells the checksum, as ``projservo`` does."""
    data = path.read_bytes()
    path.write_bytes(data + f"\nprojservo sha256 {hashlib.sha256(data).hexdigest()}\n".encode())


def edited(path: Path, edit: Edit, seed: int = 0) -> None:
    """Write a file that deceives, with its checksum."""
    path.write_bytes(sound_file())
    with h5py.File(path, "a", locking=False) as file:
        edit(file, np.random.default_rng(seed))
    resealed(path)
