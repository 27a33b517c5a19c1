"""Simulated robot with faults: latency, coarse encoders, servo lag, gravity sag and backlash.

Its time passes in ``command`` alone, so that its runs are the same to the bit wherever they are made. A servo
goes to its set-point in a straight line by the time that is due, and holds there; it follows with a lag of
first order, less the sag by its load. Beyond the encoder there are backlash, a slip and a link that flexes.
Rolling shutters are not modelled.
"""

import bisect
import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np

from projservo_cli.calibration.detections import per_rad
from projservo_cli.findings import Finding
from projservo_cli.geometry.kinematics import joint_operators
from projservo_cli.records import ByteArray, FloatArray
from projservo_cli.settings.disturbance import Events, Faults, JointMoved, LostMarkers, StuckEncoder
from projservo_cli.simulation.arm import SerialArm
from projservo_cli.simulation.ground_truth import SceneObject, Truth
from projservo_cli.simulation.mujoco_servos import Physics
from projservo_cli.simulation.random_streams import generator
from projservo_cli.simulation.rendering import AT_OPENING, Frames, RenderedScene, rendered_model

# Joints are worked out this often at least, s, and taken as straight lines between.
_GRID_S = 0.005
_EXPOSED = 5  # instants of an exposure that are averaged
_POSTURES = 500  # that are drawn to see how far an arm reaches
_BEFORE = 2**20  # frames before the opening are numbered too
_CLOCKS_S = 100.0  # maximum offset of clocks of cameras


class SimulatedRobot(NamedTuple):
    """A simulated robot with time and faults."""

    truth: Truth
    faults: Faults
    scene: RenderedScene | None  # before rendered cameras; None for cameras that see points
    period: float  # period of the loop, s
    objects: tuple[SceneObject, ...] = ()  # that its cameras see, too


class _Eyes(Protocol):
    """The cameras of a rig."""

    @property
    def borders(self) -> bool:
        """Whether markers outside an image are unseen."""

    def open(self) -> None:
        """Make ready to look, in the thread that looks."""

    def close(self) -> None:
        """Release the cameras."""

    def capture(
        self,
        view: int,
        q: FloatArray,
        moved: tuple[int, FloatArray] | None,
        rng: np.random.Generator,
        times: FloatArray = ...,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Pixels (m, 2) in a frame of a view, NaN where unseen, and their deviations (m,), px, if known.

        q : (k, n) joints at instants of its exposure, rad or m; times : these (k,), s; at the opening by
            default.
        moved : number of a marker that was moved, and by how much in the frame of the tool, (3,) m.
        """


class Points(NamedTuple):
    """Cameras that see points, with noise."""

    truth: Truth
    # pixels (V, m, 2) of markers (m, 4), given at the reference, at joints (n,); NaN where unseen
    see: Callable[[FloatArray, FloatArray], FloatArray]
    borders: bool
    sigma_px: float  # noise of a coordinate of each frame
    objects: tuple[SceneObject, ...] = ()  # that they see, too

    def open(self) -> None:
        """Nothing is to be opened."""

    def close(self) -> None:
        """Nothing is left open."""

    def capture(
        self,
        view: int,
        q: FloatArray,
        moved: tuple[int, FloatArray] | None,
        rng: np.random.Generator,
        times: FloatArray = AT_OPENING,
    ) -> tuple[FloatArray, FloatArray | None]:
        """As of all cameras."""
        M = self.truth.M
        if moved is not None:
            M, by = (
                M.copy(),
                moved[1] if self.truth.on_tool else self.truth.robot.base_tool[:3, :3] @ moved[1],
            )
            M[self.truth.number.index(moved[0]), :3] += by
        mean_pixels = np.mean([self.see(joints, M)[view] for joints in q], axis=0)
        for one in self.objects:
            at = times if one.motion is not None else times[:1]
            of_object = [one.images(self.truth, one.at(float(time)))[view] for time in at]
            mean_pixels = np.concatenate([mean_pixels, np.mean(of_object, axis=0)])
        return np.asarray(mean_pixels + self.sigma_px * self.truth.noise.draw(rng, mean_pixels.shape)), None


class _Servos(Protocol):
    """Servos of the joints.

    ``setpoint``: (n,) where they are sent, rad or m. ``force``: the greatest on the arm when they last
    followed, N.
    """

    setpoint: FloatArray
    force: float

    @property
    def motor(self) -> FloatArray:
        """Return the positions of the encoders (n,), rad or m."""

    def follow(self, setpoint: FloatArray, seconds: float) -> None:
        """Let ``seconds`` pass while the set-point goes evenly to joints (n,), rad or m."""

    def strike(self, by: FloatArray) -> None:
        """Move joints, and where they are sent, by (n,), rad or m, at once."""


class World(NamedTuple):
    """A simulated robot and its rig without faults."""

    truth: Truth
    q_start: FloatArray  # (n,) first readings, rad or m
    eyes: _Eyes
    period: float  # period of the loop, s
    seed: int
    stream: int  # stream of the random numbers of the seed
    servos: _Servos | None = None  # at rest at q_start; None for servos of first order
    eyes_later: _Eyes | None = None  # since an object moved

    def random(self, view: int, k: int) -> np.random.Generator:
        """Random numbers of a frame of a view."""
        return generator(self.seed, self.stream, view, k)


def robot_by_itself(
    robot: SimulatedRobot, q_start: FloatArray, sigma_px: float, drawn: tuple[int, int]
) -> "FaultyRobot":
    """Return the simulated robot at joints (n,), rad or m, without events, whose images have borders.

    drawn : seed, and stream of its random numbers.
    """
    points = Points(robot.truth, robot.truth.images, True, sigma_px)
    return robot_of(robot, q_start, points, drawn, Events())


def robot_of(
    robot: SimulatedRobot, q_start: FloatArray, points: Points, drawn: tuple[int, int], events: Events
) -> "FaultyRobot":
    """The simulated robot at joints (n,), rad or m, before its cameras.

    points : cameras that see points, for a robot that is not before rendered ones.
    drawn : seed, and stream of its random numbers.
    """
    truth, faults, scene, period, objects = robot
    if scene is None:
        later, moved = None, events.object_moved
        points = points._replace(objects=objects)
        if moved is not None:
            after = [one.displaced(moved) if one.name == moved.name else one for one in objects]
            later = points._replace(objects=tuple(after))
        return FaultyRobot(World(truth, q_start, points, period, *drawn, eyes_later=later), faults, events)
    rendered = rendered_model(scene)
    servos = Physics(rendered, q_start, faults.servo_time_constant_s, math.radians(faults.gravity_sag_deg))
    return FaultyRobot(World(truth, q_start, Frames(rendered), period, *drawn, servos), faults, events)


def observed_in_frames(
    scene: RenderedScene, frames: int, q: FloatArray, drawn: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Pixels (V, m, 2) that frames of a robot at rest at joints (n,), rad or m, show on average.

    And their standard deviations (V, m), of which averaging takes nothing: the same view errs alike. Both are
    NaN where most frames of a view do not show a marker.

    drawn : seed, and stream of its random numbers.
    """
    return _looked(scene, frames, q.tobytes(), drawn)


@lru_cache(maxsize=256)
def _looked(
    scene: RenderedScene, frames: int, q_bytes: bytes, drawn: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    eyes, q = Frames(rendered_model(scene)), np.frombuffer(q_bytes)[None]
    V = len(scene.view)
    detected = np.full((frames, V, len(scene.numbers), 3), np.nan)
    eyes.open()
    try:
        for k, view in np.ndindex(frames, V):
            pixels, sigma = eyes.capture(view, q, None, generator(*drawn, view, k))
            detected[k, view] = np.column_stack([pixels, sigma])
    finally:
        eyes.close()
    count = np.isfinite(detected[..., :1]).sum(axis=0)
    mean = np.where(2 * count > frames, np.nansum(detected, axis=0) / np.maximum(count, 1), np.nan)
    return np.ascontiguousarray(mean[..., :2]), np.ascontiguousarray(mean[..., 2])


class FaultyRobot:
    """A simulated robot of the contract.

    world : the robot and its rig; faults : permanent ones; events : of the run.
    ``view``: names of its views. ``taken``: (V,) true exposure times of the last frames, s, which no robot
    knows. ``frames``: (V, height, width) the last frames of rendered cameras; None of others.
    """

    def __init__(self, world: World, faults: Faults, events: Events) -> None:
        self.world, self._faults, self._events = world, faults, events
        self._joints = _Joints(world, faults, events.joint_moved)
        self.view = world.truth.view
        self._cameras = [_Camera(self._joints, world, faults, events, view) for view in range(len(self.view))]
        self._frozen: float | None = None
        self.taken = np.full(len(self.view), math.nan)

    def open(self) -> None:
        """Open the cameras, in the thread that drives."""
        self.world.eyes.open()

    def read(self) -> tuple[Any, ...]:
        """Joint readings (n,), rad or m, and pixels (V, m, 2), with stamps and deviations if there are."""
        now, q = self.now(), self._reading()
        frames = [camera.newest(now) for camera in self._cameras]
        self.taken[:] = [frame.middle for frame in frames]
        pixels = np.stack([frame.pixels for frame in frames])
        sigmas = [frame.sigma for frame in frames if frame.sigma is not None]
        if not self._faults.stamps and not sigmas:
            return q, pixels
        stamped = [now, *(frame.stamp for frame in frames)]
        stamps = stamped if self._faults.stamps else [None] * len(stamped)
        return (q, pixels, *stamps, np.stack(sigmas)) if sigmas else (q, pixels, *stamps)

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Go to joints (n,) by the time that is due, s; if none comes then, they are held."""
        del speed
        self._joints.go(_whole(target, self._faults.quantize_setpoints * self._joints.tick), due)

    def now(self) -> float:
        """Time since the opening, s."""
        return self._joints.times[-1]

    def force(self) -> float:
        """Greatest force on the arm since it was last asked for, N; 0 without an obstacle."""
        greatest, self._joints.force = self._joints.force, 0.0
        return greatest

    @property
    def frames(self) -> ByteArray | None:
        """The last frames of the cameras as they were searched, if they are rendered."""
        return self.world.eyes.last if isinstance(self.world.eyes, Frames) else None

    def truth(self) -> FloatArray:
        """True joints (n,), rad or m."""
        return self._joints.links[-1].copy()

    def stop(self) -> None:
        """Nothing moves between commands."""

    def close(self) -> None:
        """Close the cameras."""
        self.world.eyes.close()

    def _reading(self) -> FloatArray:
        """Joint readings (n,) as encoders count them."""
        q, frozen = _whole(self._joints.servos.motor, self._joints.tick), self._events.stuck_encoder
        if frozen is not None and _lasts(frozen, _step(self.now(), self.world.period)):
            self._frozen = q[frozen.joint - 1] if self._frozen is None else self._frozen
            q[frozen.joint - 1] = self._frozen
        return q


def full_reach(arm: SerialArm) -> float:
    """Return the longest lever of a joint to the tool, m: the maximum over random postures."""
    rng = np.random.default_rng(0)
    low, high = (np.clip(limit, -math.pi, math.pi) for limit in (arm.limits.lower, arm.limits.upper))
    postures = rng.uniform(low, high, (_POSTURES, len(low)))
    turning = ~arm.prismatic
    return float(max(np.linalg.norm(_tool_velocity(arm, q)[turning], axis=1).max() for q in postures))


def _tool_velocity(arm: SerialArm, q: FloatArray) -> FloatArray:
    """Velocity (n, 3) of the tool by each joint at joints (n,), m per rad or m."""
    model = arm.model(np.zeros((1, 3, 4)))
    return np.asarray((joint_operators(model, q) @ arm.pose(q)[:, 3])[:, :3])


def _whole(q: FloatArray, tick: FloatArray) -> FloatArray:
    """Joints (n,) to the nearest of their ticks (n,), of which 0 are no ticks."""
    coarse = tick > 0.0
    return np.where(coarse, tick * np.round(q / np.where(coarse, tick, 1.0)), q)


def _lasts(event: StuckEncoder | LostMarkers, step: int) -> bool:
    """Whether it is so in a period."""
    return event.from_step <= step < event.from_step + (event.steps or math.inf)


def _step(time: float, period: float) -> int:
    """Number of the period that a time, s, is in; rounding does not bring its beginning before it."""
    return math.floor(time / period + 1e-6)


class _FirstOrder:
    """Servos that follow with a lag of first order, with sag under the load of the tool."""

    force = 0.0  # no obstacle

    def __init__(
        self, load: Callable[[FloatArray], FloatArray], q: FloatArray, lag_s: float, sag: float
    ) -> None:
        self._load, self._lag, self._sag = load, lag_s, sag
        self.motor = np.array(q, dtype=np.float64)
        self.setpoint = self.motor - sag * load(self.motor)

    def follow(self, setpoint: FloatArray, seconds: float) -> None:
        """Let ``seconds`` pass while the set-point goes evenly to joints (n,), rad or m.

        m' = (u - m) / lag has the solution m = u - v lag + (m_0 - u_0 + v lag) exp(-t / lag) where u goes at
        the pace v; the load of the posture is taken as constant meanwhile.
        """
        if seconds > 0.0:
            load, lag = self._sag * self._load(self.motor), self._lag
            before, after = self.setpoint + load, setpoint + load
            behind = (after - before) * (lag / seconds)
            fades = math.exp(-seconds / lag) if lag > 0.0 else 0.0
            self.motor = after - behind + (self.motor - before + behind) * fades if lag > 0.0 else after
        self.setpoint = setpoint

    def strike(self, by: FloatArray) -> None:
        """Move joints, and where they are sent, by (n,), rad or m, at once."""
        self.setpoint, self.motor = self.setpoint + by, self.motor + by


class _Joints:
    """Servos, play and links over time.

    ``servos``: their actuators. ``times, links``: every past instant, s, and the true joints (n,) there.
    ``tick``: (n,) step of the encoders, 0 for none. All rad or m. ``force``: the greatest on the arm until
    now, N, which whoever asks sets back.
    """

    def __init__(self, world: World, faults: Faults, moved: JointMoved | None) -> None:
        self.arm, self._moved = world.truth.robot, moved
        self._moved_at = math.inf if moved is None else moved.at_step * world.period
        scale = per_rad(self.arm.prismatic)
        self.tick = scale * (
            2.0 * math.pi / faults.encoder_counts_per_turn if faults.encoder_counts_per_turn else 0.0
        )
        self._play = 0.5 * math.radians(faults.backlash_deg) * scale
        # Sag by gravity of a joint that holds the tool at full reach, rad.
        sag, self._flex = math.radians(faults.gravity_sag_deg), math.radians(faults.link_deflection_deg)
        self._loaded = sag > 0.0 or self._flex > 0.0
        self._reach = full_reach(self.arm) if self._loaded else 1.0
        self.servos = world.servos or _FirstOrder(
            self._load, world.q_start, faults.servo_time_constant_s, sag
        )
        self._link = self.servos.motor.copy()  # beyond the play
        self._slip = np.zeros(len(self._link))  # beyond both
        self.force = 0.0
        self.times, self.links = [0.0], [self._link + self._flex * self._load(self._link)]

    def go(self, target: FloatArray, due: float) -> None:
        """Move the set-point to joints (n,) by a time, s."""
        begun = self.times[-1]
        parts = max(1, math.ceil((due - begun) / _GRID_S - 1e-6))
        for left in range(parts, 0, -1):
            time = max(begun, due - (due - begun) * (left - 1) / parts)
            share = (target - self.servos.setpoint) / left
            self._advance(time, self.servos.setpoint + share if left > 1 else target)

    def at(self, time: float) -> FloatArray:
        """True joints (n,) at a past time, s; before the opening they were at rest."""
        i = bisect.bisect_right(self.times, time)
        if i == 0 or i == len(self.times):
            return self.links[max(0, i - 1)]
        x = (time - self.times[i - 1]) / (self.times[i] - self.times[i - 1])
        return np.asarray((1.0 - x) * self.links[i - 1] + x * self.links[i])

    def _advance(self, time: float, setpoint: FloatArray) -> None:
        """To a time, s, while the set-point goes evenly to joints (n,)."""
        self.servos.follow(setpoint, time - self.times[-1])
        self.force = max(self.force, self.servos.force)
        if time >= self._moved_at - 1e-9:
            self._strike()
        motor = self.servos.motor
        self._link = np.clip(self._link, motor - self._play, motor + self._play)
        self.times.append(time)
        self.links.append(self._link + self._slip + self._flex * self._load(self._link))

    def _strike(self) -> None:
        """A joint is knocked aside, or slips."""
        assert self._moved is not None
        by = np.zeros(len(self._link))
        by[self._moved.joint - 1] = self._moved.by
        self._moved_at = math.inf
        if not self._moved.encoder_slip:
            self.servos.strike(by)
        else:
            self._slip = by

    def _load(self, q: FloatArray) -> FloatArray:
        """Torque (n,) of gravity in each joint by the tool at joints (n,), 1 at full reach."""
        if not self._loaded:
            return np.zeros(len(q))
        turning = ~self.arm.prismatic
        return np.asarray(np.where(turning, -_tool_velocity(self.arm, q)[:, 2], 0.0) / self._reach)


class _Frame(NamedTuple):
    """An image."""

    middle: float  # middle of its exposure, s
    stamp: float  # the same by the clock of the camera
    pixels: FloatArray  # (m, 2), NaN where unseen
    sigma: FloatArray | None  # (m,) their deviations, px, if they are known


class _Camera:
    """One of the cameras, which runs freely or takes a frame per reading."""

    def __init__(self, joints: _Joints, world: World, faults: Faults, events: Events, view: int) -> None:
        self._joints, self._world, self._faults, self._events = joints, world, faults, events
        self._view, self._looks = view, 0
        # No frame is read before it was exposed whole.
        self._delay = max(faults.camera_latency_s.of(world.truth.view[view]) or 0.0, 0.5 * faults.exposure_s)
        self._interval = 0.0 if faults.frame_rate_hz is None else 1.0 / faults.frame_rate_hz
        self._clock = float(world.random(view, 0).uniform(-_CLOCKS_S, _CLOCKS_S))
        self._first = float(world.random(0, 0).uniform(0.0, 1.0)) * self._interval
        self._first += view * faults.frame_offset_s
        self._last: tuple[int, _Frame] | None = None

    def newest(self, now: float) -> _Frame:
        """The newest frame that can be read."""
        if not self._interval:
            self._looks += 1
            middle = now - self._delay + self._jitter(self._looks)
            return self._exposed(self._looks, min(middle, now - 0.5 * self._faults.exposure_s))
        k = math.floor((now - self._delay - self._first) / self._interval) + 2
        while self._middle(k) + self._delay > now:
            k -= 1
        if self._last is None or self._last[0] != k:
            self._last = k, self._exposed(k, self._middle(k))
        return self._last[1]

    def _middle(self, k: int) -> float:
        """When a frame of a camera that runs freely is half exposed, s."""
        return self._first + k * self._interval + self._jitter(k)

    def _jitter(self, k: int) -> float:
        if not self._faults.jitter_s:
            return 0.0
        return self._faults.jitter_s * float(self._world.random(self._view, _BEFORE + k).standard_normal())

    def _exposed(self, k: int, middle: float) -> _Frame:
        """The frame of a number, its exposure half over at a time, s."""
        world, events, step = self._world, self._events, _step(middle, self._world.period)
        truth, befell, moved = world.truth, events.marker_moved, None
        if befell is not None and step >= befell.at_step:
            moved = befell.marker, np.array(befell.by_m)
        many = _EXPOSED if self._faults.exposure_s else 1
        times = middle + self._faults.exposure_s * ((np.arange(many) + 0.5) / many - 0.5)
        rng = world.random(self._view, _BEFORE + k)
        rng.standard_normal()  # random number of the jitter
        q = np.array([self._joints.at(t) for t in times])
        eyes = world.eyes
        if (shifted := events.object_moved) is not None and step >= shifted.at_step:
            eyes = world.eyes_later or eyes
        pixels, sigma = eyes.capture(self._view, q, moved, rng, times)
        if (knocked := events.camera_moved) is not None and step >= knocked.at_step:
            pixels += knocked.shift_of(truth.view[self._view])
        if (lost := events.lost_markers) is not None and _lasts(lost, step):
            pixels[[truth.number.index(number) for number in lost.markers or truth.number]] = math.nan
        if world.eyes.borders:
            pixels = truth.within(pixels, self._view)
        return _Frame(middle, middle + self._clock, pixels, sigma)


def obstruction_of(robot: object) -> tuple[Finding, ...]:
    """Return what obstructs an arm, if its simulation knows it."""
    servos = robot.world.servos if isinstance(robot, FaultyRobot) else None
    return servos.obstruction if isinstance(servos, Physics) else ()
