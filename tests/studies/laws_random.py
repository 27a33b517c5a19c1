"""How often laws with the same features succeed on random tasks, ViSP among them.

    python -m tests.studies.laws_random [--features points] [--tasks 60] [-o runs.csv]

The sweep of configs/benchmark.yaml with fewer tasks of each of its two arms: the laws that can measure the
face by these features. By points, the laws of ViSP get the same tasks, noise, limits and verdicts. They are
given the true arm and the face in metres, and true intrinsics and cameras, or OpenCV's calibration of the
images of the trials. A run succeeds that converges and holds every constraint in truth.
"""

import json
from collections import defaultdict

import numpy as np

from projservo_cli.config import load_sweep
from projservo_cli.config.inputs import servo_inputs
from projservo_cli.laws import BODY_LAWS, REGULATE, law_and_mode
from projservo_cli.records import WorkFailed
from projservo_cli.stages.scenario import run_scenario
from projservo_cli.stages.servo import drive
from projservo_cli.sweeps.design import read_design
from projservo_cli.sweeps.runs import Part, run_part
from tests.configured import calibrate, plan, record, truth_of
from tests.conftest import ROOT
from tests.studies import visp
from tests.studies.common import parser_of, write_rows

FEATURES = ("points", "body")
NOISE_PX = 0.5  # of columns of one noise
HIDDEN = ("self_occluded_steps_left", "self_occluded_steps_right")
COLUMNS = ("base", "noise_px", "law", "verdict", "success", "steps", *HIDDEN)
COLUMNS += ("first_outside_image", "position_error_mm", "path_length_mm", "distance_mm")


def design_of(features, tasks):
    """The sweep of the laws that have some features, with a number of tasks of each arm."""
    changes = [f"set.control.features={features}", f"runs={tasks}", f"tasks.random={tasks}"]
    sweep = load_sweep(ROOT / "configs" / "benchmark.yaml", changes)
    if features == "body":
        axis = sweep.grid["law"]
        laws = {name: axis.also.get(name, {}) for name in axis.values if law_and_mode(name)[0] in BODY_LAWS}
        sweep = load_sweep(ROOT / "configs" / "benchmark.yaml", [*changes, f"grid.law={json.dumps(laws)}"])
    return read_design(sweep)


def calibrated(design, features):
    """Calibrations of a sweep by key, and by points what ViSP is given of each, by what is told of it."""
    found, cells = {}, {}
    for key, config in design.calibrations():
        try:
            found[key] = calibrate.run(config)[1]
        except WorkFailed:
            found[key] = None
        if features == "points":
            truth, (seen, _) = truth_of(config), record.observed(config)
            cells[key] = {"true": visp.true_cell(truth), "calibrated": visp.calibrated_cell(truth, seen)}
    return found, cells


def by_visp(design, run, calibration, cells, program):
    """Rows of the laws of ViSP on the task of a run."""
    config, values = design.config(run), design.values(design.numbers(run)[0])
    scenario, planned = run_scenario(servo_inputs(config), calibration), plan.run(config, calibration)
    for name, factory in program.laws(cells, scenario.termination.image_error_px):
        made = drive(scenario, planned, "ViSP", factory=factory)
        hidden = dict(zip(HIDDEN, made.self_occluded_steps, strict=True))
        numbers = {"law": name, "verdict": made.verdict, "steps": made.steps} | hidden
        row = values | numbers | made.summary._asdict()
        yield {key: row[key] for key in COLUMNS}


def rows_of(design, features):
    """Rows of all runs of a sweep and of ViSP."""
    calibrations, cells = calibrated(design, features)
    table = run_part(Part(design, 0, design.total, calibrations)).columns
    columns = [table[name] for name in COLUMNS]
    texts = [np.char.decode(each) if each.dtype.kind == "S" else each for each in columns]
    for values in zip(*(each.tolist() for each in texts), strict=True):
        yield dict(zip(COLUMNS, values, strict=True))
    if features != "points":
        return
    with visp.Program() as program:
        for run in range(design.total):
            cell, _, number, _ = design.numbers(run)
            key = design.calibration_key(cell, number)
            if design.values(cell)["law"] == "stacked" and calibrations[key] is not None:
                yield from by_visp(design, run, calibrations[key], cells[key], program)


def tell(rows):
    """Print the table."""
    cells = defaultdict(list)
    for row in rows:
        cells[row["law"], row["noise_px"]].append(row)
    noises = sorted({noise for _, noise in cells})
    heads = " | ".join(f"{noise:g} px" for noise in noises)
    print(f"| law | guidance | {heads} | face hidden | steps | error | path ratio |")
    print("|" + "---|" * (len(noises) + 6))
    for law in dict.fromkeys(law for law, _ in cells):
        name, mode = law_and_mode(law)
        rates = " | ".join(
            f"{100 * np.mean([row['success'] for row in cells[law, px]]):.0f}" for px in noises
        )
        mine = cells[law, NOISE_PX]
        hidden = 100 * np.mean([any(row[side] > 0 for side in HIDDEN) for row in mine])
        good = [row for row in mine if row["success"]]
        ratios = [row["path_length_mm"] / row["distance_mm"] for row in good]
        columns = [[row[key] for row in good] for key in ("steps", "position_error_mm")]
        steps, mm, ratio = np.median([*columns, ratios], axis=1) if good else [np.nan] * 3
        guided = "none" if mode == REGULATE else "plan"
        medians = f"{steps:.0f} | {mm:.2g} mm | {ratio:.2f}"
        print(f"| {name} | {guided} | {rates} | {hidden:.0f} | {medians} |", flush=True)


def main():
    """Make the runs and print a table for each of the features."""
    counted = [("tasks", 60, "of each arm")]
    given = parser_of("laws_random_study", __doc__, counted, features=(FEATURES, ["points"])).parse_args()
    if "points" in given.features:
        visp.require()
    every = []
    for features in given.features:
        rows = list(rows_of(design_of(features, given.tasks), features))
        every += [{"features": features} | row for row in rows]
        write_rows(given.output, every)
        print(
            f"Features: {features}; success (%) of {2 * given.tasks} tasks; columns of runs at {NOISE_PX} px"
        )
        tell(rows)


if __name__ == "__main__":
    main()
