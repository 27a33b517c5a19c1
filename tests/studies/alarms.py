"""What the test of images in the loop says: false alarms, and whether it names what befell a robot.

    python -m tests.studies.alarms [--runs 1000] [--arms ur5 hobby] [--faults ...] [-o runs.csv]

Runs of random tasks, guided, images 0 to 300 ms late (each camera its own) with a jitter of 8 ms, encoders of
4,096 ticks, noise of 0.5 px; ten recordings for each line of the table, whose delays are those of its runs.
Each task is driven undisturbed first: a run that ends as ``fault detected`` is a false alarm. Then the fault
occurs in the first half of that path. A fault counts as named if the run ends as ``fault detected``, before
any other verdict, for the reason expected and no other; an ambiguous reason does not count.
"""

import re
from collections import Counter

import numpy as np

from projservo_cli.records import WorkFailed
from projservo_cli.simulation.random_tasks import random_tasks
from tests.configured import calibrate, plan, servo, truth_of
from tests.known import configured, with_task
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, write_rows

ARMS = ["ur5", "hobby"]
RECORDINGS = 10
LATEST_S = 0.3
# Joints that stand still after the strike are not missed: a reading counts as frozen where its joint still
# moves by so much, deg.
MOVES_DEG = 5.0
LIVELY = (
    "disturbance.jitter_s=0.008",
    "disturbance.encoder_counts_per_turn=4096",
    "disturbance.exposure_s=0.01",
)
GUIDED = ("trajectory.profile=auto", "control.mode=track", "plant.joint_limits=stop")


def camera_moved(rng, at, way):
    """A camera is moved by 2 px in some direction."""
    view, turn = rng.choice(["left", "right"]), rng.uniform(0.0, 2.0 * np.pi)
    by = [round(2.0 * float(x), 6) for x in (np.cos(turn), np.sin(turn))]
    key = f"disturbance.camera_moved={{at_step: {at}, view: {view}, by_px: {by}}}"
    return key, f"the {view} camera was moved"


def marker_moved(rng, at, way):
    """A marker that both cameras see, then and later, is moved by 3 mm in some direction."""
    seen = np.flatnonzero(way.in_sight[at:].mean(axis=0) > 0.9)
    if not seen.size:
        return None
    j = rng.choice(seen)
    by = rng.standard_normal(3)
    by = [round(float(x), 7) for x in 0.003 * by / np.linalg.norm(by)]
    number = way.numbers[j]
    key = f"disturbance.marker_moved={{at_step: {at}, marker: {number}, by_m: {by}}}"
    return key, f"marker {number} moved on the tool"


def joint_slipped(rng, at, way):
    """A joint slips by 3 degrees on its encoder."""
    joint, by = int(rng.integers(1, way.q.shape[1] + 1)), int(rng.choice([-3, 3]))
    key = f"disturbance.joint_moved={{at_step: {at}, joint: {joint}, by_deg: {by}, encoder_slip: true}}"
    return key, rf"joint {joint} slipped by {'-' * (by < 0)}(2\.[5-9]\d*|3(\.[0-4]\d*)?)°"


def reading_frozen(rng, at, way):
    """The reading of a joint that still moves stands still."""
    moves = np.abs(way.q[-1] - way.q[at]) > np.radians(MOVES_DEG)
    if not moves.any():
        return None
    joint = int(rng.choice(np.flatnonzero(moves))) + 1
    key = f"disturbance.stuck_encoder={{joint: {joint}, from_step: {at}, steps: null}}"
    return key, f"the reading of joint {joint} stands still"


# What befalls, and the noise of images meanwhile, px.
FAULTS = {
    "camera moved by 2 px": (camera_moved, 0.1),
    "marker moved by 3 mm": (marker_moved, 0.5),
    "joint slipped by 3 deg": (joint_slipped, 0.5),
    "reading frozen": (reading_frozen, 0.5),
}


class Way:
    """An undisturbed run: joints (k, n) and which markers (k, m) both images hold."""

    def __init__(self, config, trace):
        truth = truth_of(config)
        self.q, self.numbers = trace.q, truth.number
        s = np.array([truth.images(q, truth.M) for q in trace.q])
        self.in_sight = ((s >= 0.0) & (s <= truth.image_size[:, None] - 1.0)).all(axis=(1, 3))


def tasks(config, count, seed):
    """Start and goal joints of random tasks, rad."""
    front = np.array(config.task.start.values(config.joint_types))
    return zip(*random_tasks(truth_of(config), front, count, np.random.default_rng(seed)), strict=True)


def run_of(config, calibration):
    """One run, or why there is none."""
    try:
        return servo.run(config, calibration, plan.run(config, calibration), "exact_track"), ""
    except WorkFailed as error:
        return None, str(error)


def driven(job):
    """The runs of one recording of an arm, undisturbed and struck."""
    arm, fault, recording, count = job
    strike, noise = FAULTS[fault]
    rng = np.random.default_rng([ARMS.index(arm), list(FAULTS).index(fault), recording])
    left, right = rng.uniform(0.0, LATEST_S, 2).round(4).tolist()
    given = (
        f"noise.calibration_px={noise}",
        f"noise.servo_px={noise}",
        f"disturbance.camera_latency_s={{left: {left}, right: {right}}}",
        *(*LIVELY, *GUIDED),
    )
    config = configured(arm, *given)
    told = {"arm": arm, "fault": fault, "recording": recording, "left_s": left, "right_s": right}
    seeded = config.calibration.model_copy(update={"seed": 2000 + recording})
    calibration = calibrate.run(config.model_copy(update={"calibration": seeded}))[1]
    rows = []
    for seed, ends in enumerate(tasks(config, count, 100 + recording)):
        row = told | {"seed": seed}
        quiet, why = run_of(with_task(config, ends, seed=seed), calibration)
        if quiet is None:
            rows.append(row | {"verdict": "not started", "reason": why})
            continue
        row |= {"quiet": quiet.verdict, "quiet_steps": quiet.steps, "quiet_reason": quiet.reason}
        at = int(rng.integers(3, max(4, quiet.steps // 2)))
        struck = strike(rng, at, Way(config, quiet)) if quiet.verdict == "converged" else None
        if struck is not None:
            row |= {"at": at, "struck": struck[0]}
            row |= judged(struck, configured(arm, *given, struck[0]), ends, row, calibration)
        rows.append(row)
    return rows


def judged(struck, config, ends, row, calibration):
    """What a struck run says."""
    trace, why = run_of(with_task(config, ends, seed=row["seed"]), calibration)
    if trace is None:
        return {"verdict": "not started", "reason": why}
    said = trace.reason.partition("by the calibration: ")[2]
    named = trace.verdict == "fault detected" and bool(re.match(struck[1], said)) and "; or " not in said
    told = {"verdict": trace.verdict, "reason": trace.reason, "expected": struck[1], "named": named}
    return told | {"late": trace.steps - row["at"]}


def tell(arm, fault, rows):
    """Lines on a fault of an arm."""
    quiet = Counter(row["quiet"] for row in rows if "quiet" in row)
    struck = [row for row in rows if "named" in row]
    named = sum(row["named"] for row in struck)
    late = [row["late"] for row in struck if row["named"]]
    print(
        f"{arm}, {fault}: undisturbed {dict(quiet)}; named {named} of {len(struck)}, "
        f"{rate(named, len(struck))} %; after (periods, median / 95 % / most) {quantiles(late)}"
    )
    for row in struck:
        if not row["named"]:
            print(f"    {row['recording']}.{row['seed']} {row['struck']}: {row['verdict']}: {row['reason']}")
    for row in rows:
        if row.get("quiet") == "fault detected":
            print(f"    {row['recording']}.{row['seed']} undisturbed: {row['quiet_reason']}")


def main():
    """Drive all runs and print a line for each arm and fault, and all false alarms together."""
    counted = [("runs", 1000, "of each arm and fault")]
    given = parser_of("alarms_study", __doc__, counted, arms=ARMS, faults=FAULTS).parse_args()
    pairs = [(arm, fault) for arm in given.arms for fault in given.faults]
    each = -(-given.runs // RECORDINGS)
    jobs = [(*pair, recording, each) for pair in pairs for recording in range(RECORDINGS)]
    found, every = in_two_processes(driven, jobs, "recordings"), []
    for arm, fault in pairs:
        rows = [row for _ in range(RECORDINGS) for row in next(found)]
        tell(arm, fault, rows)
        every += rows
    quiet = [row["quiet"] for row in every if "quiet" in row]
    false = sum(verdict == "fault detected" for verdict in quiet)
    print(f"false alarms: {false} in {len(quiet)} undisturbed runs, {rate(false, len(quiet))} %")
    write_rows(given.output, every)


if __name__ == "__main__":
    main()
