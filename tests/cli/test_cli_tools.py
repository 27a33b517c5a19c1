"""The commands compare, export, init, schema and doctor; completion; examples in the help."""

import csv
import io
import json
import os
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from projservo_cli.cli import _commands, doctor
from projservo_cli.cli.commands import COMMANDS, allowed
from projservo_cli.cli.options import OPTIONS
from projservo_cli.config import load_config
from projservo_cli.config.schema import json_schema
from projservo_cli.store import load


@pytest.fixture
def run(projservo, stages):
    assert projservo("report", "-c", "tiny.yaml", "-o", "out", "-q").code == 0
    return load("out")


def fields(run):
    """Every array and scalar of the run by the name of its place."""
    for name, result in run.results.items():
        for label, record in result.records.items():
            for field, value in vars(record).items():
                if value is not None:
                    yield (f"{name}/{label}" if label else name), field, value


def test_csv_holds_every_array_and_says_what_it_is(projservo, run, tmp_path):
    answer = projservo("export", "out", "--to", "csv", "--json")
    assert answer.code == 0, answer.err
    folder = tmp_path / "out" / "csv"
    assert {Path(file).parent for file in answer.json["files"]} == {folder}
    about = {
        (row["file"], row["field"]): row
        for row in csv.DictReader(io.StringIO((folder / "fields.csv").read_text()))
    }
    for place, field, value in fields(run):
        file = f"{place.replace('/', '_')}.csv"
        row = about[file, field]
        if not isinstance(value, np.ndarray):
            assert row["value"] == (value if isinstance(value, str) else row["value"])
            continue
        table = list(csv.reader(io.StringIO((folder / file).read_text())))
        again = np.full(value.shape, np.nan)
        for k, heading in enumerate(table[0]):
            label, _, index = heading.rstrip("]").partition("[")
            if label == field:
                place_in = tuple(slice(None) if i == ":" else int(i) for i in index.split(",") if i)
                column = [float(cells[k]) for cells in table[1:] if cells[k] != ""]
                again[place_in] = column if value.ndim else column[0]
        np.testing.assert_array_equal(again, value.astype(float), err_msg=f"{file} {field}")
        assert len(row["dimensions"].split()) == value.ndim
        assert row["unit"]


def test_npz_holds_everything_without_pickle(projservo, run):
    assert projservo("export", "out", "--to", "npz").code == 0
    with np.load("out/run.npz", allow_pickle=False) as archive:
        for place, field, value in fields(run):
            stored = archive[f"{place}/{field}"]
            if isinstance(value, (np.ndarray, str, float, int)):
                np.testing.assert_array_equal(stored, value)
            else:
                assert json.loads(str(stored)) == json.loads(json.dumps(value))


def test_mat_holds_every_array_in_structures(projservo, run):
    assert projservo("export", "out", "--to", "mat").code == 0
    content = loadmat("out/run.mat", simplify_cells=False)
    for place, field, value in fields(run):
        holder = content
        for part in place.split("/"):
            holder = holder[part] if holder is content else holder[part][0, 0]
        stored = holder[field][0, 0]
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(np.ravel(stored), np.ravel(value), err_msg=f"{place} {field}")
        elif isinstance(value, str):
            assert "".join(stored) == value  # an empty text is no array of one


def test_an_export_replaces_nothing_unasked_and_repeats_itself(projservo, run, tmp_path):
    assert projservo("export", "out", "--to", "npz").code == 0
    before = (tmp_path / "out" / "run.npz").read_bytes()
    again = projservo("export", "out/run.h5", "--to", "npz")
    assert again.code == 2
    assert "--force" in again.err
    assert projservo("export", "out", "--to", "npz", "--force").code == 0
    assert (tmp_path / "out" / "run.npz").read_bytes() == before
    assert projservo("export", "out", "--to", "npz", "-o", "there.txt").code == 2
    assert projservo("export", "out", "--to", "npz", "-o", "there.npz").code == 0


REFUSED = {
    "no run": (["export", "--to", "csv"], "needs a run"),
    "no kind": (["export", "out"], "--to csv"),
    "unknown kind": (["export", "out", "--to", "xls"], "--to"),
    "one run to compare": (["compare", "out"], "two runs"),
    "no page": (["compare", "out", "out", "-o", "both"], "both.html"),
    "no such run": (["compare", "out", "nowhere"], "nowhere/run.h5: there is no run file"),
    "no yaml": (["init", "mine.json"], "mine.yaml"),
    "two files": (["init", "a.yaml", "b.yaml"], "takes 1 argument"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line(projservo, run, case):
    arguments, message = REFUSED[case]
    answer = projservo(*arguments)
    assert (answer.code, answer.out) == (2, "")
    assert message in answer.err
    assert answer.err.count("\n") == 1


class Texts(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_data(self, data):
        self.found.append(data.strip())


def test_runs_of_different_settings_are_compared(projservo, stages, tmp_path):
    assert projservo("servo", "-c", "tiny.yaml", "-o", "out", "-q").code == 0
    changed = ["--set", "control.gain_t=1.25"]
    assert projservo("servo", "-c", "tiny.yaml", "-o", "other", *changed, "-q").code == 0
    answer = projservo("compare", "out", "other", "--json")
    assert answer.code == 0, answer.err
    assert answer.json["runs"] == [str(tmp_path / name / "run.h5") for name in ("out", "other")]
    texts = Texts((tmp_path / "compare.html").read_text(encoding="utf-8")).found
    place = texts.index("control.gain_t")
    assert [text for text in texts[place:] if text][1:3] == ["2.5", "1.25"]
    assert {"tiny (out)", "tiny (other)"} <= set(texts)
    assert projservo("compare", "out", "other").code == 2
    assert projservo("compare", "out", "other", "other", "--force").code == 0


def test_init_writes_what_loads_and_its_schema(projservo, stages, tmp_path):
    answer = projservo("init", "mine.yaml", "--json")
    assert answer.json == {
        "configuration": str(tmp_path / "mine.yaml"),
        "schema": str(tmp_path / "projservo.schema.json"),
    }
    first = (tmp_path / "mine.yaml").read_text(encoding="utf-8").splitlines()[0]
    assert first.endswith("$schema=projservo.schema.json")
    assert json.loads((tmp_path / "projservo.schema.json").read_text(encoding="utf-8")) == json_schema()
    assert load_config(tmp_path / "mine.yaml").name == "mine"
    (tmp_path / "mine.yaml").write_text("name: changed")
    assert "--force" in projservo("init", "mine.yaml").err
    assert (tmp_path / "mine.yaml").read_text() == "name: changed"
    assert projservo("init", "mine.yaml", "--force").code == 0
    assert projservo("plan", "-c", "mine.yaml", "-n").code == 0
    assert projservo("init", "-q").code == 0
    assert (tmp_path / "projservo.yaml").is_file()


def test_schema_is_printed_or_written(projservo, stages, tmp_path):
    assert projservo("schema").json == json_schema()
    assert projservo("schema", "-o", "s.json").out == ""
    assert json.loads((tmp_path / "s.json").read_text(encoding="utf-8")) == json_schema()


def test_doctor_tells_versions_extras_kernels_and_results(projservo, stages, tmp_path):
    value = projservo("doctor", "--json").json
    assert value["missing"] == []
    assert value["results"] == {"folder": str(tmp_path / "results"), "writable": True}
    assert set(value["kernels"]) == {"jit", "cache", "compiled"}
    text = projservo("doctor").out
    assert max(map(len, text.splitlines())) <= 80 or str(tmp_path) in text
    for word in ("python", "packages", "kernels", "results"):
        assert word in text


def test_doctor_names_what_is_missing(projservo, stages, monkeypatch):
    needed = ["numpy>=2", "not-there-at-all>=1", "neither; extra == 'other'"]
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda name: needed)
    answer = projservo("doctor")
    assert answer.code == 1
    assert "not-there-at-all MISSING" in answer.out
    assert "extra other: lacks neither: pip install 'projservo[other]'" in answer.out
    assert projservo("doctor", "--json").json["missing"] == ["not-there-at-all"]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example_that_the_command_line_takes(projservo, name):
    example = COMMANDS[name].example
    assert example in " ".join(projservo(name, "--help").out.split())
    program, *words = shlex.split(example)
    assert program == "projservo"
    assert name in words
    opts = {opt: option for option, click_option in OPTIONS.items() for opt in click_option.opts}
    given = {opts[word] for word in words if word.startswith("-")}
    flags = {option for option in given if OPTIONS[option].is_flag}
    plain, skip = [], False
    for word in words:
        if word.startswith("-"):
            skip = opts[word] not in flags
        else:
            plain += [] if skip else [word]
            skip = False
    names, rest = _commands(plain)
    assert given <= allowed(names)
    required = [argument for argument in COMMANDS[name].arguments if argument[0] != "["]
    assert len(rest) >= len(required)


def complete(line):
    """What bash is offered after a line."""
    words = shlex.split(line)
    count = len(words) if line.endswith(" ") else len(words) - 1
    environment = {
        **os.environ,
        "_PROJSERVO_COMPLETE": "bash_complete",
        "COMP_WORDS": line,
        "COMP_CWORD": str(count),
    }
    code = "from projservo_cli.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    return done.stdout.split()


def test_a_shell_completes_commands_stages_laws_and_files():
    assert complete("projservo cal") == ["plain,calibrate"]
    assert complete("projservo calibrate re") == ["plain,report"]
    assert complete("projservo servo --law st") == ["plain,stacked"]
    assert complete("projservo export out --to n") == ["plain,npz"]
    assert complete("projservo show res") == ["file,res"]
    assert complete("projservo plan -c x") == ["file,x"]
