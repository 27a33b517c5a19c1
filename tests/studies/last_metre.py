"""Whether a run that says it has arrived is as near as it states, where faults are too small to be seen.

    python -m tests.studies.last_metre [--runs 40] [--kinds turned drifting goal elsewhere sound] [-o FILE]

Rigs and tasks are those of ``monitoring``, drawn by seed: arms x corners x backlash x latency x kind of goal.
Sizes are uniform within ``SIZES``. A run counts as right if its exit code is 1, or if the tool is off by no
more than ``TIMES`` what is stated. The truth is where the tool was when its goal was taught, or where it is
at the readings of a goal by joints; tags that moved on the tool do not move that.
"""

import json
from collections import Counter

import numpy as np

from tests.monitoring.stand_in import ARMS, KINDS, LAST, StandIn, tool_pose
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, written
from tests.studies.monitoring import (
    Rig,
    calibrated,
    moved_so_far,
    off_mm,
    planned,
    rigs,
    run_of,
    taught,
)

SEED, PERIOD_S, TIMES, RIGS, BAR = 4848, 0.04, 1.5, 20, 97.0
# Least and greatest size: camera turned before the run, px; drift of one, px a period; one view of the goal
# images, px; tags on the tool, mm.
SIZES = {
    "turned": (0.3, 1.0),
    "drifting": (0.003, 0.01),
    "goal": (1.0, 12.0),
    "elsewhere": (0.2, 1.0),
    "sound": (0.0, 0.0),
}
COLUMNS = (
    *("kind", "number", *Rig._fields, "goal", "size", "verdict", "exit", "stage", "steps", "error_mm"),
    *("stated_mm", "right", "seconds", "task", "by", "reason"),
)


def fault_of(kind, size, T, rng):
    """The fault of a kind and size, for a tool at a pose."""
    view, axis, sign = int(rng.integers(2)), int(rng.integers(3)), int(rng.choice([-1, 1]))
    if kind in ("turned", "drifting"):
        fault = moved_so_far("turn", (view,), axis, sign, size, T)
        return fault if kind == "turned" else fault | {"kind": "drift", "by": fault["by"] / PERIOD_S}
    if kind == "goal":
        turn = rng.uniform(0.0, 2.0 * np.pi)
        return {"kind": "shift", "views": [view], "by": [size * np.cos(turn), size * np.sin(turn)]}
    by = rng.standard_normal(3)
    return {"kind": "slip", "by": (1e-3 * size * by / np.linalg.norm(by)).tolist()} if size else None


def goal_of(rig, q_deg, how, fault=None):
    """A goal by joints, by images with the joints there, or by images alone."""
    shown = taught(rig, q_deg, fault) if how != "joints" else q_deg
    if how == "images":
        del shown["images"]["joints"]
    return shown


def driven(job):
    """Rows of all runs of one rig."""
    rig, first, count, kinds = job
    calibration, arm, rows = calibrated(rig), ARMS[rig.arm], []
    for kind in kinds:
        for number in range(first, first + count):
            row = {"kind": kind, "number": number, **rig._asdict()}
            if isinstance(calibration, str):
                rows.append(row | {"verdict": "no calibration", "reason": calibration})
                continue
            rng = np.random.default_rng([SEED, list(SIZES).index(kind), number])
            size = float(rng.uniform(*SIZES[kind]))
            how = str(rng.choice(["images", "taught"] if kind == "goal" else ["joints", "images", "taught"]))
            start, goal, shown, _ = planned(rig, rng, lambda q, how=how: goal_of(rig, q, how))
            there = tool_pose(arm, np.radians(goal))
            fault = fault_of(kind, size, there, rng)
            if how != "joints":
                there = StandIn(**rig.options(at_deg=goal, seed=2)).pose()
            if kind == "goal":
                shown, during = goal_of(rig, goal, how, fault), None
            else:
                during = fault
            found = run_of(rig, (start, shown), during, seed=int(rng.integers(2**31)))
            row |= {"goal": how, "size": size, "task": [start, goal], "by": json.dumps(fault)} | found
            row["error_mm"] = off_mm(there) if LAST else float("nan")
            stated = row.get("stated_mm")
            row["right"] = row["exit"] == 1 or (stated is not None and row["error_mm"] <= TIMES * stated)
            rows.append({key: row.get(key) for key in COLUMNS})
    return rows


def tell(kind, rows):
    """Lines on a kind."""
    rows = [row for row in rows if row["kind"] == kind and "right" in row]
    if not rows:
        return
    zero, right = [row for row in rows if row["exit"] == 0], sum(row["right"] for row in rows)
    off, stated = ([row[key] or 0.0 for row in zero] for key in ("error_mm", "stated_mm"))
    verdicts = dict(Counter(row["verdict"] for row in rows))
    print(f"{kind}: right {right} of {len(rows)}, {rate(right, len(rows))} % ({BAR:g} wanted); {verdicts}")
    print(f"    exit code 0 in {len(zero)}: off by (mm) {quantiles(off)}, stated {quantiles(stated)}")
    for row in rows:
        if not row["right"]:
            about = f"{row['corners']} {row['arm']} {row['backlash_deg']}° {row['goal']} {row['size']:.3g}"
            print(f"    {row['number']} {about}: {row['error_mm']:.2f} mm, stated {row['stated_mm']}")
        elif kind == "sound" and row["exit"]:
            print(
                f"    {row['number']} {row['corners']} {row['goal']}: {row['verdict']}: {row['reason']}"[:260]
            )


def main():
    """Drive the runs of all kinds and print a summary."""
    counted = [("runs", 40, "of each kind")]
    given = parser_of("last_metre_study", __doc__, counted, kinds=SIZES, corners=KINDS).parse_args()
    some = rigs(given.corners)[: min(RIGS, max(1, given.runs // 4))]
    each = -(-given.runs // len(some))
    jobs = [(rig, i * each, each, given.kinds) for i, rig in enumerate(some)]
    every = written(given.output, COLUMNS, in_two_processes(driven, jobs, "rigs"))
    for kind in given.kinds:
        tell(kind, every)


if __name__ == "__main__":
    main()
