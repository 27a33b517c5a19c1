"""Record as the first stage of a chain: where the table goes, what is up to date, what is never replaced."""

from pathlib import Path

from projservo_cli.store.run_file import load

CHAIN = ("record", "calibrate", "plan", "-c", "tiny.yaml", "-o", "out")
TABLE = Path("out/trials.csv")


def test_the_table_lies_beside_the_run_and_calibrate_finds_it_alone_later(projservo, stages):
    answer = projservo("calibrate", "-o", "out", "plan", "--json", "record", "-c", "tiny.yaml")
    assert answer.code == 0, answer.err
    assert list(answer.json) == ["record", "calibrate", "plan"]
    told = answer.json["record"]
    assert (told["run"], told["table"]) == (str(Path("out/run.h5").resolve()), str(TABLE.resolve()))
    assert (told["recorded"], told["found"], told["pending"]) == (17, 0, 0)
    assert (stages.made, answer.json["calibrate"]["source"]) == (["calibrate", "plan"], "recorded")
    assert load("out").results["calibrate"].inputs["table"] == str(TABLE.resolve())
    again = projservo(*CHAIN, "--json")
    assert (again.json["record"]["recorded"], again.json["record"]["found"]) == (0, 17)
    assert "record, calibrate, plan: up to date" in again.err
    for found in (("calibrate", "-o", "out"), ("plan", "-c", "tiny.yaml", "-o", "out")):
        assert projservo(*found).code == 0
    assert stages.made == ["calibrate", "plan"]


def test_an_outdated_recording_is_made_anew_and_what_rests_on_it(projservo, stages):
    assert projservo(*CHAIN, "-q").code == 0
    before = TABLE.read_bytes()
    dry = projservo(*CHAIN, "--set", "seed=1", "--dry-run", "--json").json["steps"]
    assert [(step["stage"], step["why"]) for step in dry] == [
        (name, "outdated") for name in ("record", "calibrate", "plan")
    ]
    assert TABLE.read_bytes() == before
    answer = projservo(*CHAIN, "--set", "seed=1")
    assert "record: making (outdated)\n" in answer.err
    assert TABLE.read_bytes() != before
    assert stages.made == ["calibrate", "plan"] * 2
    assert projservo(*CHAIN, "--set", "seed=1", "--force").code == 0
    assert stages.made == ["calibrate", "plan"] * 3


def test_what_somebody_recorded_is_not_replaced(projservo, stages):
    own = Path("t.csv").read_bytes()
    answer = projservo(*CHAIN, "--data", "t.csv")
    assert (answer.code, Path("t.csv").read_bytes()) == (2, own)
    assert "t.csv: was not recorded with this configuration" in answer.err
    assert projservo("calibrate", "-c", "tiny.yaml", "--data", "t.csv", "-o", "out", "-q").code == 0
    answer = projservo(*CHAIN)
    assert (answer.code, TABLE.exists()) == (2, False)
    assert "its calibration comes from" in answer.err
    assert "--force" in answer.err
    assert projservo(*CHAIN, "--force", "-q").code == 0
    TABLE.write_text(TABLE.read_text().replace("simulated ", "lab:Arm "))
    answer = projservo(*CHAIN, "--set", "seed=1")
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert "lab:Arm" in TABLE.read_text()
