"""Whether an object that moves is where its tracker says, and whether it tells hands, pushes and stops apart.

    python -m tests.studies.tracker [--calibrations 20] [--hands 300] [--pushes 100] [--changes 100]
                                    [--arms NAME ...] [-o tracker.csv]

Each calibration of a simulated arm, from trial motions at 0.5 px, sees an object of two tags of 60 mm by a
goal of the tool that was taught on it. It lies still, or moves on a belt or a turntable, evenly or with
accelerations as they are assumed to be. Images are 40 ms apart, those of both cameras up to 12 ms, at 0.5 px.
The goal 0.4 s ahead, where a law of 2.5/s is led, is compared with the true one by the true cameras.

Hands: in each run one is over one camera, which hides corners, draws them aside or shifts a tag. Pushes: in
each run the object is pushed by 10 to 40 mm within 60 to 150 ms, or taken. Changes: it stops within 100 ms,
is reversed, or is hidden for 0.5 s, or both. From 1.2 s after on, what is predicted 0.4 s ahead is compared
with what is found then, as before the event.
"""

from functools import cache

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import projservo_cli as projservo
from projservo_cli.config.settings_and_rules import truth_of
from projservo_cli.geometry.kinematics import project
from projservo_cli.simulation.random_tasks import random_tasks
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView
from projservo_cli.task.objects.object_tracker import ObjectTracker
from tests.known import configured
from tests.samples import hat
from tests.studies.carried_goals import NOISE_PX, carried_pose, direction, scene, seen
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, written
from tests.studies.hand_eye_coverage import pose
from tests.studies.metric_coverage import longest

ARMS = ("ur5", "paper")
SEED, PERIOD, LEAD = 730_100, 0.04, 0.4  # s, s
ACCELERATION, MOST, LASTS = 0.05, 1.0, 0.1  # m/s², m/s², s
# Speed, m/s or rad/s, whether about an axis 200 mm beside it, and whether with accelerations by chance.
MOTIONS = {
    "still": (0.0, False, False),
    "belt 10": (0.01, False, False),
    "belt 50": (0.05, False, False),
    "belt 100": (0.1, False, False),
    "turntable 10": (np.radians(10.0), True, False),
    "still, by chance": (0.0, False, True),
    "belt 50, by chance": (0.05, False, True),
    "turntable 10, by chance": (np.radians(10.0), True, True),
}
EVENTS = ("hands", "pushes", "changes")
NAMES = range(40, 48)
COLUMNS = (
    *("arm", "seed", "run", "event", "motion", "square", "mm", "deg", "std_mm", "std_deg", "kind"),
    *("before_px", "during_px", "after_px", "covered", "pushed", "unseen_s"),
)


@cache
def calibrated(arm, seed):
    """The truth of an arm, its calibration, its metric, and joints (20, n) at goals."""
    config = configured(arm)
    truth = truth_of(config)
    c = projservo.calibrate(projservo.simulate(config, seed=seed, noise_px=NOISE_PX))
    front = np.array(config.task.start.values(config.joint_types))
    return (
        truth,
        c,
        c.metric(*longest(truth, c)),
        random_tasks(truth, front, 20, np.random.default_rng(seed))[1],
    )


class Moving:
    """Object of 60 mm tags that moves beside a goal of the tool, and cameras that see it at 0.5 px."""

    def __init__(self, arm, seed, motion, seconds, rng):
        self.truth, c, metric, goals = calibrated(arm, seed)
        self.c = c
        self.rng, self.ago = rng, rng.uniform(0.0, 0.012, 2) * rng.permutation([0.0, 1.0])
        while True:
            X, tool, start = scene(self.truth, goals, 0.06, rng)
            self.at = self.path(X @ start.T, motion, rng, seconds)
            if all(
                seen(self.truth, Y @ (self.at(t) @ start).T)
                for t in (0.3 * seconds, seconds)
                for Y in (X, tool)
            ):
                break
        self.X, self.start, self.tool = (
            X,
            start,
            tool[[self.truth.number.index(n) for n in c.marker.tolist()]],
        )
        looks = [ObjectView(self.noisy(project(self.truth.P, Y, self.truth.lens))) for Y in (X, X @ start.T)]
        most = {"acceleration": 1e3 * ACCELERATION, "max_acceleration": 1e3 * MOST, "name": "part"}
        self.tracker = ObjectTracker.of(c, NAMES, looks, metric=metric, **most)
        self.goal = ObjectView(self.noisy(project(self.truth.P, self.tool, self.truth.lens)))

    def noisy(self, s):
        return s + NOISE_PX * self.rng.standard_normal(s.shape)

    def path(self, X, motion, rng, seconds):
        """Displacements (4, 4) over time of an object (k, 4)."""
        speed, turns, by_chance = MOTIONS[motion]
        middle, radius = (
            X[:, :3].mean(axis=0),
            np.sqrt(np.square(X[:, :3] - X[:, :3].mean(axis=0)).sum(axis=1).mean()),
        )
        axis, beside = direction(rng), middle + 0.2 * direction(rng)
        even = hat(axis, np.cross(beside, axis)) if turns else hat(np.zeros(3), axis)
        steps = np.zeros((int(seconds / 0.004) + 2, 4, 4))
        if by_chance:
            each = np.r_[np.full(3, ACCELERATION / (4.0 * radius)), np.full(3, ACCELERATION)]
            walk = np.cumsum(rng.standard_normal((len(steps), 6)) * each * np.sqrt(LASTS * 0.004), axis=0)
            steps = 0.004 * np.array(
                [hat(w, v - np.cross(w, middle)) for w, v in zip(walk[:, :3], walk[:, 3:], strict=True)]
            )
        T = [np.eye(4)]
        for step in steps:
            T.append(T[-1] @ expm(step + 0.004 * speed * even))

        def at(t):
            i = int(np.clip(t / 0.004, 0, len(T) - 2))
            return T[i] @ expm((t / 0.004 - i) * (steps[i] + 0.004 * speed * even))

        return at

    def seen(self, t):
        """Images (V, k, 2) of views, each at its time, at the end of a period."""
        each = [project(self.truth.P, self.X @ (self.at(one) @ self.start).T, self.truth.lens)[v]
                for v, one in enumerate(t - self.ago)]  # fmt: skip
        return self.noisy(np.array(each))

    def images(self, t):
        """Images (V, k, 2) of the object at a time as the tracker has it, by the calibration."""
        return project(self.c.P, self.tracker.M @ self.tracker.at(t).D.T, self.c.lens)


def covered(arm, seed, run, motion):
    """A row of a predicted goal against the true one."""
    rng = np.random.default_rng([seed, run, 1])
    seconds = rng.uniform(1.2, 2.4)
    one = Moving(arm, seed, motion, seconds + LEAD + 0.1, rng)
    for i in range(int(seconds / PERIOD)):
        one.tracker.observe(i * PERIOD - one.ago, one.seen(i * PERIOD))
    t = i * PERIOD + LEAD
    carried = one.tracker.carry(one.goal, t)
    error, J = carried_pose(one.truth, carried.s, one.tool @ (one.at(t) @ one.start).T)
    changes = np.linalg.pinv(J) @ carried.changes.reshape(len(carried.changes), -1).T
    return {
        "square": error @ np.linalg.solve(changes @ changes.T, error),
        "mm": 1e3 * np.linalg.norm(error[:3]),
        "deg": np.degrees(np.linalg.norm(error[3:])),
        "std_mm": carried.position_mm,
        "std_deg": carried.rotation_deg,
        "kind": one.tracker.kind.name,
        "pushed": one.tracker.pushed is not None,
    }


def hand(rng):
    """Images of one view with a hand over it, by the share (0 to 1) of how far it has come."""
    view, kind, order, turn = rng.integers(2), rng.integers(4), rng.permutation(8), rng.uniform(-np.pi, np.pi)
    px, shift = rng.uniform(2.0, 10.0), rng.uniform(3.0, 15.0) * np.array([np.cos(turn), np.sin(turn)])

    def over(s, share):
        count = int(np.ceil(8 * min(2.0 * share, 2.0 * (1.0 - share), 1.0)))
        s = s.copy()
        if kind < 2:  # covers corner after corner; those at its edge are drawn aside
            s[view, order[:count]] = np.nan
            if kind == 1:
                s[view, order[count : count + 2]] += px * rng.standard_normal(
                    (len(order[count : count + 2]), 2)
                )
        elif kind == 2:
            s[view, order[:count]] += px * rng.standard_normal((count, 2))
        else:  # a tag like it, held before it
            s[view, :4] += shift
        return s

    return over


def push(rng, X):
    """Displacement (4, 4) over time of an object (k, 4) pushed at 0, and whether it is taken out of sight."""
    taken = rng.uniform() < 0.3
    mm, lasts = (300.0, 0.4) if taken else (rng.uniform(10.0, 40.0), rng.uniform(0.06, 0.15))
    by, turn = direction(rng), np.radians(rng.uniform(0.0, 10.0)) * direction(rng)
    middle = X[:, :3].mean(axis=0)

    def at(t):
        share = 0.5 * (1.0 - np.cos(np.pi * np.clip(t / lasts, 0.0, 1.0)))
        R = Rotation.from_rotvec(share * turn)
        return pose(R.as_rotvec(), middle - R.apply(middle) + 1e-3 * mm * share * by)

    return at, lasts if taken else np.inf


def event(arm, seed, run, kind):
    """A row of a run in which something happens."""
    rng = np.random.default_rng([seed, run, 2 + EVENTS.index(kind)])
    motion = ("belt 50", "belt 100", "turntable 10")[run % 3]
    one = Moving(arm, seed, motion, 4.8, rng)
    even, at, hidden, lasts = one.at, rng.uniform(1.2, 1.6), (np.inf, -np.inf), rng.uniform(0.2, 0.8)
    spoil = hand(rng)
    if kind == "pushes":
        pushed, gone = push(rng, one.X @ (even(at) @ one.start).T)
        one.at = lambda t: pushed(t - at) @ even(t)
        hidden = (at + gone, np.inf)
    elif kind == "changes":
        to, hides = ((0.0, False), (-1.0, False), (1.0, True), (0.0, True))[run % 4]
        to, ramp = (-0.5 if motion == "belt 100" and to < 0.0 else to), 0.1 if to >= 0.0 else 0.15

        def course(t):
            during = np.clip(t - at, 0.0, ramp)
            return min(t, at) + during + (to - 1.0) * during**2 / (2.0 * ramp) + to * max(t - at - ramp, 0.0)

        one.at = lambda t: even(course(t))
        hidden = (at, at + 0.5) if hides else hidden
    now, ahead, said = [], [], []
    for i in range(int(4.6 / PERIOD)):
        t = i * PERIOD
        s = one.seen(t)
        if kind == "hands" and 0.0 < (t - at) / lasts < 1.0:
            s = spoil(s, (t - at) / lasts)
        s = np.full_like(s, np.nan) if hidden[0] < t < hidden[1] else s
        one.tracker.observe(t - one.ago, s)
        now.append(one.images(t))
        ahead.append(one.images(t + LEAD))
        said.append((one.tracker.covered is not None, one.tracker.unseen_s(t)))
    steps = round(LEAD / PERIOD)
    px = np.sqrt(np.square(np.array(ahead)[:-steps] - np.array(now)[steps:]).sum(axis=-1).mean(axis=(1, 2)))
    ago = PERIOD * np.arange(len(px)) - at
    back = {"hands": lasts, "pushes": 0.2}.get(kind, 0.5 if np.isfinite(hidden[0]) else 0.1) + 1.2

    def rms(chosen):
        return float(np.sqrt(np.mean(px[chosen] ** 2)))

    return {
        "before_px": rms((ago > -LEAD - 0.6) & (ago < -LEAD)),
        "during_px": float(px[(ago > 0.0) & (ago < back)].max()),
        "after_px": rms(ago > back),
        "covered": sum(covered for covered, _ in said),
        "pushed": one.tracker.pushed is not None,
        "unseen_s": max(unseen for _, unseen in said if np.isfinite(unseen)),
    }


def drawn(job):
    arm, seed, run, kind, motion = job
    row = covered(arm, seed, run, motion) if kind == "still" else event(arm, seed, run, kind)
    return [{"arm": arm, "seed": seed, "run": run, "event": kind, "motion": motion, **row}]


def main():
    counts = [("calibrations", 20, "of each arm, with each motion twice"), ("hands", 300, "runs with a hand")]
    counts += [("pushes", 100, "runs with a push"), ("changes", 100, "runs with a stop, reversal or gap")]
    given = parser_of("tracker", __doc__, counts, arms=(ARMS, list(ARMS))).parse_args()
    seeds = [SEED + k for k in range(max(given.calibrations, 1))]
    jobs = [
        (arm, seed, 2 * m + k, "still", motion)
        for arm in given.arms
        for seed in seeds[: given.calibrations]
        for m, motion in enumerate(MOTIONS)
        for k in range(2)
    ]
    for kind in EVENTS:
        for run in range(getattr(given, kind)):
            jobs.append((given.arms[run % len(given.arms)], seeds[run % len(seeds)], run, kind, ""))
    rows = written(given.output, COLUMNS, in_two_processes(drawn, jobs, "runs"))
    for motion in MOTIONS:
        own = [r for r in rows if r["motion"] == motion]
        if own:
            held = rate(sum(r["square"] <= chi2.ppf(0.95, 6) for r in own), len(own))
            over = np.sqrt(np.mean([r["mm"] ** 2 for r in own]) / np.mean([r["std_mm"] ** 2 for r in own]))
            kinds = {kind: sum(r["kind"] == kind for r in own) for kind in {r["kind"] for r in own}}
            mm, pushed = quantiles([r["mm"] for r in own]), sum(r["pushed"] for r in own)
            print(
                f"{motion}: held {held} %; {mm} mm, over stated {over:.2f}; {kinds}; pushed {pushed}",
                flush=True,
            )
    for kind in EVENTS:
        own = [r for r in rows if r["event"] == kind]
        if own:
            found = sum(r["pushed"] or r["unseen_s"] > 0.5 for r in own)
            ratio = np.sqrt(
                np.mean([r["after_px"] ** 2 for r in own]) / np.mean([r["before_px"] ** 2 for r in own])
            )
            print(
                f"{kind}: pushed {sum(r['pushed'] for r in own)} of {len(own)}, or unseen for 0.5 s {found}; "
                f"view left out in {sum(r['covered'] > 0 for r in own)}; px while it lasts "
                f"{quantiles([r['during_px'] for r in own])}; rms after over before {ratio:.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
