"""Comma-separated text read strictly: every complaint says file, line and what was expected."""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from projservo_cli.records import InputError

_INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
MAX_JOINTS = 64  # as many as a configuration may have
MAX_COLUMNS = 10_000
MAX_BYTES = 100_000_000  # of a table; more would not be calibrated from
_JOINT = re.compile(r"q[1-9][0-9]{0,8}")


class Sheet:
    """A header and the rows under it.

    Parameters
    ----------
    path : the file, UTF-8 with or without byte-order mark, any line ends.
    expected : the header a reader hopes for, for the message about an empty file.

    Attributes
    ----------
    where : the file, for messages.
    names : columns of the header, in small letters without surrounding spaces.

    Raises
    ------
    InputError
        When the file cannot be read or has no header.
    """

    def __init__(self, path: Path | str, expected: str) -> None:
        self.where = str(path)
        self._reader = csv.reader(io.StringIO(_text(Path(path)), newline=""), strict=True)
        header = self._next()
        if header is None:
            raise InputError(f"{self.where}: the table is empty; expected a header {expected}")
        if len(header) > MAX_COLUMNS:
            raise InputError(f"{self.where}:1: {len(header)} columns; a table has at most {MAX_COLUMNS}")
        self.names = [name.strip().lower() for name in header]
        if len(self.names) == 1 and ";" in self.names[0]:
            raise InputError(
                f"{self.where}:1: columns are separated by semicolons; use commas and decimal points"
            )

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line and cells of each row that is not blank.

        Raises
        ------
        InputError
            At a row of another length than the header.
        """
        while (cells := self._next()) is not None:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(self.names):
                raise InputError(
                    f"{self.where}:{self._reader.line_num}: {len(cells)} cells where the header has "
                    f"{len(self.names)}; the row is cut short or malformed"
                )
            yield self._reader.line_num, [cell.strip() for cell in cells]

    def _next(self) -> list[str] | None:
        try:
            return next(self._reader, None)
        except csv.Error as error:
            raise InputError(
                f"{self.where}:{self._reader.line_num}: {error}; expected comma-separated values"
            ) from error

    def columns(self, needed: Sequence[str], optional: Sequence[str] = ()) -> dict[str, int]:
        """Position of each column that is read: those needed, q1 … qN, and optional ones if present.

        Raises
        ------
        InputError
            When one is missing or stands there twice, or joint columns leave a gap.
        """
        joints = sorted(
            (name for name in set(self.names) if _JOINT.fullmatch(name)), key=lambda name: int(name[1:])
        )
        if len(joints) > MAX_JOINTS:
            raise InputError(f"{self.where}:1: {len(joints)} joint columns; a robot has at most {MAX_JOINTS}")
        missing = [name for name in needed if name not in self.names] + ([] if joints else ["q1"])
        if missing:
            raise InputError(f"{self.where}:1: the header lacks the column(s) {', '.join(missing)}")
        wanted = [*needed, *joints, *(name for name in optional if name in self.names)]
        twice = sorted({name for name in wanted if self.names.count(name) > 1})
        if twice:
            raise InputError(
                f"{self.where}:1: the header names the column(s) {', '.join(twice)} more than once"
            )
        gaps = [f"q{i}" for i in range(1, len(joints) + 1) if f"q{i}" not in joints]
        if gaps:
            raise InputError(
                f"{self.where}:1: joint column {gaps[0]} is missing, though there is {joints[-1]}"
            )
        return {name: self.names.index(name) for name in wanted}


def joints_of(columns: dict[str, int]) -> list[str]:
    """The joint columns among those that are read, in their order."""
    return [name for name in columns if _JOINT.fullmatch(name)]


def integer(where: str, column: str, text: str) -> int:
    """A whole number of at most 18 digits, or an ``InputError``."""
    if not _INTEGER.fullmatch(text):
        raise InputError(f"{where}: {column} is {text!r}; expected an integer")
    return int(text)


def number(where: str, column: str, text: str) -> float:
    """A finite number with a decimal point, or an ``InputError``."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {column} is {text!r}; expected a finite number")
    return value


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; expected a table") from error
    if len(content) > MAX_BYTES:
        raise InputError(
            f"{path}: larger than {MAX_BYTES // 1_000_000} MB; expected a table of trial motions"
        )
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError(f"{path}:{line}: not UTF-8 text; export the table as UTF-8 CSV") from error
    if "\0" in text:
        line = text.split("\0", 1)[0].count("\n") + 1
        raise InputError(f"{path}:{line}: not a text file (it has a NUL byte)")
    return text
