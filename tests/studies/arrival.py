"""How often guided runs arrive on robots that are late, lag, sag, have play or coarse encoders.

    python -m tests.studies.arrival [--arms ur5 hobby] [--conditions ...] [--tasks 30] [-o runs.csv]

Thirty tasks by seed on ten recordings for each arm and condition, driven by ``exact_track`` with the profile
auto. A task fails unless the run converged within 3 mm and 1 degree of the truth; one that the true model
finds no way for is dropped. Of each recording it tells whether it is usable, whether chi-square lies in its
99 % band, and how delay and joint noise compare with the truth.
"""

import argparse
import math
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from projservo_cli.records import WorkFailed
from tests.configured import calibrate, plan, servo, truth_of
from tests.studies.conditions import (
    ARMS,
    CONDITIONS,
    FIRST_ROW,
    HALF_TICK,
    NEAR_DEG,
    NEAR_MM,
    RECORDED,
    SEEDS,
    TAUGHT,
    recorded_config,
    task_config,
    tasks_of,
    watched,
)
from tests.studies.planning_tables import has_no_way, in_two_processes, quantiles, rate, write_rows

RECORDINGS = 10
TAUGHT_FRAMES = 8
BAND = 0.01
NUMBERS = ("verdict", "steps", "overruns", "replan_attempts", "reason")


def judged(calibration, true):
    """What a recording says of itself, beside the truth."""
    told = {"usable": calibration.usable, "chi2": calibration.chi2_per_dof, "why": calibration.reason}
    low, high = (chdtri(calibration.dof, p) / calibration.dof for p in (1.0 - BAND / 2, BAND / 2))
    told["chi2_in_band"] = bool(low <= calibration.chi2_per_dof <= high)
    sigma_q, delay = true["sigma_q"], true["delay"]
    told |= {"sigma_q": calibration.sigma_q, "sigma_q_true": sigma_q, "delay_true": delay[0]}
    if calibration.sigma_q_interval is not None:
        least, most = calibration.sigma_q_interval
        told["sigma_q_covered"] = bool(least <= sigma_q <= most)
    if calibration.time_offset_s is not None:
        off = calibration.time_offset_s - delay
        told |= {"delay_s": calibration.time_offset_s[0], "delay_off_ms": 1e3 * float(np.abs(off).max())}
        inside = (calibration.time_offset_interval_s[:, 0] <= delay) & (
            delay <= calibration.time_offset_interval_s[:, 1]
        )
        told["delay_covered"] = float(inside.mean())
    return told


def driven(job):
    """A recording of an arm under a condition, and the runs of its tasks."""
    arm, condition, number, seeds = job
    told = {"arm": arm, "condition": condition, "recording": number}
    config = recorded_config(arm, condition, number)
    try:
        with watched() as true:
            calibration = calibrate.run(config)[1]
    except WorkFailed as error:
        return told | {"usable": False, "why": str(error)}, []
    taught = config.noise.servo_px / math.sqrt(TAUGHT_FRAMES) if condition == TAUGHT else None
    rows = [run_of(task_config(config, arm, seed, taught), calibration, arm, seed) for seed in seeds]
    return told | judged(calibration, true), [told | row for row in rows]


def run_of(config, calibration, arm, seed):
    """One run, with its true errors at the end."""
    told = {"seed": seed}
    try:
        trace = servo.run(config, calibration, plan.run(config, calibration), "exact_track")
    except WorkFailed as error:
        told |= {"verdict": "not started", "reason": str(error), "arrived": False}
        return told | {"no_way": has_no_way(config)} if config.task.goal.joints is not None else told
    goal = truth_of(config).robot.pose(tasks_of(arm)[seed][1])
    mm, deg = errors(trace.pose[-1], goal, truth_of(config))
    arrived = trace.verdict == "converged" and mm <= NEAR_MM and deg <= NEAR_DEG
    told |= {name: getattr(trace, name) for name in NUMBERS} | {"mm": mm, "deg": deg, "arrived": arrived}
    if not arrived and config.task.goal.joints is not None:
        told["no_way"] = has_no_way(config)
    return told


def errors(pose, goal, truth):
    """How far the middle of the face is from where it belongs, mm, and how far it is turned, degrees."""
    back = np.linalg.inv(truth.robot.base_tool)
    middle = truth.M_face.mean(axis=0)
    way = (pose @ back - goal @ back) @ middle
    turn = np.clip(0.5 * (np.trace(pose[:3, :3].T @ goal[:3, :3]) - 1.0), -1.0, 1.0)
    return 1e3 * float(np.linalg.norm(way[:3])), math.degrees(math.acos(turn))


def tell(arm, condition, recordings, rows, ideal):
    """Lines on an arm under a condition; ``ideal`` are its rows on the ideal plant, by seed."""
    possible = [row for row in rows if not row.get("no_way")]
    failed = [row for row in possible if not row["arrived"]]
    ended = Counter(f"{row['verdict']}" for row in failed)
    steps = [
        row["steps"] / ideal[row["seed"]]["steps"]
        for row in possible
        if row["arrived"] and ideal.get(row["seed"], {}).get("arrived")
    ]
    mm = [row.get("mm", math.nan) for row in possible]
    print(
        f"{arm}, {condition}: arrived {len(possible) - len(failed)} of {len(possible)}; error (mm, median / "
        f"95 % / most) {quantiles(mm)}; deg {quantiles([row.get('deg', math.nan) for row in possible])}; "
        f"steps over ideal {quantiles(steps, (0.5, 0.95))}; else {dict(ended)}"
    )
    usable = sum(row["usable"] for row in recordings)
    parts = [f"{usable} of {len(recordings)} recordings usable"]
    if condition in RECORDED:
        banded = sum(row.get("chi2_in_band", False) for row in recordings)
        parts.append(f"chi2 in its band {banded}")
        off = [row["delay_off_ms"] for row in recordings if "delay_off_ms" in row]
        parts.append(
            f"delay within 5 ms {sum(x <= 5.0 for x in off)} of {len(off)} (off {quantiles(off)} ms)"
        )
        covered = [row["delay_covered"] for row in recordings if "delay_covered" in row]
        parts.append(f"its interval holds {100 * np.mean(covered) if covered else math.nan:.0f} %")
        covered = [row["sigma_q_covered"] for row in recordings if "sigma_q_covered" in row]
        parts.append(
            f"that of sigma_q {100 * np.mean(covered) if covered else math.nan:.0f} % of {len(covered)}"
        )
        found = [row["sigma_q"] for row in recordings if row.get("sigma_q") is not None]
        true = max((row["sigma_q_true"] for row in recordings if "sigma_q_true" in row), default=0.0)
        if true > 0.0 and found:
            parts.append(f"sigma_q over truth {np.median(found) / true:.2f}")
    print("    " + "; ".join(parts), flush=True)


def main():
    """Make all recordings, drive all runs, and print two lines for each arm and condition."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=list(CONDITIONS))
    parser.add_argument("--tasks", type=int, default=len(SEEDS), help="of each arm and condition")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("arrival_study.csv"), help="every run, as CSV"
    )
    given = parser.parse_args()
    seeds = list(SEEDS)[: given.tasks]
    jobs = [
        (arm, condition, number, [seed for seed in seeds if seed % RECORDINGS == number])
        for arm in given.arms
        for condition in given.conditions
        for number in range(RECORDINGS)
    ]
    every, kept, ideal = [], [], {}
    found = in_two_processes(driven, jobs, "recordings")
    first = []
    for arm in given.arms:
        for condition in given.conditions:
            both = [next(found) for _ in range(RECORDINGS)]
            recordings, rows = [one for one, _ in both], [row for _, mine in both for row in mine]
            if condition == "ideal":
                ideal[arm] = {row["seed"]: row for row in rows}
            tell(arm, condition, recordings, rows, ideal.get(arm, {}))
            every += rows
            kept += recordings
            first += [row for row in rows if condition in FIRST_ROW and not row.get("no_way")]
    if first:
        print(f"first row pooled: {rate(sum(row['arrived'] for row in first), len(first))} %")
    print("half a tick times reach (mm):", {arm: round(1e3 * HALF_TICK * ARMS[arm], 2) for arm in given.arms})
    write_rows(given.output, every)
    write_rows(given.output.with_name(f"{given.output.stem}_recordings.csv"), kept)


if __name__ == "__main__":
    main()
