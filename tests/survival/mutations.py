"""Run files as they must never come: ``python -m tests.survival.mutations 2000`` opens so many of them.

Each is a sound run file with one thing changed, by its number alone: cut short, bits turned, something else
altogether, or made with h5py to deceive, with the checksum that ``projservo`` writes. The table tells how
each kind ended; the exit code is 1 where one ended in another way than with exit code 2 and one line,
within 500 MB.
"""

import hashlib
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from tests.store.sound import sound_file
from tests.survival.calls import Ending, call, prepare

MEGABYTES = 500.0
COMMANDS = (
    ("show", "{run}", "--json"),
    ("show", "{run}"),
    ("export", "{run}"),
    ("compare", "{run}", "{run}"),
    ("plan", "-o", "{run}", "-n"),
)
Bytes = Callable[[bytes, np.random.Generator], bytes]
Edit = Callable[[h5py.File, np.random.Generator], object]


def _bits(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for place in rng.integers(0, len(data) * 8, size=rng.choice([1, 1, 2, 30])):
        changed[place // 8] ^= 1 << (place % 8)
    return bytes(changed)


def _block(data: bytes, rng: np.random.Generator) -> bytes:
    first = int(rng.integers(0, len(data) - 1))
    size = int(rng.integers(1, 4096))
    filling = [bytes(size), b"\xff" * size, rng.bytes(size), data[:size], b""][rng.integers(5)]
    return data[:first] + filling + data[first + size :]


def _other(data: bytes, rng: np.random.Generator) -> bytes:
    heads = (b"", b"PK\x03\x04", b"\x89PNG\r\n\x1a\n", b"name: paper\n", data[:8], data[:48], data[:600])
    return heads[rng.integers(len(heads))] + rng.bytes(int(rng.integers(0, 5000)))


BYTES: dict[str, Bytes] = {
    "cut short": lambda data, rng: data[: rng.integers(1, len(data))],
    "empty": lambda data, rng: b"",
    "bits turned": _bits,
    "a block changed or lost": _block,
    "bytes appended": lambda data, rng: data + rng.bytes(int(rng.integers(1, 500))),
    "something else": _other,
}
GROUPS = ("calibrate/calibration", "calibrate/observation", "plan", "servo/stacked", "report")
# Attributes of groups, and what stands there instead; None where nothing does.
HEADS = (
    *(("/", "schema", value) for value in ("other", np.zeros(2))),
    *(("/", "schema_version", value) for value in (0, 99, "x", np.nan)),
    *(("/", "order", value) for value in ("[1]", '["../../plan"]', '["/"]', '["nothing"]', "{}", None)),
    *(("/", "order", value) for value in ("[" * 100_000, "9" * 5000)),
    *(("/", "configuration", value) for value in (3, np.zeros(3))),
    *(("calibrate", "records", value) for value in ('["calibration", "x"]', "[]", '[["calibration"]]')),
    *(("plan", name, value) for name, value in (("records", '["x"]'), ("inputs", '{"a": 3}'), ("key", 3.0))),
    *(("plan", "provenance", value) for value in ("[1]", "{")),
    *((group, "record", value) for group in GROUPS for value in ("Path", "Model", None)),
    ("calibrate/calibration", "joint_types", "RRX"),
    *(("calibrate/calibration", "advice", value) for value in ('{"a": 1}', "[3]")),
    *(("report", "claims", value) for value in ("[{}]", '["x"]', None)),
    ("report", "left_out", '[{"what": []}]'),
    ("report", "figures", "[[]]"),
    *(("servo/stacked", "steps", value) for value in (np.inf, 0.5)),
    *((group, name, None) for group, name in (("plan", "tau"), ("servo/stacked", "law"))),
)


def _head(file: h5py.File, rng: np.random.Generator) -> None:
    group, name, value = HEADS[rng.integers(len(HEADS))]
    del file[group].attrs[name]
    if value is not None:
        file[group].attrs[name] = value


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
    for name in ("parameter", "parameter_", "covariance"):
        del group[name]
    group.create_dataset("covariance", data=np.zeros((size, size)), compression=1, chunks=(size, size))


EDITS: dict[str, Edit] = {
    "attribute of another type": _attribute,
    "attribute lost or other": _head,
    "array of another shape": _instead(lambda g, n, shape: g.create_dataset(n, data=np.zeros((*shape, 2)))),
    "array of complex numbers": _instead(lambda g, n, shape: g.create_dataset(n, data=np.ones(shape, "c16"))),
    "array of integers": _instead(lambda g, n, shape: g.create_dataset(n, data=np.ones(shape, "i8"))),
    "array of short numbers": _instead(lambda g, n, shape: g.create_dataset(n, data=np.ones(shape, "f4"))),
    "array of texts": _dataset(dtype=h5py.string_dtype()),
    "array of references": _dataset(dtype=h5py.ref_dtype),
    "array of records": _dataset(dtype=[("a", "f8"), ("b", "i4")]),
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
    "named type": lambda file, rng: file["plan"].__setitem__("kind", np.dtype("f8")),
}
KINDS = (*BYTES, *EDITS)


def resealed(path: Path) -> None:
    """Append the line that tells the checksum, as ``projservo`` does."""
    data = path.read_bytes()
    path.write_bytes(data + f"\nprojservo sha256 {hashlib.sha256(data).hexdigest()}\n".encode())


def edited(kind: str, path: Path, rng: np.random.Generator) -> None:
    """Write a file that deceives, with its checksum."""
    path.write_bytes(sound_file())
    with h5py.File(path, "a", locking=False) as file:
        EDITS[kind](file, rng)
    resealed(path)


def mutate(number: int, path: Path) -> str:
    """Write the mutated file of a number; its kind."""
    rng = np.random.default_rng([20_001, number])
    kind = KINDS[number % len(KINDS)]
    if kind in EDITS:
        edited(kind, path, rng)
        return kind
    data = sound_file()
    while (changed := BYTES[kind](data, rng)) == data:
        pass
    path.write_bytes(changed)
    return kind


def wrong(number: int, ending: Ending) -> str:
    """What is wrong with how a call ended; empty where nothing is."""
    found = ending.wrong_refusal()
    if not found and len(ending.err.splitlines()) > 1:
        found = f"more than one line: {ending.err[:300]}"
    if not found and ending.megabytes > MEGABYTES:
        found = f"{ending.megabytes:.0f} MB"
    return f"mutation {number}: {found}" if found else ""


def study(count: int) -> int:
    """Open so many mutated files and print what became of them; the number of those that ended wrong."""
    prepare()
    ends = defaultdict(list)
    failures = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.h5")
        for number in range(count):
            kind = mutate(number, path)
            command = COMMANDS[(number // len(KINDS)) % len(COMMANDS)]
            ending = call(*(part.format(run=path) for part in command))
            ends[kind].append(ending)
            failures += [f"{kind}: {text}" for text in [wrong(number, ending)] if text]
            if left := sorted(other.name for other in Path(folder).iterdir() if other != path):
                failures.append(f"{kind}: mutation {number}: wrote {', '.join(left)}")
                break
    print(f"{'mutation':<30}{'files':>6}{'exit 2':>8}{'most MB':>9}{'most s':>8}")
    for kind, found in sorted(ends.items()):
        refused = sum(ending.code == 2 for ending in found)
        most, longest = max(e.megabytes for e in found), max(e.seconds for e in found)
        print(f"{kind:<30}{len(found):>6}{refused:>8}{most:>9.0f}{longest:>8.2f}")
    print("\n".join(failures))
    print(f"{count} files, {len(failures)} that ended in another way than exit code 2, one line, < 500 MB")
    return len(failures)


if __name__ == "__main__":
    sys.exit(study(int(sys.argv[1])) > 0)
