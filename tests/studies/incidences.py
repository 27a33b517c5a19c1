"""How often random tasks of each kind of incidence are planned and done, and whether errors are as stated.

    python -m tests.studies.incidences [--tasks 500] [--arms paper ur5 hobby] [--kinds ...]
                                       [--starts random 0.7 1.6] [-o runs.csv]

Tasks are random ones between joints at which the cameras see the face, images and trials at 0.5 px; or start
with every joint off the goal by up to 0.7 or 1.6 rad, where the cameras see the face too. The goal is taught
at the second joints; each kind takes some of its pose and leaves the rest open. Every task is planned with
the profile auto and followed by ``exact``, and driven by the law ``incidences`` alone. A run succeeds if it
converged within the limits with the face visible at every instant. What each incidence is off in truth is
compared with what the run states, and the sense in which features point.
"""

import numpy as np

from projservo_cli.records import WorkFailed
from projservo_cli.settings.features import Feature
from projservo_cli.simulation import random_tasks as drawing
from projservo_cli.stages.scenario import run_scenario
from projservo_cli.task.incidence_errors import Separation, angle_off
from tests.configured import plan, servo, servo_inputs, truth_of
from tests.known import with_task
from tests.studies.common import in_two_processes, jobs_of, parser_of, quantiles, rate, written

# Markers of a point, of another one on a line through it, and of a plane off it.
MARKERS = {"paper": (8, 4, (5, 7, 9)), "ur5": (8, 4, (5, 7, 9)), "hobby": (4, 6, (5, 6, 7))}
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
STARTS = {"random": None, "0.7": 0.7, "1.6": 1.6}
SEEDS = {"paper": 251, "ur5": 252, "hobby": 253}
TRIES = 2000  # starts that are drawn until the cameras see the face


def features(arm):
    """Features of the tool by its markers, and those of the scene where they were taught."""
    point, third, plane = MARKERS[arm]
    shown = {"point": {"point": (point,)}, "line": {"line": (point, third)}, "plane": {"plane": plane}}
    of_tool = {name: Feature(on="tool", **kind) for name, kind in shown.items()}
    return of_tool | {
        f"{name}_there": Feature(on="scene", **dict.fromkeys(kind, name)) for name, kind in shown.items()
    }


def task_of(config, arm, kind):
    """A configuration whose goal is of a kind."""
    pairs = tuple((tool, f"{scene}_there", *how) for tool, scene, *how in KINDS[kind])
    goal = config.task.goal.model_copy(update={"incidences": pairs})
    task = config.task.model_copy(update={"goal": goal})
    trajectory = config.trajectory.model_copy(update={"profile": "auto"})
    control = config.control.model_copy(
        update={"mode": ("track", "regulate"), "laws": ("exact", "incidences")}
    )
    return config.model_copy(
        update={"task": task, "features": features(arm), "trajectory": trajectory, "control": control}
    )


def near(arm, seed, config, by):
    """A task that starts with joints off those of the goal by up to so many rad; None for one that cannot."""
    truth, types = truth_of(config), config.joint_types
    goal, front = (np.array(one.values(types)) for one in (config.task.goal.joints, config.task.start))
    limits, rng = truth.robot.limits, np.random.default_rng([SEEDS[arm], seed, round(10 * by)])
    q = goal + rng.uniform(-by, by, (TRIES, len(goal)))
    ahead = np.sign(drawing._cosines(truth, drawing._poses(truth, front[None]))[0, 0])
    shown = drawing._accepted(truth, drawing._poses(truth, q), ahead, len(truth.P))
    within = [i for i in shown if ((q[i] > limits.lower) & (q[i] < limits.upper)).all()]
    return with_task(config, (q[within[0]], goal), seed=seed) if within else None


def in_truth(config, calibration, trace):
    """True errors of each incidence, mm and degrees, and whether features point the way they should."""
    scenario, truth = run_scenario(servo_inputs(config), calibration), truth_of(config)
    T, T_taught = (truth.displacement(q) for q in (trace.q[-1], scenario.q_taught))
    M, found = truth.of(scenario.world.numbers), []
    for one in scenario.exact.goal.incidences:
        tool, scene = (
            (np.array([M[list(at)].mean(axis=0) for at in flat]) @ where.T)[:, :3]
            for flat, where in ((one.tool, T), (one.scene, T_taught))
        )
        apart, turned = Separation.of(one, tool, scene)
        mm = 1e3 * np.linalg.norm(apart, axis=1).max() if apart.size else np.nan
        deg = np.degrees(angle_off(one, tool, scene)) if turned.size else np.nan
        found.append((mm, deg))
    return np.array(found).reshape(-1, 2)


def driven(job):
    """Rows of a task of every kind."""
    arm, seed, config, calibration, kinds, starts = job
    rows = []
    for start in starts:
        by = STARTS[start]
        begun = config if by is None else near(arm, seed, config, by)
        for kind in kinds if begun is not None else ():
            told, chosen = {"arm": arm, "kind": kind, "start": start, "seed": seed}, task_of(begun, arm, kind)
            try:
                planned = plan.run(chosen, calibration)
            except WorkFailed as error:
                unplanned = {"planned": False, "refused": True, "success": False, "reason": str(error)}
                rows += [told | {"law": law} | unplanned for law in LAWS]
                continue
            told |= {"planned": planned.feasible, "free_dof": planned.free_dof}
            rows += [told | run_of(chosen, calibration, planned, law) for law in LAWS]
    return rows


def run_of(config, calibration, planned, law):
    """Values of a run of a law."""
    try:
        trace = servo.run(config, calibration, planned, law)
    except WorkFailed as error:
        return {"law": law, "success": False, "reason": str(error)}
    row = {"law": law, "success": trace.success, "verdict": trace.verdict, "reason": trace.reason}
    row |= {"mm": trace.position_error_mm, "deg": trace.rotation_error_deg, "steps": trace.steps}
    if not trace.incidences:
        return row
    true = in_truth(config, calibration, trace)
    stated = np.column_stack([trace.incidence_mm, trace.incidence_deg])
    worst = np.nanmax(true / stated, axis=0, initial=0.0)
    row |= {
        "px": float(trace.incidence_px[-1].max()),
        "mm_over_stated": worst[0],
        "deg_over_stated": worst[1],
    }
    row |= {"true_mm": np.nanmax(true[:, 0], initial=0.0), "true_deg": np.nanmax(true[:, 1], initial=0.0)}
    row |= {
        "stated_mm": np.nanmax(stated[:, 0], initial=0.0),
        "stated_deg": np.nanmax(stated[:, 1], initial=0.0),
    }
    return row | {"sense": bool(np.nanmax(true[:, 1], initial=0.0) < 90.0)}


def main():
    """Drive all tasks and print rates of plans, of successes and of errors within twice the stated ones."""
    numbers = [("tasks", 500, "of each kind and arm")]
    choices = {"arms": (MARKERS, ["paper", "ur5"]), "kinds": KINDS, "starts": (STARTS, ["random"])}
    given = parser_of("incidences_study", __doc__, numbers, **choices).parse_args()
    jobs = list(jobs_of(given.arms, given.tasks, given.kinds, given.starts))
    rows = written(given.output, None, in_two_processes(driven, jobs, "tasks"))
    for arm in given.arms:
        for start in given.starts:
            for law in LAWS:
                told = [row for row in rows if (row["arm"], row["start"], row["law"]) == (arm, start, law)]
                for kind in given.kinds:
                    print(f"{arm}, {start}, {law}, {kind}: {summary([x for x in told if x['kind'] == kind])}")
                print(f"{arm}, {start}, {law}, all: {summary(told)}", flush=True)


def summary(told):
    """Rates of rows, in words."""
    done = [row for row in told if row["success"]]
    said = [row for row in done if "sense" in row]
    held = sum(max(row["mm_over_stated"], row["deg_over_stated"]) <= 2.0 for row in said)
    parts = {
        "planned": rate(sum(row["planned"] for row in told), len(told)),
        "refused": rate(sum(row.get("refused", False) for row in told), len(told)),
        "success": rate(len(done), len(told)),
        "within twice the stated": rate(held, len(said)),
        "sense": rate(sum(row["sense"] for row in said), len(said)),
        "mm": quantiles([row["mm"] for row in done]),
        "stated over true mm": quantiles(
            [1.0 / row["mm_over_stated"] for row in said if row["mm_over_stated"]]
        ),
    }
    return "; ".join(f"{name} {value}" for name, value in parts.items())


if __name__ == "__main__":
    main()
