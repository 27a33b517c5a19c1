"""Study of ``doctor --move``: forty set-ups, of which most have one of twelve faults, and what is named.

    python -m tests.studies.doctor

A fault is twice its threshold, a sound set-up has half of each. A fault counts as named if a finding that is
not fine tells it; a sound set-up as blamed if any finding is not fine.
"""

import sys
from types import SimpleNamespace

import numpy as np

from projservo_cli.detection import TagFinder
from projservo_cli.hardware.camera_robot import View
from projservo_cli.hardware.cameras import Frame
from projservo_cli.hardware.checks_at_rest import RobotAtRest, findings_at_rest
from projservo_cli.records import JointLimits
from projservo_cli.settings.cameras import Source
from tests.hardware.arms_in_motion import Faults, findings
from tests.hardware.streams import picture
from tests.hardware.test_doctor import seen_from

SEED, SOUND = 20261125, 16
# Each fault with the words that name it, and for motions what it changes.
MOTIONS = {
    "late": (lambda rng: {"latency_s": (0.6, 0.6)}, "left camera", "latency"),
    "right late": (lambda rng: {"latency_s": (0.1, 0.6)}, "right camera", "latency"),
    "backlash": (lambda rng: {"backlash_deg": 3.0}, "joint", "backlash"),
    "hysteresis": (lambda rng: {"hysteresis_deg": 3.0}, "joint", "hysteresis"),
    "loose tag": (lambda rng: {"loose": int(rng.integers(5)), "loose_px": 2.8}, "tags", "moved by"),
    "wrist link": (lambda rng: {"link": 4}, "joint 5", "no tag moved"),
    "arm link": (lambda rng: {"link": 2}, "joints 3, 4, 5", "no tag moved"),
    "held joint": (lambda rng: {"held": int(rng.integers(1, 5))}, "joint", "held or too weak"),
}
AT_REST = {
    "no depth": ({"baseline": 0.017}, "both cameras", "directions"),
    "blurred": ({"blur": 5.0}, "left camera", "is blurred by"),
    "slow": ({"rate": 0.375 * 30.0}, "left camera", "instead of 30"),
    "small tags": ({"side": 12.0}, "left image", "px a cell"),
}


def setting(rng):
    """What is drawn of every set-up, sound or not."""
    return {
        "latency_s": tuple(rng.uniform(0.05, 0.15, 2)),
        "rate_hz": float(rng.choice([15.0, 25.0, 30.0])),
        "hysteresis_deg": rng.uniform(0.0, 0.75),
        "backlash_deg": rng.uniform(0.0, 0.75),
        "sag_deg": rng.uniform(0.0, 2.0),
        "noise_px": rng.uniform(0.02, 0.1),
        "lag_s": rng.uniform(0.02, 0.08),
    }


def moved(rng, change):
    """Findings of motions, and the errors of both latencies, s."""
    given = setting(rng) | change
    if not change:
        given |= {"loose": int(rng.integers(5)), "loose_px": 0.7}  # half of the threshold between two rests
    q = np.array([0.0, 10.0, -25.0, 15.0, 0.0]) + rng.uniform(-8.0, 8.0, 5)
    found, _ = findings(Faults(**given), q_deg=tuple(q))
    late = [float(one.text.split()[1]) for one in found if one.text.startswith("latency")]
    errors = [1e-3 * ms - true for ms, true in zip(late, given["latency_s"], strict=len(late) == 2)]
    return found, errors


def at_rest(rng, change):
    """Findings of two drawn images."""
    finder, limits = TagFinder("4X4_50"), np.full(5, 2.0)
    baseline = change.get("baseline", rng.uniform(0.2, 0.35))
    tilt = rng.uniform(10.0, 30.0)
    images = [seen_from(x, tilt) for x in (-baseline / 2, baseline / 2)]
    if "blur" in change or "side" in change:
        images[0] = picture(
            at=(150.0, 120.0), side=change.get("side", 60.0), size=(640, 480), blur=change.get("blur", 0.7)
        )
    cameras, views = [], []
    for name, image in zip(("left", "right"), images, strict=True):
        frame = Frame(image, 0.0, 1)
        views.append(View(frame, *finder.find(image.astype(float))))
        cameras.append(
            SimpleNamespace(
                name=name,
                newest=lambda frame=frame: frame,
                rate_hz=change.get("rate", rng.uniform(27.0, 31.0)),
                settings=Source(source="http://camera", rate_hz=30.0),
                stamped=False,
                remarks=[],
            )
        )
    s = np.stack([view.tags[0].pixels if 0 in view.tags else np.full((4, 2), np.nan) for view in views])
    seen = RobotAtRest(
        marker=range(4),
        face=range(4),
        q=np.zeros(5),
        s=s,
        sigma=None,
        scatter=np.full((2, 4), 0.02),
        limits=JointLimits(-limits, limits, limits, limits),
        units=("deg",) * 5,
        views=views,
        cameras=cameras,
    )
    return [*findings_at_rest(seen, finder, "4X4_50")]


def set_ups():
    """Name of the fault, empty for a sound set-up, and a generator of random numbers, forty times."""
    names = [*MOTIONS, *AT_REST] * 2 + [""] * SOUND
    return [(name, np.random.default_rng([SEED, k])) for k, name in enumerate(names)]


def main():
    named, blamed, errors = 0, 0, []
    for k, (name, rng) in enumerate(set_ups()):
        off = []
        if name in AT_REST:
            change, where, words = AT_REST[name]
            found = at_rest(rng, change)
        else:
            change, where, words = MOTIONS.get(name, (lambda rng: {}, "", ""))
            found, off = moved(rng, change(rng))
            errors += off
            found += [] if name else at_rest(rng, {})
        wrong = [one for one in found if one.level != "fine"]
        hit = any(one.where.startswith(where) and words in f"{one.text}: {one.remedy}" for one in wrong)
        named, blamed = named + (bool(name) and hit), blamed + (not name and bool(wrong))
        told = "; ".join(f"{one.where}: {one.text}" for one in wrong[:2])
        result = ("named" if hit else "MISSED") if name else ("BLAMED" if wrong else "")
        print(f"{k:2} {name or 'sound':12} {result:7} {np.round(1e3 * np.array(off), 1)} {told}")
    faults = len(MOTIONS) * 2 + len(AT_REST) * 2
    print(f"named {named} of {faults}, blamed {blamed} of {SOUND} sound ones")
    print(f"latency off by {1e3 * np.max(np.abs(errors)):.1f} ms at most, {len(errors)} cameras")
    return 0 if named >= 0.95 * faults and blamed <= 1 and np.max(np.abs(errors)) <= 5e-3 else 1


if __name__ == "__main__":
    sys.exit(main())
