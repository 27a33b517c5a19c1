"""The animation of a run: both camera images over time, a column a law."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from projservo_cli.files import replacing
from projservo_cli.records import BODY_LAWS, FloatArray, IntArray, Trace
from projservo_cli.report import style
from projservo_cli.report.figures.images import near_pixels
from projservo_cli.report.material import CLASSICAL, VIEWS, title

FRAMES = 60
FRAME_MS, LAST_MS = 80, 2000
_MOST_COLUMNS = 4
SEEN, HIDDEN = style.GREEN, style.ORANGE
_PATH: style.Look = {"color": SEEN, "linewidth": 0.9}
_BEHIND: style.Look = {"color": HIDDEN, "linewidth": 4.0, "alpha": 0.6}
_PANEL, _LEAST_WIDTH = 2.3, 4.0  # inches across one panel, and across the legend
_COLORS = 128


def shown(traces: Mapping[str, Trace]) -> list[str]:
    """Names of the runs beside one another: the first direct law and the classical ones that were run."""
    direct = [name for name in traces if name in BODY_LAWS]
    found = [*direct[:1], *(name for name in traces if name in CLASSICAL)]
    return (found if len(found) > 1 else list(traces))[:_MOST_COLUMNS]


def times(traces: Sequence[Trace]) -> FloatArray:
    """Time of each frame, s: from the start to the end of the longest run that converged, if any did."""
    ends = [trace.period * trace.steps for trace in traces if trace.verdict == "converged"]
    return np.linspace(0.0, max(ends or [trace.period * trace.steps for trace in traces]), FRAMES)


def frames(
    traces: Mapping[str, Trace], order: IntArray, size: FloatArray, at: FloatArray
) -> Iterator[npt.NDArray[np.uint8]]:
    """Draw one frame after another; yields the pixels (height, width, 3) of each.

    Columns are the ``traces``, ``order`` (m,) are the markers around the face, ``size`` (2,) is that of the
    images, px, and ``at`` (f,) the time of each frame, s.
    """
    every = [t[:, :, order].reshape(-1, 2) for run in traces.values() for t in (run.s, run.s_star[None])]
    near = near_pixels(np.concatenate(every), size)
    width = max(_LEAST_WIDTH, _PANEL * len(traces) + 0.5)
    figure = style.new_figure(2.0 * _PANEL * style.aspect(near) + 1.6, width)
    axes = figure.subplots(2, len(traces), squeeze=False, sharex=True, sharey=True)
    panels = []
    for column, (name, trace) in enumerate(traces.items()):
        for view, camera in enumerate(VIEWS):
            panel = axes[view, column]
            style.image_axes(panel, "" if view else f"{title(name)}\nrunning")
            panel.set_ylabel("" if column else f"{camera} camera\nv (px)")
            panel.set_xlabel("u (px)" if view else "")
            style.face(panel, trace.s[0, view, order], style.START)
            style.face(panel, trace.s_star[view, order], style.GOAL)
            style.frame_pixels(panel, near)
            panels.append(_Panel(panel, trace.s[:, view, order], trace.self_occluded[:, view]))
    looks = {"start": style.START, "goal": style.GOAL, "path of a marker": _PATH}
    looks["face hidden from this camera"] = _BEHIND
    style.legend_below(figure, looks, 4 if len(traces) > 2 else 2)
    clock = figure.suptitle("time 00.00 s", fontsize=9)
    style.arrange(figure)
    for seconds in at:
        clock.set_text(f"time {seconds:.2f} s")
        for column, (name, trace) in enumerate(traces.items()):
            now = min(int((seconds + 1e-9) / trace.period), trace.steps)
            ended = "" if now == trace.steps else "later: " if seconds == at[-1] else None
            told = "running" if ended is None else f"{ended}{trace.verdict}, {trace.steps} steps"
            axes[0, column].set_title(f"{title(name)}\n{told}")
            for panel in panels[2 * column : 2 * column + 2]:
                panel.show(now)
        yield style.pixels(figure)


class _Panel:
    """What moves in the image of one camera under one law: paths (t, m, 2) and a face, hidden (t,) or not."""

    def __init__(self, axes: Any, s: FloatArray, hidden: npt.NDArray[np.bool_]) -> None:
        self.s, self.hidden = s, hidden
        count = s.shape[1]
        self.behind = [axes.plot([], [], **_BEHIND)[0] for _ in range(count)]
        self.paths = [axes.plot([], [], **_PATH)[0] for _ in range(count)]
        (self.face,) = axes.fill([0.0], [0.0], linewidth=1.2, edgecolor=style.BLACK, alpha=0.9, zorder=3)
        place = {"transform": axes.transAxes, "ha": "center", "va": "bottom"}
        self.word = axes.text(0.5, 0.03, "", fontweight="bold", fontsize=8, **place)

    def show(self, now: int) -> None:
        """Show the paths up to an instant, and the face at it."""
        past, hidden = self.s[: now + 1], self.hidden[: now + 1]
        for k, (line, behind) in enumerate(zip(self.paths, self.behind, strict=True)):
            line.set_data(*past[:, k].T)
            behind.set_data(*np.where(hidden[:, None], past[:, k], np.nan).T)
        here = past[-1][np.isfinite(past[-1]).all(axis=1)]
        self.face.set_visible(len(here) > 2)
        if len(here) > 2:
            self.face.set_xy(here)
        self.face.set_facecolor(HIDDEN if hidden[-1] else SEEN)
        unseen = "MARKERS NOT SEEN" if len(here) < self.s.shape[1] else ""
        self.word.set_text("FACE HIDDEN" if hidden[-1] else unseen)


def write_animation(
    path: Path,
    traces: Mapping[str, Trace],
    order: IntArray,
    size: Sequence[float] | None,
    progress: Callable[[str, int, int], None],
) -> None:
    """Write the animation of runs that moved as GIF.

    ``order`` are the markers around the face, ``size`` is that of the images in px; where it is not known,
    the animation shows what reaches around all that was seen.
    """
    from PIL import Image

    if size is None:
        size = np.nanmax(np.concatenate([run.s.reshape(-1, 2) for run in traces.values()]), axis=0) + 1.0
    columns = {name: traces[name] for name in shown(traces)}
    images, at = [], times(list(columns.values()))
    with style.styled():
        for pixels in frames(columns, order, np.array(size, dtype=np.float64), at):
            images.append(Image.fromarray(pixels))
            progress("animation", len(images), len(at))
    # The last frame has all colours; one palette for all keeps what does not move the same.
    palette = images[-1].quantize(_COLORS, method=Image.Quantize.MAXCOVERAGE)
    first, *others = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    with replacing(path) as temporary:
        durations = [*[FRAME_MS] * len(others), LAST_MS]
        first.save(temporary, "GIF", save_all=True, append_images=others, duration=durations, loop=0)
