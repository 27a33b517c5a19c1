"""Checks of robot and cameras before anything is recorded, and findings with their remedies."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from projservo_cli.detection import MIN_CELL, BoardFinder, Corners, Finder, TagFinder, dictionaries
from projservo_cli.hardware.camera_robot import View, exposure_of
from projservo_cli.hardware.video_cameras import VideoCamera, stable_name
from projservo_cli.records import CORNERS, BoolArray, ByteArray, FloatArray, JointLimits, in_unit

FAULT, WARNING, FINE = "fault", "warning", "fine"
# Width of a cell, px, from which corners are good.
_GOOD_CELL = 4.0
# Frames a second, as a share of those asked for, below which a camera is slow; those of webcams by day, 1/s.
_SLOW, _USUAL_HZ = 0.75, 30.0
# Angle between the directions from which two cameras see a tag, deg: depth errors grow with its inverse.
_MIN_ANGLE_DEG, _GOOD_ANGLE_DEG = 4.0, 10.0
# Standard deviations of a corner by which perspective must move it to show the side of a tilt.
_CERTAIN = 4.0
# Markers that two cameras, or the only one, must see: a turn about a line through two shows in no image.
MIN_SHARED = 3
# Distance from a limit at which a joint has no room, rad.
_ROOM = math.radians(1.0)


class Finding(NamedTuple):
    """One result of a check."""

    level: str  # fault, warning or fine
    where: str  # subject
    text: str  # finding, with the number and its limit
    remedy: str = ""  # empty for a sound part


@dataclass(eq=False)
class RobotAtRest:
    """A robot at rest, as its joints and cameras show it."""

    marker: Sequence[int]  # numbers of the markers
    face: Sequence[int]  # those that must stay visible
    q: FloatArray  # (n,) mean of the joint readings, rad or m
    s: FloatArray  # (V, m, 2) mean of the pixels, NaN where most frames do not show a marker
    sigma: FloatArray | None  # (V, m) deviation of a corner of one frame as the detector states it, px
    scatter: FloatArray  # (V, m) between frames, px
    limits: JointLimits
    units: Sequence[str]  # of the joints, for messages
    views: Sequence[View] = ()  # the last one of each camera of projservo
    cameras: Sequence[VideoCamera] = ()
    health: Mapping[str, float | str] = field(default_factory=dict)  # such as the voltage


def findings_at_rest(
    robot: RobotAtRest, finder: Finder, dictionary: str, *, moves: bool = False
) -> Iterator[Finding]:
    """All findings at rest.

    dictionary : name of that of the ``finder``; moves : whether joints are to move next, which need limits.
    """
    for camera, view in zip(robot.cameras, robot.views, strict=True):
        yield from _of_camera(camera)
        if isinstance(finder, TagFinder):
            yield from _of_tags(camera.name, view, robot, finder, dictionary)
        elif isinstance(finder, BoardFinder):
            yield _of_board(camera.name, view, finder)
    yield from _of_all_views(robot)
    yield from _of_joints(robot, FAULT if moves else WARNING)


def _of_camera(camera: VideoCamera) -> Iterator[Finding]:
    """Rate, stamps, exposure and sharpness of a camera."""
    where, grey = f"{camera.name} camera", camera.newest().grey
    rate, asked = camera.rate_hz, camera.settings.rate_hz or _USUAL_HZ
    stamps = "stamped by its driver" if camera.stamped else "stamped when they arrive"
    size = f"{grey.shape[1]} x {grey.shape[0]} px"
    frames = f"{rate:.1f}" if math.isfinite(rate) else "fewer than 3"
    if not rate >= _SLOW * asked:
        remedy = (
            "webcams expose longer in the dark: add light, or set exposure_ms below "
            f"{1e3 / asked:.0f}; on one hub with another camera, set fourcc: MJPG"
        )
        yield Finding(WARNING, where, f"{size}, {frames} frames a second instead of {asked:g}", remedy)
    else:
        yield Finding(FINE, where, f"{size}, {frames} frames a second, {stamps}")
    for remark in camera.remarks:
        what, _, remedy = remark.partition(": ")
        yield Finding(WARNING, where, what, remedy or "take another camera, or keep it from changing")
    if name := stable_name(camera.settings.source):
        what = f"device {camera.settings.source} may get another number when it is plugged in again"
        yield Finding(WARNING, where, what, f"set cameras.{camera.name}.source: {name}")
    light = exposure_of(grey)
    for wrong in light.faults():
        what, _, remedy = wrong.rpartition(": ")
        yield Finding(FAULT if "black" in wrong else WARNING, where, f"its image {what}", remedy)
    text = f"mean grey {light.mean:.0f} of 255, {light.clipped:.1%} white"
    sharp = math.isfinite(light.blur_px)
    yield Finding(FINE, where, f"{text}, edges blurred by {light.blur_px:.1f} px" if sharp else text)


def _of_tags(
    name: str, view: View, robot: RobotAtRest, finder: TagFinder, dictionary: str
) -> Iterator[Finding]:
    """Tags in the image of a camera: which, how large, how certain."""
    where, expected = f"{name} image", {number // CORNERS for number in robot.marker}
    for number in view.repeated:
        remedy = "a number must be unique: print another one, or cover the tag that is not on the tool"
        yield Finding(FAULT, where, f"tag {number} is there twice", remedy)
    there = {number: tag for number, tag in view.tags.items() if number in expected}
    if not there:
        other, count = _other_dictionary(view.frame.grey, dictionary)
        if count > len(view.tags):
            remedy = f"set markers.dictionary: {other}, or print tags of {dictionary}"
            yield Finding(FAULT, where, f"{count} tags are of {other}, none of {dictionary}", remedy)
        elif view.tags:
            others = ", ".join(map(str, sorted(view.tags)))
            remedy = "name the corners of the tags on the tool (4 t + k) in markers.numbers"
            yield Finding(FAULT, where, f"tags {others} are there, and markers has none of them", remedy)
        else:
            minimum = math.ceil(MIN_CELL * finder.cells)
            remedy = (
                f"turn the tool towards it; look at light, focus and white margins; tags below {minimum} px "
            )
            remedy += f"({MIN_CELL:g} px a cell) are too small: print larger ones, or move the camera nearer"
            yield Finding(FAULT, where, f"there is no tag of {dictionary}", remedy)
        return
    width = {number: _width(tag) for number, tag in there.items()}
    smallest = min(width, key=lambda number: width[number])
    cell = width[smallest] / finder.cells
    sigma = np.concatenate([tag.sigma[np.isfinite(tag.sigma)] for tag in there.values()])
    sizes = ", ".join(f"{number} ({width[number]:.0f} px)" for number in sorted(there))
    text = f"tags {sizes}" + (f"; corners to {np.median(sigma):.2g} px" if sigma.size else "")
    if cell < _GOOD_CELL:
        limit = MIN_CELL if cell < MIN_CELL else _GOOD_CELL
        level = FAULT if max(width.values()) / finder.cells < MIN_CELL else WARNING
        what = f"tag {smallest} is {width[smallest]:.0f} px wide, {cell:.1f} px a cell ({limit:g} at least)"
        yield Finding(level, where, what, "print larger tags, move the camera nearer, or raise its size_px")
    yield Finding(FINE, where, text)


def _of_board(name: str, view: View, finder: BoardFinder) -> Finding:
    """The board in the image of a camera: how many of its corners, how certain."""
    if not view.tags:
        what, _, remedy = finder.nothing.format(count=1).partition(": ")
        return Finding(FAULT, f"{name} image", f"there is {what.replace('any of 1 images', 'it')}", remedy)
    sigma = view.tags[0].sigma
    known = sigma[np.isfinite(sigma)]
    text = f"{finder.board} with {known.size} of {finder.corners} corners, to {np.median(known):.2g} px"
    return Finding(FINE, f"{name} image", text)


def _width(tag: Corners) -> float:
    """Mean side of a tag, px."""
    return float(np.linalg.norm(np.roll(tag.pixels, -1, axis=0) - tag.pixels, axis=1).mean())


def _other_dictionary(grey: ByteArray, dictionary: str) -> tuple[str, int]:
    """Return the dictionary with the highest number of tags in an image, among other kinds, and the number.

    Of two with as many tags it is the one of the larger and the fewer tags.
    """
    counts = {}
    for name in dictionaries():
        if name != dictionary.upper().removeprefix("DICT_"):
            finder = TagFinder(name)
            counts[name] = len(finder.find(grey.astype(np.float64))[0]), finder.cells, -finder.known
    best = max(counts, key=lambda name: counts[name])
    return best, counts[best][0]


def _of_all_views(robot: RobotAtRest) -> Iterator[Finding]:
    """Markers that two cameras or more see, the face among them, and whether views differ enough for depth.

    Of a single camera those that it sees.
    """
    visible = np.isfinite(robot.s[..., 0])
    images, cameras, share, lack = {
        1: ("image", "the camera", "shows", "does not show"),
        2: ("both images", "both cameras", "share", "do not both show"),
    }.get(len(visible), ("images", "the cameras", "two or more show", "fewer than two show"))
    in_two: BoolArray = visible.sum(axis=0) >= min(2, len(visible))
    shared = int(in_two.sum())
    if visible.any(axis=1).all() and shared < MIN_SHARED:
        remedy = f"turn the tool towards {cameras}, or move {'it' if len(visible) == 1 else 'them'}"
        what = f"{share} {shared} of {len(robot.marker)} markers ({MIN_SHARED} at least)"
        yield Finding(FAULT, images, what, remedy)
    elif shared:
        yield Finding(FINE, images, f"{share} {shared} of {len(robot.marker)} markers")
    shared_numbers = {number for k, number in enumerate(robot.marker) if in_two[k]}
    for number in robot.marker:
        if shared and number in robot.face and number not in shared_numbers:
            what = f"{lack} marker {number} of the face, tag {number // CORNERS}"
            remedy = f"turn the tool towards {cameras}, or name another markers.face"
            yield Finding(WARNING, images, what, remedy)
            break
    if len(robot.views) > 1:
        angles = [_view_angle_deg(one.tags, other.tags) for one, other in combinations(robot.views, 2)]
        angle = max(angles, key=lambda one: -math.inf if math.isnan(one) else one)
        if angle < _GOOD_ANGLE_DEG:
            what = (
                f"the cameras see the tags from directions {angle:.1f}° apart ({_GOOD_ANGLE_DEG:g}° at least)"
            )
            remedy = (
                "move them apart, by a third of their distance from the tool: depth shows in their difference"
            )
            yield Finding(FAULT if angle < _MIN_ANGLE_DEG else WARNING, cameras, what, remedy)
        elif np.isfinite(angle):
            yield Finding(FINE, cameras, f"see the tags from directions {angle:.0f}° apart")
    noise, stated = np.nanmedian(robot.scatter) if np.isfinite(robot.scatter).any() else 0.0, robot.sigma
    if (
        stated is not None
        and np.isfinite(stated).any()
        and noise > 5.0 * np.nanmedian(stated)
        and noise > 0.3
    ):
        what = (
            f"corners scatter by {noise:.2g} px at rest, {noise / np.nanmedian(stated):.0f} times their noise"
        )
        remedy = "look for lamps that flicker, tables that shake, and autofocus"
        yield Finding(WARNING, images, what, remedy)


def _view_angle_deg(left: Mapping[int, Corners], right: Mapping[int, Corners]) -> float:
    """Angle between the directions from which two cameras see the tags, median over tags; NaN without one.

    Tags whose perspective does not show to which side they are tilted count where there are no others; of the
    sides that fit them the nearer ones are taken.
    """
    sure, unsure = list[float](), list[float]()
    for number in left.keys() & right.keys():
        sigma = np.array([left[number].sigma, right[number].sigma])
        if sigma.shape[1] != CORNERS or not np.isfinite(sigma).all():
            continue
        towards = [_directions(view[number].pixels, view[number].sigma) for view in (left, right)]
        cosine = max(float(np.clip(a @ b, -1.0, 1.0)) for a, b in product(*towards))
        certain = len(towards[0]) == len(towards[1]) == 1
        (sure if certain else unsure).append(math.degrees(math.acos(cosine)))
    return float(np.median(sure or unsure)) if sure or unsure else math.nan


def _directions(pixels: FloatArray, sigma: FloatArray) -> list[FloatArray]:
    """Directions (3,) towards the camera, in the frame of a square tag, that fit its corners (4, 2).

    Near its centre an image of a square is a scaled orthographic one: a circle there becomes an ellipse,
    whose axes show the tilt. Perspective, if it is more than the noise ``sigma`` (4,) of the corners, shows
    to which side: the farther part is smaller. Neither needs intrinsics.
    """
    square = np.array([(-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
    rows = []
    for (x, y), (u, v) in zip(square, pixels - pixels.mean(axis=0), strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y, -u], [0, 0, 0, x, y, 1, -v * x, -v * y, -v]]
    h = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    h /= h[2, 2]
    affine = h[:2, :2] - np.outer(h[:2, 2], h[2, :2])
    _, (large, small), axes = np.linalg.svd(affine)
    z = small / large
    side = math.sqrt(max(0.0, 1.0 - z * z)) * axes[1]
    nearer, width = -h[2, :2] @ axes[1], 2.0 * large
    if width * abs(nearer) > _CERTAIN * np.nanmax(sigma):
        return [np.array([*(math.copysign(1.0, nearer) * side), z])]
    return [np.array([*side, z]), np.array([*-side, z])]


def _of_joints(robot: RobotAtRest, endless: str) -> Iterator[Finding]:
    """Readings within their limits, and the measurements of the arm itself.

    endless : level of a joint without limits.
    """
    lower, upper = robot.limits.lower, robot.limits.upper
    readings = ", ".join(in_unit(x, unit, 4) for x, unit in zip(robot.q.tolist(), robot.units, strict=True))
    yield Finding(FINE, "joints", f"read {readings}")
    for i, (x, unit) in enumerate(zip(robot.q.tolist(), robot.units, strict=True)):
        low, high = (in_unit(float(limit[i]), unit, 4) for limit in (lower, upper))
        if not np.isfinite([lower[i], upper[i]]).all():
            yield Finding(
                endless, f"joint {i + 1}", "has no limits", "set robot.limits.joints, or run projservo limits"
            )
        elif not lower[i] <= x <= upper[i]:
            what = f"reads {in_unit(x, unit, 4)}, beyond its limits {low} to {high}"
            remedy = "move it back by hand; a reading far off has another unit or zero than the limits"
            yield Finding(FAULT, f"joint {i + 1}", what, remedy)
        elif unit != "m" and min(x - lower[i], upper[i] - x) < _ROOM:
            what = f"reads {in_unit(x, unit, 4)}, at its limits {low} to {high}"
            yield Finding(WARNING, f"joint {i + 1}", what, "move it away from there by hand")
    for name, value in robot.health.items():
        yield Finding(FINE, "arm", f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}")
