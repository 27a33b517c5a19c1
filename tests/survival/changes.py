"""What happens to configurations and tables on their way, by accident or by malice."""

from collections.abc import Callable

import numpy as np

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
