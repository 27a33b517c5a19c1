"""The arm of the emulator: joints in MuJoCo, each turned by a servo of its own, and the hand of somebody."""

import copy
import math
import threading
import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from projservo_cli.config import load_config, shipped
from projservo_cli.config.inputs import scene_of
from projservo_cli.simulation.mjcf import mujoco
from projservo_cli.simulation.rendering import rendered_model

STEP_S = 0.002  # of the integration
STALL_NM = 1.9  # torque of a servo at the end of what it can do
FULL_SPEED = math.radians(300.0)  # of a servo without load, rad/s
HAND_SPEED = math.radians(60.0)  # of an arm that somebody moves
KEPT_S = 4.0  # how long it is known where the links were
TAGS = ("plant={use: mujoco}", "noise.servo_px=0", "markers={tags: roof, tag_size_m: 0.04}")


class Clock:
    """Time of everything that is emulated, s; at a rate below one it passes slower than that of the wall."""

    def __init__(self, rate=1.0):
        self.rate, self._since = rate, (time.monotonic(),) * 2

    def now(self):
        wall, emulated = self._since
        return emulated + (time.monotonic() - wall) * self.rate

    def slow_down(self, factor):
        """Go on by this factor of the rate."""
        self._since = time.monotonic(), self.now()
        self.rate *= factor

    def sleep(self, seconds):
        if seconds > 0.0:
            time.sleep(seconds / self.rate)


@dataclass
class Mechanics:
    """What is not ideal in every joint."""

    lag_s: float = 0.03
    sag_deg: float = 2.0  # at the joint and posture that gravity loads most
    hysteresis_deg: float = 1.0  # between set-point and reading, from end to end
    backlash_deg: float = 0.2  # between reading and link, which no encoder tells
    stops_deg: dict = field(default_factory=dict)  # joint, from 0: lowest and highest angle


class Arm:
    """The joints of configs/hobby.yaml, with tags on its tool, from joints q (n,), rad, on.

    Whoever asks has it move on to the present; ``drive`` is what servos do, set by their bus.
    """

    def __init__(self, clock, q_deg=(0, 10, -25, 15, 0), mechanics=None, settings=()):
        self.clock, self.mechanics = clock, mechanics or Mechanics()
        self.config = load_config(shipped("hobby"), (*TAGS, *settings))
        self.rendered = rendered_model(scene_of(self.config, None, dict.fromkeys(self.config.objects.named)))
        self._model = copy.copy(self.rendered.model)
        self._model.opt.timestep = STEP_S
        self._places, self._rates = self.rendered.positions, self.rendered.rates
        q = np.radians(np.array(q_deg, dtype=float))
        self._data, self.n = self.rendered.begin(self._model, q), len(q)
        inertia, load = self._heaviest()
        self._stiff = np.full(self.n, load / math.radians(max(self.mechanics.sag_deg, 0.01)))
        self._damping = 2.0 * np.sqrt(self._stiff * inertia)
        self.torque_on = np.zeros(self.n, dtype=bool)
        self.share = np.ones(self.n)  # of the stall torque that a servo may give
        self.goal, self.speed = q.copy(), np.full(self.n, FULL_SPEED)
        self._setpoint, self._sent, self._geared = q.copy(), q.copy(), q.copy()
        self.torque, self.link = np.zeros(self.n), q.copy()
        self.hand = q.copy()  # where somebody holds it while torque is off; None lets it fall
        self._hand_speed = HAND_SPEED
        self.overloaded_s = np.zeros(self.n)
        # (4, 4) of the objects of the settings, in the base frame, m, or a function that gives it at a time
        self.displacement = np.eye(4)
        self.lock, self._time = threading.RLock(), clock.now()
        self._past = deque([(self._time, q.copy())])

    @property
    def q(self):
        """Angles of the shafts (n,), rad."""
        return np.array(self._data.qpos[self._places])

    def put(self, q_deg, speed_deg_s=60.0):
        """Have somebody move the arm to joints, where its torque is off."""
        with self.lock:
            self.advance()
            self.hand, self._hand_speed = np.radians(np.array(q_deg, dtype=float)), math.radians(speed_deg_s)

    def at(self, instant):
        """Where the links were at an instant (n,), rad."""
        with self.lock:
            self.advance()
            times = [t for t, _ in self._past]
            return self._past[min(int(np.searchsorted(times, instant)), len(times) - 1)][1].copy()

    def advance(self):
        """Move on to the present."""
        with self.lock:
            now = self.clock.now()
            while self._time + STEP_S <= now:
                self._step()
                self._time += STEP_S
                self._past.append((self._time, self.link.copy()))
            while self._past[0][0] < self._time - KEPT_S:
                self._past.popleft()

    def _step(self):
        q, half = self.q, 0.5 * math.radians(self.mechanics.hysteresis_deg)
        on = self.torque_on
        self._setpoint += np.clip(self.goal - self._setpoint, -self.speed * STEP_S, self.speed * STEP_S)
        self._setpoint, self._sent, self._geared = (
            np.where(on, x, q) for x in (self._setpoint, self._sent, self._geared)
        )
        self._sent += (self._setpoint - self._sent) * -math.expm1(-STEP_S / self.mechanics.lag_s)
        self._geared = np.clip(self._geared, self._sent - half, self._sent + half)
        rate = np.array(self._data.qvel[self._rates])
        wanted = self._stiff * (self._geared - q) - self._damping * rate
        most = STALL_NM * self.share
        self.torque = np.where(on, np.clip(wanted, -most, most), 0.0)
        self._data.qfrc_applied[self._rates] = np.where(on, self.torque, -0.2 * self._damping * rate)
        mujoco().mj_step(self._model, self._data)
        if self.hand is not None and not on.all():
            led = q + np.clip(self.hand - q, -self._hand_speed * STEP_S, self._hand_speed * STEP_S)
            self._data.qpos[self._places[~on]], self._data.qvel[self._rates[~on]] = led[~on], 0.0
        for joint, stops in self.mechanics.stops_deg.items():
            low, high = np.radians(stops)
            place, there = self._places[joint], self._data.qpos[self._places[joint]]
            if not low <= there <= high:
                self._data.qpos[place] = np.clip(there, low, high)
                self._data.qvel[self._rates[joint]] = 0.0
        slack = 0.5 * math.radians(self.mechanics.backlash_deg)
        self.link = np.clip(self.link, self.q - slack, self.q + slack)
        heavy = np.abs(self.torque) > 0.8 * STALL_NM
        self.overloaded_s = np.where(heavy, self.overloaded_s + STEP_S, 0.0)

    def _heaviest(self):
        """Most inertia (n,) of joints, kg m², and most torque that gravity asks of any, N m."""
        mj, low, high = mujoco(), *np.array(self.config.robot.ranges).T
        data, full = self.rendered.begin(self._model, np.zeros(self.n)), np.zeros((self._model.nv,) * 2)
        inertia, load = np.zeros(self.n), 0.0
        for q in np.random.default_rng(0).uniform(low, high, (100, self.n)):
            data.qpos[self._places] = q
            mj.mj_forward(self._model, data)
            mj.mj_fullM(self._model, data, full)
            inertia = np.maximum(inertia, np.diag(full)[self._rates])
            load = max(load, float(np.abs(data.qfrc_bias[self._rates]).max()))
        return inertia, load
