"""How often random tasks of each kind of incidence are planned and done, and the whole pose beside them.

    python -m tests.studies.incidences [--tasks 500] [--arms paper ur5] [--kinds ...] [-o runs.csv]

Tasks are random ones between joints at which the cameras see the face, images and trials at 0.5 px. The goal
is taught at the second joints; each kind takes some of its pose and leaves the rest open. Every task is
planned with the profile auto and followed by ``exact``, and driven by the law ``incidences`` alone. A run
succeeds if it converged within the limits with the face visible at every instant.
"""

import numpy as np

from projservo_cli.records import WorkFailed
from projservo_cli.settings.features import Feature
from tests.configured import plan, servo
from tests.studies.common import in_two_processes, jobs_of, parser_of, quantiles, rate, write_rows

ARMS = ["paper", "ur5"]
SHOWN = {
    "point": {"point": (8,)},
    "other": {"point": (9,)},
    "line": {"line": (8, 4)},
    "plane": {"plane": (5, 7, 9)},
}
# Incidences of each kind: a feature of the tool, that of the scene, and how they are to lie.
KINDS = {
    "pose": (),
    "point on plane": (("point", "plane"),),
    "point on line": (("point", "line"),),
    "point on point": (("point", "point"),),
    "line in plane": (("line", "plane"),),
    "pin in hole": (("line", "line"), ("point", "point")),
    "line on line": (("line", "line"),),
    "plane on plane": (("plane", "plane"),),
    "parallel lines": (("line", "line", "parallel"),),
    "perpendicular": (("line", "line", 90.0),),
}
LAWS = ("exact_track", "incidences")


def features():
    """Features of the tool by its markers, and those of the scene where they were taught."""
    of_tool = {name: Feature(on="tool", **kind) for name, kind in SHOWN.items()}
    of_scene = {
        f"{name}_there": Feature(on="scene", **dict.fromkeys(kind, name)) for name, kind in SHOWN.items()
    }
    return of_tool | of_scene


def task_of(config, kind):
    """A configuration whose goal is of a kind."""
    pairs = tuple((tool, f"{scene}_there", *how) for tool, scene, *how in KINDS[kind])
    goal = config.task.goal.model_copy(update={"incidences": pairs})
    task = config.task.model_copy(update={"goal": goal})
    trajectory = config.trajectory.model_copy(update={"profile": "auto"})
    control = config.control.model_copy(
        update={"mode": ("track", "regulate"), "laws": ("exact", "incidences")}
    )
    return config.model_copy(
        update={"task": task, "features": features(), "trajectory": trajectory, "control": control}
    )


def driven(job):
    """Rows of a task of every kind."""
    arm, seed, config, calibration, kinds = job
    rows = []
    for kind in kinds:
        told, chosen = {"arm": arm, "kind": kind, "seed": seed}, task_of(config, kind)
        try:
            planned = plan.run(chosen, calibration)
        except WorkFailed as error:
            rows += [
                told | {"law": law, "planned": False, "success": False, "reason": str(error)} for law in LAWS
            ]
            continue
        told |= {"planned": planned.feasible, "free_dof": planned.free_dof}
        for law in LAWS:
            try:
                trace = servo.run(chosen, calibration, planned, law)
            except WorkFailed as error:
                rows.append(told | {"law": law, "success": False, "reason": str(error)})
                continue
            left = [] if trace.incidence_px is None else trace.incidence_px[-1]
            rows.append(
                told
                | {"law": law, "success": trace.success, "verdict": trace.verdict, "reason": trace.reason}
                | {"mm": trace.position_error_mm, "deg": trace.rotation_error_deg}
                | {"px": float(np.max(left, initial=0.0)), "steps": trace.steps}
            )
    return rows


def main():
    """Drive all tasks and print rates of plans and of successes, and errors from the nearest goal."""
    numbers = [("tasks", 500, "of each kind and arm")]
    given = parser_of("incidences_study", __doc__, numbers, arms=ARMS, kinds=KINDS).parse_args()
    jobs = list(jobs_of(given.arms, given.tasks, given.kinds))
    rows = []
    for mine in in_two_processes(driven, jobs, "tasks"):
        rows += mine
        write_rows(given.output, rows)  # what is cut off leaves what was driven
    for arm in given.arms:
        for kind in given.kinds:
            for law in LAWS:
                told = [row for row in rows if (row["arm"], row["kind"], row["law"]) == (arm, kind, law)]
                done = [row for row in told if row["success"]]
                plans, good = rate(sum(row["planned"] for row in told), len(told)), rate(len(done), len(told))
                mm = quantiles([row["mm"] for row in done])
                print(f"{arm}, {kind}, {law}: planned {plans} %, success {good} %; mm {mm}", flush=True)


if __name__ == "__main__":
    main()
