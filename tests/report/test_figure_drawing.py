from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from matplotlib.text import Text

from projservo_cli.report import figure_processes, style
from tests.report.cases import SPECS, case, seen

VIEWS = "left", "right", "ceiling"


@pytest.mark.parametrize("views", [2, 3])
@pytest.mark.parametrize("name", SPECS)
def test_axes_have_units_and_no_text_is_clipped_by_the_figure_or_lies_on_another(name, views, monkeypatch):
    spec, material = SPECS[name], case()[2] if views == 2 else seen(VIEWS)
    if name == "fig21_runs" and views == 3:  # a row of panels for each run: two are enough
        material = replace(material, traces=dict(islice(material.traces.items(), 2)))
    if spec.lacking(material):
        return
    figure = style.drawn(spec.draw, spec.data(material), spec.height)
    for axes in figure.axes:
        for label in (axes.get_xlabel(), axes.get_ylabel(), getattr(axes, "get_zlabel", str)()):
            assert not label or ("(" in label and ")" in label), label
    found, draw = [], Text.draw

    def record(self, renderer, *args, **kwargs):
        if self.get_visible() and self.get_text().strip():
            found.append((self.get_text(), self.get_window_extent(renderer)))
        return draw(self, renderer, *args, **kwargs)

    monkeypatch.setattr(Text, "draw", record)  # what is really drawn: ticks beyond the limits are not
    with style.styled():
        figure.canvas.draw()
    assert len(found) > 5
    texts, (low, high) = (
        [text for text, _ in found],
        np.array([extent.get_points() for _, extent in found]).swapaxes(0, 1),
    )
    # half a pixel of anti-aliasing may stand over
    clipped = (low < -0.5).any(axis=1) | (high > figure.bbox.get_points()[1] + 0.5).any(axis=1)
    assert not clipped.any(), [texts[i] for i in np.flatnonzero(clipped)]
    # boxes hold the leading of a line: a pixel or two in common is no touching ink
    shared = (np.minimum(high[:, None], high) - np.maximum(low[:, None], low)).min(axis=2)
    clashes = np.argwhere(np.triu(shared > 2.5, 1))
    assert not len(clashes), [(texts[i], texts[j]) for i, j in clashes]


def test_two_processes_draw_the_same_bytes_as_one_even_where_the_second_ends(monkeypatch):
    formats = {"fig01_partition": ("svg",), "fig11_image_errors": ("svg",), "fig15_modes_path": style.FORMATS}
    figures = [
        figure_processes.Drawing(SPECS[name], SPECS[name].data(case()[2]), of) for name, of in formats.items()
    ]
    alone = [figure.contents() for figure in figures]
    here, contents = [], style.contents

    def drawn_here(*given):
        """Draw once the other process has drawn a figure, or ended."""
        here.append(1)
        with second._changed:
            assert second._changed.wait_for(lambda: second._drawn or not second._working, 60.0)
        return contents(*given)

    monkeypatch.setattr(figure_processes, "PROCESSORS", 2)
    monkeypatch.setattr(style, "contents", drawn_here)
    for ended in (False, True):
        here.clear()
        with figure_processes.SecondProcess() as second:
            if ended:
                second._process.kill()
            assert list(second.contents(figures)) == alone
        assert len(here) == 3 if ended else 0 < len(here) < 3


def test_joints_of_both_kinds_have_whole_ordinates_and_a_legend_in_their_order():
    """Ticks of as many digits when the panels have their height as when labels are given room."""
    decay = np.exp(-0.107 * np.arange(96))[:, None]
    q = decay * [80.0, -140.0, 70.0, 15.0, -14.0, 130.0] + [-30.0, 60.0, -50.0, -5.0, 6.0, -70.0]
    data = {"prismatic": np.array([True] * 3 + [False] * 3), "step_limit_deg": np.array(5.0)}
    for name in ("free", "limited"):
        data |= {f"t_s_{name}": 0.04 * np.arange(96), f"q_{name}": q, f"step_{name}": np.diff(q, axis=0)}
    figure = style.drawn(SPECS["fig12_joints"].draw, data, SPECS["fig12_joints"].height)
    with style.styled():
        figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    assert min(axes.yaxis.label.get_window_extent(renderer).x0 for axes in figure.axes[:8]) > 2.0
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == [*(f"$q_{{{i}}}$" for i in range(1, 7)), "limit"]
