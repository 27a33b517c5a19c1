"""From names to classes: what is found, what is refused and how, what is never imported."""

import sys
from pathlib import Path

import pytest

from projservo_cli import plugins
from projservo_cli.config import load_config
from projservo_cli.records import InputError
from projservo_cli.result_hashes import source_hash

UR5 = Path(__file__).parents[2] / "configs" / "ur5.yaml"
HERE = "tests.robots.robots"


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)


def written(name, text):
    Path(f"{name}.py").write_text(text)
    sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (
            "no_such_module:A",
            r"plant no_such_module:A: there is no module no_such_module on the Python path or",
        ),
        ("tests.no_such:A", r"there is no module tests\.no_such on"),
        (f"{HERE}:Faulti", r"tests\.robots\.robots has no Faulti; did you mean Faulty\?"),
        (f"{HERE}:Zzz", r"has no Zzz; classes: Sound, ByPoses, Telling, "),
        (f"{HERE}:NOT_A_CLASS", r"is no class, but of type int"),
        (f"{HERE}:NoStop", r"lacks stop\(\); needed: open, read, command, stop, close"),
        (f"{HERE}:Old", r"lacks open\(\), close\(\); needed: open, joints,"),
        (f"{HERE}:Truths", r"has truths, which is not in the contract; did you mean truth\?"),
        (f"{HERE}:Now", r"has now, which is to be a method; give it another name"),
        (f"{HERE}:Stopp", r"has stopp, which is not in the contract; did you mean stop\?"),
        (f"{HERE}:Sound", r"does not take plant\.options: missing a required argument: 'config'"),
        ("mine_bad_syntax:A", r"importing mine_bad_syntax failed: SyntaxError: .* \(mine_bad_syntax.py:2\)$"),
        (
            "mine_lacks:A",
            r"importing mine_lacks failed: ModuleNotFoundError: No module named 'no_such_thing'",
        ),
        ("mine_exits:A", r"importing mine_exits failed: SystemExit: 3 \(mine_exits.py:1\)"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_line(target, message):
    written("mine_bad_syntax", "x = 1\ndef f(:\n")
    written("mine_lacks", "import no_such_thing\n")
    written("mine_exits", "raise SystemExit(3)\n")
    with pytest.raises(InputError, match=message) as caught:
        plugins.make("plant", target, (), {})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("plant=arm", "plant.use: must be module:Class, such as my_robot:Robot"),
        ("plant=a b:C", "must be module:Class"),
        ("plant.speed_scale=1.5", "at most 1"),
        ("plant.timeout_s=0", "greater than 0"),
        ("plant.options={a: .nan}", "takes text, finite numbers"),
        ("control.laws=['a:']", "must be module:Class, such as my_laws:Law"),
        ("law=direct_tree", "'direct_tree' is not one of them; did you mean direct_three?"),
    ],
)
def test_bad_values_are_refused_where_they_stand(override, message):
    with pytest.raises(InputError) as caught:
        load_config(UR5, [override])
    assert message in str(caught.value)
    assert f"--set {override}" in str(caught.value)


def test_the_source_of_a_law_is_its_module_and_what_of_ones_own_it_imports():
    """Found without running any; what is installed counts by its version."""
    written("mine_gains", "raise AssertionError('nothing is run')\nGAIN = 1\n")
    written("mine_other", "x = 1\n")
    Path("mine_package").mkdir()
    written("mine_package/__init__", "")
    written("mine_package/deep", "from . import beside\n")
    written("mine_package/beside", "x = 1\n")
    written(
        "mine_law",
        "import json\nimport numpy as np\nfrom mine_package.deep import x\n"
        "def f():\n    from mine_gains import GAIN\n",
    )
    hashes = [source_hash("mine_law:f")]
    for name in (
        "mine_law",
        "mine_gains",
        "mine_package/deep",
        "mine_package/beside",
        "mine_package/__init__",
    ):
        path = Path(f"{name}.py")
        path.write_text(path.read_text() + "# edited\n")
        hashes.append(source_hash("mine_law:f"))
    assert len(set(hashes)) == 6
    Path("mine_other.py").write_text("x = 2\n")
    assert source_hash("mine_law:f") == hashes[-1]
    assert not source_hash("mine_gone:f")
    assert not {"mine_law", "mine_gains", "mine_package"} & sys.modules.keys()


LAW = """
class Law:
    def __init__(self, setup):
        self.n = len(setup.calibration.H_hat_0)

    def __call__(self, s, q):
        return [0.0] * self.n
"""


def test_a_law_that_is_edited_is_run_anew_and_one_that_is_gone_stands(projservo):
    written("mine_edited", LAW)
    command = ("servo", "-c", UR5, "--law", "mine_edited:Law", "-o", "run", "--set", "stop.max_steps=2")

    def said():
        return projservo(*command, "--dry-run").out

    assert projservo(*command).code == 1  # it does not converge
    assert "servo/mine_edited:Law: up to date\n" in said()
    written("mine_edited", LAW + "# edited\n")
    assert "servo/mine_edited:Law: would be made (the source of its law changed)" in said()
    projservo(*command)
    Path("mine_edited.py").unlink()
    assert "servo/mine_edited:Law: up to date, though the source of its law is gone" in said()
