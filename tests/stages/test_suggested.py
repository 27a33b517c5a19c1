"""Suggested poses are recorded and make the next calibration better: the loop a user goes through."""

import csv
from pathlib import Path

import numpy as np
import pytest

from projservo_cli import files
from projservo_cli.store.tables import read_joint_list, read_table

CONFIGS = Path(__file__).parents[2] / "configs"
STANFORD = ("-c", CONFIGS / "stanford.yaml", "--set", "calibration.frames_per_joint=4")


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(files, "_synchronise", lambda path: None)


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


def test_asking_again_costs_no_calibration_and_says_the_same(projservo):
    one = projservo("calibrate", *STANFORD, "-o", "run", "--suggest", 2, "--json")
    two = projservo("calibrate", "-o", "run", "--json", "--suggest", "2")
    assert "up to date" in two.err
    assert one.json == two.json
    words = projservo("calibrate", "--suggest", "2", "-o", "run").out
    assert "q3 mm" in words
    assert f"{one.json['suggestions'][0]['variance_after'] ** 0.5:.3g}" in words
    assert "no joint limits" not in words
    assert "suggestions" not in projservo("calibrate", "-o", "run", "--json").json


def test_a_table_in_degrees_gets_suggestions_in_degrees(projservo):
    assert projservo("record", *STANFORD, "-o", "t.csv", "-q").code == 0
    with open("t.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    with open("deg.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        for row in rows:
            turned = {f"q{i}": repr(np.degrees(float(row[f"q{i}"])).item()) for i in (1, 2, 4, 5, 6)}
            writer.writerow(row | turned)
    table = ("--data", "deg.csv", "--joints", "RRPRRR", "--joint-unit", "deg")
    answer = projservo("calibrate", *table, "-o", "run", "--suggest", "1", "--json")
    assert answer.json["suggestions_unit"] == "deg"
    assert answer.json["suggestions_limited"] is False
    motions = read_joint_list("run/suggestions.csv", "RRPRRR", "deg")
    np.testing.assert_allclose(motions.q[0], answer.json["suggestions"][0]["q"], rtol=1e-12)


@pytest.mark.parametrize(
    ("limits", "known"),
    [("{from_data: 0.1}", False), ("{joints: [[-3,3],[-3,3],[0,1],[-3,3],[-3,3],[-3,3]], unit: rad}", True)],
)
def test_suggestions_without_joint_limits_say_where_to_give_them(projservo, limits, known):
    assert projservo("record", *STANFORD, "-o", "t.csv", "-q").code == 0
    table = ("--data", "t.csv", "--joints", "RRPRRR", "--set", f"robot.limits={limits}")
    answer = projservo("calibrate", *table, "-o", "run", "--suggest", "1")
    assert answer.code == 0, answer.err
    assert ("give them with -c or robot.limits" in " ".join(answer.out.split())) != known
