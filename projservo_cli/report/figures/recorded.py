"""A figure that is drawn once and written in several formats.

Finding out what has to be drawn takes matplotlib longer than drawing it. What the parts of a figure
ask of a renderer is therefore kept, and asked again of the renderer of each format.
"""

import copy
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from matplotlib.backend_bases import GraphicsContextBase, RendererBase
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.figure import Figure
from matplotlib.textpath import TextToPath
from matplotlib.transforms import Affine2D, Bbox, Transform, TransformedPath

SHARE = {"left": 0.0, "center": 0.5, "right": 1.0}  # of a text's width before the point it is set at
Size = tuple[float, float, float]


class _Asked(NamedTuple):
    """A method of a renderer and what it was called with, in pixels; no look where nothing is drawn."""

    method: str
    look: GraphicsContextBase | None
    arguments: tuple[Any, ...]
    named: dict[str, Any]


def _keeping(method: str) -> Callable[..., None]:
    def keep(self: "_Recorder", gc: GraphicsContextBase, *arguments: Any, **named: Any) -> None:
        fixed = [value.frozen() if isinstance(value, Transform) else value for value in arguments]
        self.asked.append(_Asked(method, copy.copy(gc), tuple(fixed), named))  # who asks may change gc

    return keep


class _Recorder(RendererBase):
    """Keeps what it is asked to draw; v points up, texts are as large as in a picture of pixels."""

    def __init__(self, dpi: float) -> None:
        super().__init__()
        self.asked: list[_Asked] = []
        self.dpi = dpi
        self._picture: Any = cast(Any, RendererAgg)(1, 1, dpi)

    draw_path = _keeping("draw_path")
    draw_markers = _keeping("draw_markers")
    draw_path_collection = _keeping("draw_path_collection")
    draw_quad_mesh = _keeping("draw_quad_mesh")
    draw_text = _keeping("draw_text")

    def open_group(self, s: str, gid: str | None = None) -> None:
        self.asked.append(_Asked("open_group", None, (s, gid), {}))

    def close_group(self, s: str) -> None:
        self.asked.append(_Asked("close_group", None, (s,), {}))

    def flipy(self) -> bool:
        return False

    def points_to_pixels(self, points: Any) -> Any:
        return points * self.dpi / 72.0

    def get_text_width_height_descent(self, s: str, prop: Any, ismath: Any) -> Size:
        size: Size = self._picture.get_text_width_height_descent(s, prop, ismath)
        return size


@functools.cache
def _recorder(dpi: float) -> _Recorder:
    """One for all figures, since matplotlib remembers how large texts are on it."""
    return _Recorder(dpi)


@functools.lru_cache(4096)
def _excess(s: str, prop: Any, ismath: Any, dpi: float) -> float:
    """By how much a text is wider in a picture of pixels than its outlines, points."""
    width, _, _ = _recorder(dpi).get_text_width_height_descent(s, prop, ismath)
    return 72.0 / dpi * width - _outlines().get_text_width_height_descent(s, prop, ismath)[0]


@functools.cache
def _outlines() -> TextToPath:
    return TextToPath()


class Recorded(Figure):
    """What a figure shows as it is now, for saving with pixels of one size, and without pixels.

    Parameters
    ----------
    figure : to be drawn; it must not change before this one is saved.
    dpi : pixels per inch.
    """

    def __init__(self, figure: Figure, dpi: float) -> None:
        super().__init__(figsize=tuple(figure.get_size_inches()), dpi=dpi)
        recorder = _recorder(dpi)
        figure.set_dpi(dpi)  # and stays: clips are kept as they are in the figure
        recorder.asked = []
        figure.draw(recorder)
        self._asked, self._recorded_dpi = recorder.asked, dpi

    def draw(self, renderer: RendererBase) -> None:
        """Ask a renderer what the recorder was asked."""
        scale = self.dpi / self._recorded_dpi
        enlarge, clips = Affine2D().scale(scale), _Clips(scale)
        height = renderer.get_canvas_width_height()[1]
        for method, look, arguments, named in self._asked:
            ask = getattr(renderer, method)
            if look is None:
                ask(*arguments)
                continue
            gc = renderer.new_gc()
            gc.copy_properties(look)
            gc.set_clip_rectangle(clips.box(look))
            gc.set_clip_path(clips.path(look))
            if method == "draw_text":
                x, y = self._place(*arguments, **named)
                ask(gc, x, height - y if renderer.flipy() else y, *arguments[2:], **named)
            else:
                ask(gc, *(a + enlarge if isinstance(a, Transform) else a for a in arguments), **named)
            gc.restore()

    def _place(
        self, x: float, y: float, s: str, prop: Any, angle: float, ismath: Any = False, mtext: Any = None
    ) -> tuple[float, float]:
        """Where a text begins, so that it is centred by its own width; several lines stay where they are."""
        scale = self.dpi / self._recorded_dpi
        shift = 0.0
        if scale != 1.0 and mtext is not None and (angle == 0.0 or mtext.get_rotation_mode() == "anchor"):
            shift = SHARE[mtext.get_ha()] * _excess(s, prop.copy(), ismath, self._recorded_dpi)
        turn = math.radians(angle)
        return scale * x + shift * math.cos(turn), scale * y + shift * math.sin(turn)


class _Clips:
    """Where drawing ends, enlarged; the same object for the same place, by which PDF knows it again."""

    def __init__(self, scale: float) -> None:
        self._enlarge = Affine2D().scale(scale)
        self._boxes: dict[bytes, Bbox] = {}
        self._paths: dict[tuple[int, bytes], TransformedPath] = {}

    def box(self, look: GraphicsContextBase) -> Bbox | None:
        """Rectangle, if any."""
        box = look.get_clip_rectangle()
        if box is None:
            return None
        corners = self._enlarge.transform(np.array(box))
        return self._boxes.setdefault(corners.tobytes(), Bbox(corners))

    def path(self, look: GraphicsContextBase) -> TransformedPath | None:
        """Outline, if any."""
        path: Any  # declared otherwise by matplotlib
        path, transform = look.get_clip_path()
        if path is None or transform is None:
            return None
        place = transform + self._enlarge
        return self._paths.setdefault((id(path), place.get_matrix().tobytes()), TransformedPath(path, place))
