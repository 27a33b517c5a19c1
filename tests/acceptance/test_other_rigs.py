"""One camera, and three: what calibrate, validate, report and export do, and that tasks take two views."""

import numpy as np
import pytest

from projservo_cli.store.observation_tables import to_csv, write_table
from tests.calibration.simulated_robot import around, random_robot, trials
from tests.calibration.test_cameras_on_the_tool import Hand

FEW = 4  # of the corners of the board, every so many


@pytest.mark.parametrize(("types", "views", "mount"), [("RRRR", 1, "world"), ("RRPR", 3, "tool")])
def test_a_chain_of_another_rig(answer, elsewhere, types, views, mount):
    rng = np.random.default_rng(2)
    robot = random_robot(types, rng, markers=8, views=views)
    robot = Hand(**vars(robot)) if mount == "tool" else robot
    poses = np.concatenate([trials(robot, frames=4), around(robot, 12, rng)])
    write_table(robot.observe(poses, 0.4, rng), "table.csv")
    write_table(robot.observe(around(robot, 8, rng), 0.4, rng), "ahead.csv")
    words = "calibrate", "--data", "table.csv", "--joints", types, "--mount", mount
    sizes = [f"{1280 + view}x1024" for view in range(4)]
    code, found, error = answer(
        *words, "-o", "out", "--image-size", ",".join(sizes[:views]), "--suggest", "1"
    )
    assert code == 0, error
    assert (found["usable"], found["mount"]) == (True, mount)
    assert found["view"] == ["left", "right", "top"][:views]
    assert [joint["type"] for joint in found["joints"]] == [*types]
    assert (found["sigma_view_px"] is None) == (views < 3)
    assert len(found["suggestions"]) == 1
    code, _, error = answer(*words, "-o", "other", "--image-size", ",".join(sizes))
    assert code == 2
    assert f"4 image sizes for the views {', '.join(found['view'])}: give one, or one per view" in error
    code, value, _ = answer("validate", "out", "--data", "ahead.csv")
    assert (code, value["count"]) == (0, views * 8 * 8)
    assert value["median_px"] <= value["limit_px"]
    code, value, _ = answer("report", "-o", "out", "calibrate")
    assert code == 0, value
    assert any("calibration" in name for name in value["report"]["figures"])
    for kind in ("opencv", "urdf", "ros", "json"):
        code, _, error = answer("export", "out", "--to", kind, "--metric", "0.1", "--between", "5,8")
        assert code in (0, 1), (kind, error)


def test_case_45_sizes_reach_the_cameras_of_their_names(answer, case):
    folder = case("45_order_of_views")
    tables = "--data", folder / "s6_sizes_miss_tr.csv", "--readings", folder / "s6_sizes_miss_J.csv"
    found = []
    for sizes in ("1280x960,1920x1440,1600x1200", "c2=1600x1200, C0=1280x960,c1=1920x1440"):
        code, value, error = answer("calibrate", *tables, "--image-size", sizes, "-o", f"out{len(found)}")
        assert code == 0, error
        assert value["view"] == ["c0", "c1", "c2"]
        found.append(value["sigma_view_px"])
    assert found[0] == found[1]
    for names in ("c0=1280x960,c1=1920x1440", "c0=1280x960,c1=1920x1440,c3=1600x1200"):
        code, _, error = answer("calibrate", *tables, "--image-size", names, "-o", "other")
        assert (code, "but the views are c0, c1, c2: give one size, or one of each view" in error) == (
            2,
            True,
        )
    code, _, error = answer(
        "calibrate", *tables, "--image-size", "640x480,1920x1440,1600x1200", "-o", "other"
    )
    assert (code, "of the c0 view are outside" in error) == (2, True)


def test_three_webcams_before_a_real_arm(answer, elsewhere, shared_data):
    """A list of detections beside joints, of a quarter of the corners; bars are those of all corners."""
    rows = np.genfromtxt(shared_data / "ur3e" / "detections_cam123.csv", delimiter=",", names=True)
    joints = np.genfromtxt(shared_data / "ur3e" / "joints.csv", delimiter=",", names=True)
    few = rows[rows["marker"] % FEW == 0]
    for name, held_out in (("train", False), ("test", True)):
        some, at = (part[(part["pose"] % 4 == 0) == held_out] for part in (few, joints))
        for file, table, whole in ((name, some, ("pose", "camera", "marker")), (f"{name}_q", at, ("pose",))):
            columns = {
                key: table[key].astype(int) if key in whole else table[key] for key in table.dtype.names
            }
            with open(f"{file}.csv", "w", encoding="utf-8") as out:
                out.write(to_csv(columns))
    tables = "--data", "train.csv", "--readings", "train_q.csv"
    code, found, _ = answer("calibrate", *tables, "--joint-unit", "deg", "--lens", "-o", "out")
    assert (code, found["usable"], found["view"]) == (0, True, ["cam1", "cam2", "cam3"])
    code, value, _ = answer(
        "validate", "out", "--data", "test.csv", "--readings", "test_q.csv", "--joint-unit", "deg"
    )
    assert code == 0
    assert value["median_px"] <= 0.40
    assert {25, 26} <= set(found["rejected"]["poses"])
    assert {1, 2, 3, 5, 6} <= {one["pose"] for one in found["moved_images"]}
    assert found["sigma_view_px"][2] > 2.0 * max(found["sigma_view_px"][:2])
    assert any(text.startswith("the cam3 camera is") for text in found["advice"])
    code, value, error = answer("report", "-o", "out", "calibrate")  # with poses that are left out as a whole
    assert (code, value["report"]["figures"]) == (0, ["figures/fig13_calibration.svg"]), error
    assert not any(text.startswith(("joint ", "check the joint")) for text in found["advice"])


def test_one_camera_and_a_board(answer, elsewhere, shared_data):
    """All 63 corners of a flat board, of which the fit of the body takes a part."""
    folder = shared_data / "board"
    tables = "--data", folder / "train.csv", "--readings", folder / "train_joints.csv"
    code, found, error = answer("calibrate", *tables, "--image-size", "1280x960", "-o", "out")
    assert (code, found["usable"]) == (0, True), error
    assert not any(found["rejected"]["tracks"].values())
    code, value, _ = answer(
        "validate", "out", "--data", folder / "test.csv", "--readings", folder / "test_joints.csv"
    )
    # 0.0553 px a coordinate, at 0.2 px of noise; every second corner alone leaves 0.063.
    assert (code, value["skipped"]["unknown_marker"]) == (0, 0)
    assert value["rms_px"] <= 0.09


def test_case_32_good_markers_rejected(case, answer):
    folder = case("32_good_markers_rejected")
    words = "--mount", "tool", "--joints", "RRPR", "--image-size", "1280x960"
    code, found, _ = answer("calibrate", "--data", folder / "t.csv", *words, "-o", "out")
    assert (code, found["usable"], any(found["rejected"]["tracks"].values())) == (0, True, False)
    code, value, _ = answer("validate", "out", "--data", folder / "held.csv")
    assert (code, value["skipped"]["unknown_marker"]) == (0, 0)


def test_case_34_few_corners_seen(case, answer):
    folder = case("34_few_corners_seen")
    words = "--mount", "tool", "--joints", "PPPRRR", "--image-size", "1280x960"
    code, found, error = answer("calibrate", "--data", folder / "t.csv", *words, "-o", "out")
    assert "internal error" not in error
    assert (code, found["usable"]) in ((0, True), (1, False))


def test_case_38_joint_named_for_a_camera_on_the_tool(case, answer):
    folder = case("38_joint_named_for_a_camera_on_the_tool")
    words = "--mount", "tool", "--joints", "PPPRRR", "--image-size", "1600x1200"
    code, found, error = answer("calibrate", "--data", folder / "t.csv", *words, "-o", "out")
    assert (code, found["usable"]) == (1, False)
    for one in found["findings"]:
        if joints := one["subject"].get("joints"):
            assert one["unit"] == ("m" if max(joints) <= 3 else "rad")
    (one,) = (one for one in found["findings"] if 2 in one["subject"].get("joints", ()))
    assert 0.05 < one["amount"] < 0.2
    assert "on the tool" not in error


@pytest.mark.parametrize("stated", [(), ("--noise-px", 0.3)])
def test_case_30_no_pixel_noise(case, answer, stated):
    """Images projected from estimated poses: no two markers show the noise, and joints take its errors."""
    folder = case("30_no_pixel_noise")
    words = "--joints", "RRRRRR", "--image-size", "1280x960", *stated
    code, found, error = answer("calibrate", "--data", folder / "t.csv", *words, "-o", "out")
    assert (code, found["usable"]) == (0, True), error
    # With 0.1 px added to the pixels, the same table predicts to 0.123 px.
    assert 0.06 <= found["predicted_rms_px"] <= 0.25
    assert any(line.startswith("the images have no noise") for line in found["advice"]) == (not stated)
