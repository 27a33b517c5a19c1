"""How often guided runs succeed, and why others do not: the table of the sweep of sweep_guidance.yaml.

    projservo sweep -c configs/sweep_guidance.yaml
    python -m tests.studies.planning_success results/sweep_guidance [FOLDER ...] [-o runs.csv]

The sweep may be interrupted; what is done of it counts. A task that guidance does not solve is looked at with
the true model: where 20 searches of 100,000 samples each find no way, borders and limits without margin,
there is *no way*, and rates are told with and without it. Every run is a row of the CSV file, with its seed.
"""

from collections import Counter
from itertools import groupby

import numpy as np

from projservo_cli.records import WorkFailed
from projservo_cli.store.sweep_table import SweepTable
from projservo_cli.sweeps.folder import Folder, run_of
from tests.configured import plan, servo, truth_of
from tests.studies.common import (
    has_no_way,
    in_two_processes,
    parser_of,
    quantiles,
    rate,
    search_of,
    write_rows,
)

GUIDED, ALONE = "exact_track", "exact"
KEPT = ("run", "noise_px", "law", "draw", "task", "seed", "verdict", "success", "usable", "steps")
NUMBERS = ("position_error_mm", "rotation_error_deg", "rotation_deg", "first_outside_image")


def rows_of(folder):
    """Every run of a sweep that is done, as a mapping."""
    table, design = SweepTable(Folder(folder).assembled()), Folder(folder).design()
    columns = {name: table.column(name).tolist() for name in (*KEPT, *NUMBERS)}
    bases = [name for name, _ in design.bases]
    for i, run in enumerate(columns["run"]):
        cell = design.numbers(run)[0]
        yield {"folder": folder, "arm": bases[design.base_of(cell)]} | {
            name: values[i] for name, values in columns.items()
        }


def why(row):
    """Of a guided run that failed: whether there is no way, the plan that it followed, and how it ended."""
    config, calibrated = run_of(f"{row['folder']}:{row['run']}")
    told = {"no_way": has_no_way(*search_of(config)), "cause": row["verdict"]}
    if calibrated is None:
        return told
    calibration = calibrated.records["calibration"]
    try:
        planned = plan.run(config, calibration)
        trace = servo.run(config, calibration, planned, GUIDED)
    except WorkFailed as error:
        return told | {"cause": f"not started: {error}"}
    told |= {"profile": planned.profile, "plan": planned.reason, "ended": trace.reason}
    if not planned.feasible:
        return told | {"cause": f"no plan, {trace.verdict}"}
    if trace.verdict == "converged":
        return told | {"cause": "converged, " + broken(config, trace)}
    return told | {"cause": trace.verdict}


def broken(config, trace):
    """What a run that converged did on its way, in truth."""
    if trace.self_occluded.any():
        return "behind the face"
    truth = truth_of(config)
    seen = np.array([truth.images(q, truth.M_face) for q in trace.q])
    inside = (seen >= -0.5) & (seen <= truth.image_size[:, None] - 0.5)
    return "past a limit" if inside.all() else "out of an image"


def arm_lines(rows):
    """Lines of the table on the runs of one arm and noise, or of several."""
    no_way = {(row["folder"], row["task"]) for row in rows if row.get("no_way")}
    for law in (GUIDED, ALONE):
        mine = [row for row in rows if row["law"] == law]
        possible = [row for row in mine if (row["folder"], row["task"]) not in no_way]
        good = [row for row in mine if row["success"]]
        rates = rate(len(good), len(mine)), rate(len(good), len(possible))
        errors = quantiles([row["position_error_mm"] for row in good], (0.5, 0.95))
        yield f"{law:<12}{len(mine):>5}{rates[0]:>24}{rates[1]:>24}{len(mine) - len(possible):>7}  {errors}"


def paired(rows):
    """How the final errors compare on the tasks that both solve, in words."""
    errors = {law: {} for law in (GUIDED, ALONE)}
    for row in rows:
        if row["success"]:
            task = row["folder"], row["arm"], row["draw"], row["noise_px"]
            errors[row["law"]][task] = row["position_error_mm"]
    both = [(error, errors[ALONE][task]) for task, error in errors[GUIDED].items() if task in errors[ALONE]]
    if not both:
        return "no task that both solve"
    first, second = np.array(both).T
    medians = np.median(first), np.median(second), np.median(first / second)
    return (
        "{} tasks that both solve: median error {:.3g} guided, {:.3g} alone, mm; median of the ratios "
        "{:.3f}".format(len(both), *medians)
    )


def tell(title, rows):
    """Print what there is to say of some runs."""
    print(
        f"\n{title}\n{'':7}{'runs':>5}{'success %':>24}{'where there is a way':>24}{'no way':>7}  mm 50/95 %"
    )
    print("\n".join(arm_lines(rows)))
    print(paired(rows))
    causes = Counter(row["cause"] for row in rows if "cause" in row)
    print(
        "guided failures:", ", ".join(f"{cause} {count}" for cause, count in causes.most_common()) or "none"
    )


def main():
    """Read the sweeps, look into what failed, and print the table."""
    parser = parser_of("success_study", __doc__)
    parser.add_argument("folders", nargs="+", help="of sweeps of configs/sweep_guidance.yaml")
    given = parser.parse_args()
    rows = [row for folder in given.folders for row in rows_of(folder)]
    failed = [row for row in rows if row["law"] == GUIDED and not row["success"]]
    for row, told in zip(failed, in_two_processes(why, failed, "failures"), strict=True):
        row |= told
    write_rows(given.output, rows)

    def place(row):
        return row["arm"], row["noise_px"]

    for (arm, noise_px), mine in groupby(sorted(rows, key=place), place):
        tell(f"{arm}, {noise_px:g} px", list(mine))
    for noise_px in sorted({row["noise_px"] for row in rows}):
        tell(f"pooled, {noise_px:g} px", [row for row in rows if row["noise_px"] == noise_px])


if __name__ == "__main__":
    main()
