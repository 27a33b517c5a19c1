"""Robots and laws of others, sound and faulty, as users would write them."""

import time

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.loop.python import BuiltInLaw
from projservo_cli.stages.world import truth_of
from projservo_cli.task.face import MIDPOINT
from projservo_cli.task.target import Shown

CALLS = []


class Sound:
    """The robot of a configuration with pixel noise; everything it is asked for is noted in ``CALLS``."""

    def __init__(self, config, noise_px=0.5):
        CALLS.clear()
        self.truth = truth_of(load_config(config))
        self.q = self.truth.robot.lower * 0 + [3.66, -1.68, -1.85, 0.28, 1.16, 3.53]
        self.noise_px, self.random = noise_px, np.random.default_rng(5)
        self.count = 0

    def joints(self):
        CALLS.append("joints")
        return self.q

    def observe(self):
        CALLS.append("observe")
        self.count += 1
        s = self.truth.images(self.q, self.truth.M)
        return s + self.noise_px * self.random.standard_normal(s.shape)

    def command(self, step, period):
        CALLS.append(("command", step.copy(), period))
        self.q = self.q + step

    def stop(self):
        CALLS.append("stop")


class Faulty(Sound):
    """Goes wrong in a way of its own after so many observations."""

    def __init__(self, config, fault, after=0, noise_px=0.5):
        super().__init__(config, noise_px)
        self.fault, self.after, self.still = fault, after, self.q

    @property
    def wrong(self):
        return self.count > self.after

    def joints(self):
        q = super().joints()
        if not self.wrong or self.fault != "frozen readings":
            self.still = q
        return self.still

    def observe(self):
        s = super().observe()
        if not self.wrong:
            return s
        if self.fault == "bumped camera":
            s[0] += [2.0, -2.5]
        if self.fault == "lost" or (self.fault == "lost for a while" and self.count < self.after + 10):
            s[:] = np.nan
        if self.fault == "raises":
            raise OSError("camera 2 is unplugged")
        if self.fault == "interrupted":
            raise KeyboardInterrupt
        if self.fault == "hangs":
            time.sleep(5.0)
        return s

    def command(self, step, period):
        super().command(step, period)
        if self.wrong and self.fault == "command raises":
            raise RuntimeError("protective stop")


class NoStop:
    def joints(self): ...
    def observe(self): ...
    def command(self, step, period): ...


class Stopp(NoStop):
    def stopp(self): ...


class Unmakeable(Sound):
    def __init__(self):
        raise ConnectionError("no route to 10.0.0.7")


NOT_A_CLASS = 3


class DirectThree:
    """The law direct_three, made from what a law of others is given."""

    def __init__(self, setup):
        model = setup.calibration.model()
        task = Shown(setup.plan.q_start, setup.s_start, setup.s_star, MIDPOINT).task(model)
        self.law = BuiltInLaw(0, model, task, setup.gains)
        self.law.state.driven[:] = setup.plan.rotation_sense()

    def __call__(self, s, q):
        return self.law(s, q)[1]


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


class Silent(Wrong):
    answer = None


class Raising(ByImage):
    def __call__(self, s, q):
        return [][0]
