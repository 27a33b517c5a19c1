"""The real stages through the command line: refusals, runs that repeat, options, what is read afterwards."""

from pathlib import Path

import numpy as np
import pytest

from projservo_cli.laws import PAPER_LAWS
from projservo_cli.records import flat_fields
from projservo_cli.store import run_file
from tests.conftest import ROOT

CONFIGS = ROOT / "configs"
PAPER = ("-c", CONFIGS / "paper.yaml")
FEW = "calibration.frames_per_joint=4"


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """Work in an empty folder: nothing may depend on the working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cross-validate", "1"], "--cross-validate 1: calibration.cross_validate"),
        (["--cross-validate", "26"], "there are 25 poses; choose 2 to 25 parts"),
        (["--set", "calibration.method=closed_form"], "calibration.method"),
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


@pytest.mark.volume
def test_what_the_first_chain_prints_is_read_in_ten_seconds(first_chain):
    told = (first_chain / "told.txt").read_text(encoding="utf-8")
    assert len(told.splitlines()) <= 45
    assert len(told.split()) <= 350
    # The reason of a run that did not converge is one line, however long.
    short = [line for line in told.splitlines() if str(first_chain) not in line and " ended in " not in line]
    assert max(map(len, short)) <= 80
    for law in PAPER_LAWS:
        assert sum(line.split()[:1] == [law] for line in told.splitlines()) == 1
    assert f"page: {first_chain / 'report.html'}" in told
    assert " judged claims hold" in " ".join(told.split())


def arrays(run):
    """Every array of a run by the name of its place."""
    return {
        f"{name}/{label}/{field.name}": getattr(record, field.name)
        for name, result in run.results.items()
        for label, record in result.records.items()
        for field in flat_fields(type(record))
        if "dims" in field.metadata
    }


@pytest.mark.volume
def test_the_same_seed_makes_identical_arrays_and_running_again_changes_nothing(projservo, first_chain):
    answer = projservo("servo", *PAPER, "--law", "direct_three", "-o", "one", "--json")
    (trace,) = answer.json["laws"]
    assert (answer.code, trace["verdict"]) == (0, "converged")
    one, first = arrays(run_file.load("one")), arrays(run_file.load(first_chain))
    assert any(name.startswith("servo/direct_three") for name in one)
    for name, value in one.items():
        np.testing.assert_array_equal(value, first[name], err_msg=name)
    before = Path("one/run.h5").read_bytes()
    again = projservo("calibrate", "plan", "servo", "--law", "direct_three", "-o", "one", "--json")
    assert again.json["servo"]["laws"] == [trace]
    assert Path("one/run.h5").read_bytes() == before
    assert projservo("calibrate", *PAPER, "-o", "two", "--set", "seed=2", "-q").code == 0
    assert not np.array_equal(
        run_file.load("two").observation.images, run_file.load("one").observation.images
    )
