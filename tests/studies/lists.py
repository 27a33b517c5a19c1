"""Whether contradictory lists of incidences are refused, and consistent ones with too many rows are not.

    python -m tests.studies.lists [--tasks 300] [--arms ur5 hobby] [--kinds ...] [-o lists.csv]

Tasks are random ones, images and trials at 0.5 px. A contradictory list has two rows that no place of the
tool meets: angles that differ by 5° to 60°, a point on two others, on a plane that it is off, or on a line
and beside it. It is to be refused by these two rows, before any motion. A consistent one holds where the goal
was taught, and has up to eleven rows for six freedoms, or for the five of an arm of five joints.
"""

import numpy as np

from projservo_cli.records import WorkFailed
from projservo_cli.settings.features import Feature
from tests.configured import plan
from tests.studies.common import in_two_processes, jobs_of, parser_of, rate, write_rows

# Markers of a point, of another one, of a line through the first, and of a plane off it.
MARKERS = {"paper": (8, 9, 4, (5, 7, 9)), "ur5": (8, 9, 4, (5, 7, 9)), "hobby": (4, 5, 6, (5, 6, 7))}
CONTRADICTORY = {
    "angles of lines": (("line", "line", "a"), ("line", "line", "b")),
    "angles of planes": (("plane", "plane", "a"), ("plane", "plane", "b")),
    "parallel and inclined": (("line", "line", "parallel"), ("line", "line", "difference")),
    "on line and inclined": (("line", "line"), ("line", "line", "difference")),
    "two points": (("point", "point"), ("point", "other")),
    "point and plane": (("point", "point"), ("point", "plane")),
    "line and point": (("line", "line"), ("point", "other")),
}
CONSISTENT = {
    "three points": (("point", "point"), ("other", "other"), ("third", "third")),
    "point, line, plane": (("point", "point"), ("line", "line"), ("plane", "plane")),
    "two lines": (("line", "line"), ("edge", "edge"), ("line", "line", "parallel")),
}
KINDS = CONTRADICTORY | CONSISTENT


def features(arm):
    """Features of the tool by its markers, and those of the scene where they were taught."""
    point, other, third, plane = MARKERS[arm]
    shown = {
        "point": {"point": (point,)},
        "other": {"point": (other,)},
        "third": {"point": (third,)},
        "line": {"line": (point, third)},
        "edge": {"line": (other, third)},
        "plane": {"plane": plane},
    }
    of_tool = {name: Feature(on="tool", **kind) for name, kind in shown.items()}
    of_scene = {
        f"{name}_there": Feature(on="scene", **dict.fromkeys(kind, name)) for name, kind in shown.items()
    }
    return of_tool | of_scene


def list_of(kind, rng):
    """Incidences of a kind, with angles that differ by 5° to 60°."""
    first, by = rng.uniform(5.0, 25.0), rng.uniform(5.0, 60.0)
    angles = {"a": first, "b": first + by, "difference": by, "parallel": "parallel"}
    return tuple((tool, f"{scene}_there", *(angles[x] for x in how)) for tool, scene, *how in KINDS[kind])


def planned(job):
    """Rows of a task of every kind."""
    arm, seed, config, calibration, kinds = job
    rows = []
    for kind in kinds:
        rng = np.random.default_rng([seed, list(KINDS).index(kind)])
        goal = config.task.goal.model_copy(update={"incidences": list_of(kind, rng)})
        task = config.task.model_copy(update={"goal": goal})
        trajectory = config.trajectory.model_copy(update={"profile": "auto"})
        chosen = config.model_copy(update={"task": task, "features": features(arm), "trajectory": trajectory})
        try:
            found = plan.run(chosen, calibration)
            code, why = "", found.reason
        except WorkFailed as error:
            code, why = error.findings[0].code if error.findings else "other", str(error)
        rows.append({"arm": arm, "kind": kind, "seed": seed, "code": code, "why": why})
    return rows


def main():
    """Plan all tasks and print how many were refused, and as what."""
    numbers = [("tasks", 300, "of each kind and arm")]
    given = parser_of(
        "lists_study", __doc__, numbers, arms=(MARKERS, ["ur5", "hobby"]), kinds=KINDS
    ).parse_args()
    jobs = list(jobs_of(given.arms, given.tasks, given.kinds))
    rows = []
    for mine in in_two_processes(planned, jobs, "tasks"):
        rows += mine
        write_rows(given.output, rows)
    for arm in given.arms:
        for kind in given.kinds:
            told = [row["code"] for row in rows if (row["arm"], row["kind"]) == (arm, kind)]
            refused = sum(code == "contradictory_incidences" for code in told)
            others = {code: told.count(code) for code in set(told) - {"", "contradictory_incidences"}}
            print(
                f"{arm}, {kind}: contradictory {rate(refused, len(told))} %; other refusals {others}",
                flush=True,
            )


if __name__ == "__main__":
    main()
