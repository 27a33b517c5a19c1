"""Both camera images over time, a column a law: the frames of the animation."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from projservo_cli.records import BODY_LAWS, BoolArray, FloatArray, IntArray, Trace
from projservo_cli.report import style
from projservo_cli.report.figures.images import near_pixels
from projservo_cli.report.material import CLASSICAL, VIEWS, title

FRAMES = 60
DPI = 100
MOST_COLUMNS = 4
PANEL = 2.3  # inches across one panel
LEAST_WIDTH = 4.0  # inches, of the legend
HIDDEN_COLOR = style.ORANGE
SEEN_COLOR = style.GREEN


class Strip(NamedTuple):
    """One column of the film.

    Attributes
    ----------
    title : name of the run.
    verdict : how it ended.
    end : time of the last instant, s.
    seconds : (t,) time of the instants, s.
    s : (t, 2, m, 2) pixels of the face, in cyclic order.
    s_star : (2, m, 2) where they are to go.
    hidden : (t, 2) whether the face is hidden from each camera.
    """

    title: str
    verdict: str
    end: float
    seconds: FloatArray
    s: FloatArray
    s_star: FloatArray
    hidden: BoolArray


def shown(traces: Mapping[str, Trace]) -> list[str]:
    """Names of the runs beside one another: the first direct law and the classical ones that were run."""
    moved = [name for name, trace in traces.items() if trace.steps > 0]
    direct = [name for name in moved if name in BODY_LAWS]
    found = [*direct[:1], *(name for name in moved if name in CLASSICAL)]
    return (found if len(found) > 1 else moved)[:MOST_COLUMNS]


def strips(traces: Mapping[str, Trace], order: IntArray) -> list[Strip]:
    """The columns of the film, of the runs that are shown.

    Parameters
    ----------
    order : (m,) markers around the face.
    """
    return [
        Strip(
            title(name),
            f"{trace.verdict}, {trace.steps} steps",
            trace.period * trace.steps,
            trace.period * np.arange(len(trace.s), dtype=np.float64),
            trace.s[:, :, order],
            trace.s_star[:, order],
            trace.self_occluded,
        )
        for name, trace in ((name, traces[name]) for name in shown(traces))
    ]


def times(columns: list[Strip], converged: list[bool]) -> FloatArray:
    """Time of each frame, s: from the start to the end of the longest run that converged, if any did."""
    ends = [strip.end for strip, good in zip(columns, converged, strict=True) if good]
    return np.linspace(0.0, max(ends or [strip.end for strip in columns]), FRAMES)


def frames(columns: list[Strip], size: FloatArray, at: FloatArray) -> Iterator[npt.NDArray[np.uint8]]:
    """Draw one frame after another; yields the pixels (height, width, 3) of each.

    Parameters
    ----------
    columns : what is shown.
    size : (2,) of the images, px.
    at : (f,) time of each frame, s.
    """
    every = np.concatenate([np.concatenate([c.s.reshape(-1, 2), c.s_star.reshape(-1, 2)]) for c in columns])
    near = near_pixels(every, size)
    width = max(LEAST_WIDTH, PANEL * len(columns) + 0.5)
    figure = style.new_figure(2.0 * PANEL * style.aspect(near) + 1.6, width)
    figure.set_dpi(DPI)
    axes = figure.subplots(2, len(columns), squeeze=False, sharex=True, sharey=True)
    for column, strip in enumerate(columns):
        for view, name in enumerate(VIEWS):
            panel = axes[view, column]
            style.image_axes(panel, f"{strip.title}\nrunning" if view == 0 else "")
            if column:
                panel.set_ylabel("")
            else:
                panel.set_ylabel(f"{name} camera\nv (px)")
            if view == 0:
                panel.set_xlabel("")
            style.face(panel, strip.s[0, view], style.START)
            style.face(panel, strip.s_star[view], style.GOAL)
            style.frame_pixels(panel, near)
    style.legend_below(figure, _handles(), 4 if len(columns) > 2 else 2)
    clock = figure.suptitle("time 00.00 s", fontsize=9)
    moving = [
        [_Panel(axes[view, column], strip, view) for view in range(2)] for column, strip in enumerate(columns)
    ]
    style.arrange(figure)
    for seconds in at:
        clock.set_text(f"time {seconds:.2f} s")
        for strip, pair in zip(columns, moving, strict=True):
            now = int(np.searchsorted(strip.seconds, seconds + 1e-9, side="right")) - 1
            ended = "" if seconds >= strip.end - 1e-9 else "later: " if seconds == at[-1] else None
            pair[0].axes.set_title(f"{strip.title}\n{'running' if ended is None else ended + strip.verdict}")
            for panel in pair:
                panel.show(now)
        yield style.pixels(figure)


class _Panel:
    """What moves in the image of one camera under one law."""

    def __init__(self, axes: Any, strip: Strip, view: int) -> None:
        self.axes = axes
        self.s = strip.s[:, view]
        self.hidden = strip.hidden[:, view]
        points = self.s.shape[1]
        self.behind = [
            axes.plot([], [], color=HIDDEN_COLOR, linewidth=4.0, alpha=0.6)[0] for _ in range(points)
        ]
        self.paths = [axes.plot([], [], color=SEEN_COLOR, linewidth=0.9)[0] for _ in range(points)]
        (self.face,) = axes.fill([0.0], [0.0], linewidth=1.2, edgecolor=style.BLACK, alpha=0.9, zorder=3)
        self.word = axes.text(
            0.5, 0.03, "", transform=axes.transAxes, ha="center", va="bottom", fontweight="bold", fontsize=8
        )

    def show(self, now: int) -> None:
        """Show the paths up to an instant, and the face at it."""
        past = self.s[: now + 1]
        for k, (line, behind) in enumerate(zip(self.paths, self.behind, strict=True)):
            line.set_data(*past[:, k].T)
            behind.set_data(*np.where(self.hidden[: now + 1, None], past[:, k], np.nan).T)
        here = self.s[now][np.isfinite(self.s[now]).all(axis=1)]
        self.face.set_visible(len(here) > 2)
        if len(here) > 2:
            self.face.set_xy(here)
        self.face.set_facecolor(HIDDEN_COLOR if self.hidden[now] else SEEN_COLOR)
        unseen = "MARKERS NOT SEEN" if len(here) < len(self.s[now]) else ""
        self.word.set_text("FACE HIDDEN" if self.hidden[now] else unseen)


def _handles() -> list[Any]:
    return [
        style.line_handle("start", **style.START),
        style.line_handle("goal", **style.GOAL),
        style.line_handle("path of a marker", color=SEEN_COLOR, linewidth=0.9),
        style.line_handle("face hidden from this camera", color=HIDDEN_COLOR, linewidth=4, alpha=0.6),
    ]
