"""Bags of ROS 1 and 2: the table of a bag is that of its images at stops, in any storage and encoding."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.store.flange_poses import pose_columns
from projservo_cli.store.observation_tables import read_table, to_csv
from tests.detection.ros_bags import BOARD, OPTIONS, Bag, Show, cv2, mosaic, put_readings

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
        lambda bag, topic, t, image: bag.image(topic, t, mosaic(image, "gbrg"), "bayer_gbrg8"),
        lambda image: cv2.cvtColor(mosaic(image, "gbrg"), cv2.COLOR_BayerGBRG2GRAY),
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


def written(show, path, storage="mcap", encoding="mono8", readings="joints", motions=0):
    """Write a bag of a show, and its images at stops as files, with a table of readings."""
    put, as_file = ENCODINGS[encoding]
    bag = Bag(path, storage)
    put_readings(bag, show, readings)
    for side, frames in zip(("left", "right"), show.frames(motions), strict=True):
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


def same(table, files):
    """Whether the stops of a table of a bag are those of files."""
    rest = table.at_rest
    np.testing.assert_array_equal(rest.images, files.images)
    np.testing.assert_array_equal(rest.sigma, files.sigma)
    if files.flange_chart is None:
        np.testing.assert_array_equal(rest.q, files.q)
    else:
        of = (FlangeChart.from_record(each.flange_chart).poses(each.q) for each in (rest, files))
        np.testing.assert_allclose(*of, atol=1e-9)


@pytest.mark.parametrize(
    ("storage", "encoding", "readings"),
    [
        (storage, encoding, READINGS[(i + j) % 3])
        for (i, storage), (j, encoding) in product(enumerate(STORAGES), enumerate(ENCODINGS))
        if j < 3 or j % 3 == i
    ],
)
def test_a_bag_is_the_table_of_its_images(projservo, storage, encoding, readings):
    show = Show(4)
    path = {"ros1": "b.bag", "sqlite3": "b", "mcap": "b"}[storage]
    written(show, path, storage, encoding, readings, motions=1)
    path = "b/b.mcap" if storage == "mcap" and readings != "joints" else path  # with and without its folder
    answer = projservo("detect", "--bag", path, *IMAGES, *OPTIONS[readings], *DETECT, "-o", "b.csv", "--json")
    assert answer.code == 0, answer.err
    assert (answer.json["poses"], answer.json["poses_in_motion"] >= 10) == (4, True)
    answer = projservo("detect", "left", "right", "--readings", "q.csv", *DETECT, "-o", "f.csv")
    assert answer.code == 0, answer.err
    same(read_table("b.csv"), read_table("f.csv"))
