"""An arm that stands still, before cameras of whoever tests."""

import numpy as np


class Quiet:
    """What of the contract of robots does nothing."""

    def open(self):
        pass

    def stop(self):
        pass

    def close(self):
        pass


class Still(Quiet):
    """Five joints at rest."""

    def __init__(self, q_deg=(0.0, 10.0, -25.0, 15.0, 0.0)):
        self.q = np.radians(q_deg)

    def joints(self):
        return self.q, None

    def command(self, target, speed, due):
        raise AssertionError("nothing is to be moved")

    def health(self):
        return {"supply, V": 12.1}
