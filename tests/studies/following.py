"""Goals that move: how far the tool is from them, over the distance from goals that stand still.

    python -m tests.studies.following [--runs 20] [--arms NAME ...] [--motions NAME ...] [--periods 0 1 2]
                                      [-o following.csv]

Each run has a calibration of its own, from trial motions at 0.5 px with the latency of the run, a goal drawn
at random, and an object of two tags of 60 mm, 80 mm beside the tool there. The object moves along a direction
or turns about its middle; it is where the goal was taught after 2 s, and the arm begins there. The distance
is of the centre of the face from where the object truly has it, rms from the first arrival on, for 2 s. The
same goals, not followed, stand still for comparison.
"""

import json
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from projservo_cli.config.inputs import servo_inputs
from projservo_cli.records import WorkFailed
from projservo_cli.report.figure_inputs import Driven
from projservo_cli.report.figures import FIGURES
from projservo_cli.simulation.arm import camera_center
from projservo_cli.simulation.random_tasks import random_tasks
from projservo_cli.stages.scenario import run_scenario
from projservo_cli.stages.servo import drive
from tests.configured import calibrate, plan, truth_of
from tests.known import configured
from tests.studies.carried_goals import carried_pose, direction, scene, seen
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, written

ARMS = {"ur5": 530, "paper": 531}
# Velocity of the object, mm/s along its direction and deg/s about an axis.
MOTIONS = {"still": (0, 0), "10mm": (10, 0), "50mm": (50, 0), "100mm": (100, 0), "10deg": (0, 10)}
PERIOD, AT_TAUGHT, FOLLOWED = 0.04, 2.0, 2.0  # s
SIDE, NOISE_PX = 0.06, 0.5  # m
KEPT, FARTHEST = np.radians(5.0), 1.5  # rad, of the joints from their limits and from the goal
EDGE_ON = 0.2  # cosine of the angle of a camera from the normal of the face, at least
PLACES = 5  # along half a motion
TRIES = 200  # to draw an object in sight beside a goal
COLUMNS = (
    *("arm", "run", "periods", "motion", "verdict", "mm", "stated_px", "rms_px", "seconds", "square"),
    *("stated_mm", "kind", "failed"),
)


def displaced(motion, along, middle, t):
    """Displacement (4, 4) of an object since it was taught, t s after its motion began."""
    speed, turn = MOTIONS[motion]
    T, R = np.eye(4), Rotation.from_rotvec(np.radians(turn) * (t - AT_TAUGHT) * along)
    T[:3, :3], T[:3, 3] = R.as_matrix(), 1e-3 * speed * (t - AT_TAUGHT) * along + middle - R.apply(middle)
    return T


def in_sight(truth, X, tool, along):
    """Whether both cameras see the object (8, 4) and the tool (m, 4) all along each motion."""
    middle = X[:, :3].mean(axis=0)
    normals = np.array([np.cross(*(X[4 * k + 1 : 4 * k + 3, :3] - X[4 * k, :3])) for k in range(2)])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    cameras = np.array([camera_center(P) for P in truth.P])

    def turned_away(T):
        """Whether a camera sees the face nearly from its edge."""
        M = (tool[list(truth.face)] @ T.T)[:, :3]
        rays = cameras - M.mean(axis=0)
        cosine = rays @ np.linalg.svd(M - M.mean(axis=0))[2][2] / np.linalg.norm(rays, axis=1)
        return (np.abs(cosine) < EDGE_ON).any()

    places = [displaced(motion, along, middle, t) for motion in MOTIONS for t in (0.0, 2.0 * AT_TAUGHT)]
    if any(map(turned_away, places)):
        return False
    return all(seen(truth, X @ T.T, normals @ T[:3, :3].T) and seen(truth, tool @ T.T) for T in places)


def in_reach(truth, q_goal, X, along):
    """Whether the joints reach the goal (n,) all along each motion, within their limits."""
    low, high = truth.robot.limits.lower + KEPT, truth.robot.limits.upper - KEPT
    middle, pose = X[:, :3].mean(axis=0), truth.robot.pose(q_goal)
    for motion in MOTIONS:
        for end in (0.0, 2.0 * AT_TAUGHT):
            q = q_goal
            for t in np.linspace(AT_TAUGHT, end, PLACES)[1:]:
                there = displaced(motion, along, middle, t) @ pose
                found = least_squares(
                    lambda q, T=there: (truth.robot.pose(q) - T)[:3].ravel(), q, max_nfev=15
                )
                q, far = found.x, np.abs(found.x - q_goal).max() > FARTHEST
                if found.cost > 1e-12 or far or (q < low).any() or (q > high).any():
                    return False
    return True


@lru_cache
def task(arm, run):
    """Joints of a goal, corners (8, 3) of the object there and the direction of its motion."""
    config, rng = configured(arm), np.random.default_rng((ARMS[arm], run))
    truth, front = truth_of(config), np.array(config.task.start.values(config.joint_types))
    while True:
        for q in random_tasks(truth, front, 6, rng)[1]:
            for _ in range(5):
                if (found := scene(truth, [q], SIDE, rng, TRIES)) is None:
                    break  # the tool there, or what is beside it, is nowhere in sight
                (X, tool, _), along = found, direction(rng)
                if in_sight(truth, X, tool, along) and in_reach(truth, q, X, along):
                    return q, X, along


def settings(arm, run, periods, motion, *, follow):
    """Configuration of a run."""
    q, X, along = task(arm, run)
    (speed, turn), middle = MOTIONS[motion], X[:, :3].mean(axis=0)
    at_first = displaced(motion, along, middle, 0.0)
    shift = (at_first[:3, :3] @ middle + at_first[:3, 3] - middle).tolist()
    part = {
        "markers": [*range(40, 48)],
        "positions_m": X[:, :3].tolist(),
        "displacement": {
            "translation_m": shift,
            "rotation_deg": Rotation.from_matrix(at_first[:3, :3]).as_rotvec(degrees=True).tolist(),
        },
        "follow": follow,
    }
    if follow:
        part["velocity"] = {
            "translation_mm_s": (speed * along).tolist(),
            "rotation_deg_s": (turn * along).tolist(),
        }
    joints = {"joints": q.tolist(), "unit": "rad"}
    there = {"start": joints, "goal": {"joints": joints, "on": "part"}, "start_offset": None}
    dwell = () if follow else ("stop.image_error_px=1e-6", "stop.noise_factor=0", "stop.stall_periods=1000")
    return configured(
        arm,
        f"seed={1000 * ARMS[arm] + run}",
        f"objects={json.dumps({'part': part, 'max_goal_deviation_mm': 1000.0})}",
        f"task={json.dumps(there)}",
        *(f"noise.{name}_px={NOISE_PX}" for name in ("calibration", "servo")),
        f"noise.averaged_frames={10}",
        *("control.laws=[exact]", "control.mode=regulate", f"control.period_s={PERIOD}"),
        *(f"control.{name}=2.5" for name in ("gain_t", "gain_r", "gain_p", "gain_s", "gain")),
        f"disturbance.camera_latency_s={periods * PERIOD}",
        *(f"stop.follow_s={FOLLOWED}", f"stop.max_steps={250 if follow else 150}"),
        *("trajectory.profile=linear", *dwell),
    )


def centre_mm(run, along_with):
    """Distances (k,) of the centre of the face from where displacements (k, 4, 4) have its goal, mm."""
    scenario, rows = run.scenario, len(along_with)
    found = scenario.world.poses(
        run.plant, scenario.true_ends, run.log.H[:rows], None, scenario.joints_at_goal
    )
    return 1e3 * np.linalg.norm(found.center - (along_with @ scenario.true_ends.goal)[:, :3], axis=1)


def against_truth(run, t):
    """χ² of the goal at a time, s, against where it truly is, by its stated errors; with the goal."""
    truth, carried = run.scenario.world.truth, run.goal.carried
    (T,), _ = run.goal.true_motion(np.array([t]))
    H = T @ run.scenario.true_ends.goal_pose @ np.linalg.inv(run.scenario.true_ends.base_tool)
    error, J = carried_pose(truth, carried.s, truth.M @ H.T)
    changes = np.linalg.pinv(J) @ carried.changes.reshape(len(carried.changes), -1).T
    return float(error @ np.linalg.solve(changes @ changes.T, error)), carried


def one_run(config, calibration, *, follow):
    """Row of a run."""
    planned = plan.run(config, calibration)
    run = drive(run_scenario(servo_inputs(config), calibration), planned, "exact")
    last = round(FOLLOWED / PERIOD)
    if not follow:
        off = centre_mm(run, np.broadcast_to(np.eye(4), (run.steps + 1, 4, 4)))[-last:]
        return {"verdict": run.verdict, "mm": float(np.sqrt(np.mean(off**2)))}
    t = np.array([one.t for one in run.goal.periods])
    off, window = centre_mm(run, run.scenario.world.true_motion(t)[0]), run.goal.followed
    if not window:
        return {"verdict": run.verdict}
    px, stated = run.goal.over_window
    mm = float(np.sqrt(np.mean(off[-len(window) :] ** 2)))
    square, carried = against_truth(run, t[-1])
    return {
        "square": square,
        "stated_mm": carried.position_mm,
        "kind": run.goal.motion,
        "verdict": run.verdict,
        "mm": mm,
        "rms_px": px,
        "stated_px": stated / 3.0,
        "seconds": run.steps * PERIOD,
    }


def drawn(job):
    """Rows of the motions of a run, and of its goal not followed."""
    arm, k, periods, motions = job
    rows, calibration = [], None
    for motion in ("not followed", *motions):
        follow = motion != "not followed"
        config = settings(arm, k, periods, motion if follow else "still", follow=follow)
        row = {"arm": arm, "run": k, "periods": periods, "motion": motion}
        try:
            calibration = calibration or calibrate.run(config)[1]
            row |= one_run(config, calibration, follow=follow)
        except WorkFailed as error:
            row["failed"] = str(error)
        rows.append(row)
    return rows


def draw_following(path, run, step, law):
    """Write how a step of a stored run followed its goal, Fig. 23 of a report, as a PNG."""
    (figure,) = (spec for spec in FIGURES if spec.name == "fig23_following")
    shown = Driven(run.calibration, None, run.at_step(step).plan, {law: run.traces[f"{step}/{law}"]})
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.drawn(figure.data(shown)).savefig(path)


def rms(rows):
    """Root mean square of the distances of runs, mm."""
    return float(np.sqrt(np.mean([row["mm"] ** 2 for row in rows]))) if rows else np.nan


def in_region(row):
    """Whether the goal is in its 95 % region."""
    return row["square"] <= chi2.ppf(0.95, 6)


def kinds(rows):
    """How often the motion was found to be of each kind."""
    found = [row["kind"] for row in rows]
    return ", ".join(f"{kind} {found.count(kind)}" for kind in sorted({*found}))


def main():
    parser = parser_of(
        "following", __doc__, [("runs", 20, "of each arm and latency")], arms=ARMS, motions=MOTIONS
    )
    parser.add_argument("--periods", nargs="+", type=int, default=[0, 1, 2], help="latency of images")
    given = parser.parse_args()
    cells = [(arm, n) for arm in given.arms for n in given.periods]
    jobs = [(arm, k, n, given.motions) for arm, n in cells for k in range(given.runs)]
    rows = written(given.output, COLUMNS, in_two_processes(drawn, jobs, "runs"))
    for arm, periods in cells:
        own = [row for row in rows if (row["arm"], row["periods"]) == (arm, periods)]
        done = {(row["run"], row["motion"]): row for row in own if "mm" in row}
        print(f"{arm}, latency of {periods} periods, {given.runs} runs:", flush=True)
        for motion in given.motions:
            pairs = [k for k in range(given.runs) if {(k, motion), (k, "not followed")} <= done.keys()]
            of, still = ([done[k, name] for k in pairs] for name in (motion, "not followed"))
            followed = sum(row.get("verdict") == "followed" for row in own if row["motion"] == motion)
            print(
                f"  {motion}: followed {followed}; {rms(of):.2f} mm rms, {rms(of) / rms(still):.2f} of the "
                f"still goal's ({rms(still):.2f}); {quantiles([row['mm'] for row in of])} mm; "
                f"goal in its region {rate(sum(map(in_region, of)), len(of))} %; {kinds(of)}",
                flush=True,
            )
    print("\n".join(sorted({f"  {row['motion']}: {row['failed']}" for row in rows if "failed" in row})[:10]))


if __name__ == "__main__":
    main()
