"""Bags of ROS 1 and 2: the table of a bag is that of its images at stops, in any storage and encoding."""

import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import projservo_cli
from projservo_cli.calibration.prediction import predict
from projservo_cli.detection.bags import bag_series, open_bag
from projservo_cli.detection.stops import Stream
from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.records import InputError
from projservo_cli.store.camera_files import camera_info, read_intrinsics
from projservo_cli.store.flange_poses import pose_columns
from projservo_cli.store.observation_tables import read_table, to_csv
from tests.calibration.simulated_robot import around
from tests.detection.ros_bags import (
    BEGIN,
    BOARD,
    MOVE_S,
    NAMES,
    OPTIONS,
    SIZE,
    STOP_S,
    Bag,
    Show,
    cv2,
    mosaic,
    put_readings,
)

DETECT = ["--board", str(BOARD), "--dictionary", "4X4_250"]
IMAGES = ["--images", "left=/left", "right=/right"]
STORAGES, READINGS = ("ros1", "sqlite3", "mcap"), tuple(OPTIONS)


def jpeg(image, quality=95):
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def grey16(image, bits):
    """Grey values of so many bits, of which the lower ones are lost on files of 8."""
    return (image.astype(np.uint32) * (2**bits - 1) // 255).astype(np.uint16)


def colours(image, count):
    return np.repeat(image[..., None], count, axis=2)


# How images are put into a bag, and the file whose grey values are the same.
ENCODINGS = {
    "mono8": (lambda bag, topic, t, image: bag.image(topic, t, image, pad=5), None),
    "jpeg": (lambda bag, topic, t, image: bag.compressed(topic, t, jpeg(image)), jpeg),
    "bayer_gbrg8": (
        lambda bag, topic, t, image: bag.image(topic, t, mosaic(image, "gbrg"), "bayer_gbrg8"), None
    ),
    "rgb8": (lambda bag, topic, t, image: bag.image(topic, t, colours(image, 3), "rgb8", pad=2), None),
    "bgra8": (lambda bag, topic, t, image: bag.image(topic, t, colours(image, 4), "bgra8"), None),
    "mono16": (
        lambda bag, topic, t, image: bag.image(topic, t, grey16(image, 16), "mono16", big=True, pad=6), None
    ),
}  # fmt: skip


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def written(show, shown, path, storage, encoding, readings):
    """Write a bag of a show, and its images at stops as files, with a table of readings."""
    put, as_file = ENCODINGS[encoding]
    bag = Bag(path, storage)
    put_readings(bag, show, readings)
    for side, frames in zip(("left", "right"), shown, strict=True):
        Path(side).mkdir(exist_ok=True)
        last, number = None, 0
        for t, image in frames:
            put(bag, f"/{side}", t, image)
            if image is last:  # the image of a stop comes again
                content = image if as_file is None else as_file(image)
                content = (
                    content if isinstance(content, bytes) else cv2.imencode(".png", content)[1].tobytes()
                )
                ending = "jpg" if encoding == "jpeg" else "png"
                Path(side, f"{number // 2}.{ending}").write_bytes(content)
                number += 1
            last = image
    bag.close()
    poses = {"pose": np.arange(len(show.stops))}
    if readings == "joints":
        poses |= {f"q{i}": column for i, column in enumerate(show.stops.T, 1)}
    else:
        poses |= pose_columns(np.array([show.flange(q) for q in show.stops]))
    Path("q.csv").write_text(to_csv(poses))


def same(table, files, exact):
    """Whether the stops of a table of a bag are those of files, to the bit or to some thousandths of a px."""
    rest = table.at_rest
    if exact:
        np.testing.assert_array_equal(rest.images, files.images)
        np.testing.assert_array_equal(rest.sigma, files.sigma)
    else:
        off = rest.images - files.images
        assert np.isfinite(off).mean() > 0.95
        assert np.nanmean(off**2) ** 0.5 < 0.005
    if files.flange_chart is None:
        np.testing.assert_array_equal(rest.q, files.q)
    else:
        of = (FlangeChart.from_record(each.flange_chart).poses(each.q) for each in (rest, files))
        np.testing.assert_allclose(*of, atol=1e-9)


SHORT = Show(3)
FRAMES = SHORT.frames(1)


@pytest.mark.parametrize(
    ("storage", "encoding", "readings"),
    [
        (storage, encoding, READINGS[(i + j) % 3])
        for (i, storage), (j, encoding) in product(enumerate(STORAGES), enumerate(ENCODINGS))
        if j < 3 or j % 3 == i
    ],
)
def test_a_bag_is_the_table_of_its_images(projservo, storage, encoding, readings):
    path = "b.bag" if storage == "ros1" else "b"
    written(SHORT, FRAMES, path, storage, encoding, readings)
    path = "b/b.mcap" if storage == "mcap" and readings != "joints" else path  # with and without its folder
    answer = projservo("detect", "--bag", path, *IMAGES, *OPTIONS[readings], *DETECT, "-o", "b.csv", "--json")
    assert answer.code == 0, answer.err
    assert (answer.json["poses"], answer.json["poses_in_motion"]) == (3, 22)
    answer = projservo("detect", "left", "right", "--readings", "q.csv", *DETECT, "-o", "f.csv")
    assert answer.code == 0, answer.err
    same(read_table("b.csv"), read_table("f.csv"), exact="bayer" not in encoding)


@pytest.mark.parametrize(
    ("storage", "encoding", "readings", "types", "stops"),
    [("ros1", "bayer_gbrg8", "joints", "RRR", 12), ("mcap", "jpeg", "tf", "RRRRRR", 18)],
)
def test_a_bag_calibrates_as_its_images_and_shows_the_delay(
    projservo, storage, encoding, readings, types, stops
):
    show = Show(stops, delay=0.05, types=types)
    path = "b.bag" if storage == "ros1" else "b"
    written(show, show.frames(2), path, storage, encoding, readings)
    for command in (
        ["detect", "--bag", path, *IMAGES, *OPTIONS[readings], *DETECT, "-o", "b.csv"],
        ["detect", "left", "right", "--readings", "q.csv", *DETECT, "-o", "f.csv"],
        ["calibrate", "--data", "b.csv", "--image-size", "320x240", "-o", "b.run"],
        ["calibrate", "--data", "f.csv", "--image-size", "320x240", "-o", "f.run"],
    ):
        answer = projservo(*command)
        assert answer.code == 0, answer.err
    q = around(show.arm, 40, np.random.default_rng(9), angle=0.3)
    of_bag, of_files = (projservo_cli.load(f"{name}.run").calibration for name in "bf")
    rms = []
    for found in (of_bag, of_files):
        at = q
        if found.flange_chart is not None:
            at = FlangeChart.from_record(found.flange_chart).coordinates(np.array([*map(show.flange, q)]))
        rms.append(np.sqrt(np.nanmean((predict(found, at) - show.arm.images(q)) ** 2)))
    assert rms[0] < 1.05 * rms[1] < 0.01
    np.testing.assert_allclose(of_bag.time_offset.time_offset_s, 0.05, atol=0.002)


# Errors of readings, and whether a joint that stands still is among them.
ERRORS = {
    "none": lambda q, rng: q,
    "noise": lambda q, rng: q + 1e-3 * rng.standard_normal(q.shape),
    "counts": lambda q, rng: np.round((q + 3e-4 * rng.standard_normal(q.shape)) / 1.5e-3) * 1.5e-3,
    "still joint": lambda q, rng: np.c_[q, 0.3 + 1e-4 * rng.standard_normal(len(q))],
}


@pytest.mark.parametrize(("name", "rate"), [*product(ERRORS, [10, 50, 250])])
def test_every_stop_is_found_whatever_the_noise_and_the_rate(rng, name, rate):
    show = Show(12)
    t = np.arange(0.0, show.end, 1.0 / rate)
    t += rng.uniform(-0.1, 0.1, len(t)) / rate
    stops = Stream(t, ERRORS[name](show.joints(t), rng)).stops()
    begins = np.arange(12) * show.period
    middle = begins + 0.5 * STOP_S
    number = np.searchsorted(begins, stops.mean(axis=1)) - 1
    assert {*number.tolist()} == {*range(12)}
    assert (np.abs(stops - np.c_[begins, begins + STOP_S][number]) < 0.5 * MOVE_S).all()
    assert (np.abs(middle[number] - stops.mean(axis=1)) < 0.3).all()


def test_a_robot_that_always_moves_has_no_stop():
    t = np.arange(0.0, 20.0, 0.01)
    for q in (0.05 * t, np.sin(t), np.round(0.05 * t / 1e-3) * 1e-3):
        assert len(Stream(t, np.c_[q, 0.5 * q]).stops()) == 0


def simple(path, storage="sqlite3", stops=3, **cameras):
    """Write a bag of small images without markers, of one camera unless others are given, and close it."""
    show, bag, image = Show(stops), Bag(path, storage), np.zeros((8, 8), dtype=np.uint8)
    put_readings(bag, show, "joints")
    for topic, times in ({"/left": np.arange(0.1, show.end, 0.1)} | cameras).items():
        for t in times:
            bag.image(topic, t, image)
    return show, bag


def series(path="b", source="/joint_states", frames=None, names=(), **topics):
    """What is read of a bag, each image looked at."""
    with open_bag(Path(path)) as bag:
        found = bag_series(bag, topics or {"left": "/left"}, source, frames, names, lambda *_: None)
        for row in found.series.images:
            for stored in row:
                assert stored is None or stored.grey().shape == (8, 8)
    return found


def test_every_image_is_counted():
    """Of one camera that is off at a stop, of images before and after all readings, and in a gap."""
    show, bag = simple("b", **{"/right": np.arange(1.5, 5.0, 0.1)})
    bag.image("/left", -1.0, np.zeros((8, 8), dtype=np.uint8))
    bag.image("/left", show.end + 2.0, np.zeros((8, 8), dtype=np.uint8))
    gap = range(round((BEGIN + 2.2) * 1e9), round((BEGIN + 2.7) * 1e9))
    bag.waiting = [row for row in bag.waiting if row[1] != "/joint_states" or row[0] not in gap]
    bag.close()
    found = series(left="/left", right="/right")
    total = {topic: sum(row[1] == f"/{topic}" for row in bag.waiting) for topic in ("left", "right")}
    assert {name: sum(fate.values()) for name, fate in found.fate.items()} == total
    assert found.fate["left"]["at stops"] == found.fate["right"]["at stops"] == 2
    assert found.fate["left"]["at stops of which another camera has none"] >= 5
    assert found.fate["left"]["without readings at their time"] >= 4
    assert not {-1.0, show.end + 2.0} & {*found.series.t_view[:, 0]}


def test_joints_are_taken_by_name_from_several_publishers():
    """Grippers publish on the same topic; names choose joints and their order."""
    show, bag = simple("b")
    for t in np.arange(0.0, show.end, 0.1):
        bag.joints("/joint_states", t + 0.005, ["finger"], [0.01])
    bag.joints("/joint_states", 0.5051, NAMES, [])
    bag.close()
    found = series()
    rest = found.series.joints.q[found.series.moving == 0]
    np.testing.assert_array_equal(rest, show.stops)
    assert any("37 of 219 messages have other joints or no positions" in note for note in found.notes), (
        found.notes
    )
    assert any(f"q1 … q6 are {', '.join(NAMES)}" in note for note in found.notes)
    found = series(names=NAMES[3:1:-1])
    np.testing.assert_array_equal(found.series.joints.q[found.series.moving == 0], show.stops[:, 3:1:-1])


def test_headers_without_stamps_have_the_time_of_receipt_which_is_said():
    show, bag = simple("b")
    bag.waiting = [row for row in bag.waiting if row[1] != "/left"]
    for t in np.arange(0.1, show.end, 0.1):
        bag.image("/left", t, np.zeros((8, 8), dtype=np.uint8), stamp=False)
    bag.close()
    found = series()
    assert any("/left: 35 headers have no stamp" in note for note in found.notes), found.notes
    assert found.fate["left"]["at stops"] == 3


def test_grey_values_of_twelve_bits_are_scaled_by_their_range():
    show, bag = simple("b.bag", "ros1")
    bag.waiting = [row for row in bag.waiting if row[1] != "/left"]
    pixels = np.linspace(0, 4095, 64).round().astype(np.uint16).reshape(8, 8)
    for t in np.arange(0.1, show.end, 0.1):
        bag.image("/left", t, pixels, "16UC1", big=True, pad=3)
    bag.close()
    with open_bag(Path("b.bag")) as bag:
        found = bag_series(bag, {"left": "/left"}, "/joint_states", None, (), lambda *_: None)
        np.testing.assert_allclose(found.series.images[0][0].grey(), pixels / 4095 * 255, atol=1e-12)
    assert any("/left: 12 of 16 bit are used" in note for note in found.notes)


K8 = np.array([[10.0, 0.0, 4.1], [0.0, 11.0, 3.9], [0.0, 0.0, 1.0]])
SMALLER = np.c_[0.9 * K8[:, :2], K8[:, 2], np.zeros(3)]
LENS = [-0.01, 0.001, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("storage", "topic", "model", "lens"),
    [
        ("ros1", "/cam/image_raw", "plumb_bob", LENS),
        ("sqlite3", "/cam/image_raw/compressed", "rational_polynomial", [*LENS, 0.0, 0.0, 0.0]),
        ("mcap", "/cam/image_rect", "plumb_bob", LENS),
    ],
)
def test_camera_info_next_to_images_becomes_a_file_of_a_camera(projservo, storage, topic, model, lens):
    """K of raw images and their lens; of rectified ones K of the projection, and no lens."""
    path = "b.bag" if storage == "ros1" else "b"
    show, bag = simple(path, storage, stops=4)
    for t in np.arange(0.1, show.end, 0.1):
        bag.camera_info("/cam/camera_info", t, (8, 8), K8, lens, model, SMALLER)
        if "compressed" in topic:
            bag.compressed(topic, t, cv2.imencode(".png", np.zeros((8, 8), dtype=np.uint8))[1].tobytes())
        else:
            bag.image(topic, t, np.zeros((8, 8), dtype=np.uint8))
    bag.close()
    found = series(path, eye=topic).cameras["eye"]
    rectified = topic.endswith("rect")
    np.testing.assert_array_equal(found.K, SMALLER[:, :3] if rectified else K8)
    assert (found.size, found.model) == ((8, 8), model)
    Path("eye.yaml").write_text(camera_info("eye", *found))
    read = read_intrinsics("eye.yaml")
    np.testing.assert_array_equal(read.K, found.K)
    assert (read.size, read.lens[3:].any()) == ((8, 8), not rectified)


NOT_TAKEN = {
    "is of 16x16 px, and the images are 8x8": [((16, 16), K8)],
    "has a focal length of 0": [((8, 8), 0.0 * K8)],
    "has 2 contents": [((8, 8), K8), ((8, 8), 1.1 * K8)],
}


@pytest.mark.parametrize("why", NOT_TAKEN)
def test_camera_info_of_other_images_is_said_and_not_taken(why):
    _, bag = simple("b", **{"/cam/image_raw": np.arange(0.1, 4.0, 0.1)})
    for t, content in enumerate(NOT_TAKEN[why]):
        bag.camera_info("/cam/camera_info", 0.5 + t, *content, LENS)
    bag.close()
    found = series(eye="/cam/image_raw")
    assert found.cameras == {}
    assert any(f"/cam/camera_info {why}" in note for note in found.notes), found.notes


def test_camera_info_next_to_two_cameras_is_taken_for_none():
    _, bag = simple("b", **{"/right": np.arange(0.1, 5.0, 0.1)})
    bag.camera_info("/camera_info", 0.5, (8, 8), K8, LENS)
    bag.close()
    found = series(left="/left", right="/right")
    assert found.cameras == {}
    assert any("is next to images of several cameras" in note for note in found.notes), found.notes


def test_files_of_cameras_are_written_next_to_the_table_and_replaced_on_request(projservo):
    """For a calibration by them."""
    show, bag = Show(3), Bag("b", "mcap")
    put_readings(bag, show, "joints")
    for t, image in show.frames()[0]:
        bag.image("/cam/image_raw", t, image)
        bag.camera_info("/cam/camera_info", t, SIZE, np.diag([40.0, 40.0, 1.0]) @ K8, LENS)
    bag.close()
    words = ["--bag", "b", "--images", "eye=/cam/image_raw", *OPTIONS["joints"], *DETECT, "-o", "t.csv"]
    answer = projservo("detect", *words, "--json")
    assert answer.code == 0, answer.err
    assert answer.json["intrinsics"] == {"eye": str(Path("t_eye.yaml").resolve())}
    np.testing.assert_array_equal(read_intrinsics("t_eye.yaml").K[:2], 40.0 * K8[:2])
    Path("t.csv").unlink()
    answer = projservo("detect", *words)
    assert (answer.code, "t_eye.yaml" in answer.err, Path("t.csv").exists()) == (2, True, False)


REFUSED = {
    "no such topic": (["--images", "left=/cam"], "b: no topic /cam; it has: /depth, /joint_states, /late"),
    "readings as images": (["--images", "left=/joint_states"], "give a topic of Image or CompressedImage"),
    "images as readings": (["--readings-topic", "/left"], "give a topic of JointState, PoseStamped or tf"),
    "no frames": (["--readings-topic", "/tf"], "name two frames, --frames BASE FLANGE"),
    "frames of joints": (["--frames", "base", "flange"], "leave out --frames"),
    "no such frame": (
        ["--readings-topic", "/tf", "--frames", "base", "hand"],
        "there are: base, column, earth",
    ),
    "no chain": (["--readings-topic", "/tf", "--frames", "base", "moon"], "no common parent"),
    "nothing moves": (["--readings-topic", "/tf", "--frames", "base", "column"], "does not move in base"),
    "no such joint": (["--joint-names", "hand"], "no joint hand; there are: joint_a, joint_b"),
    "encoding": (["--images", "left=/depth"], "the encoding '32FC1' is not known"),
    "other clock": (["--images", "left=/late"], "none of the time of the readings"),
    "no bag": (["--bag", "q.txt"], "q.txt: no bag that can be read"),
    "no file": (["--bag", "nowhere"], "nowhere: no bag that can be read"),
    "both": (["--readings", "q.csv"], "name the readings by --readings-topic"),
}


@pytest.fixture(scope="module")
def odd_bag(tmp_path_factory):
    """A bag with a chain of transforms, another frame, depths, and images of another time."""
    path = tmp_path_factory.mktemp("odd") / "b"
    show, bag = simple(path, **{"/late": np.arange(100.0, 101.0, 0.1)})
    put_readings(bag, show, "tf")
    bag.transforms("/tf", 0.0, {("earth", "moon"): np.eye(4)})
    for t in np.arange(0.1, show.end, 0.1):
        bag.image("/depth", t, np.ones((8, 8), dtype=np.float32), "32FC1")
    bag.close()
    return path


@pytest.mark.parametrize("name", REFUSED)
def test_bags_that_make_no_table(projservo, odd_bag, name):
    options, message = REFUSED[name]
    Path("b").symlink_to(odd_bag)
    Path("q.txt").write_text("no bag")
    given = {"--bag": ["b"], "--images": ["left=/left"], "--readings-topic": ["/joint_states"]}
    given |= {options[0]: []} | ({"--readings-topic": []} if "--readings-topic" in options else {})
    words = [word for option, values in given.items() if values for word in (option, *values)]
    answer = projservo("detect", *words, *options, "-o", "t.csv", "-q")
    assert (answer.code, answer.err.count("\n")) == (2, 1), answer.err
    assert message in answer.err


def test_options_of_a_bag_need_one(projservo):
    answer = projservo("detect", "a", "b", "--readings", "q.csv", *OPTIONS["tf"], "-o", "t.csv")
    assert (answer.code, "are of a --bag" in answer.err) == (2, True)


def test_a_robot_that_stops_nowhere_is_told_to_stop():
    bag = Bag("b", "mcap")
    for t in np.arange(0.0, 5.0, 0.02):
        bag.joints("/joint_states", t, ["a", "b"], [np.sin(t), np.cos(2 * t)])
        bag.image("/left", t, np.zeros((8, 8), dtype=np.uint8))
    bag.close()
    with pytest.raises(InputError, match=r"stands still nowhere for 0\.3 s"):
        series()


def test_a_bag_that_is_cut_off_is_named(projservo):
    _, bag = simple("b.bag", "ros1")
    bag.close()
    content = Path("b.bag").read_bytes()
    for share in (0.3, 0.7, 0.95):
        Path("c.bag").write_bytes(content[: int(share * len(content))])
        answer = projservo(
            "detect", "--bag", "c.bag", "--images", "left=/left", *OPTIONS["joints"], "-o", "t.csv"
        )
        assert (answer.code, "c.bag: " in answer.err) == (2, True), answer.err


def test_without_rosbags_the_remedy_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match=r"bags need rosbags: pip install '\.\[bags\]'"), open_bag(Path("b")):
        pass
