"""What the figures that compare the modes are made of, against the traces."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.report.figures import FIGURES, modes
from projservo_cli.report.material import title
from projservo_cli.stages.report import lacking
from tests.figures.cases import DRAWS, case

COMPARED = ["stacked", "exact", "exact_track", "stacked_image_track"]
SPECS = {spec.name: spec for spec in FIGURES if spec.modes}


@pytest.fixture
def material():
    return case("paper")[2]


def test_laws_that_follow_the_plan_stand_beside_the_same_that_plan_anew(material):
    assert material.compared() == COMPARED
    assert title("stacked_image_track") == "stacked Jacobians, following planned images"
    assert title("my_laws:Law") == "my_laws:Law"


def test_the_path_begins_on_the_line_and_knows_how_far_it_strays(material):
    data = modes.data_path(material)
    assert data["names"].tolist() == COMPARED
    for name in COMPARED:
        way, off = data[f"path_mm_{name}"].T
        assert (way[0], off[0]) == pytest.approx((0.0, 0.0), abs=1e-9)
        most = material.traces[name].center_deviation_at_samples_mm
        assert off.max() == pytest.approx(most, abs=1e-9)


def test_image_errors_are_those_of_the_traces(material):
    data = modes.data_images(material)
    assert float(data["planned_s"]) == 2.0
    for name in COMPARED:
        trace = material.traces[name]
        np.testing.assert_array_equal(data[f"image_error_px_{name}"], trace.image_error)
        assert data[f"t_s_{name}"][-1] == pytest.approx(trace.steps * trace.period)


def test_deviations_over_the_noise(material):
    data = modes.data_noise(material)
    assert float(data["noise_px"]) == 0.5
    for name in data["names"].tolist():
        runs = material.noisy[name]
        assert 1 < len(runs) <= DRAWS
        k = 7
        center = np.array([run.center[k] for run in runs])
        spread = np.sqrt(((center - center.mean(axis=0)) ** 2).sum() / (len(runs) - 1))
        assert data[f"center_mm_{name}"][k - 1] == pytest.approx(1e3 * spread, rel=1e-9)
        assert data[f"t_s_{name}"][k - 1] == pytest.approx(k * runs[0].period)
        q_dot = np.degrees([run.q_dot[k] for run in runs])
        assert data[f"command_deg_s_{name}"][k] == pytest.approx(np.sqrt(q_dot.var(axis=0, ddof=1).sum()))


def test_without_a_run_that_follows_the_plan_there_is_nothing_to_compare(material):
    traces = {name: material.traces[name] for name in ("exact", "stacked")}
    plain = dataclasses.replace(material, traces=traces)
    for spec in SPECS.values():
        assert "set control.mode" in lacking(spec, plain)
        assert lacking(spec, material) == ""
    assert "noise" in lacking(SPECS["fig17_modes_noise"], dataclasses.replace(material, noisy={}))
