"""Episodes of LeRobot: both versions, units of states, chosen frames, and a camera that moved."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import projservo_cli
from projservo_cli.detection.episodes import episode_of
from projservo_cli.store.observation_tables import read_table
from tests.detection.lerobot import DELAY, FPS, make_episodes, write_dataset, write_video

pytest.importorskip("cv2", reason="OpenCV is not installed: pip install '.[lerobot]'")
pytest.importorskip("av", reason="PyAV is not installed: pip install '.[lerobot]'")
pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install '.[lerobot]'")
pq = pytest.importorskip("pyarrow.parquet")

NAMES = ["shoulder_pan.pos", "shoulder_lift.pos", "wrist_roll.pos", "gripper.pos"]


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def rendered():
    """Four episodes of an arm of three joints; camera top moves before the third."""
    return make_episodes(np.random.default_rng(5), 4, moved=2)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_episodes_calibrate_for_each_stretch_in_which_cameras_stood(projservo, rendered, version):
    episodes, moved_px = rendered
    write_dataset(Path("set"), version, episodes, NAMES, units="degrees")
    answer = projservo("detect", "--lerobot", "set", "-o", "t.csv", "--json")
    assert answer.code == 0, answer.err
    (one,) = answer.json["moved"]
    assert (one["view"], one["last"], one["first"]) == ("top", 1, 2)
    assert one["by_px"] == pytest.approx(moved_px, rel=0.1)
    assert answer.json["episodes"] == [[0, 1], [2, 3]]
    assert answer.json["joints"] == NAMES[:3]
    assert answer.json["left_out"] == ["gripper.pos"]
    table, later = read_table("t.csv"), read_table("t_episodes_2-3.csv")
    assert {*episode_of(table.pose)} == {0, 1}
    assert {*episode_of(later.pose)} == {2, 3}
    assert table.view == ("top", "side")
    for k, number in enumerate(table.pose):  # the joints are those of the frame, in rad
        state = episodes[number // 100_000][0][number % 100_000]
        np.testing.assert_allclose(table.q[k], np.radians(state[:3]), atol=1e-6)
    if version == "v2.1":  # the tables are the same
        return
    answer = projservo("calibrate", "--data", "t.csv", "-o", "out", "--json")
    assert answer.code == 0, answer.err
    assert answer.json["usable"]
    np.testing.assert_allclose(projservo_cli.load("out").calibration.time_offset_s, DELAY / FPS, atol=0.01)
    answer = projservo(
        "detect", "--lerobot", "set", "--episodes", "2-3", "side=side", "-o", "s.csv", "--points", "centers"
    )
    assert answer.code == 0, answer.err
    assert "moved by" not in answer.out
    np.testing.assert_array_equal(read_table("s.csv").at_rest.pose, later.at_rest.pose)


def put(units=None, values=(10.0, 20.0, 30.0), frames=12, version="v2.1", names=NAMES, tag=True, fast=False):
    """A data set of two episodes and one camera that sees one tag."""
    import cv2

    from tests.detection.rendering import render, square

    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image = render(cv2, tags, (160, 120), [(1, square((80, 60), 50, 0.2))] if tag else [])
    q = np.tile([*values, 55.0], (frames, 1)) + (30.0 * np.arange(frames)[:, None] if fast else 0.0)
    more = {} if units is None else {"units": units}
    write_dataset(Path("set"), version, [(q, {"top": [image] * frames})] * 2, names, as_images=True, **more)


MOTORS = {
    name.removesuffix(".pos"): {
        "id": k,
        "drive_mode": k % 2,
        "homing_offset": 9,
        "range_min": 1000,
        "range_max": 3048,
    }
    for k, name in enumerate(NAMES)
}


def test_normalised_states_are_turned_by_the_calibration_of_the_arm(projservo):
    put("range_m100_100")
    Path("arm.json").write_text(json.dumps(MOTORS))
    command = ["detect", "--lerobot", "set", "-o", "t.csv"]
    answer = projservo(*command)
    assert answer.code == 2
    assert "is normalised, shares of a range" in answer.err
    answer = projservo(*command, "--calibration-file", "arm.json")
    assert answer.code == 0, answer.err
    assert "normalised, as the data set says, by arm.json" in answer.out
    assert "joints that moved little: shoulder_pan.pos 0.0°" in answer.out
    expected = np.radians([9.0, -18.0, 27.0])  # 2048 counts are half a turn, the second sign is turned
    np.testing.assert_allclose(read_table("t.csv").q, [expected, expected])


@pytest.mark.parametrize(
    ("unit", "given", "values", "expected"),
    [
        (None, "rad", (1, 2, 3), (1, 2, 3)),
        ("rad", None, (1, 2, 3), (1, 2, 3)),
        (["degrees"] * 3 + ["percent"], None, (1, 2, 3), np.radians((1, 2, 3))),
        (None, None, (120, 2, 3), np.radians((120, 2, 3))),
    ],
)
def test_units_are_those_that_are_said(projservo, unit, given, values, expected):
    put(unit, values)
    asked = ["--state-unit", given] if given else []
    answer = projservo("detect", "--lerobot", "set", "-o", "t.csv", *asked)
    assert answer.code == 0, answer.err
    np.testing.assert_allclose(read_table("t.csv").q[0], expected, atol=1e-6)


DEG, RAD = {"units": "deg"}, {"units": "rad"}
# Of the data set, options, and the message.
REFUSED = {
    "no folder": ({}, "--lerobot none", "there is no such file; give the folder of a LeRobot data set"),
    "no unit": ({}, "", "does not say the unit of observation.state, whose values reach 30"),
    "two units": (RAD, "--state-unit deg", "is in deg and rad; expected one of"),
    "unknown unit": ({"units": "ticks"}, "", "is in 'ticks'; expected one of"),
    "no radians": (RAD, "", "reaches 30, more than 12.57: it is not rad"),
    "another arm": (
        {"units": "normalised"}, "--calibration-file other.json",
        "other.json: has no drive_mode, range_min and range_max of shoulder_pan"),
    "no episode": (DEG, "--episodes 0-3,7", "there is no episode 2; it has 0 to 1"),
    "no list": (DEG, "--episodes 3-0", "'3-0' is no number or range; give 0-3,7"),
    "no camera": (DEG, "wrist=wrist", "has no such images; it has top"),
    "no name": (DEG, "wrist", "NAME=KEY of each camera, such as"),
    "readings too": (DEG, "--readings q.csv", "leave out --readings"),
    "no names": (DEG | {"names": None}, "", "observation.state has no names"),
    "fast": (DEG | {"fast": True}, "", "at all 24 frames a joint is faster than 5°/s"),
    "no table": (
        DEG | {"spoilt": "data/chunk-000/episode_000001.parquet"}, "",
        "episode_000001.parquet: cannot be read as Parquet"),
    "no list of episodes": (DEG | {"spoilt": "meta/episodes.jsonl"}, "", "episodes.jsonl: cannot be read: "),
    "no description": (DEG | {"spoilt": "meta/info.json"}, "", "info.json: is not JSON"),
    "other version": (DEG | {"version": "v1.6"}, "", "codebase_version is 1.6; 2.1 and 3.0 are read"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_data_sets_that_make_no_table(projservo, name):
    how, asked, message = REFUSED[name]
    spoilt = how.get("spoilt")
    put(**{key: value for key, value in how.items() if key != "spoilt"})
    Path("other.json").write_text("{}")
    if spoilt:
        Path("set", spoilt).write_bytes(b"PAR1\xff" if spoilt != "meta/info.json" else b"{")
    folder = "" if "--lerobot" in asked else "--lerobot set"
    answer = projservo("detect", *folder.split(), *asked.split(), "-o", "t.csv")
    assert answer.code == 2
    assert message in " ".join(answer.err.split()), answer.err
    assert not Path("t.csv").exists()


@pytest.mark.parametrize("spoilt", ["short", "no video"])
def test_videos_without_the_frame_of_a_state_are_named(projservo, spoilt):
    image = np.full((64, 64), 200, dtype=np.uint8)
    write_dataset(Path("set"), "v2.1", [(np.zeros((12, 4)), {"top": [image] * 12})], NAMES, units="deg")
    path = Path("set/videos/chunk-000/observation.images.top/episode_000000.mp4")
    if spoilt == "short":
        write_video(path, [image])
        table = pq.read_table("set/data/chunk-000/episode_000000.parquet")
        later = pa.array(np.float32(1.0 + np.arange(12) / FPS))
        table = table.set_column(table.column_names.index("timestamp"), "timestamp", later)
        pq.write_table(table, "set/data/chunk-000/episode_000000.parquet")
    else:
        path.write_bytes(b"no video")
    answer = projservo("detect", "--lerobot", "set", "-o", "t.csv")
    message = "has no frame at 1.000 s" if spoilt == "short" else "cannot be read as a video"
    assert (answer.code, f"episode_000000.mp4: {message}" in " ".join(answer.err.split())) == (2, True), (
        answer.err
    )


def test_without_packages_the_remedy_is_one_line(projservo, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    answer = projservo("detect", "--lerobot", "set", "-o", "t.csv")
    assert (answer.code, "episodes need pyarrow and PyAV: pip install '.[lerobot]'" in answer.err) == (
        2,
        True,
    )
