"""Run files as they must never come: ``python -m tests.survival.mutations 2000`` opens so many of them.

Each is a sound run file with one thing changed, by its number alone: cut short, bits
turned, something else altogether, or made with h5py to deceive, with the checksum that ``projservo`` writes.
The table tells how each kind ended; the exit code is 1 where one ended in another way
than with exit code 2 and one line, within 500 MB.
"""

import hashlib
import struct
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
Edit = Callable[[h5py.File, np.random.Generator], None]


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
    some = rng.bytes(int(rng.integers(0, 5000)))
    heads = (
        b"",
        b"PK\x03\x04",
        b"\x89PNG\r\n\x1a\n",
        b"name: paper\n",
        b"\x89HDF\r\n\x1a\n",
        data[:48],
        data[:600],
    )
    return heads[rng.integers(len(heads))] + some


BYTES: dict[str, Bytes] = {
    "cut short": lambda data, rng: data[: rng.integers(1, len(data))],
    "empty": lambda data, rng: b"",
    "bits turned": _bits,
    "a block changed or lost": _block,
    "bytes appended": lambda data, rng: data + rng.bytes(int(rng.integers(1, 500))),
    "something else": _other,
    "another length claimed": lambda data, rng: data[:28] + struct.pack("<Q", 2**40) + data[36:],
}


def _group(file: h5py.File, rng: np.random.Generator) -> h5py.Group:
    names = ("calibrate/calibration", "calibrate/observation", "plan", "servo/stacked", "report")
    return file[names[rng.integers(len(names))]]


def _array(file: h5py.File, rng: np.random.Generator) -> tuple[h5py.Group, str]:
    group = _group(file, rng)
    own = [name for name, data in group.items() if "units" in data.attrs]
    return group, own[rng.integers(len(own))]


def _instead(make: Callable[[h5py.Group, str, np.random.Generator], None]) -> Edit:
    """Something else under the name of an array."""

    def edit(file: h5py.File, rng: np.random.Generator) -> None:
        group, name = _array(file, rng)
        del group[name]
        make(group, name, rng)

    return edit


def _attribute(file: h5py.File, rng: np.random.Generator) -> None:
    group = _group(file, rng)
    name = sorted({*group.attrs} - {"configuration", "provenance", "inputs", "untested"})
    name = name[rng.integers(len(name))]
    text = isinstance(group.attrs[name], str)
    group.attrs[name] = [np.zeros(3), 1.5, np.zeros((2, 2), "S3")][rng.integers(3)] if text else "{]"


def _lost(file: h5py.File, rng: np.random.Generator) -> None:
    group = _group(file, rng)
    name = ("record", "claims", "law", "method", "tau", "folds")[rng.integers(6)]
    del group.attrs[name if name in group.attrs else "record"]


def _header(file: h5py.File, rng: np.random.Generator) -> None:
    changes = [
        ("schema", "other"),
        ("schema", np.zeros(2)),
        ("schema_version", 0),
        ("schema_version", 99),
        ("schema_version", "x"),
        ("schema_version", np.nan),
        ("order", "[1]"),
        ("order", '["../../plan"]'),
        ("order", '["/"]'),
        ("order", '["nothing"]'),
        ("order", "[" * 100_000),
        ("order", "{}"),
        ("order", "9" * 5000),
        ("configuration", 3),
        ("configuration", np.zeros(3)),
    ]
    name, value = changes[rng.integers(len(changes))]
    del file.attrs[name]
    file.attrs[name] = value


def _result(file: h5py.File, rng: np.random.Generator) -> None:
    changes = [
        ("calibrate", "records", '["calibration", "other"]'),
        ("calibrate", "records", "[]"),
        ("calibrate", "records", '[["calibration"]]'),
        ("plan", "records", '["x"]'),
        ("plan", "provenance", "[1]"),
        ("plan", "provenance", "{"),
        ("plan", "inputs", '{"table": 3}'),
        ("plan", "key", 3.0),
        ("plan", "record", "Path"),
        ("plan", "record", "Trace"),
        ("calibrate/calibration", "record", "Model"),
        ("calibrate/calibration", "joint_types", "RRX"),
        ("calibrate/calibration", "advice", '{"a": 1}'),
        ("calibrate/calibration", "advice", "[3]"),
        ("report", "claims", "[{}]"),
        ("report", "claims", '["x"]'),
        ("report", "left_out", '[{"what": []}]'),
        ("report", "figures", "[[]]"),
        ("servo/stacked", "steps", np.inf),
        ("servo/stacked", "steps", 0.5),
    ]
    group, name, value = changes[rng.integers(len(changes))]
    del file[group].attrs[name]
    file[group].attrs[name] = value


def _virtual(group: h5py.Group, name: str, rng: np.random.Generator) -> None:
    layout = h5py.VirtualLayout((3, 4), "f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (3, 4))
    group.create_virtual_dataset(name, layout)


def _huge(group: h5py.Group, name: str, rng: np.random.Generator) -> None:
    shape = [(10**9,), (10**6, 10**6), (2**40, 40), (2**20, 2**20, 20)][rng.integers(4)]
    group.create_dataset(name, shape, "f8", chunks=(1,) * (len(shape) - 1) + (16,), fletcher32=True)


def _bomb(group: h5py.Group, name: str, rng: np.random.Generator) -> None:
    group.create_dataset(name, data=np.zeros((2000, 4000)), compression=9, chunks=(2000, 4000))


def _circle(file: h5py.File, rng: np.random.Generator) -> None:
    file["plan/again"] = file["plan"]


def _deep(file: h5py.File, rng: np.random.Generator) -> None:
    file.create_group("/".join("d" * 200))


def _many(file: h5py.File, rng: np.random.Generator) -> None:
    file["plan/kind"] = np.dtype("f8")


EDITS: dict[str, Edit] = {
    "attribute of another type": _attribute,
    "attribute lost": _lost,
    "head of the file": _header,
    "head of a result or record": _result,
    "array of another shape": _instead(lambda g, n, r: g.create_dataset(n, data=np.zeros((2, 3, 1, 5, 7)))),
    "array of another type": _instead(lambda g, n, r: g.create_dataset(n, data=np.zeros(3, "c16"))),
    "array of texts": _instead(lambda g, n, r: g.create_dataset(n, data=["a"], dtype=h5py.string_dtype())),
    "array of references": _instead(lambda g, n, r: g.create_dataset(n, data=[g.ref], dtype=h5py.ref_dtype)),
    "array of records": _instead(lambda g, n, r: g.create_dataset(n, (2,), [("a", "f8"), ("b", "i4")])),
    "array lost": _instead(lambda g, n, r: None),
    "soft link": _instead(lambda g, n, r: g.__setitem__(n, h5py.SoftLink("/plan/sigma"))),
    "link to a file": _instead(lambda g, n, r: g.__setitem__(n, h5py.ExternalLink("/etc/passwd", "/x"))),
    "virtual array": _instead(_virtual),
    "array in a file": _instead(
        lambda g, n, r: g.create_dataset(n, (3,), "f8", external=[("/etc/passwd", 0, 24)])
    ),
    "huge shape": _instead(_huge),
    "compressed zeros": _instead(_bomb),
    "group instead of an array": _instead(lambda g, n, r: g.create_group(n)),
    "circle of groups": _circle,
    "deep groups": _deep,
    "named type": _many,
}
KINDS = (*BYTES, *EDITS)


def resealed(path: Path) -> None:
    """Append the line that tells the checksum, as ``projservo`` does."""
    data = path.read_bytes()
    path.write_bytes(data + f"\nprojservo sha256 {hashlib.sha256(data).hexdigest()}\n".encode())


def mutate(number: int, path: Path) -> str:
    """Write the mutated file of a number; its kind."""
    rng = np.random.default_rng([20_001, number])
    kind = KINDS[number % len(KINDS)]
    if kind in BYTES:
        data = sound_file()
        while (changed := BYTES[kind](data, rng)) == data:
            pass
        path.write_bytes(changed)
        return kind
    path.write_bytes(sound_file())
    with h5py.File(path, "a", locking=False) as file:
        EDITS[kind](file, rng)
    resealed(path)
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
            if number % 100 == 99:
                print(f"{number + 1} files, {len(failures)} ended wrong", file=sys.stderr)
            if left := sorted(other.name for other in Path(folder).iterdir() if other != path):
                failures.append(f"{kind}: mutation {number}: wrote {', '.join(left)}")
                for other in left:
                    (Path(folder) / other).unlink()
    print(f"{'mutation':<48}{'files':>6}{'exit 2':>8}{'most MB':>9}{'most s':>8}")
    for kind, found in sorted(ends.items()):
        refused = sum(ending.code == 2 for ending in found)
        most, longest = max(e.megabytes for e in found), max(e.seconds for e in found)
        print(f"{kind:<48}{len(found):>6}{refused:>8}{most:>9.0f}{longest:>8.2f}")
    print("\n".join(failures))
    print(f"{count} files, {len(failures)} that ended in another way than exit code 2, one line, < 500 MB")
    return len(failures)


if __name__ == "__main__":
    sys.exit(study(int(sys.argv[1])) > 0)
