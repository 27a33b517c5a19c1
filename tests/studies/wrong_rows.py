"""Tables whose rows are not what they seem: orders, couplings, sizes, markers, images of other poses.

    python -m tests.studies.wrong_rows [--faults NAME ...] [--arms ...] [--seeds 8] [--jobs 2]

Tables are those of ``faulty_arms`` at 0.3 px, twelve markers. The fault of a table is named if a finding of
its calibration, or of its refusal, has the right code and subject; a calibration is honest if its true error
at poses within the ranges of the joints, over the markers that it has, is within twice what it states. What
is neither is wrong. ``blamed`` counts deviations that are none of the right codes.
"""

import itertools
import os
import time
import warnings
from collections import Counter
from typing import NamedTuple

import numpy as np

import projservo_cli as projservo
from projservo_cli.calibration import predict
from projservo_cli.deviations import DEVIATIONS
from projservo_cli.findings import NOTE
from tests.studies.common import in_two_processes, parser_of, written
from tests.studies.faulty_arms import ARMS, IMAGE, World
from tests.studies.model_errors import NOISE_PX, inside, poses_of

SEED, HELD_OUT = 68, 100


class Table(NamedTuple):
    """Readings and noiseless images of a table, and the images where it is judged."""

    q: np.ndarray  # (K, n) as listed
    s: np.ndarray  # (K, 2, m, 2) px
    ahead: np.ndarray  # (H, n) as listed
    there: np.ndarray  # (H, 2, m, 2) px
    codes: tuple[str, ...]  # that are right
    joints: tuple[int, ...] = ()  # of which one is in the subject, if any are given
    markers: tuple[int, ...] = ()
    poses: tuple[int, ...] = ()
    views: tuple[str, ...] = ()
    known: tuple[tuple[str, str], ...] = ()  # arguments of the calibration


def images(arm, q, put=lambda w: None, held=False, markers=None):
    arm = arm if markers is None else arm._replace(markers=markers)
    w = World(arm, q, np.linspace(0.0, 1.0, len(q)), held)
    put(w)
    return w.images()


def plain(arm, q, ahead, rng, codes=(), **more):
    return Table(q, images(arm, q), ahead, images(arm, ahead, held=True), codes, **more)


def other_order(arm, q, ahead, rng):
    """Two neighbours of the same kind, listed in each other's place."""
    types = arm.types
    i = int(rng.choice([i for i in range(len(types) - 1) if types[i] == types[i + 1]]))
    order = [*range(len(types))]
    order[i], order[i + 1] = i + 1, i
    one = plain(arm, q, ahead, rng, ("exchanged_joints",))
    return one._replace(q=q[:, order], ahead=ahead[:, order], joints=(i + 1, i + 2))


def parallelogram(arm, q, ahead, rng):
    """A joint that keeps the direction of its link as the one before turns."""
    i = arm.joints[0] if arm.types[arm.joints[0]] == "R" else arm.joints[1] - 1
    i = next(k for k in range(i, len(arm.types)) if arm.types[k - 1 : k + 1] == "RR")

    def put(w):
        w.turn(i + 1, -w.read(i))

    there = images(arm, ahead, put, held=True)
    return Table(q, images(arm, q, put), ahead, there, ("full_coupling", "coupling"), joints=(i, i + 1))


def half_size(arm, q, ahead, rng):
    """Images that are smaller from a pose on: larger ones are beyond the size that is given."""
    onset, factor = int(rng.integers(len(q) // 4, 3 * len(q) // 4)), float(rng.choice([0.5, 2.0 / 3.0, 0.75]))
    one = plain(arm, q, ahead, rng, ("image_size_changed",), poses=(onset,))
    one.s[onset:] = factor * (one.s[onset:] + 0.5) - 0.5
    return one


def standing_markers(arm, q, ahead, rng):
    """Some markers that stay where the first pose shows them."""
    some = sorted(rng.choice(12, int(rng.integers(2, 5)), replace=False).tolist())
    one = plain(arm, q, ahead, rng, ("standing_markers",), markers=tuple(some))
    one.s[:, :, some] = one.s[:1, :, some]
    return one


def on_a_link(arm, q, ahead, rng):
    """A marker that sits before the last joint."""
    j, last = int(rng.integers(12)), len(arm.types) - 1
    one = plain(arm, q, ahead, rng, ("marker_on_link",), markers=(j,))
    for poses, s in ((q, one.s), (ahead, one.there)):
        still = poses.copy()
        still[:, last] = arm.home[last]
        s[:, :, j] = images(arm, still, held=True)[:, :, j]
    return one


def creeps(arm, q, ahead, rng):
    """A marker that creeps on the tool; it ends where it is judged."""
    j, size = int(rng.integers(12)), np.ptp(arm.markers, axis=0).max()
    by = rng.standard_normal(3)
    by *= 0.05 * size / np.linalg.norm(by)
    one = plain(arm, q, ahead, rng, ("marker_drift", "marker_step"), markers=(j,))
    for k, share in enumerate(np.linspace(0.0, 1.0, len(q))):
        markers = arm.markers.copy()
        markers[j] += share * by
        one.s[k, :, j] = images(arm, q[k : k + 1], held=True, markers=markers)[0, :, j]
    markers = arm.markers.copy()
    markers[j] += by
    one.there[:, :, j] = images(arm, ahead, held=True, markers=markers)[:, :, j]
    return one


def remembers(arm, q, ahead, rng):
    """A tracker that keeps a share of the image before."""
    keep = float(rng.uniform(0.02, 0.1))
    one = plain(arm, q, ahead, rng, ("memory", "tracker_memory"))
    for k in range(1, len(q)):
        one.s[k] = (1.0 - keep) * one.s[k] + keep * one.s[k - 1]
    return one


def cyclic(arm, q, ahead, rng):
    """A joint that errs again and again over its range."""
    i = int(rng.choice(arm.joints))
    times, phase = float(rng.uniform(4.0, 12.0)), float(rng.uniform(0.0, 2.0 * np.pi))
    unit = 0.3 if arm.types[i - 1] == "P" else 1.0
    period, size = arm.reach[i - 1] / unit / times * 2.0, np.radians(0.5)

    def put(w):
        w.turn(i, size * np.sin(2.0 * np.pi * w.read(i) / period + phase))

    there = images(arm, ahead, put, held=True)
    return Table(q, images(arm, q, put), ahead, there, ("cyclic", "joint_noise", "erring_joint"), joints=(i,))


def servo_curve(arm, q, ahead, rng):
    """Joints of one kind that all err by a curve of the third order, fitted by auto."""
    size = np.radians(0.5) * rng.uniform(0.5, 1.5, len(arm.types)) * rng.choice([-1.0, 1.0], len(arm.types))

    def put(w):
        for i in range(1, len(arm.types) + 1):
            reach = arm.reach[i - 1] / w.unit[i - 1]
            middle = arm.home[i - 1] / w.unit[i - 1]
            w.turn(i, size[i - 1] * ((w.read(i) - middle) / reach) ** 3)

    there = images(arm, ahead, put, held=True)
    return Table(q, images(arm, q, put), ahead, there, (), known=(("joint_model", "auto"),))


def other_pose(arm, q, ahead, rng):
    """Three images of one view that show the pose before."""
    v, one = int(rng.integers(2)), plain(arm, q, ahead, rng, ("other_pose", "late_view"))
    some = np.sort(rng.choice(np.arange(2, len(q)), 3, replace=False))
    one.s[some, v] = one.s[some - 1, v].copy()
    return one._replace(poses=tuple(some.tolist()), views=(("left", "right")[v],))


def late_from_a_pose(arm, q, ahead, rng):
    """Images that come one pose late, from a pose on."""
    onset, one = int(rng.integers(len(q) // 3, 2 * len(q) // 3)), plain(arm, q, ahead, rng)
    one.s[onset:] = one.s[onset - 1 : -1].copy()
    return one._replace(codes=("images_late_from",), poses=(onset,))


def camera_and_back(arm, q, ahead, rng):
    """A camera that is pushed, and put back later."""
    v, first = int(rng.integers(2)), int(rng.integers(len(q) // 4, len(q) // 2))
    last = first + len(q) // 5
    by = rng.uniform(-1.0, 1.0, 2)
    one = plain(arm, q, ahead, rng, ("moved_camera",), poses=(first,))
    one.s[first:last, v] += 8.0 * by / np.linalg.norm(by)
    return one._replace(views=(("left", "right")[v],))


def in_degrees(arm, q, ahead, rng):
    """One joint in degrees where all are in rad."""
    i = int(rng.choice([k for k, kind in enumerate(arm.types) if kind == "R"]))
    one = plain(arm, q, ahead, rng, ("joint_unit",), joints=(i + 1,))
    for part in (one.q, one.ahead):
        part[:, i] = np.degrees(part[:, i])
    return one


FAULTS = {
    "none": plain,
    "order": other_order,
    "parallelogram": parallelogram,
    "image size": half_size,
    "standing markers": standing_markers,
    "marker on a link": on_a_link,
    "marker creeps": creeps,
    "tracker remembers": remembers,
    "cyclic": cyclic,
    "cyclic, random": cyclic,
    "servo curve": servo_curve,
    "other pose": other_pose,
    "late from a pose": late_from_a_pose,
    "camera and back": camera_and_back,
    "degrees": in_degrees,
}


class Job(NamedTuple):
    """A table."""

    fault: str
    arm: str
    seed: int


def tells(one, table):
    """Whether a finding names the fault of a table."""
    told, asked = one.subject, table
    near = [abs(k - at) <= 1 for k in told.poses for at in asked.poses]
    return one.code in asked.codes and all(
        (
            not asked.joints or not told.joints or {*told.joints} & {*asked.joints},
            not asked.markers or {*told.markers} & {*asked.markers},
            not asked.poses or not told.poses or any(near),
            not asked.views or not told.views or {*told.views} & {*asked.views},
        )
    )


def judged(job):
    """What came of a table: a row."""
    warnings.simplefilter("ignore")
    arm, number = ARMS[job.arm], [*FAULTS].index(job.fault)
    rng = np.random.default_rng([SEED, [*ARMS].index(job.arm), job.seed, number])
    # Trials of each joint, then some of several at once: all that a usual recording has.
    q = poses_of(arm, "random" if job.fault.endswith("random") else "trials", rng)
    ahead = rng.uniform(q.min(axis=0), q.max(axis=0), (HELD_OUT, len(arm.home)))
    table = FAULTS[job.fault](arm, q.copy(), ahead.copy(), rng)
    s = table.s + NOISE_PX * rng.standard_normal(table.s.shape)
    s[~inside(table.s)] = np.nan
    row, begun = job._asdict(), time.process_time()
    try:
        seen = projservo.Observations.from_arrays(
            table.q, s, joint_types=arm.types, joint_unit="rad", image_size=IMAGE
        )
        c = projservo.calibrate(seen, progress=False, **dict(table.known))
        findings, row["exit"] = c.findings, int(not c.usable)
    except (projservo.InputError, projservo.WorkFailed) as refused:
        c, findings = None, getattr(refused, "findings", ())
        row["exit"] = 2 if isinstance(refused, projservo.InputError) else 1
        row["reason"] = str(refused)[:200]
    except Exception as failed:  # an internal error is a row of the study
        c, findings, row["exit"], row["reason"] = None, (), 3, f"{type(failed).__name__}: {failed}"
    row["seconds"], told = time.process_time() - begun, [one for one in findings if one.severity != NOTE]
    row["named"] = any(tells(one, table) for one in findings)
    row["codes"] = " ".join(dict.fromkeys(one.code for one in told))
    row["blamed"] = sum(one.code in DEVIATIONS and one.code not in table.codes for one in told)
    row["true"] = row["stated"] = np.nan
    if c is not None and c.usable:
        off = (predict(c, table.ahead) - table.there[:, :, c.marker])[inside(table.there)[:, :, c.marker]]
        row["true"] = float(np.sqrt(np.mean((off**2).sum(axis=-1))))
        row["stated"] = float(c.predicted_rms_px)
    row["honest"] = bool(row["true"] <= 2.0 * row["stated"])
    return row


def tell(rows):
    print(f"{'fault':18}{'tables':>7}{'named':>7}{'honest':>7}{'wrong':>7}{'blamed':>7}  true/stated  codes")
    for fault in dict.fromkeys(r["fault"] for r in rows):
        some = [r for r in rows if r["fault"] == fault]
        wrong = sum(not r["named"] and not r["honest"] for r in some)
        ratios = [r["true"] / r["stated"] for r in some if r["true"] == r["true"]]
        codes = Counter(f"error {r['reason']}" if r["exit"] == 3 else r["codes"] for r in some).most_common(3)
        blamed, ratio = sum(r["blamed"] > 0 for r in some), np.median(ratios) if ratios else np.nan
        counts = len(some), sum(r["named"] for r in some), sum(r["honest"] for r in some), wrong, blamed
        told = "; ".join(f"{code or 'nothing'} {count}" for code, count in codes)[:110]
        print(f"{fault:18}{''.join(f'{count:7d}' for count in counts)}{ratio:12.2f}  {told}")


COLUMNS = (*Job._fields, "exit", "named", "honest", "true", "stated", "blamed", "codes", "seconds", "reason")


def main():
    """Calibrate the tables of the study and print a line of each fault."""
    numbers = [("seeds", 8, "of each fault and arm"), ("jobs", 2, "number of processes")]
    given = parser_of("wrong_rows_study", __doc__, numbers, faults=[*FAULTS], arms=ARMS).parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # of the processes to come
    jobs = [Job(*one) for one in itertools.product(given.faults, given.arms, range(given.seeds))]
    made = in_two_processes(judged, jobs, "tables", given.jobs)
    tell(written(given.output, COLUMNS, ([dict.fromkeys(COLUMNS, "") | row] for row in made)))


if __name__ == "__main__":
    main()
