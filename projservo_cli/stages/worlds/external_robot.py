"""Robots of the contract: made, opened, driven to given joints."""

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from projservo_cli import messages, plugins
from projservo_cli.detection.finders import finder_of
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.hardware.camera_robot import Arm, CameraRobot
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.passwords import MASK
from projservo_cli.records import FloatArray, InputError
from projservo_cli.robots.contract import Bounds, PluginRobot, Reading, Robot
from projservo_cli.robots.flange_robot import by_joints
from projservo_cli.robots.joint_limits import Joints, require_no_turn_off
from projservo_cli.robots.pacing import Steered
from projservo_cli.robots.session import Session
from projservo_cli.robots.standstill import STILL, Standstill, at_rest
from projservo_cli.simulation.robot_with_faults import FaultyRobot, obstruction_of
from projservo_cli.stages.stage_inputs import Drive, OwnRobot

_NEVER_LATE_S = 3600.0  # for a simulated robot, whose code may be compiled first


def plugin_robot(
    own: OwnRobot,
    bounds: Bounds,
    types: str,
    numbers: Sequence[int],
    given: Robot | None = None,
    view: Sequence[str] | None = None,
    *,
    further: Sequence[int] = (),
) -> PluginRobot:
    """Make the user's robot, unless it is given; an InputError if a joint has no speed limit.

    types : one letter a joint, R or P; numbers : of the markers of the tool that the robot observes; further
        : of markers of objects, likewise.
    view : names of the views of readings, which go on if a camera is lost; None for all of the robot's,
        none of which may be lost.
    """
    limited = np.isfinite(bounds.limits.speed)
    for kind, key in (("R", "joint_speed_limit_deg_s"), ("P", "prismatic_speed_limit_m_s")):
        if any(letter == kind and not known for letter, known in zip(types, limited, strict=True)):
            raise InputError(
                f"plant {own.target}: a robot that is not simulated needs a limit: set control.{key}"
            )
    name, timeout_s = f"plant {plugins.short_name(own.target)}", own.timeout_s
    if given is None:
        robot = _made(own, (*numbers, *further), bounds, whole=view is None)
    else:
        robot = by_joints(given, name, own.flange_chart)
    if own.cameras is not None:  # a reading waits for a camera that reconnects
        timeout_s += own.cameras.reconnect_s
    waits, size = (timeout_s, own.open_s), own.image_size
    return PluginRobot(
        robot, name, len(numbers), bounds, *waits, image_size=size, view=view, objects=len(further)
    )


def _made(own: OwnRobot, numbers: Sequence[int], bounds: Bounds, *, whole: bool) -> Robot:
    """Make an object of the class of a robot, with its options, and cameras if it brings none.

    A class that takes an argument ``limits`` is given the limits of its joints, and ``numbers`` all numbers.

    whole : whether none of these cameras may be lost.
    """
    options = dict(own.options)
    if MASK in repr((options, own.cameras)):
        raise InputError(
            f"plant {own.target}: a password of its options or cameras is masked, as run files keep none: "
            "name the configuration, -c FILE"
        )
    if takes_limits(own):
        options["limits"] = bounds.limits
    if "numbers" not in options and plugins.takes(own.target, "numbers"):
        options["numbers"] = tuple(numbers)
    if own.cameras is not None:
        arm: Arm = plugins.make("plant", own.target, (), options)
        if not plugins.brings_no_pixels(arm):
            raise InputError(
                f"plant {own.target}: has read(), which brings pixels, and cameras are configured as well: "
                "write joints() in its place, or leave cameras out"
            )
        arm = by_joints(arm, f"plant {own.target}", own.flange_chart)
        finder = finder_of(own.board, own.dictionary)
        return CameraRobot(arm, own.cameras, finder, numbers, whole=whole)
    if own.dictionary is not None and own.board is None:
        if not plugins.takes(own.target, "dictionary"):
            raise InputError(
                f"markers.dictionary: is without effect: plant.use {own.target} takes no argument "
                "dictionary; leave it out, or let the class take it"
            )
        options["dictionary"] = own.dictionary
    robot: Robot = plugins.make("plant", own.target, (), options)
    if not callable(getattr(robot, "read", None)):
        raise InputError(
            f"plant {own.target}: has joints(), which brings no pixels: configure cameras, left and right"
        )
    return by_joints(robot, f"plant {own.target}", own.flange_chart)


def takes_limits(own: OwnRobot) -> bool:
    """Whether the class of a robot is made with the limits of its joints."""
    return "limits" not in own.options and plugins.takes(own.target, "limits")


def path_to(
    robot: Steered, q: FloatArray, settle_s: float, what: str, fit: Callable[[Reading], None] | None = None
) -> Iterator[Reading]:
    """Move to joints (n,) along a straight line at the speed limit and come to rest there.

    what : its command, for messages.
    fit : is shown the first reading, before anything moves; it raises where nothing should.
    Yields the reading after each command. The robot has then been at rest for a time, s, and so have the
    images. Raises WorkFailed if a joint does not follow, goes the other way, or nothing comes to rest, or if
    one reads a whole turn beyond its limits.
    """
    bounds, still = robot.robot.bounds, Standstill(settle_s)
    begun = robot.observe().q
    require_no_turn_off(bounds, begun)
    if fit is not None:
        fit(robot.reading)
    while (gap := q - robot.target).any():
        periods = np.max(np.abs(gap) / (bounds.limits.speed * bounds.period), initial=1.0)
        robot.command(gap / periods, bounds.period)
        stands = still.joints(robot.observe())
        yield robot.reading
        away = np.abs(q - robot.reading.q) - np.abs(q - begun)
        at_bound = np.abs(robot.target - robot.reading.q) >= bounds.lead * (1.0 - 1e-6)
        if (away > bounds.lead).any() or (stands and at_bound.any()):
            break
    else:
        yield from at_rest(robot.reading, robot.hold, settle_s, what)
    gap = np.abs(q - robot.reading.q)
    i, sag = int(np.argmax(gap / np.maximum(bounds.sag, STILL))), bounds.sag
    if gap[i] > max(sag[i], STILL) or (q != robot.target).any():
        unit, obstructions = bounds.unit(i), obstruction_of(robot.robot.robot)
        further = gap[i] > abs(q[i] - begun[i]) + sag[i]
        code = "obstructed" if obstructions else "moved_away" if further else "stands_short"
        found = Finding("joint_reading", amount=robot.reading.q[i], limit=begun[i], unit=unit)
        of, others = Subject(joints=(i + 1,)), (found, *obstructions)
        short = Finding(code, REFUSES, of, gap[i], limit=q[i], unit=unit, others=others)
        again = "; then run the command again" + (" to continue" if what == "record" else "")
        setup = Setup(coordinates=getattr(robot.robot.robot, "coordinates", ()))
        raise messages.failed([short], setup, again, stage=what)


def simulated_robot(driven: Drive, joints: Joints, robot: FaultyRobot) -> PluginRobot:
    """A simulated robot of the contract, which is never late, and goes beyond its limits if it may."""
    bounds = driven.following.bounds(joints)
    if driven.endless:
        endless = np.full(len(joints.types), math.inf)
        bounds = bounds._replace(limits=bounds.limits._replace(lower=-endless, upper=endless))
    markers, waits = len(robot.world.truth.number), (_NEVER_LATE_S, _NEVER_LATE_S)
    return PluginRobot(robot, "the simulated robot", markers, bounds, *waits, objects=len(driven.further))


def opened_robot(
    session: Session,
    driven: Drive,
    joints: Joints,
    observed: Sequence[int],
    view: Sequence[str],
    given: Robot | None = None,
) -> Steered:
    """Open the user's robot in a session, unless it is open; no joint is moved.

    observed : numbers of the markers of the tool; view : names of the views of the calibration.
    given : an object of the contract instead of one of a class.
    """
    if session.steered is not None:
        session.steered.resume()
        return session.steered
    assert isinstance(driven.robot, OwnRobot)
    bounds, types = driven.following.bounds(joints), joints.types
    known, further = (driven.robot, bounds, types, observed), driven.further
    return session.opened(plugin_robot(*known, given, view, further=further))
