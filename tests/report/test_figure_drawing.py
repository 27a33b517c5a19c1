import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from projservo_cli.report import style
from tests.report.cases import SPECS, case

NAMES = [*SPECS]


def drawn(spec, material):
    return style.drawn(spec.draw, spec.data(material), spec.height)


@pytest.fixture(scope="module", params=["paper", "stanford"])
def figures(request):
    material = case(request.param)[2]
    return {name: drawn(spec, material) for name, spec in SPECS.items()}


@pytest.mark.parametrize("name", NAMES)
def test_no_text_is_clipped_by_the_figure_or_lies_on_another(figures, name, monkeypatch):
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


def test_legend_covers_no_axes(figures):
    for name, figure in figures.items():
        legend = figure.legends[0].get_window_extent()
        if name not in ("fig03_scene", "fig18_metric"):
            assert not any(axes.get_window_extent().overlaps(legend) for axes in figure.axes), name
            continue
        (axes,) = figure.axes  # fill the figure; what is drawn in them counts
        extent = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
        m = axes.get_proj() @ [*np.array(np.meshgrid(*extent)).reshape(3, -1), np.ones(8)]
        shown = axes.transData.transform((m[:2] / m[3]).T)
        assert shown[:, 1].min() >= legend.y1
        assert (shown >= 0).all()
        assert (shown <= figure.bbox.get_points()[1]).all()


def test_axes_have_units(figures):
    for axes in (axes for figure in figures.values() for axes in figure.axes):
        labels = [axes.get_xlabel(), axes.get_ylabel(), getattr(axes, "get_zlabel", str)()]
        for label in labels:
            assert not label or ("(" in label and ")" in label), label


@pytest.mark.parametrize("name", ["fig00_overview", "fig04_classical", "fig07_three_two"])
def test_pixels_are_square(figures, name):
    images = [axes for axes in figures[name].axes if axes.get_label() == style.IMAGE]
    assert len(images) >= 2
    for axes in images:
        box = axes.get_window_extent()
        du, dv = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
        assert du / box.width == pytest.approx(dv / box.height, rel=1e-9)
        assert axes.get_ylim()[0] > axes.get_ylim()[1]  # v points down


def test_same_input_gives_the_same_bytes():
    first, second = (drawn(SPECS["fig13_calibration"], case()[2]) for _ in range(2))
    assert style.contents(first, style.FORMATS) == style.contents(second, style.FORMATS)


def test_names_follow_the_numbers_of_the_paper():
    # 0 the overview, 13 the calibration, 14 the path, 15 the modes, 16 the way, 17 the frames, 18 in metres
    assert [int(name[3:5]) for name in NAMES] == list(range(19))


def test_a_logarithmic_scale_of_less_than_half_a_decade_has_several_labels():
    figure = Figure()
    axes = figure.subplots()
    axes.plot([15.0, 20.0])
    style.log_scale(axes)
    figure.draw_without_rendering()
    assert len([label for label in axes.get_yticklabels(which="both") if label.get_text()]) > 4


@pytest.mark.parametrize("part", ["color", "linestyle", "marker"])
def test_curves_of_seven_joints_differ_in_each_part_of_their_look(part):
    assert len({str(style.curve(i, marker=True)[part]) for i in range(7)}) == 7


def test_a_view_and_a_law_have_one_colour_in_every_figure(figures):
    drawn = {}
    for figure in figures.values():
        for axes in figure.axes:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                if isinstance(handle, Line2D):
                    drawn.setdefault(label, set()).add(handle.get_color())
    assert drawn["left camera"] == {style.BLUE}
    assert drawn["right camera"] == {style.ORANGE}
    directs = {
        color for label, colors in drawn.items() if label.startswith("directTHREE") for color in colors
    }
    assert directs == {style.LAW_LINES["direct_three"]["color"]}


def test_a_legend_names_each_style_once(figures):
    for name, figure in figures.items():
        labels = [text.get_text() for text in figure.legends[0].get_texts()]
        assert len(set(labels)) == len(labels), name


def test_importing_figures_does_not_import_matplotlib():
    import subprocess
    import sys

    code = "import sys, projservo_cli.report.figures; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
