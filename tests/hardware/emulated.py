"""The emulated arm as a class of somebody that reads joints alone, for checks before a recording."""

import numpy as np

from tests.emulated.arm import Arm, Clock, Mechanics
from tests.emulated.cameras import Cameras, Optics

__all__ = ["Cameras", "Mechanics", "Optics", "Shaft", "arm_of"]

_THERE = []  # the arm that the class finds


def arm_of(rate=1.0, mechanics=None, **given):
    """An emulated arm that ``Shaft`` drives."""
    _THERE[:] = [Arm(Clock(rate), mechanics=mechanics, **given)]
    return _THERE[0]


class Shaft:
    """Angles of the shafts, in whole counts of 4,096, and set-points as they are sent."""

    def __init__(self):
        self.arm = _THERE[0]
        self.now = self.arm.clock.now

    def open(self):
        pass

    def joints(self):
        with self.arm.lock:
            self.arm.advance()
            count = 2.0 * np.pi / 4096
            return np.round(self.arm.q / count) * count, self.arm.clock.now()

    def command(self, target, speed, due):
        with self.arm.lock:
            self.arm.advance()
            self.arm.torque_on[:] = True
            self.arm.goal[:] = target

    def stop(self):
        pass

    def close(self):
        pass

    def health(self):
        return {"supply": 12.1}
