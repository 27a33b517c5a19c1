"""The real stages through the command line: reference tables, refusals, runs that repeat."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from projservo_cli import store
from projservo_cli.tables import read_table, write_table

PAPER = Path(__file__).parents[2] / "configs" / "paper.yaml"


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """Work in an empty folder: nothing may depend on the working directory."""
    monkeypatch.chdir(tmp_path)


def test_a_table_in_degrees_gives_the_calibration_of_the_table_in_radians(projservo, shared_data):
    table = shared_data / "stanford" / "trials_0.5px.csv"
    radians = read_table(table)
    revolute = np.array([1, 1, 0, 1, 1, 1], dtype=bool)
    q = np.where(revolute, np.degrees(radians.q), radians.q)
    write_table(dataclasses.replace(radians, q=q), "deg.csv")
    options = ["--joints", "RRPRRR", "-q"]
    refused = projservo("calibrate", "--data", "deg.csv", *options, "-o", "deg")
    assert refused.code == 2
    assert "look like degrees; give --joint-unit deg" in refused.err
    assert projservo("calibrate", "--data", table, *options, "-o", "rad").code == 0
    assert projservo("calibrate", "--data", "deg.csv", *options, "--joint-unit", "deg", "-o", "deg").code == 0
    value, expected = (
        projservo("validate", run, "--data", held_out, "--json").json
        for run in ("deg", "rad")
        for held_out in ["deg.csv" if run == "deg" else table]
    )
    # readings differ by the rounding of degrees, 1e-16; the optimum is found to 1e-6 px
    assert value["rms_px"] == pytest.approx(expected["rms_px"], abs=1e-6)


ON_A_LINE = (
    "markers={positions_m: [[-0.08, 0, 0.05], [-0.02, 0, 0.05], [0.03, 0, 0.05], [0.08, 0, 0.05]], "
    "face: [0, 1, 2]}"
)
UNSUPPORTED = {
    "no amplitude": (["--set", "calibration.amplitude_deg=0"], "joint 1"),
    "no trials": (["--set", "calibration.frames_per_joint=0"], "pose"),
    "markers on a line": (["--set", ON_A_LINE], "line"),
}


@pytest.mark.parametrize("case", UNSUPPORTED)
def test_data_that_support_no_calibration(projservo, case):
    options, message = UNSUPPORTED[case]
    answer = projservo("calibrate", "-c", PAPER, *options, "-o", "out", "-q", "--json")
    assert answer.code == 1
    assert (answer.json["usable"], answer.json["failed"]) == (False, "calibrate")
    assert message in answer.json["reason"]
    assert answer.err == f"projservo: calibrate: {answer.json['reason']}\n"
    assert not Path("out/run.h5").exists()


def test_a_goal_that_cannot_be_reached(projservo):
    goal = "task.goal={joints: {joints: [500, 0, 0, 0, 0, 0], unit: deg}}"
    answer = projservo("plan", "-c", PAPER, "--set", goal, "-o", "out", "-q")
    assert answer.code == 1
    assert "joint 1" in answer.err
    assert answer.err.count("\n") == 1


def test_a_recorded_run_says_which_key_a_stage_lacks(projservo, shared_data):
    table = shared_data / "ur5" / "trials_0.5px.csv"
    answer = projservo("servo", "--data", table, "-o", "out", "-q")
    assert answer.code == 2
    assert "set " in answer.err
    assert answer.err.count("\n") == 1
    assert list(store.load("out").results) == ["calibrate"]


def arrays(run):
    """Every array of a run by the name of its place."""
    return {
        f"{name}/{label}/{field.name}": getattr(record, field.name)
        for name, result in run.results.items()
        for label, record in result.records.items()
        for field in dataclasses.fields(record)
        if "dims" in field.metadata
    }


@pytest.mark.volume
def test_what_the_first_chain_prints_is_read_in_ten_seconds(first_chain):
    told = (first_chain / "told.txt").read_text(encoding="utf-8")
    assert len(told.splitlines()) <= 45
    assert len(told.split()) <= 350
    assert max(len(line) for line in told.splitlines() if str(first_chain) not in line) <= 80
    for law in ("direct_three", "direct_two", "stacked", "blockwise", "euclidean_points"):
        assert sum(line.split()[:1] == [law] for line in told.splitlines()) == 1
    assert f"page: {first_chain / 'report.html'}" in told
    assert " claims hold" in told


@pytest.mark.volume
def test_the_same_seed_makes_identical_arrays_and_running_again_changes_nothing(projservo, first_chain):
    answer = projservo("servo", "-c", PAPER, "--law", "direct_three", "-o", "one", "--json")
    assert answer.code == 0, answer.err
    (trace,) = answer.json["laws"]
    assert trace["verdict"] == "converged"
    one, two = arrays(store.load("one")), arrays(store.load(first_chain))
    assert any(name.startswith("servo/direct_three") for name in one)
    for name, value in one.items():
        np.testing.assert_array_equal(value, two[name], err_msg=name)
    before = Path("one/run.h5").read_bytes()
    again = projservo("calibrate", "plan", "servo", "--law", "direct_three", "-o", "one", "--json")
    assert again.code == 0
    assert again.json["servo"]["laws"] == [trace]
    assert Path("one/run.h5").read_bytes() == before
    other = projservo("calibrate", "-c", PAPER, "-o", "three", "--set", "seed=2", "-q")
    assert other.code == 0
    assert not np.array_equal(store.load("three").observation.images, store.load("one").observation.images)


@pytest.mark.volume
def test_xarray_opens_a_whole_run_with_names_and_units(first_chain):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    with xarray.open_datatree(first_chain / "run.h5", engine="h5netcdf") as tree:
        assert {
            *("/", "/calibrate", "/calibrate/observation", "/calibrate/calibration"),
            *("/plan", "/servo", "/servo/direct_two", "/report"),
        } <= set(tree.groups)
        for node in tree.subtree:
            for name, data in node.data_vars.items():
                assert data.attrs["units"], name
                assert data.attrs["long_name"], name
                assert not any(str(dim).startswith("phony") for dim in data.dims), name
        trace = tree["servo/direct_two"]
        assert trace["q"].dims == ("instant", "joint")
        assert trace.sizes["instant"] == trace.sizes["step"] + 1 == trace.attrs["steps"] + 1
