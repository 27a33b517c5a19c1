"""A five-joint arm in simulated time, with faults that small motions of its joints show."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.config.inputs import recording_inputs
from projservo_cli.config.settings_and_rules import truth_of
from projservo_cli.findings import Finding
from projservo_cli.hardware import checks_in_motion
from projservo_cli.robots.contract import PluginRobot, at_rest_after
from projservo_cli.robots.pacing import Steered
from tests.configured import bounds_of, joints_of
from tests.hardware.still import Quiet

SETTINGS = ("markers={tags: roof, tag_size_m: 0.03}", "control.joint_speed_limit_deg_s=60")
COUNT = 2.0 * np.pi / 4096
STEP_S = 0.004


@dataclass
class Faults:
    latency_s: tuple = (0.08, 0.08)  # left, right
    rate_hz: float = 30.0
    hysteresis_deg: float = 0.3  # between set-point and reading
    backlash_deg: float = 0.2  # between reading and link
    sag_deg: float = 0.5
    noise_px: float = 0.05
    lag_s: float = 0.05
    held: int | None = None  # joint that does not move
    link: int = 5  # number of joints before the link with the tags
    loose: int | None = None  # tag that hangs back by so many px after each turn
    loose_px: float = 0.0


class Wiggled(Quiet):
    """The arm of configs/hobby.yaml as its joints, with stamps of the frames, by the contract of robots."""

    def __init__(self, truth, faults, q_deg=(0.0, 10.0, -25.0, 15.0, 0.0), seed=0):
        self.truth, self.faults, self.random = truth, faults, np.random.default_rng(seed)
        self.q = np.radians(q_deg)
        self.goal, self.sent, self.geared, self.link = (self.q.copy() for _ in range(4))
        self.first, self.time, self.past = self.q.copy(), 0.0, [(0.0, self.q.copy())]
        self.tag = np.array(truth.number) // 4

    def now(self):
        return self.time

    def command(self, target, speed, due):
        self.goal, faults = target.copy(), self.faults
        half, slack = np.radians(faults.hysteresis_deg) / 2, np.radians(faults.backlash_deg) / 2
        sag = np.radians(faults.sag_deg) * np.array([0, 1, 1, 0.5, 0]) * np.cos(self.q)
        while self.time < due - 0.5 * STEP_S:
            self.time += STEP_S
            self.sent += (self.goal - self.sent) * STEP_S / faults.lag_s
            self.geared = np.clip(self.geared, self.sent - half, self.sent + half)
            q = self.geared - sag
            if faults.held is not None:
                q[faults.held] = self.first[faults.held]
            self.q = q
            self.link = np.clip(self.link, q - slack, q + slack)
            self.past.append((self.time, self.link.copy()))

    def read(self):
        faults, stamps, views = self.faults, [], []
        for view in range(2):
            came = self.time - faults.latency_s[view] - 0.004 * view
            taken = np.floor(came * faults.rate_hz) / faults.rate_hz + 0.004 * view
            k = int(np.clip(round(taken / STEP_S), 0, len(self.past) - 1))
            q = self.past[k][1].copy()
            q[faults.link :] = self.first[faults.link :]
            s = self.truth.images(q, self.truth.M)[view]
            if faults.loose is not None:
                rising = self.past[k][1].sum() >= self.past[max(0, k - 300)][1].sum()
                s[self.tag == faults.loose, 0] += faults.loose_px * (1.0 if rising else -1.0) / 2
            noise = np.random.default_rng([view, max(k, 0)]).standard_normal(s.shape)
            views.append(s + faults.noise_px * noise)
            stamps.append(taken + faults.latency_s[view])
        q = np.round(self.q / COUNT) * COUNT
        return q, np.stack(views), self.time, *stamps, np.full((2, len(self.tag)), faults.noise_px)


class Rail(Quiet):
    """A joint that turns and one that slides, at once where they are sent, and two tags that both move."""

    def __init__(self, frozen=()):
        self.q, self.time, self.sent = np.zeros(2), 0.0, []
        self.frozen = [*frozen]  # views, 0 or 1, of which one frame is repeated
        type(self).last = self

    def now(self):
        return self.time

    def command(self, target, speed, due):
        self.q, self.time = target.copy(), due
        self.sent.append((due, *target))

    def read(self):
        s = 100.0 + 10.0 * np.arange(32.0).reshape(2, 8, 2) + [600.0 * self.q[0], 2000.0 * self.q[1]]
        stamps, still = np.full(2, self.time), s - s[0, 0] + 100.0
        s[self.frozen], stamps[self.frozen] = still[self.frozen], 0.0
        return self.q, s, self.time, *stamps


def findings(faults, moving=range(5), **given):
    """Findings of the motions of joints of such an arm."""
    config = load_config("configs/hobby.yaml", SETTINGS)
    joints, numbers = joints_of(config), recording_inputs(config).numbers
    robot = Wiggled(truth_of(config), faults, **given)
    foreign = PluginRobot(robot, "arm", len(numbers), bounds_of(config, joints), 30.0, 30.0)
    with at_rest_after(foreign):
        steered = Steered(foreign)
        moved = [checks_in_motion.strokes(steered, joint) for joint in moving]
    sound = [one for one in moved if not isinstance(one, Finding)]
    return [*checks_in_motion.findings_of(sound, numbers)], moved
