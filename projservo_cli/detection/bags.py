"""Bags of ROS 1 and ROS 2: images of topics, and readings of joints, poses or a chain of transforms.

Stamps are those of headers; where a header has none, the time at which the message was received.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli import messages
from projservo_cli.detection.bag_readings import JOINTS, POSE, TREES, Readings
from projservo_cli.detection.images import ImageSeries, decoded, opencv, unfit
from projservo_cli.detection.stops import STOP_S, shots
from projservo_cli.records import FloatArray, InputError, JointList

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
# Topic of CameraInfo next to one of images, without the name of how they are packed.
_INFO, _PACKED = "camera_info", "/compressed"
_STATIC = "_static"  # ends the topic of transforms that do not change
# Messages from one report of progress to the next.
_OFTEN = 50
_MOSAIC = "mosaic"
# Windows of a mosaic, in cells: of the means that are looked at, of the brightest of them, which is white
# on each side of an edge of a tag, and over which white is smoothed. On drawn tags before grey and coloured
# walls corners err 1.01 to 1.1 times as much as with all colours in each pixel, 1.4 times where blue is
# faint; with interpolated colours 1.3 to 1.9 times.
_MEAN, _WHITE, _SMOOTH = 5, 31, 61
# Channels of the encodings of sensor_msgs/image_encodings.hpp, and how OpenCV makes grey of them.
_GREY_OF = {
    "mono": (1, ""),
    **{name: (len(name), f"{name.upper()}2GRAY") for name in ("bgr", "rgb", "bgra", "rgba")},
    **{f"bayer_{name}": (1, _MOSAIC) for name in ("rggb", "bggr", "gbrg", "grbg")},
    "yuv422_": (2, "YUV2GRAY_UYVY"),
    "yuv422_yuy2_": (2, "YUV2GRAY_YUY2"),
}
_ALSO = {
    "8uc1": "mono8",
    "8uc3": "bgr8",
    "8uc4": "bgra8",
    "16uc1": "mono16",
    "yuv422": "yuv422_8",
    "yuv422_yuy2": "yuv422_yuy2_8",
}


class _Place(NamedTuple):
    """Place of a message in a bag."""

    topic: str
    received: int  # ns
    before: int  # number of messages of the topic before it that were received at the same time


class Bag:
    """An open bag."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path = path
        self._reader = reader

    def kind(self, topic: str) -> str:
        """Type of the messages of a topic. Raises InputError, which lists all topics, if there is none."""
        kinds = {connection.topic: str(connection.msgtype) for connection in self._reader.connections}
        if topic not in kinds:
            raise InputError(f"{self.path}: no topic {topic}; it has: {', '.join(sorted(kinds)) or 'none'}")
        return kinds[topic]

    def messages(
        self, topics: Sequence[str], progress: Callable[[str, int, int], None]
    ) -> Iterator[tuple[_Place, Any]]:
        """Read all messages of topics, if there are such, in the order in which they were received."""
        wanted = [connection for connection in self._reader.connections if connection.topic in topics]
        total = sum(connection.msgcount for connection in wanted)
        last = dict[str, _Place]()
        for done, (connection, received, content) in enumerate(self._raw(wanted), 1):
            place = _Place(connection.topic, received, 0)
            if (before := last.get(connection.topic)) and before.received == received:
                place = before._replace(before=before.before + 1)
            last[connection.topic] = place
            yield place, self._message(connection, content)
            if done % _OFTEN == 0 or done == total:
                progress("read", done, max(done, total))

    def message(self, place: _Place) -> Any:
        """Read one message."""
        wanted = [connection for connection in self._reader.connections if connection.topic == place.topic]
        found = self._raw(wanted, start=place.received, stop=place.received + 1)
        connection, _, content = next(islice(found, place.before, None))
        return self._message(connection, content)

    def _raw(self, wanted: list[Any], **times: int) -> Iterator[tuple[Any, int, bytes]]:
        with self._reading():
            yield from self._reader.messages(wanted, **times)

    def _message(self, connection: Any, content: bytes) -> Any:
        with self._reading():
            return self._reader.deserialize(content, connection.msgtype)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Turn errors of rosbags, which have many types in a file that is cut off, into InputErrors."""
        try:
            yield
        except Exception as error:
            raise InputError(
                f"{self.path}: a message cannot be read: {error}; record or copy it again"
            ) from error


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag: a file of ROS 1 or MCAP, or a folder of ROS 2. Raises InputError if it is none."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError("bags need rosbags: pip install '.[bags]'") from error
    try:  # early bags of ROS 2 say nothing of their types
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:
        raise InputError(
            f"{path}: no bag that can be read: {error}; give a .bag or .mcap file, or a folder of ROS 2"
        ) from error
    try:
        yield Bag(path, reader)
    finally:
        reader.close()


@dataclass(frozen=True)
class BagImage:
    """Image of a message."""

    bag: Bag
    place: _Place
    bits: int  # that grey values of 16 bit take in this topic

    def __str__(self) -> str:
        return f"{self.bag.path}: {self.place.topic} at {self.place.received * 1e-9:.3f} s"

    def grey(self) -> FloatArray:
        """Grey values (height, width). Raises InputError if the message holds none."""
        message = self.bag.message(self.place)
        if message.__msgtype__ == _COMPRESSED:
            return decoded(message.data.tobytes(), str(self))
        pixels, conversion = _pixels(message, str(self))
        if not conversion and pixels.dtype == np.uint8 and (wrong := unfit(pixels)):
            raise InputError(f"{self}: {messages.sentence_and_remedy(wrong)}")
        if conversion not in ("", _MOSAIC):
            cv = opencv()
            pixels = cv.cvtColor(pixels, getattr(cv, f"COLOR_{conversion}"))
        grey = pixels.astype(np.float64)
        if pixels.dtype != np.uint8:
            grey = grey * 255.0 / (2**self.bits - 1)
        return _levelled(grey) if conversion == _MOSAIC else np.asarray(grey)


def _levelled(mosaic: FloatArray) -> FloatArray:
    """Grey values (height, width) behind a mosaic of colour filters: white is as bright behind each.

    Tags are black and white, so each pixel shows their edges, which interpolated colours would blur.
    """
    cv, (height, width) = opencv(), mosaic.shape
    cells = np.pad(mosaic, ((0, height % 2), (0, width % 2)), mode="edge")
    parts = [cells[i::2, j::2] for i in range(2) for j in range(2)]
    means = [cv.blur(part, (_MEAN, _MEAN)) for part in parts]
    white = [cv.blur(cv.dilate(mean, np.ones((_WHITE, _WHITE))), (_SMOOTH, _SMOOTH)) for mean in means]
    most = np.maximum.reduce(white)
    for part, level in zip(parts, white, strict=True):
        part *= most / np.maximum(level, 1.0)
    return np.asarray(np.minimum(cells, 255.0)[:height, :width])


def _pixels(message: Any, where: str) -> tuple[Any, str]:
    """Values (height, width) or (height, width, channels) of an image, and how OpenCV makes grey of them."""
    encoding = message.encoding.strip().lower()
    form = re.fullmatch(r"(.*?)(8|16)", _ALSO.get(encoding, encoding))
    if form is None or form[1] not in _GREY_OF:
        raise InputError(
            f"{where}: the encoding {message.encoding!r} is not known; record mono8, bgr8, rgb8, "
            "bayer_rggb8, mono16 or the like, or compressed images"
        )
    channels, conversion = _GREY_OF[form[1]]
    height, width, step, size = message.height, message.width, message.step, int(form[2]) // 8
    row = width * channels * size
    if not row or step < row or len(message.data) < height * step:
        raise InputError(
            f"{where}: {len(message.data)} bytes in rows of {step} hold no {width}×{height} pixels of "
            f"{message.encoding}; record it again"
        )
    values = np.ascontiguousarray(message.data[: height * step].reshape(height, step)[:, :row])
    values = values.view(f"{'>' if message.is_bigendian else '<'}u{size}").astype(f"u{size}")
    return values.reshape((height, width, channels) if channels > 1 else (height, width)), conversion


class BagCamera(NamedTuple):
    """A camera as a message CameraInfo states it."""

    K: FloatArray  # (3, 3) px
    coefficients: FloatArray  # of its lens
    model: str  # of its lens
    size: tuple[int, int]  # width and height, px


def _cameras(
    infos: Mapping[str, tuple[str, set[tuple[Any, ...]]]], images: Sequence[BagImage], notes: list[str]
) -> dict[str, BagCamera]:
    """Cameras by name, by topics and contents of CameraInfo, and an image of each; notes on others."""
    found = {}
    for (name, (topic, contents)), image in zip(infos.items(), images, strict=True):
        if not contents:  # as most bags have none
            continue
        (width, height, model, D, K, P), (rows, columns) = next(iter(contents)), image.grey().shape
        straight = "image_rect" in image.place.topic  # such images have neither K nor lens of the camera
        matrix = np.reshape(P, (3, 4))[:, :3] if straight else np.reshape(K, (3, 3))
        if sum(topic == other for other, _ in infos.values()) > 1:
            why = "is next to images of several cameras"
        elif len(contents) > 1:
            why = f"has {len(contents)} contents, as of a camera with zoom or autofocus"
        elif not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
            why = "has a focal length of 0, as of a camera that is not calibrated"
        elif (width, height) != (columns, rows):
            why = f"is of {width}x{height} px, and the images are {columns}x{rows}, binned or cropped"
        else:
            found[name] = BagCamera(matrix, np.zeros(5) if straight else np.array(D), model, (width, height))
            continue
        notes.append(f"{image.bag.path}: {topic} {why}: nothing of it is taken")
    return found


def _content(info: Any) -> tuple[Any, ...]:
    """Size, model, coefficients, K and P of a CameraInfo, whose matrices ROS 1 writes in capitals."""
    D, K, P = (getattr(info, name if hasattr(info, "K") else name.lower()) for name in "DKP")
    numbers = (tuple(map(float, M)) for M in (D, K, P))
    return int(info.width), int(info.height), str(info.distortion_model), *numbers


class BagSeries(NamedTuple):
    """Images and readings of a bag, and notes on them."""

    series: ImageSeries
    fate: dict[str, dict[str, int]]  # of each camera, how many images became what
    notes: list[str]
    cameras: dict[str, BagCamera]  # as CameraInfo states them


def bag_series(
    bag: Bag,
    topics: Mapping[str, str],
    source: str,
    frames: tuple[str, str] | None,
    names: Sequence[str],
    progress: Callable[[str, int, int], None],
) -> BagSeries:
    """Read images and readings of a bag, and pair them at stops and in motion.

    topics : of the images, by the name of each camera.
    source : topic of the readings; frames : base and flange, if these are transforms; names : of the joints,
        in their order, by default all in the order of the messages.
    Raises InputError if a topic is missing or has no images or readings, or no stop shows in all cameras.
    """
    kind = bag.kind(source)
    if kind not in (JOINTS, POSE, *TREES):
        raise InputError(f"{bag.path}: {source} has {kind}; give a topic of JointState, PoseStamped or tf")
    if kind in TREES and frames is None:
        raise InputError(f"{bag.path}: {source} has transforms; name two frames, --frames BASE FLANGE")
    if kind not in TREES and frames is not None:
        raise InputError(f"{bag.path}: {source} has {kind}, no transforms; leave out --frames")
    for topic in topics.values():
        if (shown := bag.kind(topic)) not in (_IMAGE, _COMPRESSED):
            raise InputError(f"{bag.path}: {topic} has {shown}; give a topic of Image or CompressedImage")
    where, notes = f"{bag.path}: {source}", list[str]()
    unstamped, peak = Counter[str](), Counter[str]()
    taken = {topic: list[tuple[int, _Place]]() for topic in topics.values()}
    readings = Readings(where, notes)
    beside = {
        name: f"{topic.removesuffix(_PACKED).rpartition('/')[0]}/{_INFO}" for name, topic in topics.items()
    }
    contents = {topic: set[tuple[Any, ...]]() for topic in beside.values()}
    infos = {name: (topic, contents[topic]) for name, topic in beside.items()}
    for place, message in bag.messages([source, source + _STATIC, *taken, *contents], progress):
        if place.topic in contents:
            contents[place.topic].add(_content(message))
        elif hasattr(message, "transforms"):
            for part in message.transforms:
                constant = place.topic != source
                stamp = 0 if constant else _stamp(part.header, place, unstamped)
                readings.add_transform(stamp, part)
        elif place.topic in taken:
            taken[place.topic].append((_stamp(message.header, place, unstamped), place))
            if message.__msgtype__ == _IMAGE and "16" in message.encoding:
                values = _pixels(message, f"{bag.path}: {place.topic}")[0]
                peak[place.topic] = max(peak[place.topic], int(values.max()))
        elif place.topic == source:
            add = readings.add_joints if kind == JOINTS else readings.add_pose
            add(_stamp(message.header, place, unstamped), message)
    first, stream = readings.stream(frames, names)
    notes += [
        f"{bag.path}: {topic}: {count} headers have no stamp: the time of receipt stands for it"
        for topic, count in unstamped.items()
        if count
    ]
    bits = {topic: max(8, most.bit_length()) for topic, most in peak.items()}
    notes += [f"{bag.path}: {topic}: {n} of 16 bit are used, and scaled to 8" for topic, n in bits.items()]
    images = list[list[tuple[float, BagImage]]]()
    for topic in topics.values():
        named = [(stamp, BagImage(bag, place, bits.get(topic, 8))) for stamp, place in sorted(taken[topic])]
        images.append([(1e-9 * (stamp - first), image) for stamp, image in named])
    for topic, row in zip(topics.values(), images, strict=True):
        if not row or row[-1][0] < 0.0 or row[0][0] > stream.t[-1]:
            raise InputError(
                f"{bag.path}: {topic}: {len(row)} images, none of the time of the readings of {source}; "
                "record both together, with stamps of one clock"
            )
    found = shots(stream, [np.array([t for t, _ in row]) for row in images])
    if not (found.moving == 0).any():
        raise InputError(
            f"{where}: the robot stands still nowhere for {STOP_S:g} s with an image of each camera; stop it "
            "at each pose while you record"
        )
    t_view, rows = np.full(found.image.shape, np.nan), list[tuple[BagImage | None, ...]]()
    for t, numbers in zip(t_view, found.image.tolist(), strict=True):
        pairs = [images[v][i] if i >= 0 else (np.nan, None) for v, i in enumerate(numbers)]
        t[:] = [time for time, _ in pairs]
        rows.append(tuple(image for _, image in pairs))
    chart = None if stream.chart is None else stream.chart.record
    joints = JointList(np.arange(len(rows)), found.q, numbered=True, flange_chart=chart)
    series = ImageSeries(tuple(topics), joints, rows)
    if found.moving.any():
        series = series._replace(moving=found.moving, t_q=found.t_q, t_view=t_view)
    cameras = _cameras(infos, [row[0][1] for row in images], notes)
    return BagSeries(series, dict(zip(topics, map(dict, found.fate), strict=True)), notes, cameras)


def _stamp(header: Any, place: _Place, unstamped: Counter[str]) -> int:
    """Stamp of a header, ns; when the message was received, and one more in ``unstamped``, if it has none."""
    stamp = int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
    unstamped[place.topic] += not stamp
    return stamp or place.received
