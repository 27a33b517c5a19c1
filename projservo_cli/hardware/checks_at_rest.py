"""Checks of robot and cameras before anything is recorded."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product

import numpy as np

from projservo_cli.calibration.checks.validation import of_views
from projservo_cli.detection.finders import MIN_CELL, BoardFinder, Corners, Finder, TagFinder, dictionaries
from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, Subject
from projservo_cli.hardware.camera_robot import View
from projservo_cli.hardware.exposure import exposure_of
from projservo_cli.hardware.video_cameras import VideoCamera, stable_name
from projservo_cli.records import CORNERS, BoolArray, ByteArray, FloatArray, JointLimits, Observation

# Width of a cell, px, from which corners are good.
_GOOD_CELL = 4.0
# Frame rate, as a share of the requested one, below which a camera is slow; rate of webcams by day, 1/s.
_SLOW, _USUAL_HZ = 0.75, 30.0
# Angle between the directions from which two cameras see a tag, rad: depth errors grow with its inverse.
_MIN_ANGLE, _GOOD_ANGLE = math.radians(4.0), math.radians(10.0)
# Scatter of corners at rest, in stated deviations and in px, from which something flickers or shakes.
_FLICKER, _FLICKER_PX = 5.0, 0.3
# Standard deviations of a corner by which perspective must move it to show the side of a tilt.
_CERTAIN = 4.0
# Markers that two cameras, or the only one, must see: a turn about a line through two shows in no image.
MIN_SHARED = 3
# Distance from a limit at which a joint has no room, rad.
_ROOM = math.radians(1.0)


@dataclass(eq=False)
class RobotAtRest:
    """A robot at rest, as its joints and cameras show it."""

    marker: Sequence[int]  # numbers of the markers
    face: Sequence[int]  # those that must stay visible
    q: FloatArray  # (n,) mean of the joint readings, rad or m
    s: FloatArray  # (V, m, 2) mean of the pixels, NaN where most frames do not show a marker
    sigma: FloatArray | None  # (V, m) deviation of a corner of one frame as the detector states it, px
    scatter: FloatArray  # (V, m) between frames, px
    frames: Observation  # the frames
    fresh: BoolArray  # (K, V) which of them are new
    limits: JointLimits
    units: Sequence[str]  # units of the joints: deg, rad or m
    views: Sequence[View] = ()  # the last one of each camera of projservo
    cameras: Sequence[VideoCamera] = ()
    health: Mapping[str, float | str] = field(default_factory=dict)  # such as the voltage

    def of_views(self, names: tuple[str, ...]) -> "RobotAtRest":
        """Return the check of some cameras; raises InputError if there is none of a name."""
        frames, rows = of_views(self.frames, names), [self.frames.view.index(name) for name in names]
        return replace(
            self,
            s=self.s[rows],
            sigma=None if self.sigma is None else self.sigma[rows],
            scatter=self.scatter[rows],
            frames=frames,
            fresh=self.fresh[:, rows],
            views=[self.views[v] for v in rows] if self.views else (),
            cameras=[self.cameras[v] for v in rows] if self.cameras else (),
        )

    @property
    def frame_sizes(self) -> list[tuple[int, int]] | None:
        """Width and height of the frames of each camera of projservo, px; None without one."""
        return [(view.frame.grey.shape[1], view.frame.grey.shape[0]) for view in self.views] or None


def findings_at_rest(
    robot: RobotAtRest, finder: Finder, dictionary: str, *, moves: bool = False
) -> Iterator[Finding]:
    """All findings at rest.

    dictionary : name of the ``finder``'s; moves : whether joints are to move next, which need limits.
    """
    for camera, view in zip(robot.cameras, robot.views, strict=True):
        yield from _of_camera(camera)
        if isinstance(finder, TagFinder):
            yield from _of_tags(camera.name, view, robot, finder, dictionary)
        elif isinstance(finder, BoardFinder):
            yield _of_board(camera.name, view, finder)
    yield from _of_all_views(robot)
    yield from _of_joints(robot, REFUSES if moves else LIMITS)


def _of_camera(camera: VideoCamera) -> Iterator[Finding]:
    """Rate, stamps, exposure and sharpness of a camera."""
    where, grey = Subject(views=(camera.name,)), camera.newest().grey
    rate, asked = camera.rate_hz, camera.settings.rate_hz or _USUAL_HZ
    stamped = replace(where, name="by its driver" if camera.stamped else "")
    size = Finding("size", amount=grey.shape[1], limit=grey.shape[0], unit="px")
    if rate >= _SLOW * asked:
        yield Finding("camera_rate", NOTE, stamped, rate, limit=asked, unit="1/s", others=(size,))
    else:
        yield Finding("slow_camera", LIMITS, where, rate, limit=asked, unit="1/s", others=(size,))
    yield from camera.remarks
    if name := stable_name(camera.settings.source):
        yield Finding("unstable_device", LIMITS, replace(where, name=name))
    light = exposure_of(grey)
    yield from light.faults(camera.name)
    white = Finding("white", amount=light.clipped, unit="1")
    blur = (Finding("blur", amount=light.blur_px, unit="px"),) * math.isfinite(light.blur_px)
    yield Finding("exposure", NOTE, where, light.mean, unit="1", others=(white, *blur))


def _of_tags(
    name: str, view: View, robot: RobotAtRest, finder: TagFinder, dictionary: str
) -> Iterator[Finding]:
    """Tags in the image of a camera: which, how large, how certain."""
    where, expected = Subject(views=(name,)), {number // CORNERS for number in robot.marker}
    for number in view.repeated:
        yield Finding("repeated_tag", REFUSES, replace(where, tag=number))
    there = {number: tag for number, tag in view.tags.items() if number in expected}
    if not there:
        other, count = _other_dictionary(view.frame.grey, dictionary)
        own = Finding("dictionary", subject=Subject(name=dictionary))
        if count > len(view.tags):
            yield Finding("other_dictionary", REFUSES, replace(where, name=other), count, others=(own,))
        elif view.tags:
            corners = tuple(CORNERS * number for number in sorted(view.tags))
            yield Finding("unknown_tags", REFUSES, replace(where, markers=corners))
        else:
            subject, minimum = replace(where, name=dictionary), math.ceil(MIN_CELL * finder.cells)
            yield Finding("no_tag", REFUSES, subject, MIN_CELL, limit=minimum, unit="px")
        return
    width = {number: _width(tag) for number, tag in there.items()}
    smallest = min(width, key=lambda number: width[number])
    cell = width[smallest] / finder.cells
    sigma = np.concatenate([tag.sigma[np.isfinite(tag.sigma)] for tag in there.values()])
    widths = {n: Finding("width", subject=Subject(tag=n), amount=width[n], unit="px") for n in sorted(there)}
    if cell < _GOOD_CELL:
        limit = MIN_CELL if cell < MIN_CELL else _GOOD_CELL
        level = REFUSES if max(width.values()) / finder.cells < MIN_CELL else LIMITS
        subject, part = replace(where, tag=smallest), widths[smallest]
        yield Finding("small_tag", level, subject, cell, limit=limit, unit="px", others=(part,))
    certain = float(np.median(sigma)) if sigma.size else math.nan
    yield Finding("tags_seen", NOTE, where, certain, unit="px", others=(*widths.values(),))


def _of_board(name: str, view: View, finder: BoardFinder) -> Finding:
    """The board in the image of a camera: how many of its corners, how certain."""
    where = Subject(views=(name,), name=str(finder.board))
    if not view.tags:
        return Finding("no_board", REFUSES, where)
    sigma = view.tags[0].sigma
    known = sigma[np.isfinite(sigma)]
    count = Finding("corners", amount=known.size, limit=finder.corners, unit="1")
    return Finding("board_seen", NOTE, where, float(np.median(known)), unit="px", others=(count,))


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
    in_two: BoolArray = visible.sum(axis=0) >= min(2, len(visible))
    shared, total = int(in_two.sum()), len(robot.marker)
    min_share = Finding("share", amount=MIN_SHARED, unit="1")
    if visible.any(axis=1).all() and shared < MIN_SHARED:
        yield Finding("few_shared", REFUSES, amount=shared, limit=total, unit="1", others=(min_share,))
    elif shared:
        yield Finding("shared_markers", NOTE, amount=shared, limit=total, unit="1")
    shared_numbers = {number for k, number in enumerate(robot.marker) if in_two[k]}
    for number in robot.marker:
        if shared and number in robot.face and number not in shared_numbers:
            yield Finding("unshared_face", LIMITS, Subject(markers=(number,)))
            break
    if len(robot.views) > 1:
        angles = [_view_angle(one.tags, other.tags) for one, other in combinations(robot.views, 2)]
        angle = max(angles, key=lambda one: -math.inf if math.isnan(one) else one)
        if angle < _GOOD_ANGLE:
            level = REFUSES if angle < _MIN_ANGLE else LIMITS
            yield Finding("alike_views", level, amount=angle, limit=_GOOD_ANGLE, unit="rad")
        elif np.isfinite(angle):
            yield Finding("directions", NOTE, amount=angle, limit=_GOOD_ANGLE, unit="rad")
    noise = float(np.nanmedian(robot.scatter)) if np.isfinite(robot.scatter).any() else 0.0
    known = robot.sigma is not None and np.isfinite(robot.sigma).any()
    stated = float(np.nanmedian(robot.sigma)) if robot.sigma is not None and known else math.inf
    if noise > _FLICKER * stated and noise > _FLICKER_PX:
        yield Finding("flicker", LIMITS, amount=noise, limit=stated, unit="px")


def _view_angle(left: Mapping[int, Corners], right: Mapping[int, Corners]) -> float:
    """Angle between the directions from which cameras see tags, rad, median over tags; NaN without one.

    Tags whose perspective does not show to which side they are tilted count if there are no others; of the
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
        (sure if certain else unsure).append(math.acos(cosine))
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

    endless : severity of a joint without limits.
    """
    lower, upper = robot.limits.lower, robot.limits.upper
    units = ["m" if unit == "m" else "rad" for unit in robot.units]
    joints = [
        Finding("reading", subject=Subject(joints=(i,)), amount=x, unit=unit)
        for i, (x, unit) in enumerate(zip(robot.q.tolist(), units, strict=True), 1)
    ]
    yield Finding("joint_readings", NOTE, others=(*joints,))
    for one, low, high in zip(joints, lower.tolist(), upper.tolist(), strict=True):
        limits = (Finding("range", amount=low, limit=high, unit=one.unit),)
        if not np.isfinite([low, high]).all():
            yield Finding("joint_without_limits", endless, one.subject)
        elif not low <= one.amount <= high:
            yield replace(one, code="joint_beyond_limits", severity=REFUSES, others=limits)
        elif one.unit != "m" and min(one.amount - low, high - one.amount) < _ROOM:
            yield replace(one, code="joint_at_limit", severity=LIMITS, others=limits)
    for name, value in robot.health.items():
        amount = value if isinstance(value, float) else math.nan
        value_text = f"{value:.4g}" if isinstance(value, float) else value
        yield Finding("health", NOTE, Subject(name=f"{name} {value_text}"), amount)
