"""Robots of the contract: made, checked against the calibration, driven to given joints, waited for."""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from projservo_cli.calibration import predict
from projservo_cli.detection import DICTIONARY, TagFinder
from projservo_cli.geometry.algebra import mat
from projservo_cli.hardware.camera_robot import Arm, CameraRobot
from projservo_cli.image_size import image_sizes
from projservo_cli.masking import MASK
from projservo_cli.monitoring.image_monitor import ImageMonitor
from projservo_cli.monitoring.innovation_tests import WINDOW
from projservo_cli.records import VIEWS, Calibration, FloatArray, InputError, IntArray, WorkFailed
from projservo_cli.robots import plugins
from projservo_cli.robots.client import DrivenRobot, Known
from projservo_cli.robots.contract import Bounds, PluginRobot, Reading, Robot
from projservo_cli.robots.latency import NOTHING_KNOWN, DelayPrior
from projservo_cli.robots.pacing import Steered
from projservo_cli.robots.settings import Joints, OwnRobot
from projservo_cli.simulation.faults import (
    Events,
    FaultyRobot,
    Points,
    SimulatedRobot,
    obstruction_of,
    robot_of,
)
from projservo_cli.simulation.ideal import Plant, observe
from projservo_cli.stages.given import Contract, Driven
from projservo_cli.stages.scenario import SERVO_NOISE, RunScenario

# Drift of a joint, rad or m, and of an image, px rms, within which both count as still.
_STILL, _STILL_PX = 2e-5, 0.02
_NEVER_LATE_S = 3600.0  # for a simulated robot, whose code may be compiled first
_LEAST = 6  # readings that separate noise from motion
# Minimum deviation of a delay and of single frames, s; width of a 95 % interval in deviations.
_LEAST_JITTER_S, _INTERVAL = 0.002, 3.92
_PATIENCE_S = 20.0  # for a robot to come to rest where it was sent
_WAITED = 5  # looks for each image that is wanted, where the same one comes again


def plugin_robot(
    own: OwnRobot, bounds: Bounds, types: str, numbers: Sequence[int], given: Robot | None = None
) -> PluginRobot:
    """Make a robot of somebody's, unless it is given; an InputError where a joint has no speed limit.

    types : one letter a joint, R or P; numbers : of the markers that the robot observes.
    """
    limited = np.isfinite(bounds.limits.speed)
    for kind, key in (("R", "joint_speed_limit_deg_s"), ("P", "prismatic_speed_limit_m_s")):
        if any(letter == kind and not known for letter, known in zip(types, limited, strict=True)):
            raise InputError(
                f"plant {own.target}: a robot that is not simulated needs a limit: set control.{key}"
            )
    robot, name, timeout_s = (
        _made(own, numbers, bounds) if given is None else given,
        f"plant {plugins.short_name(own.target)}",
        own.timeout_s,
    )
    if own.cameras is not None:  # a reading waits for a camera that reconnects
        timeout_s += own.cameras.reconnect_s
    return PluginRobot(robot, name, len(numbers), bounds, timeout_s, own.open_s, own.image_size)


def _made(own: OwnRobot, numbers: Sequence[int], bounds: Bounds) -> Robot:
    """Make an object of the class of a robot, with its options, and cameras where it brings none.

    A class that takes an argument ``limits`` is given those of its joints.
    """
    options = dict(own.options)
    if MASK in repr((options, own.cameras)):
        raise InputError(
            f"plant {own.target}: a password of its options or cameras is masked, as run files keep none: "
            "name the configuration, -c FILE"
        )
    if takes_limits(own):
        options["limits"] = bounds.limits
    if own.cameras is not None:
        arm: Arm = plugins.make("plant", own.target, (), options)
        if not plugins.brings_no_pixels(arm):
            raise InputError(
                f"plant {own.target}: has read(), which brings pixels, and cameras are configured as well: "
                "write joints() in its place, or leave cameras out"
            )
        return CameraRobot(arm, own.cameras, TagFinder(own.dictionary or DICTIONARY), numbers)
    if own.dictionary is not None:
        if not plugins.takes("plant", own.target, "dictionary"):
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
    return robot


def takes_limits(own: OwnRobot) -> bool:
    """Whether the class of a robot is made with the limits of its joints."""
    return "limits" not in own.options and plugins.takes("plant", own.target, "limits")


def _require_no_turn_off(bounds: Bounds, q: FloatArray) -> None:
    """Refuse joints (n,) of which one reads a whole turn off: it would turn back by that, with its cables."""
    lower, upper = bounds.limits.lower, bounds.limits.upper
    beyond = ((q < lower) | (q > upper)) & np.isfinite(upper - lower)
    for i in np.flatnonzero(beyond).tolist():
        turns = np.round((q[i] - 0.5 * (lower[i] + upper[i])) / (2.0 * np.pi))
        if bounds.units[i] == "m" or not lower[i] <= q[i] - 2.0 * np.pi * turns <= upper[i]:
            continue
        limits = f"{bounds.text(i, lower[i])} to {bounds.text(i, upper[i])}"
        raise WorkFailed(
            f"nothing was moved: joint {i + 1} reads {bounds.text(i, q[i])}, a whole turn beyond its limits "
            f"{limits}: home it again where it stands"
        )


def path_to(
    robot: Steered, q: FloatArray, settle_s: float, what: str, fit: Callable[[Reading], None] | None = None
) -> Iterator[Reading]:
    """Move to joints (n,) along a straight line at the speed limit and come to rest there.

    what : the command it is for, in messages.
    fit : is shown the first reading, before anything moves; it raises where nothing should.
    Yields the reading after each command. The robot has then stood still for so many s, and so have the
    images. Raises WorkFailed if a joint does not follow, goes the other way, or nothing comes to rest, or if
    one reads a whole turn beyond its limits.
    """
    bounds, still = robot.robot.bounds, _Standstill(settle_s)
    begun = robot.observe().q
    _require_no_turn_off(bounds, begun)
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
    i, sag = int(np.argmax(gap / np.maximum(bounds.sag, _STILL))), bounds.sag
    if gap[i] > max(sag[i], _STILL) or (q != robot.target).any():
        remedy = "free the robot, or check its sag and backlash (plant.max_steady_state_error_deg)"
        if gap[i] > abs(q[i] - begun[i]) + sag[i]:
            remedy = (
                f"it moved away from there, from {bounds.text(i, begun[i])}: check its sign and unit, and "
                "whether it can hold its load"
            )
        if obstruction := obstruction_of(robot.robot.robot):
            remedy = f"{obstruction}: take joints that it can reach and hold"
        raise WorkFailed(
            f"{what}: joint {i + 1} was sent to {bounds.text(i, q[i])} and stands at "
            f"{bounds.text(i, robot.reading.q[i])}, {bounds.text(i, gap[i], 3)} short: {remedy}; then run "
            "the command again" + (" to continue" if what == "record" else "")
        )


def at_rest(
    reading: Reading, observe: Callable[[], Reading], settle_s: float, what: str
) -> Iterator[Reading]:
    """Read once per period until joints and images stand still, and yield each reading."""
    still, first = _Standstill(settle_s), reading.t_q
    while not still.all(reading):
        if reading.t_q > first + settle_s + _PATIENCE_S:
            raise WorkFailed(
                f"{what}: {still.moving or 'the robot'} does not come to rest within {_PATIENCE_S:g} s: look "
                "for what vibrates, creeps or flickers"
            )
        reading = observe()
        yield reading


def averaged(
    reading: Reading, observe: Callable[[], Reading], wanted: int
) -> tuple[Reading, FloatArray, FloatArray]:
    """Return the mean of readings of a robot at rest, with a number of frames of each view, each once.

    Frames are weighted by their deviations, if they have any. Markers that most of the frames of a view do
    not show are NaN. Returns the mean; sums (2, m) of the squares by which pixels are off it, px²; how many
    frames (2, m) show a marker, 0 where it is NaN.
    """
    readings, frames = [reading], [[_frame(reading, view)] for view in (0, 1)]
    for _ in range(_WAITED * wanted):
        if min(map(len, frames)) >= wanted:
            break
        readings.append(observe())
        for view, new in enumerate(readings[-1].new_views(readings[-2])):
            if new and len(frames[view]) < wanted:
                frames[view].append(_frame(readings[-1], view))
    s, sigma, squares, count = (np.stack(both) for both in zip(*map(_mean, frames), strict=True))
    q = readings[0].q + np.mean([seen.q - readings[0].q for seen in readings], axis=0)
    stated = reading.sigma_px if reading.sigma_px is None or len(readings) == 1 else sigma
    return readings[-1]._replace(q=q, s=s, sigma_px=stated), squares, count


def _frame(reading: Reading, view: int) -> FloatArray:
    """Return u, v and their deviation (m, 3), px, of a view; a deviation of one if it has none."""
    sigma = np.ones(len(reading.s[view])) if reading.sigma_px is None else reading.sigma_px[view]
    return np.column_stack([reading.s[view], sigma])


def _mean(frames: list[FloatArray]) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Mean (m, 2) of frames (m, 3) of one view, its deviation (m,), squares (m,) off it, their count (m,).

    An error without scatter from frame to frame does not average away: the share of the stated variance that
    scatters, of all markers together, becomes less.
    """
    seen, sigma = np.split(np.array(frames), [2], axis=2)
    count = np.isfinite(seen[..., 0]).sum(axis=0)
    count[2 * count <= len(seen)] = 0
    weight = np.where(np.isfinite(seen), sigma**-2.0, 0.0)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean: FloatArray = np.nansum(seen * weight, axis=0) / total
    mean[count == 0] = np.nan
    off = (seen - mean) ** 2
    freedom = 2 * np.maximum(count - 1, 0).sum()
    scatter = min(1.0, float(np.nansum(off / sigma**2)) / freedom) if freedom else 1.0
    typical = count / total[:, 0]  # variance of a frame
    variance = np.where(count > 0, typical * (1.0 - scatter) + scatter / total[:, 0], np.nan)
    return mean, np.sqrt(variance), np.nansum(off, axis=(0, 2)), count


class _Standstill:
    """Tells whether a robot has stood still for a time, s, by consecutive readings.

    Over that time, and no fewer than six looks, the means of its thirds differ by no more than noise
    explains, from the differences of consecutive readings: motion adds up, noise does not.

    Source: J. von Neumann, "Distribution of the ratio of the mean square successive difference to the
    variance", Annals of Mathematical Statistics 12, 1941.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._since = math.inf
        self._q: _Rows = deque()
        self._s: tuple[_Rows, _Rows] = deque(), deque()
        self._last: Reading | None = None
        self.moving = ""  # message on the part that moves

    def joints(self, reading: Reading) -> bool:
        """Whether the joints have stood still up to the next reading."""
        self._since = min(self._since, reading.t_q)
        square, variance = _drift(self._kept(self._q, reading.t_q, reading.q))
        moving = np.flatnonzero(square > np.maximum(_STILL**2, 9.0 * variance))
        self.moving = f"joint {moving[0] + 1}" if len(moving) else ""
        whole = reading.t_q - self._since >= self.seconds * (1.0 - 1e-9)
        return whole and len(self._q) >= _LEAST and not self.moving

    def all(self, reading: Reading) -> bool:
        """Whether joints and images have stood still up to the next reading."""
        still = self.joints(reading)
        new = reading.new_views(self._last)
        self._last = reading
        for view, rows in enumerate(self._s):
            frames = self._kept(rows, reading.t_q, reading.s[view].ravel() if new[view] else None)
            if rows[-1][0] < reading.t_q - self.seconds:
                continue  # the same image all the time
            square, variance = _drift(frames[:, np.isfinite(frames).all(axis=0)])
            if square.size and square.mean() > max(_STILL_PX**2, 2.0 * variance.mean()):
                self.moving = self.moving or f"the {VIEWS[view]} image"
            still = still and len(rows) >= _LEAST
        return still and not self.moving

    def _kept(self, rows: "_Rows", now: float, row: FloatArray | None) -> FloatArray:
        """The rows of the time that counts, with one more unless it is None."""
        if row is not None:
            rows.append((now, row))
        while len(rows) > _LEAST and rows[0][0] < now - self.seconds * (1.0 + 1e-9):
            rows.popleft()
        return np.array([values for _, values in rows])


_Rows = deque[tuple[float, FloatArray]]


def _drift(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variance of the means of the thirds of rows (k, c), and what noise makes of it, (c,)."""
    third = len(rows) // 3
    if third == 0:
        return np.zeros(rows.shape[1]), np.zeros(rows.shape[1])
    means = [part.mean(axis=0) for part in (rows[:third], rows[third:-third], rows[-third:])]
    noise = 0.5 * (np.diff(rows, axis=0) ** 2).mean(axis=0)
    return np.var(means, axis=0, ddof=1), noise / third


def simulated_robot(driven: Driven, joints: Joints, robot: FaultyRobot) -> PluginRobot:
    """A simulated robot of the contract, which is never late, and goes beyond its limits where it may."""
    bounds = driven.following.bounds(joints)
    if driven.endless:
        endless = np.full(len(joints.types), math.inf)
        bounds = bounds._replace(limits=bounds.limits._replace(lower=-endless, upper=endless))
    markers = len(robot.world.truth.number)
    return PluginRobot(robot, "the simulated robot", markers, bounds, _NEVER_LATE_S, _NEVER_LATE_S)


def _in_the_loop(scenario: RunScenario, robot: SimulatedRobot, events: Events) -> FaultyRobot:
    """The simulated robot of a scenario at the start of the task, which observes all markers."""
    truth, plant = robot.truth, scenario.plant_of("exact")
    face, others, workspace = list(truth.face), list(truth.pins), np.zeros_like(plant.M)

    def see(q: FloatArray, M: FloatArray) -> FloatArray:
        """Return the pixels of markers (m, 4) in both views at joints (n,)."""
        s, ordered = np.zeros((2, len(M), 2)), np.zeros((2, len(M), 2))
        H = mat(truth.displacement(q))
        observe(plant._replace(M=M[face], pins=M[others]), H, workspace, ordered, np.zeros(2))
        s[:, face + others] = ordered
        return s

    points = Points(truth, see, False, scenario.inputs.noise_px)
    drawn = scenario.inputs.seed, SERVO_NOISE
    return robot_of(robot, scenario.exact.q_start, points, drawn, events)


def connected(scenario: RunScenario, law: str, given: Robot | None = None) -> DrivenRobot:
    """Return the robot as the loop of a law sees it: with its truth, or with the calibrated model.

    given : an object of the contract instead of one of a class.
    """
    contract, joints, calibration = scenario.given.contract, scenario.joints, scenario.calibration
    assert calibration is not None
    assert contract is not None
    driven = contract.driven
    if isinstance(driven.robot, OwnRobot):
        plant, bounds = _believed_plant(scenario, calibration), driven.following.bounds(joints)
        robot = plugin_robot(driven.robot, bounds, joints.types, scenario.observed, given)
    else:
        plant = scenario.plant_of(law)
        robot = simulated_robot(driven, joints, _in_the_loop(scenario, driven.robot, contract.events))
    monitor = None
    if not scenario.untested:
        noise = scenario.given.stop.innovation_threshold * scenario.noise_px
        visible = np.flatnonzero(np.isin(calibration.marker, scenario.observed))
        readings = scenario.limits.max_steps + 1 + WINDOW
        monitor = ImageMonitor(calibration, noise, readings, visible, plant.image_size)
    return DrivenRobot(robot, plant, _known_of(scenario, contract, calibration, law), monitor)


def _believed_plant(scenario: RunScenario, calibration: Calibration) -> Plant:
    """Return the calibrated robot and its face."""
    task = scenario.ends.by_points().task(scenario.model)
    return Plant(
        model=scenario.model,
        M=np.ascontiguousarray(calibration.M[calibration.indices_of(scenario.numbers[: scenario.m])]),
        order=task.order,
        center=task.center,
        O=task.O,
        visible=task.visible,
        image_size=image_sizes(scenario.inputs.image_size),
        limits=scenario.joints.limits,
        opaque=False,
    )


def _known_of(scenario: RunScenario, contract: Contract, calibration: Calibration, law: str) -> Known:
    """Return the knowledge of a robot and its images before a law drives it."""
    numbers = scenario.observed
    return Known(
        predicted=partial(predict, calibration),
        visible=np.array([numbers.index(number) for number in scenario.numbers_of(law)]),
        order=np.array([numbers.index(k) if k in numbers else -1 for k in calibration.marker.tolist()]),
        sigma_px=scenario.noise_px,
        sigma_q=scenario.joints.length_of(math.degrees(calibration.sigma_q or 0.0)),
        delays=_delays_of(contract.time_offset_s, calibration),
        timeout_s=contract.timeout_s,
    )


def _delays_of(given: tuple[float, float] | None, calibration: Calibration) -> DelayPrior:
    """Return the prior of the delays of both views: given, calibrated, or wide."""
    known = NOTHING_KNOWN
    if calibration.time_offset_s is not None:
        interval, jitter = calibration.time_offset_interval_s, calibration.time_offset_jitter_s
        assert interval is not None
        assert jitter is not None
        sigma = np.maximum(np.ptp(interval, axis=1) / _INTERVAL, 0.5 * _LEAST_JITTER_S)
        known = DelayPrior(calibration.time_offset_s.copy(), sigma, np.maximum(jitter, _LEAST_JITTER_S))
    if given is not None:
        known = known._replace(mean=np.array(given), sigma=np.zeros(2))
    return known
