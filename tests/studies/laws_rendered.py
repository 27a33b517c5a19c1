"""How often laws arrive before rendered cameras that are given the same four corners, ViSP among them.

    python -m tests.studies.laws_rendered [--tasks 30] [-o runs.csv]

The thirty tasks of ``rendered`` under its ideal condition, on one recording: a UR5e with its meshes, the
four corners of the middle tag, at most 300 steps. A run arrives that converged within 3 mm and 1 degree of
the truth. ViSP, eye-to-hand, has the true arm and the face in metres. Its intrinsics and cameras in the base
frame are true, or OpenCV's calibration of the recording. It servoes by both cameras, or by the left alone.
"""

import math
from collections import Counter

import numpy as np

from tests.configured import scenario_of, truth_of
from tests.studies import visp
from tests.studies.common import in_two_processes, parser_of, written
from tests.studies.rendered import calibrated, near, run_of
from tests.studies.rendered_conditions import LATEST, SEEDS, base_of, task_config, tasks_of

LAWS = ("exact_track", "exact", "stacked", "blockwise", "euclidean_points")


def driven(job):
    """Rows of all laws on a task."""
    seed, calibration, cells = job
    config, goal = task_config(base_of("ideal"), seed), tasks_of()[seed][1]
    control = config.control.model_copy(update={"features": "points"})
    stop = config.stop.model_copy(update={"max_steps": LATEST})
    config = config.model_copy(update={"control": control, "stop": stop})
    tolerance_px = scenario_of(config, calibration).termination.image_error_px
    with visp.Program() as program:
        laws = [*((name, None) for name in LAWS), *program.laws(cells, tolerance_px)]
        return [
            {"seed": seed, "by": name} | run_of(config, calibration, name, goal, near, factory=factory)
            for name, factory in laws
        ]


def main():
    """Record, drive all tasks by all laws, and print the table."""
    given = parser_of("laws_rendered_study", __doc__, [("tasks", len(SEEDS), "by seed")]).parse_args()
    visp.require()
    config = base_of("ideal")
    seen, calibration, why = calibrated(config)
    if calibration is None:
        raise SystemExit(why)
    truth = truth_of(config)
    cells = {"true": visp.true_cell(truth), "calibrated": visp.calibrated_cell(truth, seen)}
    visp.Program().close()  # compiles it once for all processes
    jobs = [(seed, calibration, cells) for seed in list(SEEDS)[: given.tasks]]
    rows = written(given.output, None, in_two_processes(driven, jobs, "tasks"))
    print(f"| law | arrived of {given.tasks} | median error of these | else |\n|---|---|---|---|")
    for by in dict.fromkeys(row["by"] for row in rows):
        mine = [row for row in rows if row["by"] == by]
        good = [(row["mm"], row["deg"]) for row in mine if row["arrived"]]
        mm, deg = np.median(good, axis=0) if good else (math.nan, math.nan)
        ended = Counter(row["verdict"] for row in mine if not row["arrived"]).most_common()
        other = ", ".join(f"{verdict} {count}" for verdict, count in ended)
        print(f"| {by} | {len(good)} | {mm:.2g} mm, {deg:.2g}° | {other} |", flush=True)


if __name__ == "__main__":
    main()
