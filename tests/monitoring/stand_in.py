"""An arm that stands in for a hobbyist's: servos, free-running cameras, tags, and what may befall them.

A class of the contract, ``plant.use: tests.monitoring.stand_in:StandIn``. Its corners err as those of a
finder do (``corners.py``); nothing is rendered. Time passes in ``command`` alone.
Faults begin at a time, s, and all but those of joints hold for frames exposed from then on:

    {kind: shift, views: [0], by: [8, 0]}             image shifted by px
    {kind: turn, views: [0], axis: 0, by: 0.01}       camera turned about its axis, rad
    {kind: move, views: [1], axis: 2, by: 0.01}       camera moved along its axis, m
    {kind: drift, views: [0], axis: 0, by: 0.001}     camera that goes on turning about its axis, rad/s
    {kind: slip, by: [0, 0.001, 0]}                   tags moved on the tool, m
    {kind: refocus, views: [0], by: 1.01}             zoomed about the centre of the image
    {kind: exchange}                                  left image for right
    {kind: size, by: 0.5, crop: [0, 0]}               images scaled, less so many px at the left and above
    {kind: reprint, by: 1.05}                         each tag larger about its centre
    {kind: sign, joint: 2}                            reading and command mirrored
    {kind: home, joint: 2, by: 0.1}                   and offset, rad
    {kind: hand, views: [0], seconds: 1}              covers tags from one side, pulls corners beside it
    {kind: occlusion, views: [0], tag: 2, seconds: 1} hides a tag
    {kind: blur, views: [0], seconds: 0.1}            blurred frames
"""

import bisect
import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.settings.markers import Markers
from tests.monitoring.corners import CornerMap

IMAGE, FOCAL, TAG_M = (800, 600), 760.0, 0.035
# Places of both cameras and what they look at, m; rolled about their axes, rad.
CAMERAS = (((0.80, -0.17, 0.31), (0.29, -0.01, 0.21), 0.05), ((0.78, 0.19, 0.25), (0.30, 0.02, 0.20), -0.03))
FPS, OFFSETS = 30.0, (0.0, 0.013)  # Hz; when the first frame of each camera is exposed, s
COUNTS, LAG_S, SAG_DEG, STEP_S = 4096, 0.06, 0.4, 0.01
MOST_TILT, BORDER_PX, LEAST_FOUND = math.radians(66.0), 4.0, 0.5
PULLED_PX, REACH_PX = 5.0, 25.0  # beside a hand: how far corners are pulled at most, and how near to it
# Which pixels, and by how much deviations are off that the finder states; None states none.
KINDS: dict[str, tuple[str, float | None]] = {
    "finder": ("finder", 1.0),
    "finder x0.3": ("finder", 0.3),
    "finder x3": ("finder", 3.0),
    "none": ("finder", None),
    "subpix": ("subpix", None),
    "jpeg": ("jpeg", None),
}
# Corners "noise" err by so much in each frame anew, px a coordinate, and by nothing else.
NOISE_PX = 0.5
LAST: list["StandIn"] = []  # the one that was made last, for what a study asks of it


class Arm(NamedTuple):
    """Joints where all readings are zero: the arm stretched out along x."""

    axes: str  # of each joint: z up, y across, x along
    at: tuple[tuple[float, float, float], ...]  # where each axis passes, m
    tip: float  # where the tool is along x, m, at the height of the last joint
    home: tuple[float, ...]  # deg
    limits: tuple[tuple[float, float], ...]  # deg
    sag: tuple[int, ...]  # joints that bear a load


ARMS = {
    "five": Arm(
        "zyyyx",
        ((0, 0, 0), (0.03, 0, 0.1), (0.18, 0, 0.1), (0.31, 0, 0.1), (0.31, 0, 0.1)),
        0.385,
        (2, -60, 76, -26, 5),
        ((-120, 120), (-110, 30), (-30, 140), (-100, 100), (-170, 170)),
        (1, 2),
    ),
    "six": Arm(
        "zyyxyx",
        ((0, 0, 0), (0.02, 0, 0.12), (0.17, 0, 0.12), (0.24, 0, 0.12), (0.30, 0, 0.12), (0.35, 0, 0.12)),
        0.38,
        (-3, -50, 70, 8, -30, -6),
        ((-120, 120), (-110, 30), (-30, 140), (-150, 150), (-100, 100), (-170, 170)),
        (1, 2),
    ),
}
_AXES = {"x": np.eye(3)[0], "y": np.eye(3)[1], "z": np.eye(3)[2]}


class Rigid(NamedTuple):
    """The tags on the tool, in its frame: places (k, 3), rotations, corners (k, 4, 3) about places."""

    place: np.ndarray
    turn: np.ndarray
    corners: np.ndarray


@lru_cache
def roof() -> Rigid:
    """Five tags on the tool."""
    tags = Markers(tags="roof", tag_size_m=TAG_M).all_tags
    T = np.array([tag.pose for tag in tags])
    return Rigid(T[:, :3, 3], T[:, :3, :3], np.array([tag.corners for tag in tags]) - T[:, None, :3, 3])


@lru_cache
def corner_map(finder: str) -> CornerMap:
    """The measured errors of a finder."""
    return CornerMap(finder)


def tool_pose(arm: Arm, q):
    """Pose (4, 4) of the tool, whose z axis is along x where the arm is stretched out, m; q (n,) rad."""
    R, t = np.eye(3), np.zeros(3)
    for letter, at, angle in zip(arm.axes, arm.at, q, strict=True):
        c, s, i = math.cos(angle), math.sin(angle), "xyz".index(letter)
        j, k = (i + 1) % 3, (i + 2) % 3
        turn = np.eye(3)
        turn[j, j] = turn[k, k] = c
        turn[j, k], turn[k, j] = -s, s
        t = t + R @ (np.array(at) - turn @ at)
        R = R @ turn
    T = np.eye(4)
    T[:3, :3] = R @ [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    T[:3, 3] = t + R @ (arm.tip, 0.0, arm.at[-1][2])
    return T


def camera_of(view):
    """Rotation (3, 3) and translation (3,), m, from the base to a camera."""
    place, target, roll = CAMERAS[view]
    z = np.subtract(target, place) / np.linalg.norm(np.subtract(target, place))
    x = np.cross(z, _AXES["z"]) / np.linalg.norm(np.cross(z, _AXES["z"]))
    R = Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix() @ [x, np.cross(z, x), z]
    return R, -R @ place


class Seen(NamedTuple):
    """Tags before a camera."""

    R: np.ndarray  # (k, 3, 3)
    t: np.ndarray  # (k, 3) m
    pixels: np.ndarray  # (k, 4, 2)
    shown: np.ndarray  # (k,) whether a tag looks at the camera and is inside its image


def seen(T, view, faults=()):
    """The tags of a tool at a pose before a camera, with what was done to them, without errors."""
    R, t = camera_of(view)
    corners, centre = roof().corners, np.array(IMAGE) / 2.0 - 0.5
    for fault in faults:
        if fault["kind"] == "reprint":
            corners = corners * fault["by"]
        elif fault["kind"] in ("turn", "move") and view in fault["views"]:
            axis = fault["by"] * np.eye(3)[fault["axis"]]
            turn = Rotation.from_rotvec(axis).as_matrix() if fault["kind"] == "turn" else np.eye(3)
            R, t = turn @ R, turn @ t + (axis if fault["kind"] == "move" else 0.0)
    place = roof().place + sum((np.array(f["by"]) for f in faults if f["kind"] == "slip"), np.zeros(3))
    there = ((place[:, None] + corners) @ T[:3, :3].T + T[:3, 3]) @ R.T + t
    middle = (place @ T[:3, :3].T + T[:3, 3]) @ R.T + t
    turned = R @ T[:3, :3] @ roof().turn
    pixels = FOCAL * there[..., :2] / there[..., 2:] + centre
    away = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    shown = -(turned[..., 2] * away).sum(axis=1) > math.cos(MOST_TILT)
    for fault in faults:
        if fault["kind"] == "shift" and view in fault["views"]:
            pixels = pixels + fault["by"]
        elif fault["kind"] == "refocus" and view in fault["views"]:
            pixels = centre + fault["by"] * (pixels - centre)
    inside = (pixels > BORDER_PX) & (pixels < np.array(IMAGE) - 1.0 - BORDER_PX)
    return Seen(turned, middle, pixels, shown & inside.all(axis=(1, 2)))


class StandIn:
    """The arm with its cameras, of the contract.

    arm : ``five`` or ``six`` joints. corners : one of ``KINDS``; "noise" has new errors alone, "exact" none.
    at_deg : (n,) where it stands at first; backlash_deg : from end to end of each joint; latency_s : of both
    cameras. frames : whether it has (empty) images. fault : what befalls it from ``at`` on, s; None nothing.
    """

    def __init__(
        self,
        arm: str = "five",
        corners: str = "finder",
        at_deg: Any = None,
        backlash_deg: float = 0.0,
        latency_s: float = 0.0,
        seed: int = 0,
        frames: bool = False,
        fault: dict[str, Any] | None = None,
    ):
        self.arm, self.kind, self.seed, self.latency = ARMS[arm], corners, seed, latency_s
        finder, self.stated = KINDS.get(corners, ("", None))
        self.map = corner_map(finder) if finder else None
        self.time, self.backlash = 0.0, math.radians(backlash_deg)
        self.fault = fault
        self.motor = np.radians(self.arm.home if at_deg is None else at_deg)
        rng = np.random.default_rng([seed, 7])
        self.link = self.motor + 0.5 * self.backlash * rng.uniform(-1.0, 1.0, len(self.motor))
        self.setpoint = self.motor - self._sag()
        self.times, self.links = [0.0], [self.link]
        self.cache: list[tuple[int, Any]] = [(-(2**30), None)] * 2
        self.begun, self.farthest = self.motor.copy(), 0.0  # how far it was sent, rad
        if frames:
            resized = fault if fault and fault["kind"] == "size" else {"by": 1.0, "crop": (0, 0)}
            width, height = resized["by"] * np.array(IMAGE) - 2 * np.array(resized["crop"])
            self.frames = np.zeros((2, int(height), int(width)), np.uint8)
        LAST[:] = [self]

    def open(self):
        pass

    def now(self):
        return self.time

    def stop(self):
        pass

    def close(self):
        pass

    def read(self):
        newest = [self._newest(view) for view in (0, 1)]
        if self._befalls("exchange", self.time):
            newest = newest[::-1]
        pixels, sigma = (np.stack(part) for part in zip(*newest, strict=True))
        tick = 2.0 * math.pi / COUNTS
        q = self._told(tick * np.round(self.motor / tick))
        return (q, pixels) if self.stated is None else (q, pixels, None, None, None, sigma)

    def command(self, target, speed, due):
        del speed
        target, before = self._told(target, back=True), self.setpoint
        self.farthest = max(self.farthest, float(np.abs(target - self.begun).max()))
        seconds, steps = due - self.time, max(1, round((due - self.time) / STEP_S))
        fades = math.exp(-seconds / steps / LAG_S)
        for k in range(1, steps + 1):
            self.setpoint = before + k / steps * (target - before)
            wanted = self.setpoint + self._sag()
            self.motor = wanted + fades * (self.motor - wanted)
            self.link = np.clip(self.link, self.motor - 0.5 * self.backlash, self.motor + 0.5 * self.backlash)
            self.times.append(self.time + seconds * k / steps)
            self.links.append(self.link)
        self.time = due

    def pose(self):
        """True pose (4, 4) of the tool, m."""
        return tool_pose(self.arm, self.link)

    def _sag(self):
        """By how much the load turns each joint, rad."""
        sag, lifted = np.zeros(len(self.motor)), 0.0
        for i in self.arm.sag:
            lifted += self.motor[i]
            sag[i] = math.radians(SAG_DEG) * math.cos(lifted)
        return sag

    def _befalls(self, kind, t):
        fault = self.fault
        return fault is not None and fault["kind"] == kind and self._lasts(t)

    def _lasts(self, t):
        assert self.fault is not None
        since = self.fault.get("at", 0.0)
        return since - 1e-9 <= t < since + self.fault.get("seconds", math.inf)

    def _told(self, q, back=False):
        """Readings (n,) of joints, or back from them."""
        q = np.array(q, dtype=float)
        for kind in ("sign", "home"):
            if self._befalls(kind, self.time):
                i = self.fault["joint"] - 1
                q[i] = -q[i] if kind == "sign" else q[i] + (-1.0 if back else 1.0) * self.fault["by"]
        return q

    def _newest(self, view):
        k = math.floor((self.time - self.latency - OFFSETS[view]) * FPS + 1e-6)
        if self.cache[view][0] != k:
            t = max(k / FPS + OFFSETS[view], -1.0)
            self.cache[view] = k, self._frame(view, k, t)
        return self.cache[view][1]

    def _at(self, t):
        """Joints (n,) behind the backlash at a time, s."""
        i = bisect.bisect_right(self.times, t)
        if i in (0, len(self.times)):
            return self.links[min(i, len(self.links) - 1)]
        share = (t - self.times[i - 1]) / (self.times[i] - self.times[i - 1])
        return self.links[i - 1] + share * (self.links[i] - self.links[i - 1])

    def _frame(self, view, k, t):
        """Pixels (m, 2), NaN where unseen, and stated deviations (m,) of a frame."""
        faults = (self.fault,) if self.fault and self._lasts(t) else ()
        if faults and faults[0]["kind"] == "drift":
            faults = ({**faults[0], "kind": "turn", "by": faults[0]["by"] * (t - faults[0].get("at", 0.0))},)
        found = seen(tool_pose(self.arm, self._at(t)), view, faults)
        pixels, shown, sigma = found.pixels.copy(), found.shown, np.full(found.pixels.shape[:2], 0.01)
        here = [fault for fault in faults if view in fault.get("views", ())]
        if self.map is not None:
            side = FOCAL * TAG_M / np.linalg.norm(found.t, axis=1)
            blurred = any(fault["kind"] == "blur" for fault in here)
            errors, sigma, fresh, share = self.map.at(found.R, found.t, side, pixels, view, blurred)
            rng = np.random.default_rng([self.seed, view, k + 2**20])
            pixels += errors + fresh[..., None] * rng.standard_normal(errors.shape)
            shown = shown & (share >= LEAST_FOUND)
        elif self.kind == "noise":
            rng = np.random.default_rng([self.seed, view, k + 2**20])
            pixels += NOISE_PX * rng.standard_normal(pixels.shape)
        for fault in here:
            if fault["kind"] == "occlusion":
                shown = shown & (np.arange(len(shown)) != fault["tag"])
            if fault["kind"] == "hand":
                # It comes in from the right of the tool to its middle, and leaves again.
                u, way = found.pixels[..., 0], math.sin(math.pi * (t - fault["at"]) / fault["seconds"])
                edge = u.max() + REACH_PX - way * (0.6 * np.ptp(u) + REACH_PX)
                shown = shown & (u.max(axis=1) < edge)
                pixels[..., 0] += PULLED_PX * np.clip(1.0 - (edge - u) / REACH_PX, 0.0, 1.0)
        pixels[~shown] = np.nan
        for fault in faults:
            if fault["kind"] == "size":
                pixels = fault["by"] * (pixels + 0.5) - 0.5 - fault["crop"]
                sigma = fault["by"] * sigma
        return pixels.reshape(-1, 2), (sigma * (self.stated or 1.0)).ravel()
