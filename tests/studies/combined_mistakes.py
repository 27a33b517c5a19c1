"""Whether any table with mistakes ends in a calibration or a refusal, and never in an error of Python.

    python -m tests.studies.combined_mistakes [--tables N] [--first SEED]

Of each seed an arm of one to six joints before one to three cameras, with three to 13 markers, and up to
three mistakes together, of which most would be refused alone. Prints what became of the tables, and each that
ended otherwise, took more than ``SLOW_S`` of processor time, or warned.
"""

import argparse
import dataclasses
import sys
import time
import traceback
import warnings
from collections import Counter

import numpy as np
from scipy.linalg import expm

from projservo_cli.calibration import calibrate
from projservo_cli.records import InputError, Observation, WorkFailed
from tests.calibration.simulated_robot import NAMES, around, random_robot, trials
from tests.studies.common import in_two_processes

MISTAKES = (
    *("bump", "bumpall", "bumpmid", "gear", "still", "sign", "order", "late", "lateview", "swap", "drop"),
    *("dropview", "frozen", "outlier", "step", "dup", "far", "mirror", "transpose", "scale", "dropmarker"),
    "droppose",
)
ENDS = ("usable", "not usable", "refused")
SLOW_S = 25.0


def bump(rng, degrees):
    """A small motion (4, 4) of a camera, in deviations of the angle, with 4 mm a degree."""
    w, B = np.radians(degrees) * rng.standard_normal(3), np.zeros((4, 4))
    B[:3, :3], B[:3, 3] = np.cross(np.eye(3), w), 0.004 * degrees * rng.standard_normal(3)
    return expm(B)


def spoil(mistake, robot, q, images, rng):
    """Make a mistake in readings (K, n), which are returned, or in images (K, V, m, 2)."""
    (K, n), (V, m) = q.shape, images.shape[1:3]
    v, at, i = int(rng.integers(V)), int(rng.integers(1, max(2, K - 1))), int(rng.integers(n))
    home = robot.q_reference[i]
    match mistake:
        case "bump" | "bumpall" | "bumpmid":
            cameras, which = robot.cameras.copy(), slice(None) if mistake == "bumpall" else slice(v, v + 1)
            cameras[which] = cameras[which] @ bump(rng, rng.choice([0.2, 1.5, 8]))
            there = dataclasses.replace(robot, cameras=cameras).images(q)
            end = min(K, at + int(rng.integers(1, 8))) if mistake == "bumpmid" else K
            images[at:end, which] = there[at:end, which]
        case "gear":
            q[:, i] = home + (q[:, i] - home) * rng.choice([0.5, 0.97, 1.1, 2])
        case "still":
            q[:, i] = rng.choice([0, home])
        case "sign":
            q[:, i] *= -1
        case "order":
            q = q[:, rng.permutation(n)]
        case "late":
            q = np.vstack([q[:1], q[:-1]])
        case "lateview":
            images[1:, v] = images[:-1, v].copy()
        case "swap":
            images[:, v] = images[:, v][:, rng.permutation(m)]
        case "drop":
            images[rng.random(images.shape[:3]) < rng.choice([0.1, 0.5, 0.9])] = np.nan
        case "dropview":
            images[at:, v] = np.nan
        case "frozen":
            images[:, v] = images[at, v]
        case "outlier":
            wrong = rng.random(images.shape[:3]) < rng.choice([0.02, 0.3, 0.7])
            images[wrong] += 200 * rng.standard_normal((wrong.sum(), 2))
        case "step":
            q[at:, i] += rng.choice([0.01, 0.3])
        case "dup":
            q[at:], images[at:] = q[at], images[at]
        case "far":
            images *= rng.choice([1e-3, 1e3])
        case "mirror":
            images[:, v, :, 0] *= -1
        case "transpose":
            images[:, v] = images[:, v, :, ::-1]
        case "scale":
            q[:, i] = np.degrees(q[:, i])
        case "dropmarker":
            images[:, :, : int(rng.integers(1, m + 1))] = np.nan
        case "droppose":
            images[at:] = np.nan
    return q


def table(seed):
    """Observation with mistakes of a seed, the types of its joints, options of the fit, and the mistakes."""
    rng = np.random.default_rng([77, seed])
    types = "".join(rng.choice(list("RRRP"), int(rng.integers(1, 7))))
    markers, views = int(rng.integers(3, 14)), int(rng.choice([1, 2, 2, 2, 3]))
    robot = random_robot(types, rng, markers, views)
    if rng.random() < 0.2:
        robot.markers[:, 2] = 0.0
    angle, parts = np.radians(rng.choice([3, 10, 20, 40])), []
    if rng.random() < 0.8:
        parts.append(trials(robot, int(rng.integers(2, 8)), angle))
    if not parts or rng.random() < 0.7:
        parts.append(around(robot, int(rng.integers(2, 25)), rng, angle))
    q = np.vstack(parts)
    images, made = robot.images(q), []
    for _ in range(int(rng.integers(0, 4))):
        made.append(str(rng.choice(MISTAKES)))
        q = spoil(made[-1], robot, q, images, rng)
    images = images + rng.choice([0, 0.02, 0.3, 3]) * rng.standard_normal(images.shape)
    options = {"lens": True} if rng.random() < 0.15 else {}
    options["joint_noise"] = float(rng.choice([0, 1e-3])) if rng.random() < 0.2 else None
    seen = Observation(np.arange(len(q)), np.arange(markers), q, images, view=NAMES[:views])
    return seen, types, options, made


def ending(seed):
    """How the calibration of a table ends: usable, not usable, refused, or an error with its place."""
    seen, types, options, made = table(seed)
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            end = ENDS[not calibrate(seen, types, source="recorded", **options).usable]
        except (WorkFailed, InputError):
            end = "refused"
        except Exception as error:
            frames = [one for one in traceback.extract_tb(error.__traceback__) if "projservo_cli" in one[0]]
            end = f"{type(error).__name__}: {error} ({frames[-1].name}:{frames[-1].lineno})"
    return seed, end, time.process_time() - began, (types, *seen.images.shape[:3], made, options)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tables", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first table")
    asked, ends = parser.parse_args(), Counter()
    seeds = range(asked.first, asked.first + asked.tables)
    for seed, end, seconds, what in in_two_processes(ending, seeds, "tables"):
        ends[end if end in ENDS else "wrong"] += 1
        if end not in ENDS or seconds > SLOW_S:
            print(f"{seed}: {end}, {seconds:.0f} s: {what}", flush=True)
    print(dict(ends))
    return ends["wrong"]


if __name__ == "__main__":
    sys.exit(main())
