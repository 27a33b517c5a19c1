"""Studies are run by name; that they can be is what is tested of them, and tables that a study makes."""

import csv
from importlib import import_module
from pathlib import Path

import pytest

STUDIES = sorted(
    path.stem
    for path in Path(__file__).parent.glob("*.py")
    if "\ndef main(" in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_can_be_run(name):
    pytest.importorskip("cv2")
    assert callable(import_module(f"tests.studies.{name}").main)


def test_a_gear_that_is_off_makes_the_predictions_of_the_study_err_as_much_as_was_asked():
    study = import_module("tests.studies.model_errors")
    with open(study.AMPLITUDES, encoding="utf-8") as file:
        known = {(row["fault"], row["arm"], row["size"]): row for row in csv.DictReader(file)}
    entry = known["gear", "hobby", "10.0"]
    sound = study.judged(study.Job("none", "hobby", "random", "white", 0.0, 0, 0.0))
    gear = study.judged(study.Job("gear", "hobby", "random", "white", 10.0, 0, float(entry["amplitude"])))
    assert (sound["exit"], sound["judged"]) == (0, "")
    assert sound["predicted_rms_px"] == pytest.approx(float(entry["stated_px"]), rel=0.15)
    assert sound["ratio"] < 2.0
    assert gear["effect_px"] == pytest.approx(10.0 * float(entry["stated_px"]), rel=0.3)
    assert gear["exit"] == 1 or gear["true_rms_px"] == pytest.approx(gear["effect_px"], rel=0.3)


def test_images_do_not_tell_a_base_that_steps_from_cameras_that_step_alike():
    study = import_module("tests.studies.model_errors")
    setting = study.Setting("hobby", 0)
    base, gear = ((study.faults_of(setting.arm)[name][0], 0.01, 0) for name in ("base steps", "gear"))
    assert setting.same_images(base, ("camera_step", (), ""))
    assert not setting.same_images(base, ("tool", (), ""))
    assert setting.same_images(gear, ("scale", (3,), ""))
    assert not setting.same_images(gear, ("scale", (4,), ""))
