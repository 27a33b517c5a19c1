"""A simulated robot as robots are: late images, coarse encoders, servos that lag, sag and have play.

Its time passes in ``command`` alone, so that its runs are the same to the bit wherever they are made. A servo
goes to its set-point in a straight line by the time that is due, and holds there; it follows with a lag of
first order, less what its load costs it. Beyond the encoder there are play, a slip and a link that flexes.
Rolling shutters are not modelled.
"""

import bisect
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration import REACH_M, REACH_RAD
from projservo_cli.geometry.kinematics import joint_operators
from projservo_cli.records import PRISMATIC, FloatArray
from projservo_cli.robots.simulated import Arm

NEVER = 2**62
# Joints are worked out this often at least, s, and taken as straight lines between.
_GRID_S = 0.005
_EXPOSED = 5  # instants of an exposure that are averaged
# What a prismatic joint moves where a revolute one turns by a radian, m.
_M_PER_RAD = REACH_M / REACH_RAD
_POSTURES = 500  # that are drawn to see how far an arm reaches
_BEFORE = 2**20  # frames before the opening are numbered too
_CLOCKS_S = 100.0  # how far clocks of cameras are off at most


class Faults(NamedTuple):
    """What is wrong with joints and time of a simulated robot; nothing where none is given."""

    delay: tuple[float, float] = (0.0, 0.0)  # of each view: s from the middle of an exposure to its reading
    exposure: float = 0.0  # over which an image is averaged, s
    jitter: float = 0.0  # deviation of the middle of single exposures, s
    interval: float = 0.0  # s between the frames of cameras that run freely; 0 takes one at each look
    offset: float = 0.0  # s by which the right one's come after the left one's, then
    stamps: bool = False  # whether frames carry the middle of their exposure, by clocks of their own
    ticks: int = 0  # of an encoder a turn; 0 for no end of them
    setpoint_ticks: bool = False  # whether set-points are whole ticks too
    lag: float = 0.0  # time constant of the servos, s
    # sag, flex: what gravity costs a joint that holds the tool at full reach, rad, read and not read
    sag: float = 0.0
    flex: float = 0.0
    play: float = 0.0  # width of the play between encoder and link, rad


class Events(NamedTuple):
    """What befalls a robot so many periods after it was opened; nothing where none is given."""

    bump_at: int = NEVER
    bump: FloatArray | float = 0.0  # (n,) by how much joints are struck, rad or m
    slips: bool = False  # bump_at, bump, slips: whether it is the link that slips on its encoder
    frozen: int = -1  # joint whose reading stands still
    frozen_at: int = NEVER
    frozen_until: int = NEVER  # frozen_at, frozen_until: periods of the reading that stays, and of the next
    camera_at: int = NEVER
    camera: FloatArray | float = 0.0  # (2, 2) by how much images are shifted from then on, px
    marker_at: int = NEVER
    marker: int = 0
    marker_by: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the frame of the tool, m
    lost_at: int = NEVER
    lost_until: int = NEVER
    lost: tuple[int, ...] = ()  # lost_at, lost_until, lost: markers that no camera sees meanwhile


class World(NamedTuple):
    """A simulated robot and its rig while nothing is wrong."""

    arm: Arm
    q_start: FloatArray  # (n,) first readings, rad or m
    M: FloatArray  # (m, 4) markers at the reference, m
    # pixels (2, m, 2) of markers (m, 4) after a displacement (4, 4), NaN where unseen
    see: Callable[[FloatArray, FloatArray], FloatArray]
    sigma_px: float  # noise of a coordinate of each frame
    period: float  # of the loop, s
    random: Callable[[int, int], np.random.Generator]  # of a frame of a view
    size: tuple[float, float] | None = None  # of images that end at their border, px


class FaultyRobot:
    """A simulated robot of the contract.

    world : the robot and its rig.
    faults, events : what is wrong with it, and what befalls it.
    ``taken``: (2,) when both frames of the last look were taken, s, which no robot knows.
    """

    def __init__(self, world: World, faults: Faults, events: Events) -> None:
        self._world, self._faults, self._events = world, faults, events
        self._joints = _Joints(world, faults, events)
        self._cameras = [_Camera(self._joints, world, faults, events, view) for view in range(2)]
        self._frozen: float | None = None
        self.taken = np.full(2, math.nan)

    def open(self) -> None:
        """Nothing is to be opened."""

    def read(self) -> tuple[FloatArray, FloatArray] | tuple[FloatArray, FloatArray, float, float, float]:
        """Joint readings (n,), rad or m, and pixels (2, m, 2), with stamps, s, where frames carry them."""
        now, q = self.now(), self._reading()
        frames = [camera.newest(now) for camera in self._cameras]
        self.taken[:] = [frame.middle for frame in frames]
        pixels = np.stack([frame.pixels for frame in frames])
        if not self._faults.stamps:
            return q, pixels
        return q, pixels, now, frames[0].stamp, frames[1].stamp

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Go to joints (n,) by the time that is due, s; where none comes then, they are held."""
        del speed
        self._joints.go(_whole(target, self._faults.setpoint_ticks * self._joints.tick), due)

    def now(self) -> float:
        """Time since the opening, s."""
        return self._joints.times[-1]

    def truth(self) -> FloatArray:
        """True joints (n,), rad or m."""
        return self._joints.links[-1].copy()

    def stop(self) -> None:
        """Nothing moves between commands."""

    def close(self) -> None:
        """Nothing is left open."""

    def _reading(self) -> FloatArray:
        """Joint readings (n,) as encoders count them."""
        q, events = _whole(self._joints.motor, self._joints.tick), self._events
        step = _step(self.now(), self._world.period)
        if events.frozen_at <= step < events.frozen_until:
            self._frozen = q[events.frozen] if self._frozen is None else self._frozen
            q[events.frozen] = self._frozen
        return q


def full_reach(arm: Arm) -> float:
    """Longest lever that a joint has to the tool, m: the most found in postures drawn within the limits."""
    rng = np.random.default_rng(0)
    low, high = (np.clip(limit, -math.pi, math.pi) for limit in (arm.lower, arm.upper))
    postures = rng.uniform(low, high, (_POSTURES, len(low)))
    turning = arm.joint_types != PRISMATIC
    return float(max(np.linalg.norm(_tool_velocity(arm, q)[turning], axis=1).max() for q in postures))


def _tool_velocity(arm: Arm, q: FloatArray) -> FloatArray:
    """Velocity (n, 3) of the tool by each joint at joints (n,), m per rad or m."""
    model = arm.model(np.zeros((2, 3, 4)))
    return np.asarray((joint_operators(model, q) @ arm.pose(q)[:, 3])[:, :3])


def _whole(q: FloatArray, tick: FloatArray) -> FloatArray:
    """Joints (n,) to the nearest of their ticks (n,), of which 0 are no ticks."""
    coarse = tick > 0.0
    return np.where(coarse, tick * np.round(q / np.where(coarse, tick, 1.0)), q)


def _step(time: float, period: float) -> int:
    """Number of the period that a time, s, is in; rounding does not bring its beginning before it."""
    return math.floor(time / period + 1e-6)


class _Joints:
    """Servos, play and links over time.

    ``times, links``: every instant so far, s, and the true joints (n,) there. ``motor``: (n,) where the
    encoders are now. ``tick``: (n,) of the encoders, 0 for none. All rad or m.
    """

    def __init__(self, world: World, faults: Faults, events: Events) -> None:
        self.arm, self.faults, self.events = world.arm, faults, events
        self._strikes = [events.bump_at * world.period] if events.bump_at < NEVER else []
        scale = np.where(world.arm.joint_types == PRISMATIC, _M_PER_RAD, 1.0)
        self.tick = scale * (2.0 * math.pi / faults.ticks if faults.ticks else 0.0)
        self._play = 0.5 * faults.play * scale
        self._loaded = faults.sag > 0.0 or faults.flex > 0.0
        self._reach = full_reach(world.arm) if self._loaded else 1.0
        self.motor = np.array(world.q_start, dtype=np.float64)
        self._link, self._slip = self.motor.copy(), np.zeros(len(self.motor))  # beyond the play; beyond both
        load = self._load(self.motor)
        self._setpoint = self.motor - faults.sag * load
        self.times, self.links = [0.0], [self._link + faults.flex * load]

    def go(self, target: FloatArray, due: float) -> None:
        """Move the set-point to joints (n,) by a time, s."""
        begun = self.times[-1]
        parts = max(1, math.ceil((due - begun) / _GRID_S - 1e-6))
        for left in range(parts, 0, -1):
            time = max(begun, due - (due - begun) * (left - 1) / parts)
            share = (target - self._setpoint) / left
            self._advance(time, self._setpoint + share if left > 1 else target)

    def at(self, time: float) -> FloatArray:
        """True joints (n,) at a time so far, s; before the opening they stood still."""
        i = bisect.bisect_right(self.times, time)
        if i == 0 or i == len(self.times):
            return self.links[max(0, i - 1)]
        x = (time - self.times[i - 1]) / (self.times[i] - self.times[i - 1])
        return np.asarray((1.0 - x) * self.links[i - 1] + x * self.links[i])

    def _advance(self, time: float, setpoint: FloatArray) -> None:
        """To a time, s, while the set-point goes evenly to joints (n,).

        m' = (u - m) / lag has the solution m = u - v lag + (m_0 - u_0 + v lag) exp(-t / lag) where u goes at
        the pace v; the load of the posture is taken as constant meanwhile.
        """
        faults, passed = self.faults, time - self.times[-1]
        load = self._load(self.links[-1])
        before, after = self._setpoint + faults.sag * load, setpoint + faults.sag * load
        self._setpoint = setpoint
        if faults.lag > 0.0 and passed > 0.0:
            behind = (after - before) * (faults.lag / passed)
            self.motor = after - behind + (self.motor - before + behind) * math.exp(-passed / faults.lag)
        elif passed > 0.0:
            self.motor = after
        if self._strikes and time >= self._strikes[0] - 1e-9:
            self._strikes.pop()
            self._strike()
        self._link = np.clip(self._link, self.motor - self._play, self.motor + self._play)
        self.times.append(time)
        self.links.append(self._link + self._slip + faults.flex * load)

    def _strike(self) -> None:
        """A joint is knocked aside, or slips."""
        if self.events.slips:
            self._slip = self._slip + self.events.bump
            return
        self._setpoint, self.motor = self._setpoint + self.events.bump, self.motor + self.events.bump

    def _load(self, q: FloatArray) -> FloatArray:
        """Torque (n,) of gravity in each joint by the tool at joints (n,), 1 for the most at full reach."""
        if not self._loaded:
            return np.zeros(len(q))
        turning = self.arm.joint_types != PRISMATIC
        return np.asarray(np.where(turning, -_tool_velocity(self.arm, q)[:, 2], 0.0) / self._reach)


class _Frame(NamedTuple):
    """An image."""

    middle: float  # of its exposure, s
    stamp: float  # the same by the clock of the camera
    pixels: FloatArray  # (m, 2), NaN where unseen


class _Camera:
    """One of both cameras, which runs freely or takes a frame at each look."""

    def __init__(self, joints: _Joints, world: World, faults: Faults, events: Events, view: int) -> None:
        self._joints, self._world, self._faults, self._events = joints, world, faults, events
        self._view, self._looks = view, 0
        # No frame is read before it was exposed whole.
        self._delay = max(faults.delay[view], 0.5 * faults.exposure)
        self._clock = float(world.random(view, 0).uniform(-_CLOCKS_S, _CLOCKS_S))
        self._first = float(world.random(0, 0).uniform(0.0, 1.0)) * faults.interval + view * faults.offset
        self._last: tuple[int, _Frame] | None = None

    def newest(self, now: float) -> _Frame:
        """The newest frame that can be read."""
        if not self._faults.interval:
            self._looks += 1
            middle = now - self._delay + self._jitter(self._looks)
            return self._exposed(self._looks, min(middle, now - 0.5 * self._faults.exposure))
        k = math.floor((now - self._delay - self._first) / self._faults.interval) + 2
        while self._middle(k) + self._delay > now:
            k -= 1
        if self._last is None or self._last[0] != k:
            self._last = k, self._exposed(k, self._middle(k))
        return self._last[1]

    def _middle(self, k: int) -> float:
        """When a frame of a camera that runs freely is half exposed, s."""
        return self._first + k * self._faults.interval + self._jitter(k)

    def _jitter(self, k: int) -> float:
        if not self._faults.jitter:
            return 0.0
        return self._faults.jitter * float(self._world.random(self._view, _BEFORE + k).standard_normal())

    def _exposed(self, k: int, middle: float) -> _Frame:
        """The frame of a number, its exposure half over at a time, s."""
        world, events, step = self._world, self._events, _step(middle, self._world.period)
        M = world.M
        if step >= events.marker_at:
            M = M.copy()
            M[events.marker, :3] += world.arm.base_tool[:3, :3] @ events.marker_by
        many = _EXPOSED if self._faults.exposure else 1
        instants = middle + self._faults.exposure * ((np.arange(many) + 0.5) / many - 0.5)
        from_tool = np.linalg.inv(world.arm.base_tool)
        shown = [world.see(world.arm.pose(self._joints.at(t)) @ from_tool, M)[self._view] for t in instants]
        rng = world.random(self._view, _BEFORE + k)
        rng.standard_normal()  # that of the jitter
        pixels = np.mean(shown, axis=0) + world.sigma_px * rng.standard_normal(shown[0].shape)
        if step >= events.camera_at:
            pixels += np.broadcast_to(events.camera, (2, 2))[self._view]
        if events.lost_at <= step < events.lost_until:
            pixels[list(events.lost)] = math.nan
        if world.size is not None:
            pixels[~((pixels >= -0.5) & (pixels <= np.array(world.size) - 0.5)).all(axis=1)] = math.nan
        return _Frame(middle, middle + self._clock, pixels)
