"""Points fixed to the tool, and tags or a board whose corners they are."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PlainValidator, Strict, StrictBool, WithJsonSchema
from scipy.spatial.transform import Rotation

from projservo_cli.detection.finders import LEAST_ROWS, Board
from projservo_cli.records import CORNERS, LEAST_CORNERS, FloatArray, StatedBoard
from projservo_cli.settings.sections import Note, Pose, Positive, Section, Text, Vector3, Whole

GROUND = 4.0 / 3.0
"""Width of a tag of six cells with a bright margin of one cell, over that without."""

_SIZE_M = 0.06  # default size of tags
_TILT = math.radians(35.0)  # tilt of the four tags around the middle one of a roof
_CORNERS = ((-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5))  # as they are detected, in sides of the tag


class Tag(Section):
    """A tag on the tool, or on an object."""

    number: Whole = Field(
        description="number of the tag t in its dictionary; its corners are markers 4 t to 4 t + 3"
    )
    size_m: Positive = Field(description="side of the black square")
    pose: Pose = Field(
        description="pose in the frame of the tool, or for an object of the base, m: the tag faces along z, "
        "y is up on it"
    )

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of its corners, which are markers."""
        return tuple(CORNERS * self.number + k for k in range(CORNERS))

    @property
    def corners(self) -> FloatArray:
        """Its corners (4, 3) in the frame of the tool, m, in the order in which they are detected."""
        T = np.array(self.pose)
        return np.asarray(self.size_m * np.array(_CORNERS) @ T[:3, :2].T + T[:3, 3])

    @property
    def normal(self) -> FloatArray:
        """Direction (3,) that it looks in."""
        return np.array(self.pose)[:3, 2]

    def at(self, T: FloatArray) -> "Tag":
        """The tag after a displacement (4, 4)."""
        pose = tuple(tuple(row) for row in (T @ np.array(self.pose)).tolist())
        return self.model_copy(update={"pose": pose})


_Side = Annotated[int, Strict(), Field(ge=LEAST_ROWS, le=1000)]


class BoardSettings(Section):
    """A board on the tool, or in the scene of cameras on the tool, whose inner corners are the markers."""

    kind: Literal["chessboard", "charuco", "circles", "acircles"] = Field(description="pattern of the board")
    rows: _Side = Field(description="rows of inner corners or circles, or of squares of a ChArUco board")
    columns: _Side = Field(description="columns, counted likewise")
    size_m: Positive | None = Field(
        None, description="side of a square, distance of rows of circles; null if unknown"
    )
    dictionary: Text | None = Field(
        None, description="of the tags on a ChArUco board by its OpenCV name; null: 4X4_50"
    )
    first: Whole | None = Field(None, description="number of the first tag on a ChArUco board; null: 0")

    @property
    def pattern(self) -> Board:
        """The board as it is detected."""
        return Board(self.kind, self.rows, self.columns, self.first or 0)

    def contradictions(self) -> Iterator[Note]:
        """Tags of a board without."""
        for key in self.given("dictionary", "first") if self.kind != "charuco" else ():
            yield (key,), f"is of the tags on a board of kind charuco, and one of kind {self.kind} has none"


_Corners = Annotated[int, Strict(), Field(ge=LEAST_CORNERS, le=1000)]


class KnownBoard(Section):
    """A board whose corners are markers of a table, numbered row by row: its shape is known."""

    first: Whole = Field(0, description="number of the marker at its first corner")
    columns: _Corners = Field(description="corners in a row, of a chessboard its inner ones")
    rows: _Corners = Field(description="rows of corners")
    pitch_mm: Positive | None = Field(
        None, description="distance of neighbouring corners, or of rows if staggered; null if unknown"
    )
    staggered: StrictBool = Field(
        False, description="whether odd rows are moved by half of a step, as in asymmetric grids of circles"
    )

    @property
    def stated(self) -> StatedBoard:
        """The board as a calibration takes it."""
        pitch_m = None if self.pitch_mm is None else 1e-3 * self.pitch_mm
        return StatedBoard(self.first, self.columns, self.rows, pitch_m, self.staggered)


def _tag(number: int, size_m: float, R: Rotation, t: Sequence[float]) -> Tag:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.as_matrix(), t
    pose = tuple(tuple(row) for row in T.tolist())
    return Tag.model_validate({"number": number, "size_m": size_m, "pose": pose})


def _roof(size_m: float) -> tuple[Tag, ...]:
    """A tag that looks forward and four around it, tilted away from it; their margins meet."""
    half = 0.5 * GROUND * size_m
    tags = [_tag(0, size_m, Rotation.identity(), [0.0, 0.0, 1.5 * half])]
    for k in range(4):
        turn = Rotation.from_euler("z", 0.5 * math.pi * k)
        place = turn.apply([half + half * math.cos(_TILT), 0.0, 1.5 * half - half * math.sin(_TILT)])
        tags.append(_tag(1 + k, size_m, turn * Rotation.from_euler("y", _TILT), place.tolist()))
    return tuple(tags)


def _plate(size_m: float) -> tuple[Tag, ...]:
    """Two by two tags in a plane that look forward; their margins meet."""
    half = 0.5 * GROUND * size_m
    centers = [(-half, half), (half, half), (half, -half), (-half, -half)]
    return tuple(_tag(k, size_m, Rotation.identity(), [*at, 1.5 * half]) for k, at in enumerate(centers))


_TOOLS = {"roof": _roof, "plate": _plate}


def _center(value: Any) -> Any:
    if value == "midpoint" or (type(value) is int and 0 <= value < 2**63):
        return value
    raise ValueError("must be midpoint or the number of a marker of the face")


_Center = Annotated[
    Literal["midpoint"] | int,
    PlainValidator(_center),
    WithJsonSchema({"anyOf": [{"const": "midpoint", "type": "string"}, {"type": "integer", "minimum": 0}]}),
]


_BARE = ("positions_m", "numbers")  # keys of markers that are no corners


class Markers(Section):
    """Points fixed to the tool; the face is the part of them that must stay visible."""

    positions_m: tuple[Vector3, ...] | None = Field(
        None, min_length=1, max_length=10_000, description="positions in the frame of the tool"
    )
    numbers: tuple[Whole, ...] | None = Field(
        None, min_length=1, description="number of each marker; null: 0, 1, 2 ..."
    )
    tags: (
        Literal["roof", "plate"] | Annotated[tuple[Tag, ...], Field(min_length=1, max_length=250)] | None
    ) = Field(None, description="tags whose corners are the markers: roof, plate, or a list")
    tag_size_m: Positive | None = Field(
        None,
        description="side of the black square of each tag; null: 0.06 for a roof or a plate",
    )
    board: BoardSettings | None = Field(
        None, description="board whose inner corners are the markers, numbered row by row as OpenCV does"
    )
    boards: tuple[KnownBoard, ...] | None = Field(
        None,
        max_length=100,
        description="boards whose corners are markers of a table; a fit uses their shape",
    )
    dictionary: Text | None = Field(
        None,
        description="tag dictionary by its OpenCV name; null: 4X4_50; passed to a robot class that "
        "accepts it",
    )
    face: tuple[Whole, ...] | None = Field(
        None,
        min_length=3,
        description="numbers of the coplanar markers that must stay visible; null: the tag that faces "
        "forward",
    )
    center: _Center = Field("midpoint", description="centre of the face: midpoint, or the number of a marker")

    @property
    def all_tags(self) -> tuple[Tag, ...]:
        """Each tag; none where markers are no corners of tags."""
        return (
            _TOOLS[self.tags](self.tag_size_m or _SIZE_M) if isinstance(self.tags, str) else self.tags or ()
        )

    @property
    def pattern(self) -> Board | None:
        """The board as it is detected; None without one."""
        return None if self.board is None else self.board.pattern

    @property
    def stated_boards(self) -> tuple[StatedBoard, ...]:
        """Boards whose shape is known, in a table or as they are detected."""
        known = tuple(one.stated for one in self.boards or ())
        if self.board is None:
            return known
        rows, columns = self.board.pattern.shape
        return (*known, StatedBoard(0, columns, rows, self.board.size_m, self.board.pattern.staggered))

    @property
    def tag_dictionary(self) -> str | None:
        """Dictionary of the tags, which may be those on the board; None if not given."""
        return (self.board or self).dictionary

    @property
    def points(self) -> FloatArray | None:
        """Positions (m, 3) of all markers in the frame of the tool, m; None if they are not known."""
        if self.tags is not None:
            return np.concatenate([tag.corners for tag in self.all_tags])
        return None if self.positions_m is None else np.array(self.positions_m)

    @property
    def normals(self) -> FloatArray | None:
        """Directions (m, 3) that corners of tags look in, in the frame of the tool; None for others."""
        if self.tags is None:
            return None
        return np.repeat([tag.normal for tag in self.all_tags], CORNERS, axis=0)

    @property
    def known(self) -> tuple[int, ...]:
        """Numbers of all markers, in the order of ``points``; none if a table has them."""
        if self.board is not None:
            return tuple(range(len(self.board.pattern.grid_points)))
        if self.tags is not None:
            return tuple(number for tag in self.all_tags for number in tag.numbers)
        if self.numbers is None and self.positions_m is not None:
            return tuple(range(len(self.positions_m)))
        return self.numbers or ()

    @property
    def front(self) -> tuple[int, ...] | None:
        """Numbers of the face: as given, otherwise of the tag that points forward most.

        Of a board, the outermost corners.
        """
        if self.face is None and self.board is not None:
            rows, columns = self.board.pattern.shape
            return (0, columns - 1, rows * columns - 1, (rows - 1) * columns)
        if self.face is not None or self.tags is None:
            return self.face
        normals = np.array([tag.normal for tag in self.all_tags])
        return self.all_tags[int(np.argmax((normals @ normals.sum(axis=0)).round(6)))].numbers

    def lengths(self, numbers: Sequence[int]) -> FloatArray:
        """Distances (k, k) between markers of some numbers, m; NaN if unknown."""
        X, tag = np.full((len(numbers), 3), np.nan), np.zeros(len(numbers))
        if self.points is not None:
            X = self.points[[self.known.index(number) for number in numbers]]
        elif self.board is not None and self.board.size_m is not None:
            X[:, 2], X[:, :2] = 0.0, self.board.size_m * self.board.pattern.grid_points[[*numbers]]
        elif self.tag_size_m is not None:
            corners = np.reshape([_CORNERS[k % CORNERS] for k in numbers], (-1, 2))
            X[:, 2], X[:, :2] = 0.0, self.tag_size_m * corners
            tag = np.array(numbers) // CORNERS
        found = np.linalg.norm(X[:, None] - X, axis=2)
        return np.asarray(np.where(tag[:, None] == tag, found, np.nan))

    def contradictions(self) -> Iterator[Note]:
        """Markers said twice; numbers that are missing, strange or given twice."""
        for whole, others in (("tags", _BARE), ("board", (*_BARE, "tags", "tag_size_m"))):
            for key in self.given(*others) if self.given(whole) else ():
                yield (key,), f"{whole} is set as well, whose corners are the markers; keep one"
        boards = sorted((one.first, one.first + one.columns * one.rows) for one in self.stated_boards)
        if any(end > first for (_, end), (first, _) in pairwise(boards)):
            yield ("boards",), "two of them share markers: give each the number of its own first corner"
        if self.board is not None and self.dictionary is not None:
            yield ("dictionary",), "applies to tags: a board has board.dictionary"
        numbers = [tag.number for tag in self.all_tags]
        if len(set(numbers)) < len(numbers):
            yield ("tags",), "the number of a tag occurs here twice"
        known, face = self.known, self.front or ()
        if known:
            if self.positions_m is not None and len(known) != len(self.positions_m):
                yield ("numbers",), f"{len(known)} numbers for {len(self.positions_m)} positions_m"
            if self.numbers is not None and len(set(known)) < len(known):
                yield ("numbers",), "a number occurs here twice"
            yield from self.unknown(face, "face")
        if face and self.center not in ("midpoint", *face):
            yield ("center",), f"marker {self.center} is not on the face; face: {_listed(face)}"
        if len(set(face)) < len(face):
            yield ("face",), "a marker occurs here twice"

    def unknown(self, numbers: Sequence[int], *path: str) -> Iterator[Note]:
        """Numbers at a path that no marker has, as far as markers are known."""
        for i, number in enumerate(numbers):
            if self.known and number not in self.known:
                yield (*path, i), f"there is no marker {number}; markers: {_listed(self.known)}"


def _listed(numbers: Sequence[int]) -> str:
    listed = ", ".join(map(str, numbers[:20]))
    return listed + (" …" if len(numbers) > 20 else "")
