"""Recorded tables of two arms, through the command line: held-out prediction, noise, order."""

import csv
import json

import numpy as np
import pytest

from projservo_cli.store.observation_tables import read_table

JOINTS = {"ur5": "RRRRRR", "stanford": "RRPRRR"}
# Limits on the median and the 95th percentile of the held-out distance per marker and view, px.
HELD_OUT = {
    ("ur5", "0.1"): (0.035, 0.12),
    ("ur5", "0.5"): (0.17, 0.6),
    ("ur5", "1.0"): (0.38, 1.2),
    ("stanford", "0.5"): (0.18, 0.5),
    ("stanford", "1.0"): (0.38, 1.2),
}
# Pixels of the tables are rounded to 1e-6: their own noise is 2.9e-7 px a coordinate.
NOISE_FREE_PX = 2e-6


@pytest.fixture
def held_out(answer, made_once, shared_data):
    """Calibrate from a table, predict the validation poses: folder of the run, both JSON objects."""

    def run(robot, noise):
        def make(folder):
            words = ["calibrate", "--data", shared_data / robot / f"trials_{noise}px.csv"]
            words += ["--joints", JOINTS[robot], "-o", folder]
            code, found, err = answer(*words)
            # A calibration that is not usable is a failure, and yet stored for comparison.
            assert code == (0 if found["usable"] else 1), err
            (folder / "told.json").write_text(json.dumps(found), encoding="utf-8")

        folder = made_once(f"recorded {robot} {noise}", make)
        code, value, err = answer("validate", folder, "--data", shared_data / robot / "validation.csv")
        assert code == 0, err
        assert value["count"] == 4000  # 200 poses, 10 markers, 2 views: nothing was dropped
        assert value["skipped"] == {"unknown_marker": 0, "behind_camera": 0, "missing": 0}
        return folder, json.loads((folder / "told.json").read_text(encoding="utf-8")), value

    return run


@pytest.mark.parametrize(("robot", "noise"), HELD_OUT)
def test_noisy_tables_predict_images_not_seen(held_out, robot, noise):
    _, calibration, value = held_out(robot, noise)
    median, p95 = HELD_OUT[robot, noise]
    assert value["median_px"] <= median
    assert value["p95_px"] <= p95
    # A median far below the noise's own contribution would mean that the answer was looked up.
    assert value["median_px"] > 0.1 * float(noise)
    assert calibration["usable"]
    assert calibration["outliers"] == []
    # The epipolar residuals of some 725 pairs tell σ to 1/√(2·725) = 2.6 %: four of that.
    assert calibration["sigma_px"] == pytest.approx(float(noise), rel=0.105)
    # 2850 degrees of freedom tell χ²/dof to 2.6 % given σ; here both σ differ.
    assert calibration["chi2_per_dof"] == pytest.approx(1.0, abs=0.2)
    assert [joint["type"] for joint in calibration["joints"]] == list(JOINTS[robot])


@pytest.mark.parametrize("robot", JOINTS)
def test_noise_free_tables_are_explained_to_their_rounding(held_out, robot):
    _, calibration, value = held_out(robot, "0.0")
    assert value["rms_px"] <= NOISE_FREE_PX
    assert value["p95_px"] <= 2.0 * NOISE_FREE_PX
    assert calibration["usable"]
    assert 0.001 < calibration["sigma_px"] < 0.01  # the floor of the estimate
    assert calibration["rms_px"] <= NOISE_FREE_PX


def test_a_table_says_the_same_in_any_order(shared_data, rng, tmp_path):
    """With columns in another order, a further one, rows shuffled, markers and poses renumbered."""
    source = shared_data / "ur5" / "trials_0.5px.csv"
    with source.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with open(tmp_path / "other.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rng.permutation([*rows[0], "remark"]))
        writer.writeheader()
        for i in rng.permutation(len(rows)):
            marker, pose = 90 - 7 * int(rows[i]["marker"]), 500 - int(rows[i]["pose"])
            writer.writerow(rows[i] | {"marker": marker, "pose": pose, "remark": "tag, partly hidden"})
    one, other = read_table(source), read_table(tmp_path / "other.csv")
    k, j = np.argsort(500 - other.pose), np.argsort(90 - other.marker)
    np.testing.assert_array_equal(500 - other.pose[k], one.pose)
    np.testing.assert_array_equal(90 - other.marker[j], 7 * one.marker)
    np.testing.assert_array_equal(other.q[k], one.q)
    np.testing.assert_array_equal(other.images[k][:, :, j], one.images)


def test_validate_fails_where_the_rig_is_another(held_out, answer, shared_data, tmp_path):
    """Both cameras are turned by 2 px since the recording, some ten times the stated error."""
    table = shared_data / "ur5" / "validation.csv"
    with open(table, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with open(tmp_path / "turned.csv", "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(
            row | {side: float(row[side]) + 2.0 for side in ("u_left", "u_right")} for row in rows
        )
    code, value, err = answer("validate", held_out("ur5", "0.5")[0], "--data", tmp_path / "turned.csv")
    assert (code, value["median_px"] > value["limit_px"]) == (1, True)
    assert "contradict the calibration" in err


def test_validate_names_the_one_camera_that_turned_and_what_no_pose_shows(
    held_out, answer, shared_data, tmp_path
):
    """By 2.4 px, a tenth of whose rows are left: the pooled median is that of the other camera."""
    with open(shared_data / "ur5" / "validation.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with open(tmp_path / "turned.csv", "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        for i, row in enumerate(rows):
            gone = {"u_right": "", "v_right": ""} if i % 10 else {"u_right": float(row["u_right"]) + 2.4}
            writer.writerow(row | gone)
    code, value, err = answer("validate", held_out("ur5", "0.5")[0], "--data", tmp_path / "turned.csv")
    assert (code, value["median_px"] < value["limit_px"]) == (1, True)
    told = " ".join(err.split())
    assert "in one camera alone: right camera: median" in told
    assert "--refit right" in told
    assert "these poses cannot confirm the order of joints 1, 2, 3, 4, 5 and 6" in told
    assert "whether the cameras are on the tool" in told


def test_a_tag_whose_corners_begin_further_in_one_view_is_named(answer, shared_data):
    """Case 23: without the check usable at a stated 0.14 px, while the truth is 18 px."""
    table = shared_data.parent / "cases/23_tag_turned_in_one_view/tag_corner_order_turned_0.csv"
    if not table.exists():
        pytest.skip(f"{table} is absent")
    code, value, err = answer("calibrate", "--data", table, "-o", "out")
    assert (code, value["failed"]) == (1, "calibrate")
    assert "tag 1: its corners begin 1 further in the right view" in " ".join(err.split())
