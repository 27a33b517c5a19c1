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
from projservo_cli.config import Config
from projservo_cli.config.models import Disturbance, FrozenJoint, LostMarkers
from projservo_cli.geometry.kinematics import joint_operators
from projservo_cli.records import PRISMATIC, FloatArray
from projservo_cli.robots.simulated import Arm
from projservo_cli.stages.world import FAULTS, Truth

# Joints are worked out this often at least, s, and taken as straight lines between.
_GRID_S = 0.005
_EXPOSED = 5  # instants of an exposure that are averaged
# What a prismatic joint moves where a revolute one turns by a radian, m.
_M_PER_RAD = REACH_M / REACH_RAD
_POSTURES = 500  # that are drawn to see how far an arm reaches
_BEFORE = 2**20  # frames before the opening are numbered too
_CLOCKS_S = 100.0  # how far clocks of cameras are off at most


class World(NamedTuple):
    """A simulated robot and its rig while nothing is wrong."""

    truth: Truth
    q_start: FloatArray  # (n,) first readings, rad or m
    # pixels (2, m, 2) of markers (m, 4), given at the reference, at joints (n,); NaN where unseen
    see: Callable[[FloatArray, FloatArray], FloatArray]
    borders: bool  # whether markers outside an image are unseen
    sigma_px: float  # noise of a coordinate of each frame
    period: float  # of the loop, s
    seed: int
    stream: int  # of the random numbers of the seed

    def random(self, view: int, k: int) -> np.random.Generator:
        """Random numbers of a frame of a view."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(self.stream, view, k)))


def robot_by_itself(
    config: Config, truth: Truth, q_start: FloatArray, sigma_px: float, seed: int, stream: int
) -> "FaultyRobot":
    """The simulated robot at joints (n,), rad or m, that nothing befalls and whose images have borders."""
    world = World(truth, q_start, truth.images, True, sigma_px, config.control.period_s, seed, stream)
    events = [name for name in type(config.disturbance).model_fields if name not in FAULTS]
    return FaultyRobot(world, config.disturbance.model_copy(update=dict.fromkeys(events)))


class FaultyRobot:
    """A simulated robot of the contract.

    world : the robot and its rig; given : what is wrong with it, and what befalls it.
    ``taken``: (2,) when both frames of the last look were taken, s, which no robot knows.
    """

    def __init__(self, world: World, given: Disturbance) -> None:
        self.world, self._given = world, given
        self._joints = _Joints(world, given)
        self._cameras = [_Camera(self._joints, world, given, view) for view in range(2)]
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
        if not self._given.stamps:
            return q, pixels
        return q, pixels, now, frames[0].stamp, frames[1].stamp

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Go to joints (n,) by the time that is due, s; where none comes then, they are held."""
        del speed
        self._joints.go(_whole(target, self._given.setpoint_ticks * self._joints.tick), due)

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
        q, frozen = _whole(self._joints.motor, self._joints.tick), self._given.frozen_joint
        if frozen is not None and _lasts(frozen, _step(self.now(), self.world.period)):
            self._frozen = q[frozen.joint - 1] if self._frozen is None else self._frozen
            q[frozen.joint - 1] = self._frozen
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


def _lasts(event: FrozenJoint | LostMarkers, step: int) -> bool:
    """Whether it is so in a period."""
    return event.from_step <= step < event.from_step + (event.steps or math.inf)


def _step(time: float, period: float) -> int:
    """Number of the period that a time, s, is in; rounding does not bring its beginning before it."""
    return math.floor(time / period + 1e-6)


class _Joints:
    """Servos, play and links over time.

    ``times, links``: every instant so far, s, and the true joints (n,) there. ``motor``: (n,) where the
    encoders are now. ``tick``: (n,) of the encoders, 0 for none. All rad or m.
    """

    def __init__(self, world: World, given: Disturbance) -> None:
        self.arm, self._lag, self._bump = world.truth.robot, given.lag_s, given.bump
        self._struck_at = math.inf if given.bump is None else given.bump.at_step * world.period
        scale = np.where(self.arm.joint_types == PRISMATIC, _M_PER_RAD, 1.0)
        self.tick = scale * (2.0 * math.pi / given.encoder_ticks if given.encoder_ticks else 0.0)
        self._play = 0.5 * math.radians(given.play_deg) * scale
        # What gravity costs a joint that holds the tool at full reach, rad.
        self._sag, self._flex = math.radians(given.sag_deg), math.radians(given.flex_deg)
        self._loaded = self._sag > 0.0 or self._flex > 0.0
        self._reach = full_reach(self.arm) if self._loaded else 1.0
        self.motor = np.array(world.q_start, dtype=np.float64)
        self._link, self._slip = self.motor.copy(), np.zeros(len(self.motor))  # beyond the play; beyond both
        load = self._load(self.motor)
        self._setpoint = self.motor - self._sag * load
        self.times, self.links = [0.0], [self._link + self._flex * load]

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
        lag, passed = self._lag, time - self.times[-1]
        load = self._load(self.links[-1])
        before, after = self._setpoint + self._sag * load, setpoint + self._sag * load
        self._setpoint = setpoint
        if lag > 0.0 and passed > 0.0:
            behind = (after - before) * (lag / passed)
            self.motor = after - behind + (self.motor - before + behind) * math.exp(-passed / lag)
        elif passed > 0.0:
            self.motor = after
        if time >= self._struck_at - 1e-9:
            self._strike()
        self._link = np.clip(self._link, self.motor - self._play, self.motor + self._play)
        self.times.append(time)
        self.links.append(self._link + self._slip + self._flex * load)

    def _strike(self) -> None:
        """A joint is knocked aside, or slips."""
        assert self._bump is not None
        by, turn = np.zeros_like(self.motor), self._bump.by_deg
        by[self._bump.joint - 1] = self._bump.by_m or 0.0 if turn is None else math.radians(turn)
        self._struck_at = math.inf
        if self._bump.read:
            self._setpoint, self.motor = self._setpoint + by, self.motor + by
        else:
            self._slip = by

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

    def __init__(self, joints: _Joints, world: World, given: Disturbance, view: int) -> None:
        self._joints, self._world, self._given = joints, world, given
        self._view, self._looks = view, 0
        # No frame is read before it was exposed whole.
        self._delay = max((given.delay_s.left, given.delay_s.right)[view], 0.5 * given.exposure_s)
        self._interval = 0.0 if given.frame_rate_hz is None else 1.0 / given.frame_rate_hz
        self._clock = float(world.random(view, 0).uniform(-_CLOCKS_S, _CLOCKS_S))
        self._first = float(world.random(0, 0).uniform(0.0, 1.0)) * self._interval
        self._first += view * given.frame_offset_s
        self._last: tuple[int, _Frame] | None = None

    def newest(self, now: float) -> _Frame:
        """The newest frame that can be read."""
        if not self._interval:
            self._looks += 1
            middle = now - self._delay + self._jitter(self._looks)
            return self._exposed(self._looks, min(middle, now - 0.5 * self._given.exposure_s))
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
        if not self._given.jitter_s:
            return 0.0
        return self._given.jitter_s * float(self._world.random(self._view, _BEFORE + k).standard_normal())

    def _exposed(self, k: int, middle: float) -> _Frame:
        """The frame of a number, its exposure half over at a time, s."""
        world, given, step = self._world, self._given, _step(middle, self._world.period)
        truth, M = world.truth, world.truth.M
        if (moved := given.marker_moved) is not None and step >= moved.at_step:
            M = M.copy()
            M[truth.number.index(moved.marker), :3] += truth.robot.base_tool[:3, :3] @ moved.by_m
        many = _EXPOSED if given.exposure_s else 1
        instants = middle + given.exposure_s * ((np.arange(many) + 0.5) / many - 0.5)
        shown = [world.see(self._joints.at(t), M)[self._view] for t in instants]
        rng = world.random(self._view, _BEFORE + k)
        rng.standard_normal()  # that of the jitter
        pixels = np.mean(shown, axis=0) + world.sigma_px * rng.standard_normal(shown[0].shape)
        if (knocked := given.camera_moved) is not None and step >= knocked.at_step:
            pixels += knocked.by_view()[self._view]
        if (lost := given.lost_markers) is not None and _lasts(lost, step):
            pixels[[truth.number.index(number) for number in lost.markers or truth.number]] = math.nan
        if world.borders:
            pixels[~((pixels >= -0.5) & (pixels <= truth.image_size - 0.5)).all(axis=1)] = math.nan
        return _Frame(middle, middle + self._clock, pixels)
