"""Goals carried by objects: whether 95 % regions hold the truth, and how large errors are.

    python -m tests.studies.carried_goals [--calibrations 17] [--arms NAME ...] [--faults NAME ...]
                                          [-o carried_goals.csv]

Each calibration of a simulated arm, from its own trial motions at 0.5 px, sees 24 objects of two tags, of 30
and of 60 mm, 80 mm beside a goal of the tool. Each is displaced by up to 150 mm and 60°, and seen once before
and once after at 0.5 px, some of them by one camera alone. The carried goal is compared with the true one by
the true cameras: the pose in which the tool would show its images.
"""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import projservo_cli as projservo
from projservo_cli.config.settings_and_rules import truth_of
from projservo_cli.geometry.kinematics import project
from projservo_cli.image_size import within_images
from projservo_cli.records import WorkFailed
from projservo_cli.simulation.arm import camera_center
from projservo_cli.simulation.random_tasks import random_tasks
from projservo_cli.task.objects.displaced_object import DisplacedObject
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView
from tests.known import configured
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, written
from tests.studies.hand_eye_coverage import pose
from tests.studies.metric_coverage import longest

ARMS = ("ur5", "paper", "hobby")
SEED, NOISE_PX = 520_000, 0.5
# Side of the tags, m, whether one camera alone sees the object at last, and how many such objects.
KINDS = ((0.06, False, 10), (0.03, False, 10), (0.06, True, 4))
BESIDE, FARTHEST, MOST = 0.08, 0.15, np.radians(60.0)  # m, m, rad
TILT = np.radians(40.0)  # of an object from the direction of the cameras, at most
# What befell an object: the markers that moved, by so many m, or the one that one image shows off, px.
FAULTS = {
    "tag slipped by 2 mm": (range(4, 8), 0.002, 0.0),
    "tag slipped by 5 mm": (range(4, 8), 0.005, 0.0),
    "marker off by 3 mm": (range(5, 6), 0.003, 0.0),
    "corner off by 6 px": (range(5, 6), 0.0, 6.0),
}
FAULTY = 12
LEAST_COSINE = np.cos(np.radians(70.0))  # of the angle between the normal of a tag and a ray
CORNERS = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
# The second tag beside the first, in sides, and how it is turned, rad.
SECOND = pose((0.2, -0.3, 0.1), (1.4, 0.3, -0.2))
COLUMNS = (
    "arm",
    "seed",
    "object",
    "side_mm",
    "one_view",
    "fault",
    "refused",
    "square",
    "mm",
    "deg",
    "std_mm",
    "std_deg",
)


def direction(rng):
    """A direction (3,), each as likely."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def tags(side):
    """Corners (8, 4) of both tags, m, about their middle, and their normals (2, 3)."""
    first = np.c_[side * CORNERS, np.ones(4)]
    shift = SECOND.copy()
    shift[:3, 3] *= side
    X = np.concatenate([first, first @ shift.T])
    X[:, :3] -= X[:, :3].mean(axis=0)
    return X, np.array([[0.0, 0.0, 1.0], SECOND[:3, 2]])


def seen(truth, X, normals=()):
    """Whether both images show points (k, 4) in front, and tags of these normals from their front."""
    depth = X @ truth.P[:, 2].T
    if (
        not (depth > 0.0).all()
        or not within_images(project(truth.P, X, truth.lens), truth.image_size[:, None]).all()
    ):
        return False
    for k, normal in enumerate(normals):
        middle = X[4 * k : 4 * k + 4, :3].mean(axis=0)
        rays = np.array([camera_center(P) for P in truth.P]) - middle
        if (rays @ normal < LEAST_COSINE * np.linalg.norm(rays, axis=1)).any():
            return False
    return True


def scene(truth, goals, side, rng, tries=10**9):
    """Object (8, 4) when taught, tool (m, 4) at the goal, and the displacement (4, 4) of both.

    None if none is found in some tries.
    """
    for _ in range(tries):
        tool = truth.M @ truth.displacement(goals[rng.integers(len(goals))]).T
        X, normals = tags(side)
        middle = tool[:, :3].mean(axis=0) + BESIDE * direction(rng)
        towards = np.mean([camera_center(P) for P in truth.P], axis=0) - middle
        turn, _ = Rotation.align_vectors(towards[None], [[0.0, 0.0, 1.0]])
        turn = Rotation.from_rotvec(rng.uniform(0.0, TILT) * direction(rng)) * turn
        turn = turn * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
        X = X @ pose(turn.as_rotvec(), middle).T
        normals = turn.apply(normals)
        R = Rotation.from_rotvec(rng.uniform(0.0, MOST) * direction(rng))
        shift = middle - R.apply(middle) + rng.uniform(0.0, FARTHEST) * direction(rng)
        T = pose(R.as_rotvec(), shift)
        if all(
            (
                seen(truth, X, normals),
                seen(truth, X @ T.T, R.apply(normals)),
                seen(truth, tool),
                seen(truth, tool @ T.T),
            )
        ):
            return X, tool, T
    return None


def carried_pose(truth, s, tool):
    """Small motion (6,) about the middle of the tool (m, 4), m and rad, after which it shows images s best.

    With it the derivative (V m 2, 6) of the images.
    """
    middle = tool[:, :3].mean(axis=0)

    def off(x):
        X = Rotation.from_rotvec(x[3:]).apply(tool[:, :3] - middle) + middle + x[:3]
        return (project(truth.P, np.c_[X, np.ones(len(X))], truth.lens) - s).ravel()

    fit = least_squares(off, np.zeros(6), x_scale=[0.01] * 3 + [0.1] * 3, jac="3-point", xtol=1e-12)
    return fit.x, fit.jac


def draw(arm, seed, faults=()):
    """Rows of all objects of a calibration, sound ones or those that something befell."""
    config = configured(arm)
    truth, rng = truth_of(config), np.random.default_rng(seed)
    try:
        c = projservo.calibrate(projservo.simulate(config, seed=seed, noise_px=NOISE_PX))
    except WorkFailed as error:
        return [{"arm": arm, "seed": seed, "object": -1, "refused": str(error)}]
    metric = c.metric(*longest(truth, c))
    tool_of = [truth.number.index(number) for number in c.marker.tolist()]
    front = np.array(config.task.start.values(config.joint_types))
    goals = random_tasks(truth, front, 20, rng)[1]

    def images(X):
        s = project(truth.P, X, truth.lens)
        return s + NOISE_PX * rng.standard_normal(s.shape)

    rows = []
    objects = [(side, one, "") for side, one, count in KINDS for _ in range(count)]
    for k, (side, one_view, fault) in enumerate(
        [(0.06, False, fault) for fault in faults for _ in range(FAULTY)] if faults else objects
    ):
        X, tool, T = scene(truth, goals, side, rng)
        tool = tool[tool_of]
        row = {"arm": arm, "seed": seed, "object": k, "side_mm": 1e3 * side, "one_view": one_view}
        row["fault"], changed, off = fault, X.copy(), 0.0
        if fault:
            which, by, off = FAULTS[fault]
            changed[which, :3] += by * direction(rng)
        taught, now, goal = images(X), images(changed @ T.T), images(tool)
        if off:
            turn = rng.uniform(-np.pi, np.pi)
            now[rng.integers(2), FAULTS[fault][0][0]] += off * np.array([np.cos(turn), np.sin(turn)])
        if one_view:
            now[rng.integers(2)] = np.nan
        rows.append(row)
        try:
            found = DisplacedObject.of(c, range(40, 48), [ObjectView(taught), ObjectView(now)], metric=metric)
            carried = found.carry(ObjectView(goal))
        except WorkFailed as error:
            row["refused"] = str(error)
            continue
        error, J = carried_pose(truth, carried.s, tool @ T.T)
        changes = np.linalg.pinv(J) @ carried.changes.reshape(len(carried.changes), -1).T
        row["square"] = error @ np.linalg.solve(changes @ changes.T, error)
        row["mm"], row["deg"] = 1e3 * np.linalg.norm(error[:3]), np.degrees(np.linalg.norm(error[3:]))
        row["std_mm"], row["std_deg"] = carried.position_mm, carried.rotation_deg
    return rows


def drawn(job):
    return draw(*job)


def main():
    parser = parser_of(
        "carried_goals",
        __doc__,
        [("calibrations", 17, "of each arm, with 24 objects each")],
        arms=(ARMS, list(ARMS)),
        faults=(FAULTS, []),
    )
    given = parser.parse_args()
    jobs = [(arm, SEED + k, given.faults) for arm in given.arms for k in range(given.calibrations)]
    rows = written(given.output, COLUMNS, in_two_processes(drawn, jobs, "calibrations"))
    for fault in given.faults:
        own = [r for r in rows if r.get("fault") == fault]
        refused = sum("refused" in r for r in own)
        held = sum(r.get("square", np.inf) <= chi2.ppf(0.95, 6) for r in own)
        mm = [r["mm"] for r in own if "mm" in r]
        good = rate(held + refused, len(own))
        print(f"{fault}: held or refused {good} %, refused {refused}; {quantiles(mm)} mm", flush=True)
    for arm in () if given.faults else given.arms:
        for side, one_view, _ in KINDS:
            own = [
                r
                for r in rows
                if r["arm"] == arm and r.get("side_mm") == 1e3 * side and r["one_view"] == one_view
            ]
            done = [r for r in own if "square" in r]
            held = sum(r["square"] <= chi2.ppf(0.95, 6) for r in done)
            rms = [np.sqrt(np.mean([r[a] ** 2 for r in done]) / np.mean([r[b] ** 2 for r in done]))
                   for a, b in (("mm", "std_mm"), ("deg", "std_deg"))]  # fmt: skip
            views = "one view" if one_view else "both views"
            print(
                f"{arm}, tags of {1e3 * side:g} mm, {views}: {len(own)} objects, refused "
                f"{len(own) - len(done)}, held {rate(held, len(done))} %; "
                f"{quantiles([r['mm'] for r in done])} mm, {quantiles([r['deg'] for r in done])} deg; "
                f"rms over stated {rms[0]:.2f}, {rms[1]:.2f}",
                flush=True,
            )
        failed = [r["refused"] for r in rows if r["arm"] == arm and "refused" in r]
        print("\n".join(f"  {text}" for text in sorted(set(failed))[:10]))


if __name__ == "__main__":
    main()
