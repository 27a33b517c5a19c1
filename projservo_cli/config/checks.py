"""What must hold between the values of a configuration, beyond the type of each.

A check yields a path and a message for everything it finds. Each names the sections it reads, so
that those whose sections are well-formed still run when another section is not.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

from projservo_cli.modes import REPLAN

Path = tuple[str | int, ...]
Finding = tuple[Path, str]
Check = Callable[[Any], Iterator[Finding]]

_CHECKS: list[tuple[tuple[str, ...], Check]] = []
TOLERANCE = 1e-6  # of rotations and unit axes written with seven digits or more


def _needs(*sections: str) -> Callable[[Check], Check]:
    def register(check: Check) -> Check:
        _CHECKS.append((sections, check))
        return check

    return register


def problems(config: Any, broken: frozenset[str] = frozenset()) -> list[Finding]:
    """Everything inconsistent in ``config``, leaving out checks that read a ``broken`` section."""
    return [
        finding for sections, check in _CHECKS if broken.isdisjoint(sections) for finding in check(config)
    ]


@_needs("robot")
def _robot(config: Any) -> Iterator[Finding]:
    robot = config.robot
    if robot is None:
        return
    if (robot.dh is None) == (robot.screws is None):
        yield ("robot",), "give exactly one of dh and screws"
        return
    kind = "dh" if robot.dh is not None else "screws"
    for i, joint in enumerate(robot.joints):
        yield from _limits(("robot", kind, "joints", i), joint)
    if robot.dh is not None:
        yield from _rigid(("robot", "dh", "tool"), robot.dh.tool)
        return
    yield from _rigid(("robot", "screws", "base_tool"), robot.screws.base_tool)
    for i, joint in enumerate(robot.screws.joints):
        yield from _screw(("robot", "screws", "joints", i), joint)


def _limits(path: Path, joint: Any) -> Iterator[Finding]:
    given = [name for name in ("limits_deg", "limits_rad", "limits_m") if getattr(joint, name) is not None]
    if len(given) > 1:
        yield (*path, given[1]), f"{given[0]} is set as well; keep one"
    for name in given:
        if (name == "limits_m") != (joint.type == "P"):
            units = "limits_m" if joint.type == "P" else "limits_deg or limits_rad"
            yield (*path, name), f"a joint of type {joint.type} takes {units}"
        low, high = getattr(joint, name)
        if not low < high:
            yield (*path, name), f"the lower limit {low:g} must be below the upper limit {high:g}"


def _rigid(path: Path, matrix: Any) -> Iterator[Finding]:
    rows = [row[:3] for row in matrix[:3]]
    products = [[sum(a * b for a, b in zip(u, v, strict=True)) for u in rows] for v in rows]
    apart = max(abs(products[i][j] - (i == j)) for i in range(3) for j in range(3))
    if tuple(matrix[3]) != (0, 0, 0, 1):
        yield path, "the last row must be [0, 0, 0, 1]"
    elif apart > TOLERANCE or _determinant(rows) < 0:
        yield path, "the upper left 3×3 block must be a rotation, written with seven digits or more"


def _determinant(rows: Any) -> float:
    (a, b, c), (d, e, f), (g, h, i) = rows
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def _screw(path: Path, joint: Any) -> Iterator[Finding]:
    axis = "w" if joint.type == "R" else "v"
    length = math.hypot(*getattr(joint, axis))
    if abs(length - 1) > TOLERANCE:
        yield (*path, axis), f"must be of unit length for a joint of type {joint.type}, it is {length:g}"
    if joint.type == "P" and math.hypot(*joint.w) > TOLERANCE:
        yield (*path, "w"), "must be zero for a joint of type P"
    if joint.type == "R" and abs(sum(a * b for a, b in zip(joint.w, joint.v, strict=True))) > TOLERANCE:
        yield (*path, "v"), "must be orthogonal to w: a revolute joint has no pitch"


@_needs("rig")
def _rig(config: Any) -> Iterator[Finding]:
    if config.rig is None:
        return
    if 0 in config.rig.image_size_px:
        yield ("rig", "image_size_px"), "width and height must be greater than 0"
    for side in ("left", "right"):
        yield from _camera(("rig", side), getattr(config.rig, side))


def _camera(path: Path, camera: Any) -> Iterator[Finding]:
    wanted = ("focal_px", "principal_point_px", "position_m", "target_m")
    given = [name for name in wanted if getattr(camera, name) is not None]
    if camera.matrix is not None:
        if given:
            yield (*path, given[0]), "matrix is set as well; keep one description of the camera"
        scale = max(abs(value) for row in camera.matrix for value in row)
        if scale == 0 or abs(_determinant([row[:3] for row in camera.matrix])) < 1e-12 * scale**3:
            yield (*path, "matrix"), "its left 3×3 block is singular: no finite pinhole camera"
        return
    if len(given) < len(wanted):
        missing = ", ".join(name for name in wanted if name not in given)
        yield (
            path,
            f"give matrix, or all of {', '.join(wanted)}" + (f" (missing: {missing})" if given else ""),
        )
        return
    sight = [b - a for a, b in zip(camera.position_m, camera.target_m, strict=True)]
    length, up = math.hypot(*sight), math.hypot(*camera.up)
    if length == 0:
        yield (*path, "target_m"), "is the position of the camera; it must look somewhere"
    elif up == 0 or abs(sum(a * b for a, b in zip(sight, camera.up, strict=True))) > (1 - 1e-9) * length * up:
        yield (*path, "up"), "must not be zero or along the line of sight"


@_needs("markers")
def _markers(config: Any) -> Iterator[Finding]:
    markers = config.markers
    if markers is None:
        return
    known = markers.known
    if known is not None:
        if markers.positions_m is not None and len(known) != len(markers.positions_m):
            yield ("markers", "numbers"), f"{len(known)} numbers for {len(markers.positions_m)} positions_m"
        if len(set(known)) < len(known):
            yield ("markers", "numbers"), "a number stands here twice"
        for i, number in enumerate(markers.face or ()):
            if number not in known:
                yield ("markers", "face", i), f"there is no marker {number}; markers: {_listed(known)}"
    if markers.face is not None and markers.center not in ("midpoint", *markers.face):
        yield (
            ("markers", "center"),
            f"marker {markers.center} is not on the face; face: {_listed(markers.face)}",
        )
    if markers.face is not None and len(set(markers.face)) < len(markers.face):
        yield ("markers", "face"), "a marker stands here twice"


def _listed(numbers: Any) -> str:
    shown = ", ".join(map(str, numbers[:20]))
    return shown + (" …" if len(numbers) > 20 else "")


@_needs("robot", "rig", "markers", "task", "calibration", "data")
def _enough(config: Any) -> Iterator[Finding]:
    if config.data is not None:
        return
    reason = "is missing; a simulated run needs it (a recorded one sets data.table)"
    if config.robot is None:
        yield ("robot",), reason
    if config.rig is None:
        yield ("rig",), reason
    if config.markers is None or config.markers.positions_m is None:
        yield ("markers", "positions_m"), reason
    if config.task is None and config.calibration.reference is None:
        yield ("task",), "is missing; a simulated run needs it, or calibration.reference"


@_needs("calibration")
def _only_refined(config: Any) -> Iterator[Finding]:
    settings = config.calibration
    for key in ("cross_validate", "init"):
        if getattr(settings, key) is not None and settings.method != "refined":
            yield ("calibration", key), f"belongs to the method refined, not to {settings.method}"


@_needs("robot", "data")
def _same_joints(config: Any) -> Iterator[Finding]:
    if config.data is None or config.data.joints is None or config.robot is None:
        return
    types = config.robot.joint_types
    if types and types != config.data.joints:
        yield ("data", "joints"), f"{config.data.joints} are not the joints of the robot, {types}"


@_needs("robot", "data", "calibration", "task")
def _joint_vectors(config: Any) -> Iterator[Finding]:
    types = config.data.joints if config.data and config.data.joints else None
    if types is None and config.robot is not None:
        types = config.robot.joint_types
    vectors: list[tuple[Path, Any, bool]] = [
        (("calibration", "reference"), config.calibration.reference, True),
    ]
    if config.robot is not None and config.robot.screws is not None:
        vectors.append((("robot", "screws", "reference"), config.robot.screws.reference, False))
    if config.task is not None:
        vectors.append((("task", "start"), config.task.start, True))
        vectors.append((("task", "start_offset"), config.task.start_offset, False))
        vectors.append((("task", "goal", "joints"), config.task.goal.joints, False))
    for path, vector, limited in vectors:
        if vector is None or not types:
            continue
        if len(vector.joints) != len(types):
            yield (*path, "joints"), f"{len(vector.joints)} values for {len(types)} joints ({types})"
        elif limited and config.robot is not None and config.robot.joint_types == types:
            yield from _within(path, vector.values(types), config.robot)


def _within(path: Path, values: tuple[float, ...], robot: Any) -> Iterator[Finding]:
    for i, (value, joint) in enumerate(zip(values, robot.joints, strict=True)):
        low, high = joint.limits
        if low <= value <= high or any(_limits((), joint)):  # limits that are wrong themselves limit nothing
            continue
        turn, unit = (math.degrees, "deg") if joint.type == "R" else (float, "m")
        yield (
            (*path, "joints", i),
            f"{turn(value):.6g} {unit} is outside the limits of joint {i + 1}, "
            f"{turn(low):.6g} to {turn(high):.6g} {unit}",
        )


@_needs("task")
def _goal(config: Any) -> Iterator[Finding]:
    if config.task is None:
        return
    goal = config.task.goal
    kinds = [name for name in ("joints", "turn_deg", "images") if getattr(goal, name) is not None]
    if len(kinds) != 1:
        given = f", not {' and '.join(kinds)}" if kinds else ""
        yield ("task", "goal"), f"give exactly one of joints, turn_deg and images{given}"
    if goal.perturbation is not None and goal.turn_deg is None:
        yield ("task", "goal", "perturbation"), "belongs to a goal given by turn_deg"


@_needs("task", "markers")
def _goal_images(config: Any) -> Iterator[Finding]:
    if config.task is None or config.task.goal.images is None:
        return
    path = ("task", "goal", "images")
    if config.markers is None or config.markers.face is None:
        yield path, "needs markers.face, whose markers these pixels are"
        return
    for side in ("left", "right"):
        pixels = getattr(config.task.goal.images, side)
        if len(pixels) != len(config.markers.face):
            yield (
                (*path, side),
                f"{len(pixels)} pixels for the {len(config.markers.face)} markers of the face",
            )


@_needs("disturbance", "plant", "robot", "markers")
def _disturbance(config: Any) -> Iterator[Finding]:
    given = config.disturbance
    wanted = [name for name in ("lost_markers", "bump", "frozen_joint") if getattr(given, name) is not None]
    if config.plant.use is not None and (wanted or given.delay_periods):
        yield ("disturbance",), "disturbs the simulated robot; leave it out where plant.use names another"
    types = config.robot.joint_types if config.robot is not None else None
    for name in ("bump", "frozen_joint"):
        if name in wanted and types and getattr(given, name).joint > len(types):
            yield ("disturbance", name, "joint"), f"the robot has {len(types)} joints, counted from 1"
    if given.bump is not None:
        yield from _bump(given.bump, types)
    known = config.markers.known if config.markers is not None else None
    lost = given.lost_markers.markers if given.lost_markers is not None else None
    for i, number in enumerate(lost or ()):
        if known is not None and number not in known:
            yield (
                ("disturbance", "lost_markers", "markers", i),
                f"there is no marker {number}; markers: {_listed(known)}",
            )


def _bump(bump: Any, types: str | None) -> Iterator[Finding]:
    if (bump.by_deg is None) == (bump.by_m is None):
        yield ("disturbance", "bump"), "give exactly one of by_deg and by_m"
    elif types and bump.joint <= len(types):
        fitting = "by_deg" if types[bump.joint - 1] == "R" else "by_m"
        if getattr(bump, fitting) is None:
            yield (
                ("disturbance", "bump"),
                f"joint {bump.joint} is of type {types[bump.joint - 1]}: give {fitting}",
            )


@_needs("control", "trajectory")
def _plan_to_follow(config: Any) -> Iterator[Finding]:
    control = config.control
    limits = (control.joint_speed_limit_deg_s, control.prismatic_speed_limit_m_s)
    if any(mode != REPLAN for mode in control.mode) and {*limits, config.trajectory.duration_s} == {None}:
        yield (
            ("control", "mode"),
            "follows the plan in time, and nothing gives it one: set trajectory.duration_s, or a limit with "
            "control.joint_speed_limit_deg_s",
        )


@_needs("control")
def _gains(config: Any) -> Iterator[Finding]:
    control = config.control
    for name in ("gain_t", "gain_r", "gain_p", "gain_s", "gain"):
        product = getattr(control, name) * control.period_s
        if product >= 1:
            yield (
                ("control", name),
                f"gain · period_s is {product:.3g}; it must stay below 1 for the loop to be stable "
                f"(below {1 / control.period_s:.3g} 1/s at this period)",
            )
