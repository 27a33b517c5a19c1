"""How long a plan takes, from images to timed joints, goals and failures included: warm, on one core.

    python -m tests.studies.planning_time [--tasks 1000] [--arms paper ur5 stanford seven] [-o plans.csv]

The tasks are shared out evenly among the arms; the profile ``auto`` is told beside ``joint``.
"""

import time

from tqdm import tqdm

from projservo_cli.records import WorkFailed
from tests.configured import calibrate, plan, scenario_of
from tests.studies.common import asked_for, quantiles, task_configs, write_rows

PROFILES = ("joint_space", "auto")


def timed(config, calibration):
    """Processor time of a plan, s, and what came of it; the simulated images are not counted."""
    scenario_of(config, calibration)  # is kept, so that simulating the images is not counted
    begin = time.process_time()
    try:
        made = plan.run(config, calibration)
        found = {
            "taken": made.profile,
            "feasible": made.feasible,
            "samples": made.samples,
            "why": made.reason,
        }
    except WorkFailed as error:
        found = {"taken": "", "feasible": False, "samples": None, "why": str(error)}
    return {"s": time.process_time() - begin} | found


def main():
    """Time the plans and print the table."""
    given = asked_for("timing_study", __doc__, 1000, counted="in all")
    rows = []
    for name in given.arms:
        count = given.tasks // len(given.arms)
        for profile in PROFILES:
            configs = list(task_configs(name, count, f"trajectory.profile={profile}"))
            calibration = calibrate.run(configs[0])[1]
            for config in configs[:10]:  # compiles, and works out how far predictions of the calibration err
                timed(config, calibration)
            for config in tqdm(configs, f"{name} {profile}", disable=None):
                rows.append(
                    {"arm": name, "profile": profile, "seed": config.seed} | timed(config, calibration)
                )
            tell(name, profile, rows)
    write_rows(given.output, rows)
    for profile in PROFILES:
        tell("all", profile, rows)


def tell(name, profile, rows):
    """Print the times of an arm, or of all."""
    mine = [row for row in rows if row["profile"] == profile and name in (row["arm"], "all")]
    none = sum(not row["feasible"] for row in mine)
    print(
        f"{name:<9}{profile:<6}{len(mine):>5} plans, {none} not feasible; median / 95 % / worst, ms: "
        f"{quantiles([1e3 * row['s'] for row in mine])}"
    )


if __name__ == "__main__":
    main()
