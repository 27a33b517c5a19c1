"""How often a pin of 8 mm goes into a hole of 9 mm with free roll, in contact, before rendered cameras.

    python -m tests.studies.insertion [--tasks 30] [--conditions ...] [-o runs.csv]

The arm, cameras and trials are those of the rendered study. A pin stands out of its tool along the diagonal
of the middle tag; a fixed block has a hole 20 mm deep with a chamfer of 1 mm. One goal is taught, the tip on
the floor of the hole, with the incidences pin on hole and tip on floor, so that the roll about the pin stays
free. In two steps of a sequence ``exact_track`` approaches it along the pin and goes in. MuJoCo has the
contact; the servos are those of the arm's file, with 2000 Nm/rad in the first three joints and 500 Nm/rad in
the wrist, their load compensated as industrial arms do, and a run stops beyond 30 N. In the second condition
the block is 4 mm beside where it was when the goal was taught, so that the pin meets its rim: the run has to
stop and say why.

    python -m tests.studies.insertion --draw

draws the tasks anew and writes insertion_tasks.csv beside this file, which the study reads.
"""

import math
import sys
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.records import WorkFailed
from projservo_cli.settings.features import Feature
from projservo_cli.settings.task import TaskStep
from projservo_cli.simulation.mjcf import mujoco
from projservo_cli.simulation.robot_with_faults import obstruction_of
from tests.configured import plan, robot_by_itself, servo, truth_of
from tests.known import with_task
from tests.studies import hand_eye
from tests.studies.common import in_two_processes, parser_of, quantiles, row_of, tasks_in, write_rows, written
from tests.studies.rendered import calibrated
from tests.studies.rendered_conditions import ARM, FRONT, base_of, taught_images

TASKS = Path(__file__).with_name("insertion_tasks.csv")
SEEDS = range(1, 31)
CONDITIONS = {"in place": 30, "moved": 10}  # with so many tasks of each
PIN_M, HOLE_M, CHAMFER_M, DEPTH_M = 0.008, 0.009, 0.001, 0.02
STAND_OFF_M = 0.06
MOST_N = 30.0
MOVED_M = 0.004
SLOWLY_S = 6.0  # into the hole
# From the middle of the middle tag along its diagonal, m: where the pin begins and ends.
PIN_FROM_M, PIN_TO_M = 0.082, 0.19
FACE_Z_M = 0.085  # of this tag in the frame of the tool
SIDES, WALL_M = 16, 0.012  # boxes around the hole, and their thickness
# Steel on steel, oiled, and a contact that is stiff against the servos.
CONTACT = {"friction": [0.2, 0.005, 0.0001], "solref": [0.004, 1.0], "density": 7850.0}
FEATURES = {
    "pin": Feature(on="tool", line=(1, 3)),
    "tip": Feature(on="tool", point=(3,)),
    "hole": Feature(on="scene", line="pin"),
    "floor": Feature(on="scene", point="tip"),
}
INCIDENCES = (("pin", "hole"), ("tip", "floor"))
STEPS = (
    TaskStep.model_validate({"approach": {"along": "pin", "by_m": STAND_OFF_M, "to": "inside"}}),
    TaskStep.model_validate({"to": "inside", "duration_s": SLOWLY_S}),
)
# Depth of the tip that counts as in, m: on the floor to a millimetre.
IN_M = DEPTH_M - 0.001


def along(pose):
    """Direction of the pin, and its tip, at a pose (4, 4) of the tool, m."""
    pin = pose[:3, :3] @ np.array([-1.0, -1.0, 0.0]) / math.sqrt(2.0)
    return pin, (pose @ [0.0, 0.0, FACE_Z_M, 1.0])[:3] + PIN_TO_M * pin


def arm_with(folder, name, hole=None):
    """An MJCF file of the arm with the pin and, where one is given, the block.

    hole : direction into it, and the middle of its mouth, m.
    """
    mj = mujoco()
    spec = mj.MjSpec.from_file(str(ARM))
    spec.meshdir = str(ARM.parent / "assets")
    tip = spec.site("attachment_site")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(tip.quat, scalar_first=True).as_matrix()
    T[:3, 3] = tip.pos
    pin, end = along(T)
    ends = [*(end - (PIN_TO_M - PIN_FROM_M) * pin), *end]
    shape = tip.parent.add_geom(
        name="pin", type=mj.mjtGeom.mjGEOM_CYLINDER, size=[0.5 * PIN_M, 0, 0], fromto=ends, **CONTACT
    )
    shape.contype = shape.conaffinity = 2  # it meets the block, not the arm
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
    if hole is not None:
        add_block(spec, *hole)
    path = Path(folder) / f"{name}.xml"
    path.write_text(spec.to_xml(), encoding="utf-8")
    return path


def add_block(spec, into, mouth):
    """Add the block to the world: walls, chamfers and a floor of boxes, and a shell around them."""
    block = spec.worldbody.add_body(name="block", pos=mouth)
    frame = Rotation.align_vectors([-into], [[0.0, 0.0, 1.0]])[0]  # z out of the hole
    radius, half_depth = 0.5 * HOLE_M, 0.5 * (DEPTH_M - CHAMFER_M)
    wide = (radius + WALL_M) * math.tan(math.pi / SIDES)

    def add(turn, at, size):
        """A box at a place of the hole's frame, turned about its axis."""
        place = frame * Rotation.from_euler("z", turn)
        geom = block.add_geom(
            type=mujoco().mjtGeom.mjGEOM_BOX,
            pos=place.apply(at),
            size=size,
            rgba=[0.5, 0.5, 0.5, 1],
            **CONTACT,
        )
        geom.contype = geom.conaffinity = 3
        return geom, place

    for k in range(SIDES):
        turn = 2.0 * math.pi * k / SIDES
        geom, place = add(
            turn, [radius + 0.5 * WALL_M, 0, -CHAMFER_M - half_depth], [0.5 * WALL_M, wide, half_depth]
        )
        geom.quat = place.as_quat(scalar_first=True)
        # Its upper face leads from the rim of the hole outwards and up.
        thin = 0.25 * CHAMFER_M
        slope = Rotation.from_euler("y", -math.pi / 4)
        middle = np.array([radius + 0.5 * CHAMFER_M, 0, -0.5 * CHAMFER_M]) - slope.apply([0, 0, thin])
        geom, place = add(turn, middle, [0.5 * math.sqrt(2.0) * CHAMFER_M, wide, thin])
        geom.quat = (place * slope).as_quat(scalar_first=True)
        outer = 0.5 * (WALL_M - CHAMFER_M)
        geom, place = add(
            turn, [radius + CHAMFER_M + outer, 0, -0.5 * CHAMFER_M], [outer, wide, 0.5 * CHAMFER_M]
        )
        geom.quat = place.as_quat(scalar_first=True)
    geom, place = add(0.0, [0, 0, -DEPTH_M - 0.005], [radius + WALL_M, radius + WALL_M, 0.005])
    geom.quat = place.as_quat(scalar_first=True)


def pose_at(center, yaw, tilt):
    """Pose (4, 4) of the tool whose middle tag is at a place, m, and faces the rig, the pin down.

    yaw : about the vertical, rad; tilt : (2,) of the pin about x and y of the base, rad.
    """
    R = Rotation.from_euler("xy", tilt) * Rotation.from_euler("z", yaw)
    normal, up = R.apply([1.0, 0.0, 0.0]), R.apply([0.0, 0.0, 1.0])
    side = np.cross(normal, up)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([(up - side) / math.sqrt(2.0), (up + side) / math.sqrt(2.0), normal])
    T[:3, 3] = center - FACE_Z_M * normal
    return T


def shifted(pose, by):
    """A pose moved by (3,) m."""
    moved = pose.copy()
    moved[:3, 3] += by
    return moved


def task_of(rng, arm):
    """Joints at the start, before the hole and in it; None where the arm does not get there."""
    center = np.array([0.5, 0.1, 0.46]) + rng.uniform(-0.06, 0.06, 3)
    goal = pose_at(center, math.radians(rng.uniform(-25, 25)), np.radians(rng.uniform(-10, 10, 2)))
    pin, _ = along(goal)
    away = center - rng.uniform(0.08, 0.14) * pin + [0.0, *rng.uniform(-0.08, 0.08, 1), 0.0]
    start = pose_at(away, math.radians(rng.uniform(-25, 25)), np.radians(rng.uniform(-10, 10, 2)))
    near = np.add(FRONT, [0, 0, 0, 0, 0, math.pi / 4])
    q_goal = hand_eye.joints_for(arm, goal, near)
    if q_goal is None:
        return None
    others = [hand_eye.joints_for(arm, T, q_goal) for T in (shifted(goal, -STAND_OFF_M * pin), start)]
    if any(q is None or np.abs(q - q_goal).max() > 1.5 for q in others):
        return None
    return others[1], others[0], q_goal


def hole_of(truth, q_goal):
    """Direction into the hole and its mouth, m, where the tip is on the floor at joints (n,)."""
    pin, tip = along(truth.robot.pose(q_goal))
    return pin, tip - DEPTH_M * pin


def config_of(folder, name, hole):
    """Configuration of the arm before a block, or without one."""
    config = base_of("ideal", arm_with(folder, name, hole))
    stop = config.stop.model_copy(update={"max_force_n": MOST_N})
    return config.model_copy(update={"features": FEATURES, "stop": stop})


def drawn():
    """Rows of tasks of all seeds that arm and cameras allow, free of contact at their start."""
    folder = mkdtemp()
    bare = config_of(folder, "bare", None)
    truth = truth_of(bare)
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        while (ends := task_of(rng, truth.robot)) is None or not clear(folder, ends):
            pass
        yield {"seed": seed} | row_of(ends[::2])


def clear(folder, ends):
    """Whether nothing touches at all joints of a task, and frames show the middle tag there."""
    config = config_of(folder, "drawn", None)
    truth = truth_of(config)
    config = config_of(folder, "drawn", hole_of(truth, ends[2]))
    truth = truth_of(config)
    robots = [robot_by_itself(config, truth, q, 0.0, 0, 0) for q in ends[:2]]
    if any(one.code == "arm_touches" for robot in robots for one in obstruction_of(robot)):
        return False
    images = (taught_images(config, q, 0) for q in ends)
    return all(None not in (*shown["left"][:4], *shown["right"][:4]) for shown in images)


def goal_of(config, q, seed):
    """A goal as ``teach`` writes it of images at joints (n,), of which the incidences count."""
    pairs = [list(pair) for pair in INCIDENCES]
    return type(config.task.goal).model_validate(
        {"images": taught_images(config, q, seed), "incidences": pairs}
    )


def driven(job):
    """Row of a task."""
    condition, seed, calibration = job
    folder, (q, goal) = mkdtemp(), tasks_in(TASKS)[seed]
    truth = truth_of(config_of(folder, "bare", None))
    into, mouth = hole_of(truth, goal)
    aim = goal_of(config_of(folder, "taught", (into, mouth)), goal, seed)
    if condition == "moved":
        side = np.cross(into, [0.0, 1.0, 0.0])
        mouth = mouth + MOVED_M * side / np.linalg.norm(side)
    config = config_of(folder, "task", (into, mouth))
    task = config.task.model_copy(update={"goals": {"inside": aim}, "steps": STEPS})
    config = config.model_copy(update={"task": task})
    row = {"condition": condition, "seed": seed, "in": False}
    for name in config.steps:
        step = config.at_step(name)
        step, row["leg"] = with_task(step, (q, goal), step.task.goal, seed=seed), name
        try:
            trace = servo.run(step, calibration, plan.run(step, calibration), "exact_track")
        except WorkFailed as error:
            return row | {"verdict": "not started", "reason": str(error)}
        row, q = row | told_of(trace), trace.q[-1]
        if trace.verdict != "converged":
            break
    pin, tip = along(trace.pose[-1])
    depth = float((tip - mouth) @ into)
    turned = trace.pose[-1][:3, :3].T @ truth.robot.pose(goal)[:3, :3]
    return (
        row
        | {"in": trace.verdict == "converged" and depth >= IN_M}
        | {"depth_mm": 1e3 * depth, "beside_mm": 1e3 * float(np.linalg.norm(tip - mouth - depth * into))}
        | {"tilt_deg": math.degrees(math.acos(min(1.0, float(pin @ into))))}
        | {"roll_deg": math.degrees(float(np.linalg.norm(Rotation.from_matrix(turned).as_rotvec())))}
    )


def told_of(trace):
    """Verdict, reason and forces of a run."""
    force = np.zeros(1) if trace.force is None else trace.force[np.isfinite(trace.force)]
    return {
        "verdict": trace.verdict,
        "reason": trace.reason,
        "steps": trace.steps,
        "peak_n": float(force.max()),
        "left_n": float(force[-1]),
    }


def main():
    """Record once, drive all tasks, and print what came of it."""
    if "--draw" in sys.argv:
        write_rows(TASKS, list(drawn()))
        return
    counted = [("tasks", len(SEEDS), "of each condition, at most")]
    given = parser_of("insertion_study", __doc__, counted, conditions=CONDITIONS).parse_args()
    _, calibration, why = calibrated(config_of(mkdtemp(), "bare", None))
    if calibration is None:
        sys.exit(f"no calibration: {why}")
    print(f"calibration: usable {calibration.usable}, chi2 {calibration.chi2_per_dof:.2f}", flush=True)
    jobs = [
        (name, seed, calibration)
        for name in given.conditions
        for seed in list(SEEDS)[: min(given.tasks, CONDITIONS[name])]
    ]
    rows = written(given.output, None, ([row] for row in in_two_processes(driven, jobs, "tasks")))
    for condition in given.conditions:
        mine = [row for row in rows if row["condition"] == condition]
        done = [row for row in mine if row["in"]]
        print(f"{condition}: in {len(done)} of {len(mine)}")
        for name in ("depth_mm", "beside_mm", "tilt_deg", "roll_deg", "peak_n", "left_n"):
            of_done, of_rest = (
                [r[name] for r in part if name in r] for part in (done, [r for r in mine if not r["in"]])
            )
            print(f"  {name}: in {quantiles(of_done)}; else {quantiles(of_rest)}")
        for row in mine:
            if not row["in"]:
                print(f"  {row['seed']}, {row['leg']}: {row['verdict']}: {row['reason']}")


if __name__ == "__main__":
    main()
