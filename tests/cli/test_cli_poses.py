"""Cross-validation and starts on the command line: JSON, run file, configuration, refusals."""

import json
from pathlib import Path

import numpy as np
import pytest

from projservo_cli import files
from projservo_cli.store import load

CONFIGS = Path(__file__).parents[2] / "configs"
PAPER = ("-c", CONFIGS / "paper.yaml", "--set", "calibration.frames_per_joint=4")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run with cross-validation, made once."""
    from projservo_cli import cli

    folder = tmp_path_factory.mktemp("run")
    assert cli.run([str(a) for a in ("--cross-validate", 3, *PAPER, "calibrate", "-q", "-o", folder)]) == 0
    return folder


def test_held_out_errors_are_in_json_and_words(made, projservo):
    answer = projservo("calibrate", "-o", made, "--json")
    assert answer.code == 0
    assert "up to date" in answer.err
    value = answer.json["cross_validation"]
    assert (value["folds"], value["unit"], value["failed"]) == (3, "poses", [])
    assert value["rms_px"] == pytest.approx(value["predicted_rms_px"], rel=0.15)
    assert value["median_px"] < value["rms_px"] < value["p95_px"]
    for parts, why in ((3, None), (4, "outdated")):  # they are part of the configuration
        dry = projservo("calibrate", "-o", made, "--dry-run", "--json", "--cross-validate", parts).json
        assert dry["steps"][0]["why"] == why
    words = projservo("calibrate", "-o", made).out
    assert f"held out, 3 parts of poses: rms {value['rms_px']:.3g} px" in words


def test_held_out_errors_are_read_with_names_and_units(made):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    with xarray.open_datatree(made / "run.h5", engine="h5netcdf") as tree:
        group = tree["calibrate/cross_validation"]
        assert group["residual"].dims == ("pose", "view", "marker", "xy")
        assert group["residual"].attrs["units"] == "px"
        assert group["predicted"].attrs["units"] == "px"
        one = group["residual"].sel(pose=0).values
    found = load(made).cross_validation
    np.testing.assert_array_equal(one, found.residual[0])
    assert found.rms_px == pytest.approx(np.sqrt(np.mean((found.residual**2).sum(axis=-1))))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cross-validate", "1"], "--cross-validate 1: calibration.cross_validate"),
        (["--cross-validate", "many"], "--cross-validate many: calibration.cross_validate"),
        (["--cross-validate", "26"], "there are 25 poses; choose 2 to 25 parts"),
        (["--cross-validate", "3", "--set", "calibration.method=closed_form"], "the method refined"),
        (["--init", "none.json"], "none.json: cannot be read"),
        (["--init", "bad.json"], "bad.json:1:1: not JSON"),
    ],
)
def test_what_cannot_be_done_is_one_line(projservo, monkeypatch, tmp_path, options, message):
    monkeypatch.chdir(tmp_path)
    Path("bad.json").write_text("no")
    answer = projservo("calibrate", *PAPER, "-o", "run", *options)
    assert answer.code == 2
    assert message in answer.err.splitlines()[-1]
    assert not Path("run").exists() or not list(Path("run").glob("*.h5"))


def test_a_number_left_out_takes_no_other_word_for_it(projservo, made):
    for words, count in ((["--suggest", "calibrate"], 5), (["--suggest", "2", "calibrate"], 2)):
        answer = projservo(*words, "-o", made, "--json")
        assert answer.code == 0, answer.err
        assert len(answer.json["suggestions"]) == count


def test_a_start_is_tried_and_named_where_it_was_none(projservo, monkeypatch, tmp_path, reference_truth):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(files, "_synchronise", lambda path: None)
    truth = reference_truth("ur5")
    Path("ur5.json").write_text(json.dumps(truth))
    config = ("-c", CONFIGS / "ur5.yaml", "--set", "calibration.frames_per_joint=4")
    good = projservo("calibrate", *config, "--init", "ur5.json", "-o", "one", "--json")
    assert good.code == 0
    assert not any("ur5.json" in text for text in good.json["advice"])
    # The file is known by what it says: elsewhere it is the same, changed it is another.
    Path("there").mkdir()
    Path("there/ur5.json").write_text(json.dumps(truth))
    moved = ("calibrate", "-o", "one", "--init", "there/ur5.json", "--dry-run", "--json")
    assert projservo(*moved).json["steps"][0]["why"] is None
    truth["T_base_tool_at_reference"][0][3] = 2.0  # between the cameras, partly behind them
    Path("there/ur5.json").write_text(json.dumps(truth))
    assert projservo(*moved).json["steps"][0]["why"] == "outdated"
    wrong = projservo("calibrate", *config, "--init", "there/ur5.json", "-o", "two", "--json")
    assert wrong.code == 0
    assert "was no start" in wrong.json["advice"][-1]
    assert wrong.json["rms_px"] == pytest.approx(good.json["rms_px"], rel=1e-6)
