"""Tables as people have them, of which the data leave something open: said by its cause."""

import numpy as np
import pytest

from projservo_cli.store import run_file
from tests.conftest import ROOT
from tests.robots.robots import CALLS


def test_case_05_wrap_360(case, answer):
    folder = case("05_wrap_360")
    code, found, _ = answer(
        "calibrate", "--data", folder / "trials.csv", "--joint-unit", "deg", "-o", "a", "--suggest", 3
    )
    _, plain, _ = answer("calibrate", "--data", folder / "same_without_wrap.csv", "-o", "b", "--suggest", 3)
    assert (code, found["usable"], found["circular_joints"], plain["circular_joints"]) == (0, True, [4], [])
    assert found["advice"][-1].startswith("readings of joint 4 pass 359° to 1°: ")
    assert found["predicted_rms_px"] == pytest.approx(plain["predicted_rms_px"], rel=1e-3)
    for one, other in zip(found["joints"], plain["joints"], strict=True):
        assert one["excitation"] == pytest.approx(other["excitation"], abs=1e-6)
    steps = [[row["delta"] for row in value["suggestions"]] for value in (found, plain)]
    assert np.abs(steps).max() < np.radians(60.0)
    wrapped, other = (run_file.load(name) for name in "ab")
    turns = (wrapped.calibration.joint_min - other.calibration.joint_min) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-6)
    np.testing.assert_allclose(np.ptp(wrapped.observation.q, axis=0), wrapped.calibration.excitation)
    code, score, _ = answer("validate", "b", "--data", folder / "trials.csv", "--joint-unit", "deg")
    assert code == 0
    assert score["median_px"] < 2.0 * plain["sigma_px"]


def test_case_15_sentinel_9999(case, answer):
    folder = case("15_sentinel_9999")
    code, found, _ = answer("calibrate", "--data", folder / "t.csv", "-o", "a")
    _, empty, _ = answer("calibrate", "--data", folder / "empty_cells.csv", "-o", "b")
    assert code == 0
    assert found["advice"][-1].startswith(
        "u = 9999, v = 9999 stands in 158 rows of several markers and poses"
    )
    assert (found["rejected"]["placeholders"], empty["rejected"]["placeholders"]) == (170, 0)
    apart = {"advice", "findings", "notes", "placeholders", "rejected", "run", "seconds"}
    assert {k: v for k, v in found.items() if k not in apart} == {
        k: v for k, v in empty.items() if k not in apart
    }
    code, score, err = answer("validate", "b", "--data", folder / "t.csv")
    assert (code, score["skipped"]["missing"]) == (0, 170)
    assert score["rms_px"] < 1.0
    assert "u = 9999, v = 9999" in err


def test_case_01_joint_order(case, answer):
    """Poses in which several joints move show the exchange: tests/calibration/test_mislabelled_data.py."""
    folder = case("01_joint_order")
    code, found, _ = answer("calibrate", "--data", folder / "trials.csv", "-o", "a")
    assert (code, found["usable"], found["order_determined"]) == (0, True, False)
    assert [1, 3] in found["undecided_order"]
    assert found["advice"][-1].startswith(
        "these poses cannot confirm the order of joints 1, 2, 3, 4, 5 and 6"
    )


UR5 = ROOT / "configs" / "ur5.yaml"
ROBOT = f"plant={{use: 'tests.robots.robots:Sound', options: {{config: {UR5}}}}}"
TASK = ["--set", "task.goal.joints.joints=[3, -1.7, -0.9, -2, 2, 1]"]


def test_a_table_without_an_order_is_planned_with_a_warning_and_drives_no_external_robot(
    answer, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    recorded = ["-c", UR5, "--set", "calibration.random_poses=0"]
    assert answer("record", *recorded, "-o", "t.csv")[0] == 0
    task = ["--data", tmp_path / "t.csv", *TASK]
    code, found, err = answer("calibrate", "plan", "-c", UR5, *task, "-o", "run")
    assert code == 0, err
    assert found["calibrate"]["order_determined"] is False
    assert "; these poses cannot confirm the order of joints 1, 2, 3, 4, 5 and 6" in found["plan"]["reason"]
    drive = ["servo", "-c", UR5, *task, "--set", ROBOT, "--law", "exact", "-o", "run"]
    CALLS.clear()
    code, _, err = answer(*drive)
    assert code == 2, err
    assert "these poses cannot confirm the order of joints 1, 2, 3, 4, 5 and 6" in err
    assert "data.joint_order=stated" in err
    assert not CALLS
    stated = [*drive, "--set", "data.joint_order=stated"]
    code, done, err = answer(*stated)
    assert code == 0, err
    assert done["laws"][0]["verdict"] == "converged"
    plan = run_file.load("run").plan
    assert "order of joints" not in plan.reason
