import numpy as np
import pytest
from matplotlib.text import Text

from projservo_cli.report import drawing, style
from tests.report.cases import SPECS, case, seen

VIEWS = "left", "right", "ceiling"


def figure(name, views):
    """A figure of two cameras; of three if it shows other numbers then; None where it has none."""
    spec, material = SPECS[name], case()[2] if views == 2 else seen(VIEWS)
    if spec.lacking(material):
        return None
    data = spec.data(material)
    if views == 3 and alike(data, spec.data(case()[2])):
        return None
    return style.drawn(spec.draw, data, spec.height)


def alike(one, two):
    """Whether a figure shows the same of two materials."""
    return one.keys() == two.keys() and all(np.array_equal(one[key], two[key]) for key in one)


@pytest.mark.parametrize("views", [2, 3])
@pytest.mark.parametrize("name", SPECS)
def test_axes_have_units_and_no_text_is_clipped_by_the_figure_or_lies_on_another(name, views, monkeypatch):
    if (shown := figure(name, views)) is not None:
        require_readable(shown, monkeypatch)
        require_units(shown)


def require_readable(figure, monkeypatch):
    """Every text that is drawn lies within the figure and on no other."""
    found, draw = [], Text.draw

    def record(self, renderer, *args, **kwargs):
        if self.get_visible() and self.get_text().strip():
            found.append((self.get_text(), self.get_window_extent(renderer)))
        return draw(self, renderer, *args, **kwargs)

    monkeypatch.setattr(Text, "draw", record)  # what is really drawn: ticks beyond the limits are not
    with style.styled():
        figure.canvas.draw()
    assert len(found) > 5
    for i, (text, extent) in enumerate(found):
        low, high = extent.get_points()
        # half a pixel of anti-aliasing may stand over
        assert (low >= -0.5).all(), f"{text!r} at {extent}"
        assert (high <= figure.bbox.get_points()[1] + 0.5).all(), f"{text!r} at {extent}"
        for other, place in found[:i]:
            shared = extent.intersection(extent, place)
            # boxes hold the leading of a line: a pixel or two in common is no touching ink
            clash = shared is not None and min(shared.width, shared.height) > 2.5
            assert not clash, f"{text!r} on {other!r}"


def require_units(figure):
    for axes in figure.axes:
        labels = [axes.get_xlabel(), axes.get_ylabel(), getattr(axes, "get_zlabel", str)()]
        for label in labels:
            assert not label or ("(" in label and ")" in label), label


def test_same_input_gives_the_same_bytes():
    first, second = (figure("fig13_calibration", 2) for _ in range(2))
    assert style.contents(first, style.FORMATS) == style.contents(second, style.FORMATS)


@pytest.mark.parametrize("ended", [False, True])
def test_two_processes_draw_the_same_bytes_as_one_even_where_the_second_ends(ended, monkeypatch):
    names = ("fig01_partition", "fig15_modes_path", "fig11_image_errors")
    figures = [drawing.Drawing(SPECS[name], SPECS[name].data(case()[2]), ("svg",)) for name in names]
    alone = [figure.contents() for figure in figures]
    here, contents = [], style.contents

    def drawn_here(*given):
        """Draw once the other process has drawn a figure, or ended."""
        here.append(1)
        with second._changed:
            assert second._changed.wait_for(lambda: second._drawn or not second._working, 60.0)
        return contents(*given)

    monkeypatch.setattr(drawing, "PROCESSORS", 2)
    monkeypatch.setattr(style, "contents", drawn_here)
    with drawing.SecondProcess() as second:
        if ended:
            second._process.kill()
        assert list(second.contents(figures)) == alone
    assert len(here) == 3 if ended else 0 < len(here) < 3
