import numpy as np
import pytest

from projservo_cli.report import style
from projservo_cli.report.figures import FIGURES, overview
from tests.figures.cases import case

SPEC = next(spec for spec in FIGURES if spec.name == "fig00_overview")


@pytest.fixture(scope="module")
def material():
    return case()[2]


def test_hidden_steps_are_those_of_the_run(material):
    data = overview.data(material)
    for law in overview.LAWS:
        trace = material.traces[law]
        hidden = data[f"hidden_{law}"]
        counts = trace.self_occluded_steps_left, trace.self_occluded_steps_right
        assert tuple(hidden.sum(axis=0)) == counts
        union = np.count_nonzero(hidden[:, 0] | hidden[:, 1])
        assert str(data[f"verdict_{law}"]).endswith(f"in {trace.steps} steps, face hidden in {union}")


def test_control_errors_begin_at_a_hundred_percent(material):
    data = overview.data(material)
    direct = material.traces["direct_three"]
    for name in ("tau_affine", "theta_r", "theta_p"):
        values = data[f"{name}_percent"]
        e = getattr(direct, name)
        assert values[0] == pytest.approx(100.0, rel=1e-14)
        np.testing.assert_allclose(values[-1] * np.abs(e[0]), 100.0 * np.abs(e[-1]), rtol=1e-12)


def test_paths_lead_from_start_to_where_the_run_ended(material):
    data = overview.data(material)
    order = material.plant.order
    for law in overview.LAWS:
        trace = material.traces[law]
        np.testing.assert_array_equal(data[f"s_{law}"][0], trace.s[0][:, order])
        np.testing.assert_array_equal(data[f"s_{law}"][-1], trace.s[-1][:, order])
    # the centre lies inside its face: between the extremes of its markers in each image
    s, center = data["s_direct_three"], data["center"]
    assert (center > s.min(axis=2)).all()
    assert (center < s.max(axis=2)).all()


def test_images_show_all_paths_with_square_pixels(material):
    data = overview.data(material)
    with style.styled():
        figure = style.new_figure(SPEC.height)
        overview.draw(data, figure)
        style.arrange(figure)
    images = [axes for axes in figure.axes if axes.get_label() == style.IMAGE]
    assert len(images) == 2
    for view, axes in enumerate(images):
        box = axes.get_window_extent()
        du, dv = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
        assert du / box.width == pytest.approx(dv / box.height, rel=1e-9)
        shown = np.concatenate([data[f"s_{law}"][:, view].reshape(-1, 2) for law in overview.LAWS])
        inside = axes.transData.transform(shown)
        assert (inside >= box.min).all()
        assert (inside <= box.max).all()
