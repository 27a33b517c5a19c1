"""Words and options in every order, help, version, and what is refused as usage."""

import itertools
import shlex
import subprocess
import sys
from types import SimpleNamespace

import pytest

from projservo_cli import cli
from projservo_cli.cli import main

PIECES = [("servo",), ("plan",), ("-c", "tiny.yaml", "-o", "out"), ("--json",)]


def test_options_stand_anywhere_in_a_chain(projservo, stages):
    for pieces in itertools.permutations(PIECES):
        answer = projservo(*itertools.chain(*pieces), "--law", "stacked", "-n")
        assert answer.code == 0, pieces
        assert [step["stage"] for step in answer.json["steps"]] == ["calibrate", "plan", "servo"]
        assert answer.json["run"].endswith("/out/run.h5")
    assert stages.made == []


@pytest.mark.parametrize("name", main.commands)
def test_help_has_an_example_that_the_command_line_takes(projservo, monkeypatch, name):
    answer = projservo(name, "--help")
    assert answer == projservo("-h", name)
    assert answer.code == 0
    assert answer.out.startswith(f"Usage: projservo {name}")
    assert ("--law" in answer.out) == (name == "servo")
    assert max(map(len, answer.out.splitlines())) <= 80
    told = " ".join(answer.out.partition("Example: ")[2].split())
    program, *words = shlex.split(told)
    assert program == "projservo"
    assert name in words
    # What it says is taken, up to files that are not here, by one who sits at a terminal.
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    with main.make_context("projservo", words) as context:
        assert name in context.obj
        _, command, rest = main.resolve_command(context, [*context.obj[:1], *context.args])
        command.make_context(name, rest, parent=context)


HEAVY = {"numpy", "scipy", "numba", "pydantic", "yaml", "h5py", "matplotlib", "tqdm"}


IMPORTS = [
    ("import projservo_cli; projservo_cli.__all__, projservo_cli.__version__", HEAVY | {"click"}),
    ("from projservo_cli.cli import run; run(['--help']); run(['servo', '-h'])", HEAVY),
    # A second of import; quantiles come from scipy.special.
    ("from projservo_cli.stages import calibrate, plan, servo, report", {"scipy.stats"}),
]


def test_what_takes_long_to_import_is_not_imported_for_help_or_without_need():
    code = "\n".join(f"{code}; assert not {absent} & set(sys.modules)" for code, absent in IMPORTS)
    command = [sys.executable, "-c", f"import sys\n{code}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def complete(line, monkeypatch, capsys):
    """What bash is offered after a line."""
    words = shlex.split(line)
    count = len(words) if line.endswith(" ") else len(words) - 1
    monkeypatch.setenv("_PROJSERVO_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(count))
    with pytest.raises(SystemExit):
        main()
    return capsys.readouterr().out.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("projservo cal", ["plain,calibrate"]),
        ("projservo calibrate re", ["plain,record", "plain,report"]),
        ("projservo -q calibrate plan -o x s", ["plain,servo"]),
        ("projservo servo --law st", ["plain,stacked"]),
        ("projservo validate --dat", ["plain,--data"]),
        ("projservo show res", ["file,res"]),
        ("projservo plan -c x", ["file,x"]),
        ("projservo nonsense x", []),
    ],
)
def test_a_shell_completes_commands_stages_laws_and_files(line, offered, monkeypatch, capsys):
    assert complete(line, monkeypatch, capsys) == offered


RECORDED, TINY = ["calibrate", "--data", "t.csv"], ["calibrate", "-c", "tiny.yaml"]
USAGE = {
    "unknown command": (["calibrat"], "did you mean calibrate?"),
    "only options": (["--json"], "no command"),
    "configuration alone": (["servo", "a.yaml"], "a.yaml: a configuration is given as -c a.yaml\n"),
    "law of a stage without laws": (
        ["calibrate", "--law", "stacked"],
        "--law: not used by calibrate; --law is of servo\n",
    ),
    "unknown law": (["servo", "--law", "mine"], "no such law; laws: direct_three, direct_two, stacked"),
    "misspelt law": (["servo", "--law", "exat"], "--law exat: no such law; did you mean exact? laws: "),
    "law with its mode": (
        ["servo", "--law", "exact_track"],
        "--law exact_track: is the run of exact in mode track: name exact, with --set control.mode=[track]",
    ),
    "key of a law with its mode": (
        ["servo", "-c", "tiny.yaml", "--set", "control.laws=[stacked_image_track]"],
        "control.laws.0: is the run of stacked in mode image_track: name stacked, with --set control.mode",
    ),
    "stage and other": (["calibrate", "validate"], "validate runs alone"),
    "other and stage": (["equations", "calibrate"], "unexpected extra argument (calibrate)"),
    "run twice": (["show", "a", "-o", "b"], "one run"),
    "validate without run": (["validate", "--data", "t.csv"], "needs a run"),
    "validate without data": (["validate", "out"], "--data TABLE"),
    "validate with both": (
        ["validate", "out", "--data", "t.csv", "--metric", "t.csv"],
        "--data and --metric: validate takes one of them",
    ),
    "fit of no positions": (["validate", "out", "--fit", "t.csv"], "are for --metric, which is not given"),
    "image size without height": (
        ["calibrate", "--data", "t.csv", "--image-size", "1280"],
        "--image-size 1280: expected width x height in px, such as 1280x1024",
    ),
    "image sizes of some names": (
        ["calibrate", "--data", "t.csv", "--image-size", "a=1x1,2x2"],
        "--image-size a=1x1,2x2: expected width x height in px",
    ),
    "image sizes of one name": (
        ["calibrate", "--data", "t.csv", "--image-size", "a=1x1,a=2x2"],
        "--image-size a=1x1,a=2x2: expected width x height in px",
    ),
    "image sizes of one camera": (
        ["calibrate", "--data", "t.csv", "--image-size", "a=1x1,A=2x2"],
        "names a view twice among a, A",
    ),
    "lens of show": (["show", "--lens"], "--lens: not used by show; --lens is of calibrate, plan, "),
    "former name of an option of detect": (
        ["show", "--joints-csv", "q.csv"],
        "No such option '--joints-csv'",
    ),
    "record without table": (["record", "-c", "tiny.yaml"], "-o TABLE, or data.table"),
    "unit of no motions": (["record", "-o", "u.csv", "--joint-unit", "deg"], "--motions"),
    "images without joints": (["detect", "a", "b", "-o", "u.csv"], "'--readings'"),
    "one run to compare": (["compare", "out"], "two runs"),
    "no page": (["compare", "out", "out", "-o", "both"], "both.html"),
    "no such run": (["compare", "out", "nowhere"], "out/run.h5: there is no run file"),
    "no yaml": (["init", "mine.json"], "mine.yaml"),
    "confirmed by nobody": (["servo", "--confirm"], "no terminal"),
    "no poses": (["calibrate", "--suggest", "0"], "--suggest"),
    "no configuration": (
        ["plan", "-c", "none.yaml"],
        "expected a configuration (YAML), which projservo init writes\n",
    ),
    "no table": ([*RECORDED[:2], "none.csv"], "which projservo record calibrate makes"),
    "other letters": ([*RECORDED, "--joints", "RX"], "--joints RX: data.joints: 'RX' must be"),
    "no noise at all": ([*RECORDED, "--noise-px", "0"], "--noise-px 0.0: data.noise_px: must be"),
    "joints of no table": ([*TINY, "--joints", "RR"], "--joints RR: data.table: is missing"),
    "override of nothing": ([*TINY, "--set", "sed=1"], "--set sed=1: sed: unknown key; did you mean"),
    "a file for a folder": ([*TINY, "-o", "t.csv/out"], "t.csv/out"),
    "a folder below a file": (["calibrate", "-o", "t.csv/out"], "cannot be written: Not a directory"),
    "a table for a run": ([*TINY, "-o", "t.csv"], "not a run file"),
}


@pytest.mark.parametrize("case", USAGE)
def test_what_makes_no_sense_is_refused_in_one_line_before_any_work(projservo, stages, tmp_path, case):
    """What else is refused in configurations and tables is tested where they are read."""
    there = set(tmp_path.iterdir())
    arguments, message = USAGE[case]
    answer = projservo(*arguments)
    assert (answer.code, answer.out) == (2, "")
    assert message in answer.err
    assert answer.err.startswith("projservo: ")
    assert answer.err.count("\n") == 1
    assert (stages.made, set(tmp_path.iterdir())) == ([], there)


EMPTY = {
    "table": (["--data", "none.csv"], "none.csv: the table is empty"),
    "rows": (["--data", "head.csv"], "head.csv: the table has a header but no rows"),
    "joints": (["--data", "one.csv", "--readings", "none.csv"], "none.csv: the table is empty"),
    "rows of joints": (["--data", "one.csv", "--readings", "q.csv"], "q.csv: the table has a header but no"),
    "configuration": (["-c", "none.csv"], "none.csv: the configuration is empty"),
    "sweep for a configuration": (["-c", "sweep.yaml"], "sweep.yaml: configures a sweep and no run"),
    "sweep for a run": (["--data", "head.csv", "-o", "swept"], "swept: holds a sweep and no run"),
    "its table": (["--data", "head.csv", "-o", "swept/sweep.h5"], "swept: holds a sweep and no run"),
}


@pytest.mark.parametrize("name", EMPTY)
def test_a_file_that_is_empty_or_of_a_sweep_is_named_in_a_line(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "swept").mkdir()
    for file, text in {
        "none.csv": "",
        "head.csv": "pose,marker,q1,u_left,v_left,u_right,v_right\n",
        "q.csv": "pose,q1\n",
        "one.csv": "pose,camera,marker,u,v\n0,c0,0,1,1\n",
        "sweep.yaml": "base: paper.yaml\nruns: 2\n",
        "swept/sweep.h5": "",
    }.items():
        (tmp_path / file).write_text(text)
    given, message = EMPTY[name]
    output = [] if "-o" in given else ["-o", "out"]
    assert cli.run(["calibrate", *given, *output]) == 2
    (line,) = capsys.readouterr().err.splitlines()  # nor is said before that anything is made
    assert line.startswith("projservo: ")
    assert message in line
    assert not (tmp_path / "out").exists()
    assert sorted(file.name for file in (tmp_path / "swept").iterdir()) == ["sweep.h5"]
