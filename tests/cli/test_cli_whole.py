"""The real stages through the command line: refusals, runs that repeat, options, what is read afterwards."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from projservo_cli import cli, store
from tests.conftest import ROOT

CONFIGS = ROOT / "configs"
PAPER = ("-c", CONFIGS / "paper.yaml")
FEW = "calibration.frames_per_joint=4"
ON_A_LINE = (
    "markers={positions_m: [[-0.08, 0, 0.05], [-0.02, 0, 0.05], [0.03, 0, 0.05], [0.08, 0, 0.05]], "
    "face: [0, 1, 2]}"
)


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """Work in an empty folder: nothing may depend on the working directory."""
    monkeypatch.chdir(tmp_path)


NO_ANGLE, NO_FRAME = "calibration.amplitude_deg=0", "calibration.frames_per_joint=0"


@pytest.mark.parametrize(
    ("given", "message"), [(NO_ANGLE, "joint 1"), (NO_FRAME, "pose"), (ON_A_LINE, "line")]
)
def test_data_that_support_no_calibration(projservo, given, message):
    answer = projservo("calibrate", *PAPER, "--set", given, "-o", "out", "-q", "--json")
    assert answer.code == 1
    assert (answer.json["usable"], answer.json["failed"]) == (False, "calibrate")
    assert message in answer.json["reason"]
    assert answer.err == f"projservo: calibrate: {answer.json['reason']}\n"
    assert not Path("out/run.h5").exists()


def test_a_goal_that_cannot_be_reached(projservo):
    goal = "task.goal={joints: {joints: [500, 0, 0, 0, 0, 0], unit: deg}}"
    answer = projservo("plan", *PAPER, "--set", goal, "--set", FEW, "-o", "out", "-q")
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


@pytest.fixture(scope="module")
def held_out(tmp_path_factory):
    """A run with cross-validation, made once."""
    folder = tmp_path_factory.mktemp("run")
    words = ("--cross-validate", 3, *PAPER, "--set", FEW, "calibrate", "-o", folder)
    assert cli.run([str(word) for word in words]) == 0
    return folder


def test_held_out_errors_are_in_json_and_words(projservo, held_out):
    value = projservo("calibrate", "-o", held_out, "--json").json["cross_validation"]
    assert (value["folds"], value["unit"], value["failed"]) == (3, "poses", [])
    assert value["rms_px"] == pytest.approx(value["predicted_rms_px"], rel=0.15)
    assert value["median_px"] < value["rms_px"] < value["p95_px"]
    words = projservo("calibrate", "-o", held_out).out
    assert f"held out, 3 parts of poses: rms {value['rms_px']:.3g} px" in words
    for parts, why in ((3, None), (4, "outdated")):  # they are part of the configuration
        dry = projservo("calibrate", "-o", held_out, "-n", "--json", "--cross-validate", parts).json
        assert dry["steps"][0]["why"] == why


def test_a_number_left_out_takes_no_other_word_for_it(projservo, held_out):
    for words, count in ((["--suggest", "calibrate"], 5), (["--suggest", "2", "calibrate"], 2)):
        answer = projservo(*words, "-o", held_out, "--json")
        assert answer.code == 0, answer.err
        assert len(answer.json["suggestions"]) == count


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cross-validate", "1"], "--cross-validate 1: calibration.cross_validate"),
        (["--cross-validate", "26"], "there are 25 poses; choose 2 to 25 parts"),
        (
            ["--cross-validate", "3", "--set", "calibration.method=closed_form"],
            "the method bundle_adjustment",
        ),
        (["--suggest", "--set", "calibration.method=closed_form"], "no covariance to judge poses by"),
        (["--init", "none.json"], "none.json: cannot be read"),
        (["--init", "bad.json"], "bad.json:1:1: not JSON"),
    ],
)
def test_what_cannot_be_done_is_one_line(projservo, options, message):
    Path("bad.json").write_text("no")
    answer = projservo("calibrate", *PAPER, "--set", FEW, "-o", "run", *options)
    assert answer.code == 2
    assert message in answer.err.splitlines()[-1]
    assert not list(Path().rglob("*.h5"))


def test_a_start_is_tried_and_named_where_it_was_none(projservo, reference_truth):
    truth = reference_truth("ur5")
    Path("ur5.json").write_text(json.dumps(truth))
    config = ("-c", CONFIGS / "ur5.yaml", "--set", FEW)
    good = projservo("calibrate", *config, "--init", "ur5.json", "-o", "one", "--json")
    assert good.code == 0
    assert not any("ur5.json" in text for text in good.json["advice"])
    # The file is known by what it says: elsewhere it is the same, changed it is another.
    Path("there").mkdir()
    Path("ur5.json").rename("there/ur5.json")
    moved = ("calibrate", "-o", "one", "--init", "there/ur5.json", "--dry-run", "--json")
    assert projservo(*moved).json["steps"][0]["why"] is None
    truth["T_base_tool_at_reference"][0][3] = 2.0  # between the cameras, partly behind them
    Path("there/ur5.json").write_text(json.dumps(truth))
    assert projservo(*moved).json["steps"][0]["why"] == "outdated"
    wrong = projservo("calibrate", *config, "--init", "there/ur5.json", "-o", "two", "--json")
    assert wrong.code == 0
    assert "was not used as a start" in wrong.json["advice"][-1]
    assert wrong.json["rms_px"] == pytest.approx(good.json["rms_px"], rel=1e-6)


@pytest.mark.volume
def test_what_the_first_chain_prints_is_read_in_ten_seconds(first_chain):
    told = (first_chain / "told.txt").read_text(encoding="utf-8")
    assert len(told.splitlines()) <= 45
    assert len(told.split()) <= 350
    # The reason of a run that did not converge is one line, however long.
    short = [line for line in told.splitlines() if str(first_chain) not in line and " ended in " not in line]
    assert max(map(len, short)) <= 80
    for law in ("direct_three", "direct_two", "stacked", "blockwise", "euclidean_points"):
        assert sum(line.split()[:1] == [law] for line in told.splitlines()) == 1
    assert f"page: {first_chain / 'report.html'}" in told
    assert " claims hold" in told


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
def test_the_same_seed_makes_identical_arrays_and_running_again_changes_nothing(projservo, first_chain):
    answer = projservo("servo", *PAPER, "--law", "direct_three", "-o", "one", "--json")
    (trace,) = answer.json["laws"]
    assert (answer.code, trace["verdict"]) == (0, "converged")
    one, first = arrays(store.load("one")), arrays(store.load(first_chain))
    assert any(name.startswith("servo/direct_three") for name in one)
    for name, value in one.items():
        np.testing.assert_array_equal(value, first[name], err_msg=name)
    before = Path("one/run.h5").read_bytes()
    again = projservo("calibrate", "plan", "servo", "--law", "direct_three", "-o", "one", "--json")
    assert again.json["servo"]["laws"] == [trace]
    assert Path("one/run.h5").read_bytes() == before
    assert projservo("calibrate", *PAPER, "-o", "two", "--set", "seed=2", "-q").code == 0
    assert not np.array_equal(store.load("two").observation.images, store.load("one").observation.images)
