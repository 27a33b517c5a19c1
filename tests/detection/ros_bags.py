"""Bags of ROS 1 and 2 of a simulated robot that carries a board from stop to stop before two cameras."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from projservo_cli.detection.finders import Board
from tests.calibration.simulated_robot import Robot, around, random_robot
from tests.detection.boards import drawn

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install '.[detect]'")
pytest.importorskip("rosbags", reason="rosbags is not installed: pip install '.[bags]'")

from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

SIZE = (320, 240)
BOARD = Board.of("charuco:5x4")
PLACES = BOARD.grid_points - BOARD.grid_points.mean(axis=0)
STOP_S, MOVE_S, READ_S, FRAME_S = 0.8, 0.6, 0.02, 0.2  # durations of a stop and a motion, periods
BEGIN = 1_700_000_000  # s
FIXED = {  # transforms that do not change, by parent and child
    ("world", "base"): ([0.3, -0.2, 0.1], [0.1, 0.2, -0.3]),
    ("base", "column"): ([0.0, 0.0, 0.4], [0.0, 0.0, 0.5]),
    ("wrist", "flange"): ([0.02, 0.01, 0.07], [0.3, -0.1, 0.2]),
}


def rigid(place, turn):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    return T


class Show:
    """A robot that carries the board, its motion from stop to stop, and what cameras see of it.

    delay : time, s, that an image is later stamped than what it shows.
    """

    def __init__(self, stops, seed=3, delay=0.0, types="RRRRRR"):
        self.rng, self.delay = np.random.default_rng(seed), delay
        arm = vars(random_robot(types, np.random.default_rng(seed)))
        body = np.c_[0.14 * PLACES, np.zeros(len(PLACES)), np.ones(len(PLACES))]
        self.arm = Robot(**(arm | {"markers": body, "cameras": np.diag([0.25, 0.25, 1.0]) @ arm["cameras"]}))
        self.stops = around(self.arm, stops, self.rng, angle=0.35)
        self.period = STOP_S + MOVE_S
        self.end = stops * STOP_S + (stops - 1) * MOVE_S

    def joints(self, t):
        """Joints (k, n) at times (k,), s: smoothly from stop to stop."""
        number = np.clip(np.floor(t / self.period).astype(int), 0, len(self.stops) - 1)
        after = np.clip(number + 1, 0, len(self.stops) - 1)
        share = np.clip((t - number * self.period - STOP_S) / MOVE_S, 0.0, 1.0)[:, None]
        return self.stops[number] + (0.5 - 0.5 * np.cos(np.pi * share)) * (
            self.stops[after] - self.stops[number]
        )

    def links(self, q):
        """Wrist in column: the first half of the arm, and the second in it."""
        parts = [np.eye(4), np.eye(4)]
        for i, (twist, amount) in enumerate(zip(self.arm.twists, q - self.arm.q_reference, strict=True)):
            parts[2 * i >= len(q)] = parts[2 * i >= len(q)] @ expm(twist * amount)
        return parts

    def flange(self, q):
        """Flange in the base."""
        first, second = self.links(q)
        return rigid(*FIXED["base", "column"]) @ first @ second @ rigid(*FIXED["wrist", "flange"])

    def image(self, q, view, blur=0.8, noise=2.0):
        H = cv2.findHomography(PLACES, self.arm.images(q[None])[0, view])[0]
        return drawn(BOARD, H, blur, noise, self.rng, SIZE)[0]

    def frames(self, motions=0):
        """Times and images of each camera: several of one image at each stop, and others in some motions."""
        found = [[], []]
        for view, frames in enumerate(found):
            for k, q in enumerate(self.stops):
                image = self.image(q, view)
                begin = k * self.period + self.delay + 0.01 * view
                frames += [(begin + FRAME_S * i, image) for i in range(1, int(STOP_S / FRAME_S))]
                if k < min(motions, len(self.stops) - 1):
                    times = k * self.period + STOP_S + np.arange(0.03, MOVE_S, 0.06) + 0.01 * view
                    rows = self.joints(times)
                    frames += [
                        (t + self.delay, self.image(q, view)) for t, q in zip(times, rows, strict=True)
                    ]
            frames.sort(key=lambda frame: frame[0])
        return found


class Bag:
    """A bag that is written: ``ros1``, ``sqlite3`` or ``mcap``."""

    def __init__(self, path, storage):
        self.one = storage == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.one else Stores.ROS2_HUMBLE)
        if self.one:
            tree = get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
            self.store.register(tree)
            self.writer = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(path, version=9, storage_plugin=plugin)
        self.connections, self.waiting = {}, []

    def type(self, name):
        return self.store.types[name]

    def header(self, t, frame=""):
        sec, nanosec = divmod(round((BEGIN + t) * 1e9), 10**9) if t is not None else (0, 0)
        stamp = self.type("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
        number = {"seq": 0} if self.one else {}
        return self.type("std_msgs/msg/Header")(**number, stamp=stamp, frame_id=frame)

    def put(self, topic, received, message):
        self.waiting.append((round((BEGIN + received) * 1e9), topic, message))

    def close(self):
        with self.writer:
            for received, topic, message in sorted(self.waiting, key=lambda row: row[0]):
                name = message.__msgtype__
                if topic not in self.connections:
                    self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
                write = self.store.serialize_ros1 if self.one else self.store.serialize_cdr
                self.writer.write(self.connections[topic], received, write(message, name))

    def image(self, topic, t, pixels, encoding="mono8", *, stamp=True, big=False, pad=0):
        """An image, perhaps with padding, big end first, or without a stamp."""
        rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).reshape(len(pixels), -1)
        rows = np.pad(rows.view(np.uint8), ((0, 0), (0, pad)), constant_values=7)
        message = self.type("sensor_msgs/msg/Image")(
            header=self.header(t if stamp else None), height=pixels.shape[0], width=pixels.shape[1],
            encoding=encoding, is_bigendian=int(big), step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip
        self.put(topic, t + 0.004, message)

    def camera_info(self, topic, t, size, K, D, model="plumb_bob", P=None):
        """A CameraInfo, whose matrices have capitals in ROS 1."""
        P = np.column_stack([K, np.zeros(3)]) if P is None else P
        matrices = {"D": np.array(D), "K": np.ravel(K), "R": np.eye(3).ravel(), "P": np.ravel(P)}
        cases = {name if self.one else name.lower(): values for name, values in matrices.items()}
        roi = self.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        message = self.type("sensor_msgs/msg/CameraInfo")(
            header=self.header(t), width=size[0], height=size[1], distortion_model=model, **cases,
            binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip
        self.put(topic, t + 0.002, message)

    def compressed(self, topic, t, content, form="jpeg"):
        message = self.type("sensor_msgs/msg/CompressedImage")(
            header=self.header(t), format=form, data=np.frombuffer(content, np.uint8)
        )
        self.put(topic, t + 0.004, message)

    def joints(self, topic, t, names, position):
        nothing = np.zeros(0)
        message = self.type("sensor_msgs/msg/JointState")(
            header=self.header(t), name=list(names), position=np.asarray(position, dtype=float),
            velocity=nothing, effort=nothing,
        )  # fmt: skip
        self.put(topic, t + 0.001, message)

    def _parts(self, T):
        turn = dict(zip("xyzw", Rotation.from_matrix(T[:3, :3]).as_quat(), strict=True))
        return dict(zip("xyz", T[:3, 3], strict=True)), self.type("geometry_msgs/msg/Quaternion")(**turn)

    def pose(self, topic, t, T):
        place, turn = self._parts(T)
        pose = self.type("geometry_msgs/msg/Pose")(
            position=self.type("geometry_msgs/msg/Point")(**place), orientation=turn
        )
        message = self.type("geometry_msgs/msg/PoseStamped")(header=self.header(t, "base"), pose=pose)
        self.put(topic, t + 0.001, message)

    def transforms(self, topic, t, parts):
        """Transforms by parent and child."""
        rows = []
        for (parent, child), T in parts.items():
            place, turn = self._parts(T)
            T = self.type("geometry_msgs/msg/Transform")(
                translation=self.type("geometry_msgs/msg/Vector3")(**place), rotation=turn
            )
            header = self.header(t, parent)
            rows.append(
                self.type("geometry_msgs/msg/TransformStamped")(
                    header=header, child_frame_id=child, transform=T
                )
            )
        self.put(topic, t + 0.001, self.type("tf2_msgs/msg/TFMessage")(transforms=rows))


NAMES = tuple(f"joint_{letter}" for letter in "cafbed")  # not in the order of the alphabet
OPTIONS = {
    "joints": ["--readings-topic", "/joint_states"],
    "poses": ["--readings-topic", "/pose"],
    "tf": ["--readings-topic", "/tf", "--frames", "base", "flange"],
}


def put_readings(bag, show, kind):
    """Readings of a show, in three forms."""
    times = np.arange(0.0, show.end + READ_S, READ_S)
    q = show.joints(times)
    if kind == "tf":
        bag.transforms("/tf_static", 0.0, {pair: rigid(*values) for pair, values in FIXED.items()})
    for k, (t, row) in enumerate(zip(times, q, strict=True)):
        if kind == "joints":
            order = list(range(len(row)))[:: -1 if k % 2 else 1]  # names tell which is which
            bag.joints("/joint_states", t, [NAMES[i] for i in order], row[order])
        elif kind == "poses":
            bag.pose("/pose", t, show.flange(row))
        else:
            bag.transforms("/tf", t, {("column", "elbow"): show.links(row)[0]})
            later = t + 0.004  # each part has stamps of its own
            second = show.links(show.joints(np.array([later]))[0])[1]
            bag.transforms("/tf", later, {("elbow", "wrist"): second})


def mosaic(image, pattern="rggb"):
    """Values behind a mosaic of colour filters: of a grey scene, by a camera of three sensitivities."""
    gain = {"r": 0.8, "g": 1.0, "b": 0.6}
    cells = np.array([gain[letter] for letter in pattern]).reshape(2, 2)
    return np.round(image * np.tile(cells, (image.shape[0] // 2, image.shape[1] // 2))).astype(image.dtype)
