"""Input that cannot be read or makes no sense: exit code 2, nothing on standard output, clear lines."""

import pytest


def refuse(answer, message):
    assert answer.code == 2
    assert answer.out == ""
    assert message in answer.err
    assert all(line.startswith("projservo: ") for line in answer.err.splitlines())


def test_bad_configurations_and_tables(projservo, stages, tmp_path):
    """What else is refused in them is tested where they are read."""
    (tmp_path / "c.yaml").write_text("seed: 1\nseed: 2\n", encoding="utf-8")
    refuse(projservo("calibrate", "-c", "c.yaml", "--json"), "projservo: c.yaml:2:1: seed: the key")
    (tmp_path / "bad.csv").write_text("pose,marker,q1,u_left,v_left,u_right,v_right\n1,0,1,2\n")
    answer = projservo("calibrate", "--data", "bad.csv", "-o", "out", "--json", "-q")
    refuse(answer, f"{tmp_path / 'bad.csv'}:2: 4 cells")
    assert not (tmp_path / "out").exists()


RECORDED, SIMULATED = ["--data", "t.csv"], ["-c", "tiny.yaml"]
OPTIONS = {
    "no such configuration": (["-c", "none.yaml"], "none.yaml: cannot be read"),
    "no such table": (["--data", "none.csv"], "none.csv: cannot be read"),
    "joints of other letters": ([*RECORDED, "--joints", "RX"], "--joints RX: data.joints: 'RX' must be"),
    "no noise at all": (
        [*RECORDED, "--noise-px", "0"],
        "--noise-px 0.0: data.noise_px: must be greater than 0",
    ),
    "joints without a table": ([*SIMULATED, "--joints", "RR"], "--joints RR: data.table: is missing"),
    "override of nothing": ([*SIMULATED, "--set", "sed=1"], "--set sed=1: sed: unknown key; did you mean"),
    "a file for a folder": ([*SIMULATED, "-o", "t.csv/out"], "t.csv/out"),
    "a table for a run": ([*SIMULATED, "-o", "t.csv"], "not a run file"),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_bad_options(projservo, stages, case):
    options, message = OPTIONS[case]
    refuse(projservo("calibrate", "-q", *options), message)


def test_several_errors_are_several_lines(projservo, stages):
    answer = projservo("calibrate", "-c", "tiny.yaml", "--set", "seed=-1", "--set", "noise.calibration_px=a")
    refuse(answer, "projservo: --set seed=-1: seed: must be at least 0")
    assert answer.err.count("\n") == 2


def test_runs_that_are_none(projservo, reported, tmp_path):
    whole = (tmp_path / "out/run.h5").read_bytes()
    (tmp_path / "out/run.h5").write_bytes(whole[: len(whole) // 2])
    for words in (["show"], ["validate", "--data", "t.csv"]):
        refuse(projservo(*words, "nowhere"), "there is no run file")
        refuse(projservo(*words, "out"), "cut short")
    refuse(projservo("calibrate", "-c", "tiny.yaml", "-o", "out"), "cut short")


def test_an_output_that_cannot_be_written_is_refused_before_the_work(projservo, stages, tmp_path):
    """The folder of the run is to be made inside a file."""
    (tmp_path / "file").write_text("", encoding="utf-8")
    answer = projservo("calibrate", "-o", "file/out", "--json")
    refuse(answer, "is no folder; choose another")
    assert "making it" not in answer.err
