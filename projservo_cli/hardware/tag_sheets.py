"""Sheets of tags in true scale: single tags, a plate, and a roof as a net to cut, fold and glue."""

import io
import math
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from projservo_cli.detection.finders import TagFinder
from projservo_cli.records import FloatArray, InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.path import Path

PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
"""Width and height of paper, mm (ISO 216, ANSI Y14.1)."""

_MM = 25.4  # mm an inch
# Border of the paper that printers may leave blank, mm.
_BORDER = 8.0
# Height of the text above the tags and of the ruler below them, mm.
_HEAD, _FOOT = 34.0, 22.0
# Gap between single tags, with room for a number, mm.
_GAP = 7.0
# Depth of the flaps by which a roof is glued to its base, mm.
_FLAP = 9.0
# Share of the wedge between two sides that a glue flap takes: the rest is play for paper and scissors.
_WEDGE = 0.8
# Length of the ruler, mm.
_RULER = 100
_CUT: Any = {"color": "0.35", "linewidth": 0.4, "fill": False}
_FOLD: Any = {"color": "0.35", "linewidth": 0.4, "linestyle": (0, (4, 3)), "fill": False}


class _FlatTag(NamedTuple):
    """A tag on the sheet."""

    number: int
    center: FloatArray  # (2,) mm
    up: FloatArray  # (2,) unit vector towards its upper side


class _Line(NamedTuple):
    """A line of a net."""

    points: FloatArray  # (k, 2) mm
    fold: bool  # whether to fold there, otherwise to cut


class _Net(NamedTuple):
    """A body of tags, unfolded around the origin."""

    tags: tuple[_FlatTag, ...]
    lines: tuple[_Line, ...]
    size: FloatArray  # (2,) width and height, mm
    labels: tuple[tuple[str, FloatArray], ...]  # texts and their positions, mm
    fixed: FloatArray  # (2,) the part of the size that does not grow with the tags, mm


def unfolded(numbers: Sequence[int], poses: FloatArray) -> _Net:
    """Unfold a tag and those around it, tilted away from it, whose bright margins meet it.

    numbers, poses : (m, 4, 4) of the tags on the body, m; the first is the middle one.
    Between two neighbours the net has a triangle that closes the gap, whose angle at the middle tag is γ by
    cos γ = sin² of the tilt, and a flap that is glued behind the other neighbour: closed, the paper has the
    tilt, and no other.
    """
    middle, around = poses[0], poses[1:]
    tilt = math.acos(float(np.clip(around[0, :3, 2] @ middle[:3, 2], -1.0, 1.0)))
    away = around[:, :2, 3] - middle[:2, 3]
    width = float(2e3 * np.linalg.norm(away[0]) / (1.0 + math.cos(tilt)))
    gap = math.acos(math.sin(tilt) ** 2)
    tags, lines, labels = [_FlatTag(numbers[0], np.zeros(2), middle[:2, 1])], [], []
    for number, pose, direction in zip(numbers[1:], around, away, strict=True):
        out = direction / np.linalg.norm(direction)
        left = np.array([-out[1], out[0]])
        tags.append(_FlatTag(number, width * out, pose[:2, 1]))
        corner, end = 0.5 * width * (out + left), 0.5 * width * (3.0 * out + left)
        right_end = 0.5 * width * (3.0 * out - left)
        # Outwards from the corner, at an angle from the side of this tag towards its left neighbour.
        rays = [math.cos(x) * out + math.sin(x) * left for x in (gap, gap + _WEDGE * (0.5 * np.pi - gap))]
        brim, flap = corner + width * rays[0], corner + 0.9 * width * rays[1]
        inset = _FLAP * (out + 0.5 * left), _FLAP * (out - 0.5 * left)
        lines += [
            _Line(np.array([corner, 0.5 * width * (out - left)]), fold=True),
            _Line(np.array([corner, end]), fold=True),
            _Line(np.array([corner, brim]), fold=True),
            _Line(np.array([end, right_end]), fold=True),
            _Line(np.array([corner, flap, brim, end]), fold=False),
            _Line(np.array([corner, corner + width * left]), fold=False),
            _Line(np.array([end, end + inset[1], right_end + inset[0], right_end]), fold=False),
        ]
        labels += [
            (f"{number}", corner + 0.68 * width * (math.cos(0.3) * out + math.sin(0.3) * left)),
            ("glue", corner + 0.76 * width * 0.5 * (rays[0] + rays[1])),
            ("base", width * 1.5 * out + 0.5 * _FLAP * out),
        ]
    flaps = np.full(2, 2.0 * _FLAP)
    return _Net(tuple(tags), tuple(lines), 3.0 * width + flaps, tuple(labels), flaps)


def plate(numbers: Sequence[int], poses: FloatArray, margin_mm: float) -> _Net:
    """Tags in one plane: poses (m, 4, 4), m, with bright margins up to a width ``margin_mm`` of each."""
    at = 1e3 * (poses[:, :2, 3] - poses[:, :2, 3].mean(axis=0))
    tags = tuple(_FlatTag(n, c, pose[:2, 1]) for n, c, pose in zip(numbers, at, poses, strict=True))
    half = np.abs(at).max(axis=0) + 0.5 * margin_mm
    corners = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    label_at = [np.array([math.copysign(half[0] + 3.0, c[0]), c[1]]) for c in at]
    labels = tuple((f"{number}", place) for number, place in zip(numbers, label_at, strict=True))
    label = np.array([12.0, 0.0])
    return _Net(tags, (_Line(corners, fold=False),), 2.0 * half + label, labels, label)


def single(numbers: Sequence[int] | None, known: int, size_mm: float, margin_mm: float, paper: str) -> _Net:
    """Tags in rows, each to be cut out, with bright margins up to a width ``margin_mm``.

    numbers : of the tags; None for as many of the ``known`` ones as the paper takes.
    size_mm : side of the black square of each.
    """
    columns, rows = _grid(paper, margin_mm)
    wanted = range(min(known, columns * rows)) if numbers is None else numbers
    asked = max(1, len(wanted))
    if columns * rows < asked:
        share, smaller = margin_mm / size_mm, range(int(size_mm), 0, -1)
        fitting = [f"{mm} mm at most" for mm in smaller if math.prod(_grid(paper, share * mm)) >= asked]
        remedies = [*fitting[:1], *["fewer --numbers"] * (asked > 1)]
        raise InputError(
            f"--size-mm {size_mm:g}: {paper} takes {columns * rows} tags with margins of {margin_mm:.3g} mm, "
            f"not {asked}: take {' or '.join(remedies)}"
        )
    pitch = margin_mm + _GAP
    columns = min(columns, len(wanted))
    count = -(-len(wanted) // columns)
    place = [
        pitch * np.array([i % columns - 0.5 * (columns - 1), 0.5 * (count - 1) - i // columns])
        for i in range(len(wanted))
    ]
    tags = tuple(_FlatTag(n, at, np.array([0.0, 1.0])) for n, at in zip(wanted, place, strict=True))
    square = 0.5 * margin_mm * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    lines = tuple(_Line(tag.center + square, fold=False) for tag in tags)
    labels = tuple((f"{tag.number}", tag.center - [0.0, 0.5 * pitch]) for tag in tags)
    return _Net(tags, lines, pitch * np.array([columns, count]) - _GAP, labels, np.zeros(2))


def _grid(paper: str, margin_mm: float) -> tuple[int, int]:
    """Columns and rows of single tags that paper takes."""
    columns, rows = (int((room + _GAP) // (margin_mm + _GAP)) for room in _room(paper))
    return columns, rows


def _room(paper: str) -> tuple[float, float]:
    """Width and height that paper leaves to tags, mm."""
    width, height = PAPERS[paper]
    return width - 2.0 * _BORDER, height - 2.0 * _BORDER - _HEAD - _FOOT


def sheet(net: _Net, finder: TagFinder, size_mm: float, paper: str, head: Sequence[str]) -> "Figure":
    """Figure of the size of the paper, of which one unit of its only axes is a millimetre.

    size_mm : side of the black square of each tag. head : lines of text above, the first one larger.
    Raises InputError if the tags do not fit on the paper, or the dictionary lacks one of them.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch, Polygon

    width, height = PAPERS[paper]
    room = np.array(_room(paper))
    if (net.size > room + 1e-9).any():
        share = float(((room - net.fixed) / (net.size - net.fixed)).min())
        raise InputError(
            f"--size-mm {size_mm:g}: the tags take {net.size[0]:.0f} x {net.size[1]:.0f} mm, and {paper} has "
            f"{room[0]:.0f} x {room[1]:.0f} mm for them: take about {math.floor(share * size_mm)} mm"
        )
    figure = Figure(figsize=(width / _MM, height / _MM))
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, width), ylim=(0.0, height))
    ax.set_axis_off()
    origin = np.array([0.5 * width, _BORDER + _FOOT + 0.5 * room[1]])
    for line in net.lines:
        line_style = _FOLD if line.fold else _CUT
        ax.add_patch(Polygon(origin + line.points, closed=False, **line_style))
    for tag in net.tags:
        black = finder.picture(tag.number, 1) == 0
        path = _tag_path(black, origin + tag.center, tag.up, size_mm / (len(black) - 2))
        ax.add_patch(PathPatch(path, facecolor="black", edgecolor="none", snap=False))
    for text, at in net.labels:
        x, y = (origin + at).tolist()
        ax.text(x, y, text, color="0.35", fontsize=7, ha="center", va="center")
    for i, text in enumerate(head):
        y = height - _BORDER - 3.0 - 5.0 * i
        ax.text(_BORDER, y, text, fontsize=8 if i else 11, va="center")
    _draw_ruler(ax, np.array([_BORDER + 2.0, _BORDER + 4.0]))
    return figure


def _tag_path(black: FloatArray, center: FloatArray, up: FloatArray, cell: float) -> "Path":
    """One path around all black cells (k, k) of a tag, so that no seam shows between two of them.

    center (2,), cell : mm; up (2,) : towards the first row.
    """
    from matplotlib.path import Path

    right = np.array([up[1], -up[0]])
    half, corners, codes = 0.5 * len(black), [], []
    for row, column in np.argwhere(black):
        for dx, dy in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0)):
            corners.append(center + cell * ((column + dx - half) * right + (half - row - dy) * up))
        codes += [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    path = Path(np.array(corners), codes)
    path.should_simplify = False
    return path


def _draw_ruler(ax: "Axes", at: FloatArray) -> None:
    """Draw a ruler from a point (2,), mm, to hold another one against."""
    x = at[0] + np.arange(_RULER + 1.0)
    length = np.where(np.arange(_RULER + 1) % 10 == 0, 5.0, np.where(np.arange(_RULER + 1) % 5, 2.0, 3.5))
    ax.vlines(x, at[1], at[1] + length, colors="black", linewidth=0.35)
    ax.plot([x[0], x[-1]], [at[1], at[1]], color="black", linewidth=0.35, solid_capstyle="butt")
    for mark in range(0, _RULER + 1, 10):
        ax.text(x[mark], at[1] + 7.0, f"{mark}", fontsize=6, ha="center", va="center")
    text = "mm: hold a ruler here. Another length?\nPrint again in actual size (100 %), not “fit to page”."
    ax.text(x[-1] + 5.0, at[1] + 2.0, text, fontsize=7, va="center")


def pdf(figure: "Figure") -> bytes:
    """Page of a figure as PDF, the same bytes each time."""
    buffer = io.BytesIO()
    metadata: Any = {"CreationDate": None, "ModDate": None, "Creator": "projservo", "Producer": None}
    figure.savefig(buffer, format="pdf", metadata=metadata)
    return buffer.getvalue()


def numbers_of(text: str) -> list[int]:
    """Numbers of tags such as ``0-4,7``; an InputError if they are none, or one occurs twice."""
    numbers: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not (last.isdecimal() and int(last) >= int(first))):
            raise InputError(f"--numbers {text}: expected numbers of tags such as 0-4,7")
        numbers += range(int(first), int(last if dash else first) + 1)
    number, times = Counter(numbers).most_common(1)[0]
    if times > 1:
        raise InputError(
            f"--numbers {text}: tag {number} occurs {times} times: name it once, since detect leaves "
            "out a tag that an image shows twice"
        )
    return numbers
