"""Folders, names and texts of strangers: nothing leads out of the output folder or commands the terminal."""

import json
from dataclasses import replace

import pytest

from projservo_cli.store.files_and_locks import working_in
from projservo_cli.store.run_file import load, save

ESCAPES = "\x1b[2J\x07\x9b31m\u202egnp.exe\u2028</script><img src=x onerror=alert(1)>"


@pytest.fixture
def hostile(reported):
    """A run whose texts are meant for a terminal."""
    run = load("out")
    plan = run.results["plan"]
    records = {"": replace(plan.records[""], reason=ESCAPES, profile=ESCAPES)}
    provenance = {**plan.provenance, "host": ESCAPES, "argv": ["x", ESCAPES]}
    made = {"calibrate": run.results["calibrate"]}
    save(replace(run, results={**made, "plan": replace(plan, records=records, provenance=provenance)}))


def plain(text):
    return all(character.isprintable() or character in "\n\u202f" for character in text)


@pytest.mark.usefixtures("hostile")
def test_texts_of_a_run_command_no_terminal(projservo):
    """Nor a browser, as is tested with the page."""
    for more in ([], ["-v"], ["--json"]):
        answer = projservo("show", "out", *more)
        assert answer.code == 0
        assert plain(answer.out + answer.err), [c for c in answer.out if not c.isprintable()]
    assert answer.json["plan"]["reason"] == ESCAPES


@pytest.mark.parametrize("name", ["../out", "/tmp/out", ".", "a\\b", "", "x\n"])
def test_a_name_is_that_of_one_folder(projservo, stages, tmp_path, name):
    before = sorted(tmp_path.rglob("*"))
    answer = projservo("calibrate", "-c", "tiny.yaml", "--set", f"name={json.dumps(name)}")
    assert answer.code == 2
    assert "name" in answer.err
    assert stages.made == []
    assert sorted(tmp_path.rglob("*")) == before


def test_a_result_folder_that_a_link_takes_elsewhere_is_refused(projservo, stages, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "tiny").symlink_to(tmp_path / "elsewhere")
    answer = projservo("calibrate", "-c", "tiny.yaml")
    assert answer.code == 2
    assert "symbolic link" in answer.err
    assert list((tmp_path / "elsewhere").iterdir()) == []
    assert projservo("calibrate", "-c", "tiny.yaml", "-o", "results/tiny").code == 0  # asked for by its name


def test_a_run_file_that_is_a_link_is_replaced_not_written_through(projservo, reported, tmp_path):
    (tmp_path / "out").rename(tmp_path / "other")
    theirs = (tmp_path / "other" / "run.h5").read_bytes()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.h5").symlink_to(tmp_path / "other" / "run.h5")
    assert projservo("plan", "--set", "seed=2", "-o", "out").code == 0
    assert (tmp_path / "other" / "run.h5").read_bytes() == theirs
    assert not (tmp_path / "out" / "run.h5").is_symlink()
    assert "seed: 2" in load("out").configuration


def test_a_second_process_is_refused_and_nothing_is_lost(projservo, stages, tmp_path):
    given = ("-c", "tiny.yaml", "-o", "out")
    with working_in(tmp_path / "out"):
        for words in (["calibrate"], ["report"], ["plan", "--force"]):
            answer = projservo(*words, *given)
            assert answer.code == 2
            assert "is at work there" in answer.err
        assert stages.made == []
        assert projservo("calibrate", "-n", *given).code == 0  # reads only
    assert projservo("calibrate", *given).code == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["run.h5"]
    with working_in(tmp_path / "out"):
        assert projservo("calibrate", *given).code == 0  # up to date
    # What a killed process left goes also where nothing is to be done.
    (tmp_path / "out" / ".lock").write_text("1\n", encoding="ascii")
    assert projservo("calibrate", *given).code == 0
    assert stages.made == ["calibrate"]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["run.h5"]


def test_what_another_process_made_meanwhile_is_kept(projservo, stages, tmp_path, monkeypatch):
    """Between reading the run and having the folder for itself, another process made the plan."""
    projservo("calibrate", "-c", "tiny.yaml", "-o", "out")
    from projservo_cli.store import files_and_locks as lock

    waiting = lock.working_in

    def meanwhile(*arguments):
        monkeypatch.setattr(lock, "working_in", waiting)
        projservo("servo", "--law", "stacked", "-c", "tiny.yaml", "-o", "out")
        return waiting(*arguments)

    monkeypatch.setattr(lock, "working_in", meanwhile)
    projservo("servo", "--law", "direct_three", "-c", "tiny.yaml", "-o", "out")
    assert stages.made == ["calibrate", "plan", "stacked", "direct_three"]
    assert list(load("out").traces) == ["stacked", "direct_three"]
