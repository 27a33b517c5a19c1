"""Chaining, what is up to date, what is made first, JSON objects and exit codes."""

import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from tqdm import tqdm

from projservo_cli.chain import progress
from projservo_cli.cli.output import Console
from projservo_cli.report import animation as film
from projservo_cli.report import page
from projservo_cli.stages import report as reporting
from projservo_cli.store.run_file import load

ALL = ["calibrate", "plan", "direct_three", "stacked", "report"]


def test_what_is_lacking_is_made_first_and_said(projservo, stages):
    answer = projservo("servo", "-c", "tiny.yaml", "-o", "out")
    assert answer.code == 0
    assert stages.made == ALL[:4]
    assert answer.err.replace("compiling kernels, once\n", "") == (
        "calibrate, plan: making (none yet, needed by servo)\n"
        "servo/direct_three, servo/stacked: making (none yet)\n"
    )
    assert "direct_three" in answer.out
    assert "calibrate" not in answer.out
    assert max(map(len, (answer.out + answer.err).splitlines())) <= 80


def test_up_to_date_is_skipped_and_prints_the_same(projservo, stages):
    first = projservo("calibrate", "plan", "servo", "report", "-c", "tiny.yaml", "-o", "out", "--json")
    assert stages.made == ALL
    stored = (load("out").path).read_bytes()
    second = projservo("calibrate", "plan", "servo", "report", "-o", "out", "--json")
    assert "calibrate, plan, servo/direct_three, servo/stacked, report: up to date" in second.err
    assert stages.made == ALL
    assert second.json == first.json
    assert load("out").path.read_bytes() == stored


@pytest.mark.parametrize(
    ("change", "remade"),
    [
        ("seed=5", ALL),
        ("task.goal.roll_deg=90", ALL[1:]),
        ("control.gain_t=1", ALL[2:]),
        ("control.laws=[stacked]", ["report"]),
        ("control.mode=[regulate, image_track]", ["stacked_image_track", "report"]),
        ("noise.servo_px=0.1", ALL[1:]),
    ],
)
def test_only_what_depends_on_a_change_is_redone(projservo, reported, change, remade):
    answer = projservo("report", "-o", "out", "--set", change)
    assert answer.code == 0
    assert reported.made == remade


def test_an_override_becomes_part_of_the_stored_configuration(projservo, reported):
    for _ in range(2):
        projservo("report", "-o", "out", "--set", "report.formats=[png]")
    projservo("report", "-o", "out")
    assert reported.made == ["report"]


def test_an_interrupted_chain_goes_on_where_it_stopped(projservo, stages, refused):
    stages.fails["stacked"] = KeyboardInterrupt()
    answer = projservo("servo", "-c", "tiny.yaml", "-o", "out")
    assert (answer.code, answer.err.splitlines()[-1]) == (130, "projservo: interrupted")
    del stages.fails["stacked"]
    stages.made.clear()
    assert projservo("servo", "-o", "out").code == 0
    assert stages.made == ["stacked"]


def test_force_makes_the_named_stages_anew_and_drops_what_hung_on_them(projservo, reported):
    answer = projservo("plan", "-o", "out", "--force")
    assert reported.made == ["plan"]
    assert "servo/direct_three, servo/stacked, report: dropped" in " ".join(answer.err.split())
    assert list(load("out").results) == ["calibrate", "plan"]
    projservo("servo", "-o", "out", "--force")
    assert reported.made == ["plan", "direct_three", "stacked"]


def test_laws_are_those_asked_for_in_their_order_and_others_stay(projservo, reported):
    laws = ["--law", "blockwise", "--law", "direct_three", "--law", "blockwise"]
    answer = projservo(*laws, "servo", "-o", "out", "--json")
    assert [trace["law"] for trace in answer.json["laws"]] == ["blockwise", "direct_three"]
    assert reported.made == ["blockwise"]
    assert list(load("out").traces) == ["direct_three", "stacked", "blockwise"]
    reported.made.clear()
    projservo("servo", "-o", "out", "--law", "blockwise", "--set", "control.gain=1")
    assert reported.made == ["blockwise"]
    assert list(load("out").traces) == ["direct_three", "stacked", "blockwise"]


def test_json_objects_have_names_for_numbers_and_null_for_none(projservo, stages, tmp_path):
    """That they have the documented keys is tested with the page on commands."""
    value = projservo("servo", "plan", "calibrate", "-c", "tiny.yaml", "-o", "out", "--json").json
    assert all(part["run"] == str(tmp_path / "out/run.h5") for part in value.values())
    calibrate = value["calibrate"]
    assert (calibrate["usable"], calibrate["advice"], calibrate["poses_used"]) == (True, ["more"], 3)
    assert calibrate["chi2_per_dof"] is None  # not a number
    assert calibrate["outliers"] == [
        {"pose": 3, "marker": 1, "view": "left"},
        {"pose": 4, "marker": 2, "view": "both"},
    ]
    assert calibrate["suspect_joint_readings"] == []
    assert (calibrate["rejected"]["observations"], calibrate["rejected"]["poses"]) == (2, [])
    names = [(joint["name"], joint["type"]) for joint in calibrate["joints"]]
    assert names == [("q1", "R"), ("elbow", "R")]
    assert value["servo"]["laws"][0]["position_error_mm"] is None


def test_what_fails_is_an_object_with_exit_code_1(projservo, stages, refused):
    stages.fails["stacked"] = refused
    answer = projservo("plan", "servo", "-c", "tiny.yaml", "-o", "out", "--json")
    assert answer.code == 1
    assert answer.json["plan"]["feasible"] is True  # what was done is kept
    assert [trace["law"] for trace in answer.json["servo"]["laws"]] == ["direct_three"]
    assert answer.json["servo"]["failed"] == "servo/stacked"
    stages.fails["calibrate"] = refused
    chain = projservo("calibrate", "plan", "servo", "-c", "tiny.yaml", "-o", "new", "--json")
    assert chain.code == 1
    assert (chain.json["calibrate"]["usable"], chain.json["calibrate"]["reason"]) == (False, str(refused))
    assert chain.json["servo"]["laws"] == []
    assert chain.json["servo"]["failed"] == "calibrate"
    assert chain.err.splitlines()[-1] == f"projservo: calibrate: {refused}"


def test_a_law_that_must_converge_decides_the_exit_code(projservo, stages):
    stages.verdicts = {"stacked": "diverged"}
    assert projservo("servo", "-c", "tiny.yaml", "-o", "out").code == 0
    stages.verdicts = {"direct_three": "no progress"}
    answer = projservo("servo", "-o", "out", "--law", "direct_three", "--force", "--json")
    assert answer.code == 1
    assert "direct_three must converge, but ended in no progress" in answer.err
    assert answer.json["laws"][0]["verdict"] == "no progress"
    assert projservo("servo", "report", "-o", "out").code == 1  # up to date, and still not converged


OWN = "tests.cli.conftest:Law"


@pytest.mark.parametrize(
    ("law", "settings", "code"),
    [
        ("exact", (), 1),
        ("exact", ("control.mode=track",), 1),
        (OWN, (), 1),
        ("stacked", (), 0),
        (OWN, ("control.must_converge=[]",), 0),
        ("stacked", ("control.must_converge=[stacked]",), 1),
    ],
)
def test_a_named_law_must_converge_unless_it_is_classical_or_the_configuration_says_so(
    projservo, reported, law, settings, code
):
    reported.verdicts = dict.fromkeys((law, f"{law}_track"), "no progress")
    sets = [word for one in settings for word in ("--set", one)]
    flags = ("--law", law) if settings else ("--set", f"control.laws=['{law}']")
    answer = projservo("servo", "-o", "out", "--force", *flags, *sets)
    assert (answer.code, answer.err.count("ended in no progress: text ä\n")) == (code, 1)
    assert (" must converge, but ended" in answer.err) == bool(code)


def test_each_run_that_did_not_converge_or_missed_periods_has_a_line_with_its_reason(
    projservo, stages, monkeypatch
):
    stages.verdicts = {"stacked": "diverged"}
    drive, missed = stages.servo, {"direct_three": 7}
    monkeypatch.setattr(
        stages, "servo", lambda *given: replace(drive(*given), overruns=missed.get(given[-1], 0))
    )
    answer = projservo("servo", "-c", "tiny.yaml", "-o", "out")
    assert answer.code == 0
    first, second = answer.err.splitlines()[-2:]
    assert first.startswith(
        "projservo: direct_three converged: text ä; 7 of 3 periods took longer than 1.5 s:"
    )
    assert second == "projservo: stacked ended in diverged: text ä"
    assert projservo("servo", "-o", "out", "-q").err == ""
    # Also where a later law fails, and of that law once.
    stages.verdicts["direct_two"] = "failed"
    answer = projservo("servo", "-o", "out", "--law", "stacked", "--law", "direct_two")
    assert answer.code == 1
    said = [line for line in answer.err.splitlines() if line.startswith("projservo:")]
    assert said == [second, "projservo: servo/direct_two: text ä"]


def test_a_dry_run_does_nothing_and_says_what_would_be_done(projservo, stages, tmp_path):
    answer = projservo("servo", "-c", "tiny.yaml", "-o", "out", "-n")
    assert answer.code == 0
    assert "servo/stacked: would be made (none yet)" in answer.out
    assert stages.made == []
    assert not (tmp_path / "out").exists()
    # By default of the shipped benchmark, in results.
    assert projservo("servo", "-n", "--json").json["run"] == str(tmp_path / "results/paper/run.h5")
    projservo("servo", "-c", "tiny.yaml", "-o", "out")
    answer = projservo("servo", "-o", "out", "-n", "--json", "--set", "control.gain=1")
    whys = {(step["stage"], step["law"]): step["why"] for step in answer.json["steps"]}
    assert whys["calibrate", None] is None
    assert whys["servo", "stacked"] == "outdated"
    assert "gain: 1" not in load("out").configuration


def test_a_failure_of_the_program_itself_is_one_line_and_verbose_shows_where(projservo, stages):
    stages.fails["plan"] = ZeroDivisionError("by\nzero")
    answer = projservo("plan", "-c", "tiny.yaml", "-o", "out")
    assert answer.code == 1
    assert answer.err.splitlines()[-1].startswith("projservo: internal error, ZeroDivisionError: by zero")
    assert "Traceback" in projservo("plan", "-o", "out", "-v").err


def test_progress_is_a_bar_to_someone_who_watches_and_else_a_line_a_minute(capsys, monkeypatch):
    monkeypatch.setattr(progress.time, "monotonic", iter([0.0, 30.0, 61.0, 100.0, 200.0]).__next__)
    with Console() as console:
        for done in range(5):
            console.progress("work", done, 4)
    assert capsys.readouterr().err == "work: 2 of 4\n"  # once a minute, and not at the end
    monkeypatch.undo()
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "TICK_S", 0.01)
    with Console(quiet=True) as console:
        console.progress("work", 1, 2)
    assert capsys.readouterr().err == ""
    with Console() as console:
        console.progress("other", 1, 3)
        console.progress("work", 0, 4)
        (bar,) = tqdm._instances
        bar.start_t -= 30.0  # as if it had begun half a minute ago
        console.progress("work", 1, 4)
        console.say("a word between")
        time.sleep(0.1)
        shown = capsys.readouterr().err
    assert "other" in shown
    assert "00:30<01:30" in shown  # a quarter is done
    assert "a word between\n" in shown
    assert shown.count("1/4") > 2
    capsys.readouterr()
    time.sleep(0.05)
    assert capsys.readouterr().err == ""


def test_a_view_and_an_animation_are_made_beside_a_report_that_is_up_to_date(
    projservo, reported, monkeypatch
):
    made = []

    def make(name):
        def write(shown, run, progress):
            made.append((name, list(run.traces)))
            return run.path.parent / name

        return write

    monkeypatch.setattr(film, "plotly", lambda: None)
    monkeypatch.setattr(reporting, "view", make("view.html"))
    monkeypatch.setattr(reporting, "animation", make("animation.gif"))
    monkeypatch.setattr(page, "write_page", lambda run, about: made.append(("page", sorted(run.results))))
    answer = projservo("report", "-o", "out", "--animation", "--view", "--json")
    assert answer.code == 0
    laws = ["direct_three", "stacked"]
    results = ["calibrate", "plan", "report", *(f"servo/{law}" for law in laws)]
    assert made == [("view.html", laws), ("animation.gif", laws), ("page", results)]
    assert answer.json["view"].endswith("/view.html")
    assert answer.json["animation"].endswith("/animation.gif")
    assert "view: " in projservo("report", "-o", "out", "--view").out
    assert reported.made == []


def test_a_refit_begins_at_the_stored_calibration_and_is_up_to_date_in_the_new_run(projservo, reported):
    before, asked = load("out").path.read_bytes(), ("--refit", "left", "--data", "t.csv", "-o", "new")
    for _ in range(2):
        assert projservo("calibrate", "out", *asked).code == 0
        assert reported.made == ["refit of left"]
    assert projservo("calibrate", "new", "--refit", "right", "--data", "t.csv", "-o", "newer").code == 0
    assert projservo("calibrate", "-o", "newer").code == 0
    assert reported.made == ["refit of left", "refit of right"]
    assert load("out").path.read_bytes() == before


def test_a_call_that_names_no_configuration_says_which_it_takes(projservo, stages):
    said = "configuration: paper.yaml, as shipped; projservo init writes yours (-c FILE)\n"
    assert projservo("plan", "-o", "out").err.count(said) == 1
    for named in (("-o", "out"), ("-c", "tiny.yaml", "-o", "own"), ("-o", "other", "-q")):
        assert said not in projservo("plan", *named).err


def test_a_refit_is_part_of_its_run_whatever_the_configuration_file_says(projservo, stages):
    recorded, table = ("-c", "tiny.yaml", "-o", "out"), Path("out/trials.csv")
    assert projservo("record", "calibrate", *recorded, "-q").code == 0
    asked = ("--refit", "left", "--data", "t.csv", "-o", "new", "-q")
    assert projservo("calibrate", "out", *asked).code == 0
    for named in (("--data", table), ()):  # a configuration that names its table, and one that does not
        answer = projservo("calibrate", "servo", "-c", "tiny.yaml", *named, "-o", "new", "--json")
        assert answer.code == 0, answer.err
        assert answer.json["calibrate"]["refits"][0]["view"] == "left"
        assert "up to date, though the configuration names no calibration.refits" in answer.err
    assert stages.made[:2] == ["calibrate", "refit of left"]
    assert stages.made.count("calibrate") == 1
    table.write_text(table.read_text() + "\n")  # recorded since, with the camera where it is now
    assert projservo("calibrate", "-c", "tiny.yaml", "--data", table, "-o", "new", "-q").code == 0
    assert load("new").calibration.refit == ()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("out", "--refit", "left", "-o", "new"), "--refit left: takes --data TABLE"),
        (("out", "--refit", "left", "--data", "t.csv", "-o", "out"), "-o out is the run itself"),
        (
            ("out", "--refit", "top", "--data", "t.csv", "-o", "new"),
            "--refit top: the cameras are left, right",
        ),
        (("out", "--refit", "left", "--data", "t.csv", "-o", "new", "--lens"), "--lens and --refit left: "),
        (("--refit", "left", "--data", "t.csv"), "calibrate RUN --refit NAME --data TABLE -o NEW"),
        (("out", "--data", "t.csv"), "calibrate RUN --refit NAME --data TABLE -o NEW"),
        (("t.csv",), "t.csv: a table is given as --data t.csv"),
    ],
)
def test_a_refit_that_is_not_clear_is_refused_in_a_line(projservo, reported, words, said):
    answer = projservo("calibrate", *words)
    assert (answer.code, answer.err.count("\n"), reported.made) == (2, 1, [])
    assert said in answer.err
