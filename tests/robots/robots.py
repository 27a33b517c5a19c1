"""Robots and laws of others, sound and faulty, as users would write them."""

import time
from typing import NamedTuple

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.config.inputs import objects_of
from projservo_cli.robots.flange_robot import PoseRefused
from tests.configured import truth_of

CALLS = []


class Sound:
    """The robot of a configuration with pixel noise; everything it is asked for is noted in ``CALLS``.

    Its time passes in commands alone.
    """

    def __init__(self, config, noise_px=0.5):
        CALLS.clear()
        self.world = truth_of(load_config(config))
        self.q = self.world.robot.limits.lower * 0 + [3.66, -1.68, -1.85, 0.28, 1.16, 3.53]
        self.noise_px, self.random = noise_px, np.random.default_rng(5)
        self.count, self.time = 0, 0.0

    def open(self):
        CALLS.append("open")

    def read(self):
        CALLS.append("read")
        self.count += 1
        s = self.world.images(self.q, self.world.M)
        return self.q, s + self.noise_px * self.random.standard_normal(s.shape)

    def command(self, target, speed, due):
        CALLS.append(Sent(target.copy(), speed.copy(), due, target - self.q, due - self.time))
        self.q, self.time = target, due

    def now(self):
        return self.time

    def stop(self):
        CALLS.append("stop")

    def close(self):
        CALLS.append("close")


class ByPoses(Sound):
    """The controller of configs/cartesian.yaml, which takes poses, and refuses those beyond a height, m."""

    readings = "flange"

    def __init__(self, config, lowest=0.0, blocked_at=0.0):
        super().__init__(config)
        self.chart, self.lowest, self.blocked_at = load_config(config).robot.flange.chart, lowest, blocked_at
        self.q = np.zeros(6)

    def read(self):
        q, s = super().read()
        return self.chart.poses(q[None])[0], s

    def command(self, target, speed, due):
        CALLS.append(
            Sent(target.copy(), speed.copy(), due, target @ np.linalg.inv(self.pose), due - self.time)
        )
        if target[2, 3] < self.lowest:
            raise PoseRefused("joint 3 would pass its limit")
        target = target.copy()
        target[2, 3] = max(target[2, 3], self.blocked_at)  # by a table
        self.q, self.time = self.chart.coordinates(target[None])[0], due

    @property
    def pose(self):
        """Pose of the flange where it is."""
        return self.chart.poses(self.q[None])[0]


class Telling(Sound):
    """Tells where its tool truly is, or its joints."""

    def __init__(self, config, joints=False):
        super().__init__(config)
        self.tells_joints = joints

    def truth(self):
        return self.q if self.tells_joints else self.world.robot.pose(self.q)


class Pressing(Sound):
    """Presses harder with each look."""

    def force(self):
        return 0.5 * self.count


class Seeing(Sound):
    """Sees the objects of its configuration too, wherever a test has put them.

    ``shift``: (4, 4) displacement of all; ``later``: number of a reading and the displacement from there on.
    ``looks``: how many readings there were, of all such robots.
    ``hidden``: numbers of markers that nobody sees, of all those of objects from the reading ``unseen_from``.
    ``exchanged``: m by which the markers of another object lie otherwise. ``last``: the robot made last.
    """

    shift, later, hidden, unseen_from, exchanged = np.eye(4), (10**9, None), (), 10**9, 0.0
    looks, last = 0, None

    def __init__(self, config, noise_px=0.1, numbers=()):
        super().__init__(config, noise_px)
        self.objects, self.numbers = objects_of(load_config(config)), np.array(numbers)
        Seeing.last = self

    def read(self):
        q, s = super().read()
        at, shift = self.later
        Seeing.looks += 1
        T = shift if self.looks >= at else self.shift
        other = self.exchanged * np.random.default_rng(1).standard_normal((8, 4)) * [1, 1, 1, 0]
        objects = [one._replace(X=one.X + other) for one in self.objects]
        seen = np.concatenate([one.images(self.world, T) for one in objects], axis=1)
        if self.looks >= self.unseen_from:
            seen[:] = np.nan
        s = np.concatenate([s, seen + self.noise_px * self.random.standard_normal(seen.shape)], axis=1)
        s[:, np.isin(self.numbers, self.hidden)] = np.nan
        return q, s


class Taking(Seeing):
    """Has a gripper, which holds nothing."""

    def act(self, name, value):
        CALLS.append(f"{name} {value:g}")
        return 0.4

    def holding(self, name):
        return False


class Faulty(Sound):
    """Goes wrong in a way of its own after so many looks."""

    def __init__(self, config, fault, after=0, noise_px=0.5):
        super().__init__(config, noise_px)
        self.fault, self.after, self.still = fault, after, self.q

    @property
    def wrong(self):
        return self.count > self.after

    def read(self):
        q, s = super().read()
        if not self.wrong:
            self.still = q
            return q, s
        if self.fault == "frozen readings":
            q = self.still
        if self.fault == "bumped camera":
            s[0] += [2.0, -2.5]
        if self.fault == "lost":
            s[:] = np.nan
        if self.fault == "blind":
            s[0] = np.nan
        if self.fault == "zeros":
            s[0] = 0.0
        if self.fault == "raises":
            raise OSError("camera 2 is unplugged")
        if self.fault == "interrupted":
            raise KeyboardInterrupt
        if self.fault == "hangs":
            time.sleep(2.0)
        return q, s

    def command(self, target, speed, due):
        super().command(target, speed, due)
        if self.wrong and self.fault == "command raises":
            raise RuntimeError("protective stop")


class Gripping(Sound):
    """Has a gripper, which takes a while; may be interrupted at a command."""

    def __init__(self, config, interrupted=None):
        super().__init__(config)
        self.interrupted = interrupted

    def act(self, name, value):
        CALLS.append(f"{name} {value:g}")
        return 0.4

    def command(self, target, speed, due):
        super().command(target, speed, due)
        if sum(isinstance(call, tuple) for call in CALLS) == self.interrupted:
            raise KeyboardInterrupt


class NoStop:
    def open(self): ...
    def read(self): ...
    def command(self, target, speed, due): ...
    def close(self): ...


class Stopp(NoStop):
    def stopp(self): ...


class Old:
    def joints(self): ...
    def observe(self): ...
    def command(self, step, period): ...
    def stop(self): ...


class Truths(NoStop):
    def stop(self): ...
    def truths(self): ...


class Now(NoStop):
    now = 0.0

    def stop(self): ...


NOT_A_CLASS = 3


class Sent(NamedTuple):
    """A command, and how far and for how long it was to move."""

    target: np.ndarray
    speed: np.ndarray
    due: float
    step: np.ndarray
    period: float


class ByImage:
    """Image error through the pseudo-inverse of the predicted Jacobian."""

    def __init__(self, setup):
        self.setup = setup

    def __call__(self, s, q):
        J = self.setup.calibration.jacobian(q)[:, self.setup.face]
        e = (self.setup.s_star - s).ravel()
        return self.setup.gains.gain * np.linalg.lstsq(J.reshape(len(e), -1), e, rcond=None)[0]


class Wrong(ByImage):
    answer = (1.0, 2.0)

    def __call__(self, s, q):
        return self.answer


class Raising(ByImage):
    def __call__(self, s, q):
        return [][0]


class Carrying(Taking):
    """Its part is on a belt that runs at 30 mm/s while time passes."""

    def read(self):
        belt = np.eye(4)
        belt[1, 3] = 0.03 * self.time
        self.shift = belt @ Seeing.shift
        return super().read()

    def holding(self, name):
        return True


class Passing(Carrying):
    """Its time passes in looks too, as of a real robot, and its right camera is a look late."""

    before = None

    def read(self):
        self.time += 0.05
        q, s = super().read()
        late = s[1].copy() if self.before is None else self.before
        self.before = s[1].copy()
        return q, np.stack([s[0], late])
