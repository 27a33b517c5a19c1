"""Words and options in every order, help, version, and what is refused as usage."""

import itertools
import subprocess
import sys

import pytest

from projservo_cli import __version__
from projservo_cli.cli import main
from projservo_cli.cli.commands import COMMANDS

PIECES = [("servo",), ("plan",), ("-c", "tiny.yaml"), ("-o", "out"), ("--json",)]


@pytest.mark.parametrize(
    "pieces", list(itertools.permutations(PIECES)), ids=lambda pieces: " ".join(itertools.chain(*pieces))
)
def test_options_stand_anywhere_in_a_chain(projservo, stages, pieces):
    answer = projservo(*itertools.chain(*pieces), "--law", "stacked", "-n")
    assert answer.code == 0
    assert [step["stage"] for step in answer.json["steps"]] == ["calibrate", "plan", "servo"]
    assert answer.json["run"].endswith("/out/run.h5")
    assert stages.made == []


@pytest.mark.parametrize("order", list(itertools.permutations(["out", "--data=t.csv", "--json"])))
@pytest.mark.parametrize("first", [0, 1, 2, 3])
def test_options_stand_anywhere_around_arguments(projservo, stages, monkeypatch, order, first):
    import projservo_cli.calibration

    monkeypatch.setattr(
        projservo_cli.calibration,
        "residual_statistics",
        lambda calibration, observation: {"count": len(observation.pose), "median_px": 0.1, "skipped": {}},
        raising=False,
    )
    assert projservo("calibrate", "-c", "tiny.yaml", "-o", "out", "-q").code == 0
    words = list(order)
    words.insert(min(first, words.index("out")), "validate")
    answer = projservo(*words)
    assert answer.code == 0, answer.err
    assert answer.json["count"] == 2


def test_stages_run_in_their_order_each_once(projservo, stages):
    answer = projservo("servo", "calibrate", "servo", "plan", "-c", "tiny.yaml", "--json")
    assert list(answer.json) == ["calibrate", "plan", "servo"]
    assert stages.made == ["calibrate", "plan", "direct_three", "stacked"]


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_every_command_has_help_within_80_columns(projservo, name, flag):
    for words in ([name, flag], [flag, name]):
        answer = projservo(*words)
        assert answer.code == 0
        assert answer.out.startswith(f"Usage: projservo {name}")
        assert "-h, --help" in answer.out
        assert ("--law" in answer.out) == (name == "servo")
        assert max(map(len, answer.out.splitlines())) <= 80


def test_help_names_all_commands_and_version_is_printed(projservo):
    text = projservo("--help").out
    assert all(f"  {name} " in text for name in COMMANDS)
    assert projservo().out == text
    assert projservo("--version").out == f"projservo {__version__}\n"


def test_help_imports_neither_numbers_nor_files():
    code = (
        "import sys; from projservo_cli.cli import run; run(['--help']); run(['servo', '-h'])\n"
        "heavy = {'numpy', 'scipy', 'numba', 'pydantic', 'yaml', 'h5py', 'matplotlib', 'tqdm'}\n"
        "sys.exit(' '.join(sorted(heavy & set(sys.modules))) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_command_is_one_of_click(capsys):
    with pytest.raises(SystemExit) as left:
        main(["calibrat"])
    assert left.value.code == 2
    assert "did you mean calibrate?" in capsys.readouterr().err


USAGE = {
    "unknown command": (["calibrat"], "did you mean calibrate?"),
    "unknown option": (["calibrate", "--nose-px", "1"], "--nose-px"),
    "option without value": (["calibrate", "-c"], "-c"),
    "only options": (["--json"], "no command"),
    "law of a stage without laws": (["calibrate", "--law", "stacked"], "--law: not used by calibrate"),
    "force of show": (["show", "--force"], "--force: not used by show"),
    "noise of validate": (["validate", "x", "--noise-px", "1"], "--noise-px: not used by validate"),
    "data of equations": (["equations", "--data", "t.csv"], "--data: not used by equations"),
    "unknown law": (["servo", "--law", "direct_four"], "laws: direct_three, direct_two, stacked"),
    "stage and other": (["calibrate", "validate"], "validate stands alone"),
    "other and stage": (["equations", "calibrate"], "takes no argument"),
    "two runs to show": (["show", "a", "b"], "takes 1 argument"),
    "run twice": (["show", "a", "-o", "b"], "one run"),
    "validate without run": (["validate", "--data", "t.csv"], "needs a run"),
    "validate without data": (["validate", "out"], "--data TABLE"),
    "threads": (["servo", "-j", "0"], "-j"),
    "unit": (["calibrate", "--data", "t.csv", "--joint-unit", "grad"], "--joint-unit"),
    "image size without height": (["calibrate", "--data", "t.csv", "--image-size", "1280"], "1280x1024"),
    "lens of show": (["show", "--lens"], "--lens: not used by show"),
    "record without table": (["record", "-c", "tiny.yaml"], "--output TABLE"),
    "unit of no motions": (["record", "-o", "u.csv", "--joint-unit", "deg"], "--motions"),
    "motions of calibrate": (["calibrate", "--motions", "m.csv"], "--motions: not used by calibrate"),
    "one folder of images": (["detect", "left", "-o", "u.csv"], "two folders"),
    "three folders of images": (["detect", "a", "b", "c"], "takes 2 arguments"),
    "images without joints": (["detect", "a", "b", "-o", "u.csv"], "--joints-csv CSV"),
    "images without table": (["detect", "a", "b", "--joints-csv", "q.csv"], "--output TABLE"),
    "unknown points": (["detect", "a", "b", "--points", "edges"], "--points"),
}


@pytest.mark.parametrize("case", USAGE)
def test_usage_is_refused_in_one_line(projservo, stages, case):
    arguments, message = USAGE[case]
    answer = projservo(*arguments)
    assert answer.code == 2
    assert answer.out == ""
    assert message in answer.err
    assert answer.err.startswith("projservo: ")
    assert answer.err.count("\n") == 1
