"""Suggested poses are recorded and make the next calibration better: the loop a user goes through."""

import csv
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.store.tables import read_joint_list, read_table

CONFIGS = Path(__file__).parents[2] / "configs"
STANFORD = ("-c", CONFIGS / "stanford.yaml", "--set", "calibration.frames_per_joint=4")


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def test_suggest_record_calibrate_again(projservo):
    first = projservo("--suggest", "calibrate", *STANFORD, "-o", "run", "--json")
    assert first.code == 0, first.err
    rows = first.json["suggestions"]
    assert len(rows) == 5
    assert Path(first.json["suggestions_file"]) == Path("run/suggestions.csv").resolve()
    motions = read_joint_list("run/suggestions.csv", "RRPRRR")
    np.testing.assert_array_equal(motions.q, [row["q"] for row in rows])
    with open("run/suggestions.csv", newline="") as file:
        listed = list(csv.DictReader(file))
    assert [int(row["from_pose"]) for row in listed] == [row["from_pose"] for row in rows]
    assert float(listed[2]["delta_q3"]) == rows[2]["delta"][2]
    # Within the limits of the robot, or record would refuse.
    answer = projservo("record", *STANFORD, "--motions", "run/suggestions.csv", "-o", "t.csv", "--json")
    assert answer.code == 0, answer.err
    assert answer.json["poses"] == 25 + 5
    np.testing.assert_array_equal(read_table("t.csv", "RRPRRR").q[25:], motions.q)
    again = projservo("calibrate", "--data", "t.csv", "--joints", "RRPRRR", "--noise-px", "0.5", "-o", "two")
    assert again.code == 0, again.err
    # Held out: trial motions of another seed.
    assert projservo("record", *STANFORD, "--set", "seed=9", "-o", "v.csv", "-q").code == 0
    errors = [
        projservo("validate", run, "--data", "v.csv", "--json").json["rms_px"] for run in ("run", "two")
    ]
    assert errors[1] < 1.05 * errors[0]
