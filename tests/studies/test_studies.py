"""Studies are run by name; that they can be is what is tested of them, and tables that a study makes."""

from importlib import import_module
from pathlib import Path

import pytest

from tests.studies.common import parser_of

STUDIES = sorted(
    path.stem
    for path in Path(__file__).parent.glob("*.py")
    if "\ndef main(" in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_can_be_run(name):
    pytest.importorskip("cv2")
    assert callable(import_module(f"tests.studies.{name}").main)


@pytest.mark.parametrize("arms", [("ur5", "hobby"), ["ur5", "hobby"], {"ur5": 1, "hobby": 2}], ids=type)
def test_a_study_takes_all_choices_by_default_and_each_by_name(arms):
    parser = parser_of("study", "Title.", arms=arms)
    assert parser.parse_args([]).arms == ["ur5", "hobby"]
    assert parser.parse_args(["--arms", "hobby"]).arms == ["hobby"]


def test_images_do_not_tell_a_base_that_steps_from_cameras_that_step_alike():
    study = import_module("tests.studies.model_errors")
    setting = study.Setting("hobby", 0)
    base, gear = ((study.faults_of(setting.arm)[name][0], 0.01, 0) for name in ("base steps", "gear"))
    assert setting.same_images(base, ("camera_step", (), ""))
    assert not setting.same_images(base, ("tool", (), ""))
    assert setting.same_images(gear, ("scale", (3,), ""))
    assert not setting.same_images(gear, ("scale", (4,), ""))
