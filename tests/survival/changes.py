"""What happens to configurations and tables on their way, by accident or by malice."""

from collections.abc import Callable

import numpy as np

Change = Callable[[bytes, np.random.Generator], bytes]
# Two spaces between them.
_WORDS = (
    "1e308  -1e308  1e999  .nan  .inf  -.inf  -1  0  1e-320  2**3  0x10  1_000  NaN  1,5  [1, 2, 3]  []  {}  "
    "null  ~  true  ''  '<script>'  ../../x  /etc/passwd  *a  &a 1  !x y  [[[[]]]]  - 1  ? x  ä  \U0001f600  "
    "!!python/name:os.system  !!binary aGk=  {a: {b: {c: 1}}}  2026-11-21  1:30"
)
VALUES = [*_WORDS.split("  "), "9" * 400, "9" * 5000, '"\\e[31m"', "|\n  a", "'", '"', "#", "\t"]
_NUMBERS = "1e308 -1e308 1e999 nan inf 1,5 1;5 x -0 0x10"
CELLS = [*_NUMBERS.split(), "", " ", "9" * 400, '"', "\x1b[2J"]


def _line(change: Callable[[bytes, np.random.Generator], list[bytes]]) -> Change:
    """A change of a random line to any number of lines."""

    def edit(data: bytes, rng: np.random.Generator) -> bytes:
        lines = data.split(b"\n")
        at = int(rng.integers(len(lines)))
        return b"\n".join([*lines[:at], *change(lines[at], rng), *lines[at + 1 :]])

    return edit


def _bits(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for place in rng.integers(0, len(data), size=rng.choice([1, 3, 30])):
        changed[place] = rng.integers(256)
    return bytes(changed)


def _value(line: bytes, rng: np.random.Generator) -> list[bytes]:
    """Another value after one of the colons of a line."""
    pieces = line.split(b": ")
    if len(pieces) > 1:
        pieces[rng.integers(1, len(pieces))] = VALUES[rng.integers(len(VALUES))].encode()
    return [b": ".join(pieces)]


def _cell(line: bytes, rng: np.random.Generator) -> list[bytes]:
    cells = line.split(b",")
    cells[rng.integers(len(cells))] = CELLS[rng.integers(len(CELLS))].encode()
    return [b",".join(cells)]


def _column(data: bytes, rng: np.random.Generator) -> bytes:
    """A column lost, of all rows or of the header alone, or renamed, or there twice."""
    rows = [line.split(b",") for line in data.split(b"\n")]
    k, kind = int(rng.integers(len(rows[0]))), rng.integers(4)
    header = [*rows[0][:k], *([], [], [b"x"], [rows[0][0]])[kind], *rows[0][k + 1 :]]
    others = [[*row[:k], *row[k + 1 :]] for row in rows[1:]] if kind == 0 else rows[1:]
    return b"\n".join(b",".join(row) for row in [header, *others])


def _bomb(data: bytes, rng: np.random.Generator) -> bytes:
    """What would exhaust a reader that does not count."""
    levels = "".join(f"b{i}: &b{i} [*{'b' + str(i - 1) if i else 'a'}{', *a' * 8}]\n" for i in range(40))
    bombs = [
        *("a: &a [x,x,x,x,x,x,x,x,x]\n" + levels, "a: &a [*a]\n", "[" * 900_000, "{a: " * 200_000),
        *("- " * 300_000, "x: [" + "1," * 400_000 + "]", "#" * 2_000_000, "a: " + "9" * 900_000),
        *("{" + ",".join(f"k{i}" for i in range(49_000)) + "}", "".join(f"k{i}: 1\n" for i in range(20_000))),
        *("? a\n" * 100_000, "name: " + "x" * 900_000, "a: 'b\n" * 10_000, "!" * 900_000),
        "robot: {dh: {joints: [" + "{type: R}," * 45_000 + "]}}",
        "robot:\n  dh:\n    joints:\n" + "      - {type: R, a_m: 1, b: 2, c: 3}\n" * 12_000,
        "plant: {options: {" + ",".join(f"o{i}: {{a: 1}}" for i in range(12_000)) + "}}",
        "markers: {positions_m: [" + "[0, 0, x]," * 12_000 + "]}",
    ]
    return bombs[rng.integers(len(bombs))].encode()


def _wide(data: bytes, rng: np.random.Generator) -> bytes:
    """Tables of sizes that nobody measured."""
    pixels = "u_left,v_left,u_right,v_right"
    tables = [
        "pose,marker," + ",".join(f"q{i + 1}" for i in range(1_000_000)) + f",{pixels}\n",
        "pose,marker," + "q1," * 1_000_000 + f"{pixels}\n",
        f"pose,marker,q1,{pixels}\n" + "".join(f"{i},{i},0.1,1,2,3,4\n" for i in range(20_000)),
        '"' + "x" * 1_000_000,
        "," * 1_000_000 + "\n" + "," * 1_000_000,
        f"pose,marker,q1,{pixels}\n" + "\n" * 1_000_000,
    ]
    return tables[rng.integers(len(tables))].encode()


ANY: dict[str, Change] = {
    "cut short": lambda data, rng: data[: rng.integers(0, len(data))],
    "bytes changed": _bits,
    "not UTF-8": lambda data, rng: data.decode().encode("utf-16" if rng.random() < 0.5 else "utf-32"),
    "CRLF": lambda data, rng: data.replace(b"\n", b"\r\n" if rng.random() < 0.7 else b"\r"),
    "byte-order mark": lambda data, rng: b"\xef\xbb\xbf" * int(rng.integers(1, 3)) + data,
    "decimal commas": lambda data, rng: data.replace(b".", b","),
    "semicolons": lambda data, rng: data.replace(b",", b";"),
    "tabs": lambda data, rng: data.replace(b" " if b" " in data else b",", b"\t"),
    "a line lost": _line(lambda line, rng: []),
    "a line many times": _line(lambda line, rng: [line] * int(rng.choice([2, 2000]))),
    "bytes of NUL": lambda data, rng: data[:50] + bytes(int(rng.integers(1, 50))) + data[50:],
    "something else": lambda data, rng: rng.bytes(int(rng.integers(0, 3000))),
}
YAML = ANY | {
    "another value": _line(_value),
    "another value, again": _line(_value),
    "another key": _line(lambda line, rng: [line.replace(b":", b"x:", 1)]),
    "indented": _line(lambda line, rng: [b" " * int(rng.integers(1, 5)) + line]),
    "bomb": _bomb,
}
CSV = ANY | {
    "another cell": _line(_cell),
    "another cell, again": _line(_cell),
    "columns": _column,
    "sizes": _wide,
}
