import numpy as np
import pytest
from matplotlib.text import Text

from projservo_cli.report import style
from tests.report.cases import SPECS, case, seen

NAMES = [*SPECS]


def drawn(spec, material):
    return style.drawn(spec.draw, spec.data(material), spec.height)


VIEWS = "left", "right", "ceiling"


@pytest.fixture(scope="module", params=[2, 3])
def figures(request):
    """All figures of two cameras, and those that show other numbers of three."""
    material, other = case()[2], seen(VIEWS) if request.param == 3 else None
    return {
        name: drawn(spec, other or material)
        for name, spec in SPECS.items()
        if not spec.lacking(other or material)
        and not (other and alike(spec.data(other), spec.data(material)))
    }


def alike(one, two):
    """Whether a figure shows the same of two materials."""
    return one.keys() == two.keys() and all(np.array_equal(one[key], two[key]) for key in one)


@pytest.mark.parametrize("name", NAMES)
def test_no_text_is_clipped_by_the_figure_or_lies_on_another(figures, name, monkeypatch):
    if name in figures:
        require_readable(figures[name], monkeypatch)


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


def test_axes_have_units(figures):
    for axes in (axes for figure in figures.values() for axes in figure.axes):
        labels = [axes.get_xlabel(), axes.get_ylabel(), getattr(axes, "get_zlabel", str)()]
        for label in labels:
            assert not label or ("(" in label and ")" in label), label


def test_same_input_gives_the_same_bytes():
    first, second = (drawn(SPECS["fig13_calibration"], case()[2]) for _ in range(2))
    assert style.contents(first, style.FORMATS) == style.contents(second, style.FORMATS)
