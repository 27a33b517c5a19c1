"""Tables as people have them, of which the data leave something open: said by its cause."""

import json

import numpy as np
import pytest

from projservo_cli import cli, store
from tests.conftest import SHARED


@pytest.fixture
def case(tmp_path, monkeypatch):
    """Function that gives the folder of a case by name; skips where it is absent."""
    monkeypatch.chdir(tmp_path)

    def folder(name):
        path = SHARED.parent / "cases" / name
        if not path.is_dir():
            pytest.skip(f"case not found at {path}")
        return path

    return folder


@pytest.fixture
def answer(capsys):
    """Exit code, JSON and messages of a call."""

    def call(*arguments):
        capsys.readouterr()
        code = cli.run([str(argument) for argument in (*arguments, "--json")])
        captured = capsys.readouterr()
        return code, json.loads(captured.out) if captured.out else None, captured.err

    return call


def test_case_05_wrap_360(case, answer):
    folder = case("05_wrap_360")
    code, found, _ = answer(
        "calibrate", "--data", folder / "trials.csv", "--joint-unit", "deg", "-o", "a", "--suggest", 3
    )
    _, plain, _ = answer("calibrate", "--data", folder / "same_without_wrap.csv", "-o", "b", "--suggest", 3)
    assert (code, found["usable"], found["circular_joints"], plain["circular_joints"]) == (0, True, [4], [])
    assert found["advice"][0].startswith("readings of joint 4 pass 359° to 1°: ")
    assert found["predicted_rms_px"] == pytest.approx(plain["predicted_rms_px"], rel=1e-3)
    for one, other in zip(found["joints"], plain["joints"], strict=True):
        assert one["excitation"] == pytest.approx(other["excitation"], abs=1e-6)
    steps = [[row["delta"] for row in value["suggestions"]] for value in (found, plain)]
    assert np.abs(steps).max() < np.radians(60.0)
    wrapped, other = (store.load(name) for name in "ab")
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
    assert found["advice"][0].startswith("u = 9999, v = 9999 stands in 158 rows of several markers and poses")
    assert (found["rejected"]["placeholders"], empty["rejected"]["placeholders"]) == (170, 0)
    apart = {"advice", "placeholders", "rejected", "run", "seconds"}
    assert {k: v for k, v in found.items() if k not in apart} == {
        k: v for k, v in empty.items() if k not in apart
    }
    code, score, err = answer("validate", "b", "--data", folder / "t.csv")
    assert (code, score["skipped"]["missing"]) == (0, 170)
    assert score["rms_px"] < 1.0
    assert "u = 9999, v = 9999" in err
