"""What becomes of guided runs that are disturbed: a success, or a verdict, and no joint past a limit.

    python -m tests.studies.planning_disturbed [--tasks 100] [--arms paper ur5] [-o runs.csv]

Markers are lost for 20 steps, for 32 (longer than they are waited for), and for ever; a joint is knocked by
3 degrees; a camera is moved by 2 px, with the test of the images and without.
"""

from collections import Counter

from projservo_cli.records import WorkFailed
from tests.configured import calibrate, plan, servo
from tests.studies.common import (
    asked_for,
    in_two_processes,
    quantiles,
    rate,
    task_configs,
    write_rows,
)

STEP = 12
CONDITIONS = {
    "undisturbed": (),
    "lost for 20 steps": (f"disturbance.lost_markers={{from_step: {STEP}, steps: 20}}",),
    "lost for 32 steps": (f"disturbance.lost_markers={{from_step: {STEP}, steps: 32}}",),
    "lost for ever": (f"disturbance.lost_markers={{from_step: {STEP}}}",),
    "joint 2 knocked by 3 deg": (f"disturbance.joint_moved={{at_step: {STEP}, joint: 2, by_deg: 3}}",),
    "left camera moved by 2 px": (f"disturbance.camera_moved={{at_step: {STEP}, view: left, by_px: 2}}",),
    "the same, not tested": (
        f"disturbance.camera_moved={{at_step: {STEP}, view: left, by_px: 2}}",
        "stop.innovation_threshold=0",
    ),
}
GUIDED = ("trajectory.profile=auto", "plant.joint_limits=stop")


def driven(job):
    """The runs of an arm under one condition."""
    name, condition, count = job
    configs = list(task_configs(name, count, *GUIDED, *CONDITIONS[condition]))
    calibration = calibrate.run(configs[0])[1]
    rows = []
    for config in configs:
        told = {"arm": name, "condition": condition, "seed": config.seed}
        try:
            trace = servo.run(config, calibration, plan.run(config, calibration), "exact_track")
        except WorkFailed as error:
            rows.append(told | {"verdict": "not started", "reason": str(error)})
            continue
        numbers = (
            "verdict",
            "success",
            "steps",
            "replan_attempts",
            "position_error_mm",
            "first_beyond_limit",
        )
        rows.append(told | {number: getattr(trace, number) for number in numbers} | {"reason": trace.reason})
    return rows


def main():
    """Drive all runs and print a line for each arm and condition."""
    given = asked_for("disturbed_study", __doc__, 100, ("paper", "ur5"))
    jobs = [(name, condition, given.tasks) for name in given.arms for condition in CONDITIONS]
    rows = []
    for mine in in_two_processes(driven, jobs, "arms and conditions"):
        rows += mine
        good = [row for row in mine if row.get("success")]
        verdicts = Counter(row["verdict"] for row in mine if not row.get("success"))
        past = sum(row.get("first_beyond_limit", -1) >= 0 for row in mine)
        print(
            f"{mine[0]['arm']}, {mine[0]['condition']}: success {rate(len(good), len(mine))} %, error (mm) "
            f"{quantiles([row['position_error_mm'] for row in good], (0.5, 0.95))}; else {dict(verdicts)}; "
            f"searched anew {sum(row.get('replan_attempts', 0) > 0 for row in mine)}; past a limit {past}"
        )
    write_rows(given.output, rows)


if __name__ == "__main__":
    main()
