"""Configurations and tables as they must never come: ``python -m tests.survival.inputs 10000`` reads so many.

Each is a sound one with one thing changed, by its number alone, or made to exhaust who reads it. Reading
either succeeds or ends in an ``InputError``, within 2 s and 500 MB. Every fiftieth goes through the command
line as well, which must end in exit code 2 with its lines, or 0. The exit code is 1 where one ended in
another way.
"""

import resource
import sys
import tempfile
import time
import traceback
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.config.sweep import load_sweep
from projservo_cli.records import InputError
from projservo_cli.tables import read_joints, read_table
from tests.conftest import ROOT
from tests.store.first_release import first_release
from tests.survival.calls import call, prepare

SECONDS, MEGABYTES = 2.0, 500.0
SAMPLE = 50  # every so many-th goes through the command line
Change = Callable[[bytes, np.random.Generator], bytes]
VALUES = (
    *(
        "1e308",
        "-1e308",
        "1e999",
        ".nan",
        ".inf",
        "-.inf",
        "-1",
        "0",
        "1e-320",
        "9" * 400,
        "9" * 5000,
        "2**3",
    ),
    *(
        "[]",
        "{}",
        "null",
        "~",
        "true",
        "''",
        '"\\e[31m"',
        "'<script>'",
        "../../x",
        "/etc/passwd",
        "*a",
        "&a 1",
    ),
    *(
        "!!python/name:os.system",
        "!!binary aGk=",
        "!x y",
        "[[[[]]]]",
        "{a: {b: {c: 1}}}",
        "2026-11-21",
        "1:30",
    ),
    *(
        "0x10",
        "1_000",
        "NaN",
        "1,5",
        "[1, 2, 3]",
        "ä",
        "\U0001f600",
        "- 1",
        "? x",
        "|\n  a",
        "'",
        '"',
        "#",
        "\t",
    ),
)
CELLS = (
    "1e308",
    "-1e308",
    "1e999",
    "nan",
    "inf",
    "",
    " ",
    "1,5",
    "1;5",
    "x",
    "9" * 400,
    "-0",
    "0x10",
    '"',
    "\x1b[2J",
)


def _line(change: Callable[[list[bytes], int, np.random.Generator], list[bytes]]) -> Change:
    """A change of the lines at a random one."""

    def edit(data: bytes, rng: np.random.Generator) -> bytes:
        lines = data.split(b"\n")
        return b"\n".join(change(lines, int(rng.integers(len(lines))), rng))

    return edit


def _bits(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for place in rng.integers(0, len(data), size=rng.choice([1, 3, 30])):
        changed[place] = rng.integers(256)
    return bytes(changed)


def _value(lines: list[bytes], at: int, rng: np.random.Generator) -> list[bytes]:
    """Another value after one of the colons or commas of a line."""
    pieces = lines[at].split(b": ")
    if len(pieces) > 1:
        pieces[rng.integers(1, len(pieces))] = VALUES[rng.integers(len(VALUES))].encode()
    return [*lines[:at], b": ".join(pieces), *lines[at + 1 :]]


def _number(lines: list[bytes], at: int, rng: np.random.Generator) -> list[bytes]:
    words = lines[at].replace(b",", b" , ").replace(b"]", b" ]").replace(b"[", b"[ ").split(b" ")
    places = [i for i, word in enumerate(words) if word[-1:].isdigit()]
    if places:
        words[places[rng.integers(len(places))]] = VALUES[rng.integers(len(VALUES))].encode()
    return [*lines[:at], b" ".join(words), *lines[at + 1 :]]


def _key(lines: list[bytes], at: int, rng: np.random.Generator) -> list[bytes]:
    return [*lines[:at], lines[at].replace(b":", b"x:", 1), *lines[at + 1 :]]


def _indented(lines: list[bytes], at: int, rng: np.random.Generator) -> list[bytes]:
    return [*lines[:at], b" " * int(rng.integers(1, 5)) + lines[at], *lines[at + 1 :]]


def _many(lines: list[bytes], at: int, rng: np.random.Generator) -> list[bytes]:
    return [*lines[:at], *[lines[at]] * int(rng.integers(2, 2000)), *lines[at + 1 :]]


def _cell(lines: list[bytes], at: int, rng: np.random.Generator) -> list[bytes]:
    cells = lines[at].split(b",")
    cells[rng.integers(len(cells))] = CELLS[rng.integers(len(CELLS))].encode()
    return [*lines[:at], b",".join(cells), *lines[at + 1 :]]


def _column(lines: list[bytes], at: int, rng: np.random.Generator) -> list[bytes]:
    """A column lost, of all rows or of the header alone, or renamed, or there twice."""
    k, kind = int(rng.integers(lines[0].count(b",") + 1)), rng.integers(4)
    rows = [line.split(b",") for line in lines]
    if kind == 0:
        return [b",".join([*row[:k], *row[k + 1 :]]) for row in rows]
    header = [*rows[0][:k], *([], [b"x"], [rows[0][0]])[kind - 1], *rows[0][k + 1 :]]
    return [b",".join(header), *lines[1:]]


def _bomb(data: bytes, rng: np.random.Generator) -> bytes:
    """What would exhaust a reader that does not count."""
    levels = "".join(f"b{i}: &b{i} [*{'b' + str(i - 1) if i else 'a'}{', *a' * 8}]\n" for i in range(40))
    bombs = (
        *(
            "a: &a [x,x,x,x,x,x,x,x,x]\n" + levels,
            "a: &a [*a]\n",
            "[" * 900_000,
            "{a: " * 200_000,
            "- " * 300_000,
        ),
        *(
            "x: [" + "1," * 400_000 + "]",
            "{" + ",".join(f"k{i}" for i in range(49_000)) + "}",
            "#" * 2_000_000,
        ),
        *("robot: {dh: {joints: [" + "{type: R}," * 45_000 + "]}}", "a: " + "9" * 900_000, "!" * 900_000),
        *(
            "".join(f"k{i}: 1\n" for i in range(20_000)),
            "? a\n" * 100_000,
            "name: " + "x" * 900_000,
            "a: 'b\n" * 10_000,
        ),
        "plant: {options: {" + ",".join(f"o{i}: {{a: 1}}" for i in range(12_000)) + "}}",
        "robot:\n  dh:\n    joints:\n" + "      - {type: R, a_m: 1, b: 2, c: 3}\n" * 12_000,
        "markers: {positions_m: [" + "[0, 0, x]," * 12_000 + "]}",
    )
    return bombs[rng.integers(len(bombs))].encode()


def _wide(data: bytes, rng: np.random.Generator) -> bytes:
    """Tables of sizes that nobody measured."""
    joints, kind = 1_000_000, rng.integers(6)
    pixels = "u_left,v_left,u_right,v_right"
    if kind == 0:
        return ("pose,marker," + ",".join(f"q{i + 1}" for i in range(joints)) + f",{pixels}\n").encode()
    if kind == 1:
        return ("pose,marker," + "q1," * joints + f"{pixels}\n").encode()
    if kind == 2:
        rows = "".join(f"{i},{i},0.1,1,2,3,4\n" for i in range(20_000))
        return f"pose,marker,q1,{pixels}\n{rows}".encode()
    if kind == 3:
        return b'"' + b"x" * 1_000_000
    if kind == 4:
        return b"," * 1_000_000 + b"\n" + b"," * 1_000_000
    return b"pose,marker,q1,u_left,v_left,u_right,v_right\n" + b"\n" * 1_000_000


ANY: dict[str, Change] = {
    "cut short": lambda data, rng: data[: rng.integers(0, len(data))],
    "bytes changed": _bits,
    "not UTF-8": lambda data, rng: data.decode().encode("utf-16" if rng.random() < 0.5 else "utf-32"),
    "CRLF": lambda data, rng: data.replace(b"\n", b"\r\n" if rng.random() < 0.7 else b"\r"),
    "byte-order mark": lambda data, rng: b"\xef\xbb\xbf" * int(rng.integers(1, 3)) + data,
    "decimal commas": lambda data, rng: data.replace(b".", b","),
    "semicolons": lambda data, rng: data.replace(b",", b";"),
    "tabs": lambda data, rng: data.replace(b" " if b" " in data else b",", b"\t"),
    "a line lost": _line(lambda lines, at, rng: lines[:at] + lines[at + 1 :]),
    "a line twice": _line(lambda lines, at, rng: lines[: at + 1] + lines[at:]),
    "a line many times": _line(_many),
    "bytes of NUL": lambda data, rng: data[:50] + bytes(int(rng.integers(1, 50))) + data[50:],
    "something else": lambda data, rng: rng.bytes(int(rng.integers(0, 3000))),
}
YAML = {**ANY, "another value": _line(_value), "another number": _line(_number), "another key": _line(_key)}
YAML |= {"indented": _line(_indented), "another value, again": _line(_value), "bomb": _bomb}
CSV = {**ANY, "another cell": _line(_cell), "columns": _line(_column), "another cell, again": _line(_cell)}
CSV |= {"sizes": _wide}


def sources() -> list[tuple[str, bytes, dict[str, Change]]]:
    """Name, content and changes of each sound file."""
    configs = [
        ROOT / "configs" / name for name in ("paper.yaml", "ur5.yaml", "stanford.yaml", "sweep_noise.yaml")
    ]
    starter = ROOT / "projservo_cli" / "config" / "starter.yaml"
    found = [(path.name, path.read_bytes(), YAML) for path in (*configs, starter)]
    rows = [
        f"{k},{m},{0.1 * k},{-0.2 * k},{k + m}.5,{2 * k},{3 * m}.25,4" for k in range(12) for m in range(5)
    ]
    table = "pose,marker,q1,q2,u_left,v_left,u_right,v_right\n" + "\n".join(rows) + "\n"
    joints = "pose,q1,q2\n" + "\n".join(f"{k},{0.1 * k},{0.2 * k}" for k in range(20)) + "\n"
    return [
        *found,
        ("table.csv", table.encode(), CSV),
        ("table.csv", table.encode(), CSV),
        ("joints.csv", joints.encode(), CSV),
    ]


def mutated(number: int) -> tuple[str, str, bytes]:
    """Name, kind of the change and content of the mutated file of a number."""
    rng = np.random.default_rng([30_001, number])
    found = sources()
    name, data, changes = found[number % len(found)]
    kind = [*changes][rng.integers(len(changes))]
    return name, kind, changes[kind](data, rng)


def read(path: Path) -> None:
    """Read a file as the commands do."""
    if path.suffix == ".csv":
        (read_joints if path.name == "joints.csv" else read_table)(path)
    else:
        (load_sweep if path.name.startswith("sweep") else load_config)(path)


def by_command(path: Path, run: Path) -> str:
    """What is wrong with how the command line ends on a file; empty where nothing is."""
    words = {
        "table.csv": ["validate", str(run), "--data", str(path)],
        "joints.csv": ["record", "-n", "--output", "none.csv", "--motions", str(path)],
        "sweep_noise.yaml": ["sweep", "-n", "-c", str(path), "-o", "none"],
    }.get(path.name, ["calibrate", "-n", "-c", str(path), "-o", "none"])
    ending = call(*words)
    if ending.code != 0 and (wrong := ending.wrong_refusal()):
        return wrong
    return ""


def examine(number: int, folder: Path, run: Path | None) -> tuple[str, bool, float, str]:
    """Kind, whether it was refused, seconds and what is wrong of the mutated file of a number."""
    name, kind, data = mutated(number)
    path = folder / name
    path.write_bytes(data)
    refused, wrong = False, ""
    began = time.process_time()
    try:
        read(path)
    except InputError as error:
        refused = True
        if not str(error) or "\n\n" in str(error) or max(map(len, str(error).splitlines())) > 2000:
            wrong = f"message {str(error)[:200]!r}"
    except Exception:
        wrong = traceback.format_exc(limit=-3)
    seconds = time.process_time() - began
    if seconds > SECONDS:
        wrong = wrong or f"{seconds:.1f} s"
    if run is not None and not wrong:
        wrong = by_command(path, run)
    what = f"{'table' if path.suffix == '.csv' else 'configuration'}: {kind}"
    return what, refused, seconds, f"{number} {name} {kind}: {wrong}" if wrong else ""


def study(count: int) -> int:
    """Read so many mutated files and print what became of them; the number of those that ended wrong."""
    prepare()
    ends = defaultdict(list)
    failures = []
    with tempfile.TemporaryDirectory() as name:
        run = Path(name, "run.h5")
        run.write_bytes(first_release())
        for number in range(count):
            kind, refused, seconds, wrong = examine(number, Path(name), run if number % SAMPLE == 0 else None)
            ends[kind].append((refused, seconds))
            failures += [wrong] if wrong else []
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"{'change':<40}{'files':>7}{'refused':>9}{'most s':>8}")
    for kind, found in sorted(ends.items()):
        longest = max(seconds for _, seconds in found)
        print(f"{kind:<40}{len(found):>7}{sum(refused for refused, _ in found):>9}{longest:>8.2f}")
    print("\n".join(failures))
    print(f"{count} files, {len(failures)} ended wrong; at most {most:.0f} MB")
    return len(failures) + (most > MEGABYTES)


if __name__ == "__main__":
    sys.exit(study(int(sys.argv[1])) > 0)
