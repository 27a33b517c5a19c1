"""Whether what befalls a robot is seen and named: whole runs of a stand-in through the public stages.

    python -m tests.studies.monitoring [--cells before during faults sound] [--runs 300] [--blind] [-o FILE]

Runs are drawn by seed from a fractional design: faults of a cell x arms x corners x backlash x latency x kind
of goal. Each rig is calibrated once from a recording of its own. Numbers of runs are of each cell; of faults
and of sound ones, of each fault and each kind of corners. A row says which causes were named, judged by
``CAUSES`` alone; what images cannot tell apart is in ``PAIRS``.
"""

import itertools
import json
import re
import tempfile
import time
from collections import Counter
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.monitoring.innovation_tests import ErrorModel
from projservo_cli.records import WorkFailed
from tests.configured import calibrate, plan, record, servo
from tests.monitoring.stand_in import ARMS, KINDS, LAST, TAG_M, StandIn, seen, tool_pose
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, written

# Causes as they are worded; a group of an expression is the joint.
CAUSES = {
    "left camera": r"\bleft camera (?:was|is|has been) (?!refocused|zoomed)",
    "right camera": r"\bright camera (?:was|is|has been) (?!refocused|zoomed)",
    "both cameras": r"\bboth cameras (?:were|are|have been) (?!exchanged|swapped)",
    "base": r"\bbase (?:was|is|has|moved|turned)",
    "exchanged": r"\b(?:exchanged|swapped)\b",
    "joint {} sign": r"\bjoint (\d)\b[^;]*?\bsign\b|\bsign of joint (\d)",
    "joint {} homed": r"\bjoint (\d) (?:has )?(?:slipped|(?:was|is) homed|homed)",
    "image size": r"\bimage size|\bimages? (?:of \w+ \w+ )?(?:is|are|was|were) (?:scaled|resized)|\bcrop",
    "tag scale": r"\b(?:tags?|markers) .{0,30}(?:larger|smaller)|\bscale of the tags",
    "focal length": r"\bfocal length|\brefocused|\bzoomed",
    "goal": r"\bgoal .{0,60}\btaught\b|\btaught .{0,40}\bgoal\b",
    "tool": r"\btool (?:was|is|has|moved|turned|sits)",
    "markers": r"\bmarkers? [\d, and]+ moved",
    "late": r"\bms (?:later|earlier)",
    "frozen": r"\breading of .* stands? still",
    "flex": r"\blinks? flex",
    "backlash": r"\b(?:play|backlash) in",
}
# A verdict without a cause says where images disagree most, which blames nobody.
_WHERE = r"disagree with the calibration by[^;]*? most\b"
# What images cannot tell apart, or hardly: both, or all, may be said. {} is one joint, {last} the last.
PAIRS = (
    {"both cameras", "base", "joint 1 homed"},  # about an upright first axis, or moved together
    {"joint {last} homed", "tool"},  # turned about its axis
    {"backlash", "tool"},  # a tool that is loose
    {"late", "joint {} homed"},  # a slip while it moves
    {"late", "backlash"},
    {"flex", "joint {} homed"},  # less than a degree
    {"joint {} sign", "joint {} homed"},  # while it stands still, a mirrored reading is an offset
    {"left camera", "focal length"},  # moved along its axis
    {"right camera", "focal length"},
    {"both cameras", "image size"},  # a crop is a turn
    {"tool", "tag scale"},  # a tool nearer to both
)
SEED, HOLD_DEG = 2029, 0.2  # of a set-point that holds the arm where it stands
SPREAD_DEG, ROLL_DEG, INSIDE_PX, FEWEST_TAGS = 18.0, 50.0, 30.0, 3  # of tasks around the home posture
GROWS = 0.2  # px of noise for each that images are off, where the test is blinded
# What a run takes before it moves and after its plan has ended, s, about; verdicts that blame nobody.
BEFORE_S, AFTER_S = 0.6, 1.0
BLAMELESS = ("converged", "no progress", "max steps")
AXES, SIGNS, VIEWS = (0, 1, 2), (-1, 1), ((0,), (1,), (0, 1))
CAMERA = [
    level
    for px in (3.0, 8.0, 15.0)
    for level in (
        *itertools.product(("shift",), VIEWS, (0, 1), SIGNS, (px,)),
        *itertools.product(("turn", "move"), VIEWS, AXES, SIGNS, (px,)),
    )
]
FAULTS = {
    "exchange": [("exchange",)],
    "sign": [("sign", joint) for joint in range(1, 7)],
    "home": [("home", joint, by) for joint in range(1, 7) for by in (-15.0, -4.0, 4.0, 15.0)],
    "size": [("size", by, crop, told) for by, crop in ((0.5, 0), (2.0, 0), (1.0, 40)) for told in (0, 1)],
    "reprint": [("reprint", 1.05)],
    "refocus": [("refocus", view, by) for view in (0, 1) for by in (0.99, 1.01)],
    "taught": [("taught", view, axis, sign, 8.0) for view in (0, 1) for axis in (0, 1) for sign in SIGNS],
}
SOUND = [("none",), ("none",), ("hand", 0), ("hand", 1), ("occlusion",), ("blur",)]


class Rig(NamedTuple):
    """An arm before its cameras."""

    arm: str
    corners: str
    backlash_deg: float
    latency_s: float

    def options(self, **more):
        return {**self._asdict(), "seed": 1, **more}


def rigs(kinds):
    """All rigs in an order by seed; of any run of them as long as there are kinds, one is of each."""
    rng = np.random.default_rng(SEED)
    rest = list(itertools.product((0.0, 0.3), (0.0, 0.08), ARMS))
    drawn = [[(kind, *rest[i]) for i in rng.permutation(len(rest))] for kind in KINDS]
    drawn = [[Rig(arm, kind, *more) for kind, *more, arm in row] for row in drawn]
    return [rig for row in zip(*drawn, strict=True) for rig in row if rig.corners in kinds]


def config_of(rig, task, table, options):
    """The configuration of somebody who followed the docs, for a task of readings, deg."""
    arm = ARMS[rig.arm]
    start, goal = task if task is not None else (arm.home, arm.home)
    here = {"joints": list(start), "unit": "deg"}
    goal = goal if isinstance(goal, dict) else {"joints": {"joints": list(goal), "unit": "deg"}}
    size = {"image_size_px": [800, 600]} if options.get("frames") else {}
    told = {
        "name": "stand-in",
        "plant": {
            "use": "tests.monitoring.stand_in:StandIn",
            "options": options,
            "timeout_s": 20,
            "settle_s": 0.3,
        },
        "data": {"table": str(table), "joints": "R" * len(arm.axes)} | size,
        "markers": {"numbers": list(range(20)), "face": [0, 1, 2, 3], "tag_size_m": TAG_M},
        "robot": {"limits": {"joints": [list(pair) for pair in arm.limits], "unit": "deg"}},
        "calibration": {
            "amplitude_deg": 25,
            "frames_per_joint": 4,
            "random_poses": 8,
            "reference": {"joints": list(arm.home), "unit": "deg"},
        },
        "task": {"start": here, "goal": goal},
        # A search that comes to nothing takes most of the time of a run otherwise.
        "trajectory": {"profile": "auto", "search": {"max_samples": 3000}},
        "stop": {"max_steps": 600},
        "control": {"laws": ["exact"], "mode": "track", "joint_speed_limit_deg_s": 60},
    }
    return load_config(Path(table).with_suffix(".yaml"), text=json.dumps(told))


@lru_cache(maxsize=64)
def calibrated(rig):
    """The calibration of a rig, or why there is none."""
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "trials.csv"
        config = config_of(rig, None, table, rig.options())
        record.record(config, record.new_recording(config, table))
        try:
            found = calibrate.run(config)[1]
        except WorkFailed as error:
            return str(error)
    return found if found.usable else found.reason


def shows(arm, q_deg):
    """Whether both cameras see the face and enough tags at readings."""
    found = [seen(tool_pose(arm, np.radians(q_deg)), view) for view in (0, 1)]
    border = [np.minimum(s.pixels, (799.0, 599.0) - s.pixels).min() for s in found]
    return min(border) > INSIDE_PX and all(s.shown[0] and s.shown.sum() >= FEWEST_TAGS for s in found)


def tasks(rig, rng):
    """Start and goal readings, deg, one after the other."""
    arm = ARMS[rig.arm]
    far = np.array([SPREAD_DEG] * (len(arm.home) - 1) + [ROLL_DEG])
    while True:
        ends = np.array(arm.home) + far * rng.uniform(-1.0, 1.0, (2, len(far)))
        if all(shows(arm, q) for q in ends):
            yield ends.round(3).tolist()


def planned(rig, rng, shown):
    """The first task with a plan: start and goal readings, deg, what is shown of the goal, and the plan."""
    for start, goal in tasks(rig, rng):
        given = shown(goal)
        with suppress(WorkFailed):
            made = plan.run(config_of(rig, (start, given), "none.csv", rig.options()), calibrated(rig))
            if made.feasible:
                return start, goal, given, made
    raise AssertionError("tasks do not end")


def taught(rig, q_deg, fault=None):
    """Goal images as they are taught, the mean of eight frames; as taught with a fault."""
    robot = StandIn(**rig.options(at_deg=q_deg, fault=fault, seed=2))
    frames = []
    for k in range(8):
        robot.command(robot.setpoint, robot.setpoint * 0.0, 0.2 + 0.04 * k)
        frames.append(robot.read()[1])
    mean, spread = np.mean(frames, axis=0), np.std(frames, axis=0, ddof=1).mean(axis=-1) / np.sqrt(8.0)
    images = {"markers": list(range(20)), "joints": {"joints": list(q_deg), "unit": "deg"}}
    for name, s, sigma in zip(("left", "right"), mean, spread, strict=True):
        images[name] = [None if np.isnan(p).any() else p.tolist() for p in s]
        images[f"sigma_{name}_px"] = [None if np.isnan(x) else max(float(x), 1e-3) for x in sigma]
    return {"images": images}


def moved_so_far(kind, views, axis, sign, px, T):
    """The fault of a camera by which the tags of a tool at T move by px rms in the views."""
    if kind == "shift":
        return {"kind": kind, "views": list(views), "by": [sign * px * (axis == i) for i in (0, 1)]}
    fault = {"kind": kind, "views": list(views), "axis": axis, "by": sign * 1e-4}
    for _ in range(4):
        off = [seen(T, v, (fault,)).pixels - seen(T, v).pixels for v in views]
        fault["by"] *= px / float(np.sqrt(2.0 * np.mean(np.square(off))))
    return fault


def fault_of(level, T, joints, rng):
    """The fault of a level of the design, and what must be named."""
    kind, *more = level
    if kind in ("shift", "turn", "move"):
        sides = ["left camera", "right camera", "both cameras"]
        return moved_so_far(*level, T), sides[VIEWS.index(more[0])]
    if kind in ("sign", "home"):
        joint = (more[0] - 1) % joints + 1
        by = {"by": float(np.radians(more[1]))} if kind == "home" else {}
        return {"kind": kind, "joint": joint, **by}, f"joint {joint} {'sign' if kind == 'sign' else 'homed'}"
    if kind == "taught":
        view, axis, sign, px = more
        return moved_so_far("shift", (view,), axis, sign, px, T), "goal"
    if kind == "size":
        return {"kind": kind, "by": more[0], "crop": [more[1], more[1]]}, "image size"
    if kind == "refocus":
        return {"kind": kind, "views": [more[0]], "by": more[1]}, "focal length"
    if kind in ("exchange", "reprint"):
        return {"kind": kind, "by": more[0] if more else 1.0}, {"exchange": "exchanged"}.get(
            kind, "tag scale"
        )
    if kind == "none":
        return None, ""
    view = [more[0]] if more else sorted({int(v) for v in rng.integers(2, size=2)})
    long = {"hand": (0.5, 1.5), "occlusion": (0.2, 2.0), "blur": (0.1, 0.2)}[kind]
    return {
        "kind": kind,
        "views": view,
        "tag": int(rng.integers(1, 5)),
        "seconds": float(rng.uniform(*long)),
    }, ""


def named_in(text):
    """Causes that a text names."""
    text, found = re.sub(_WHERE, "", text), set()
    for cause, words in CAUSES.items():
        for match in re.finditer(words, text):
            found.add(cause.format(*(group for group in match.groups() if group)))
    return found


def judged(expected, named, joints):
    """How what was named compares with what was expected: right, pair, two, wrong or none."""
    if expected == "both cameras" and named == {"left camera", "right camera"}:
        return "right"
    if not named or not expected:
        return "wrong" if named else "none"
    number = next(iter(re.findall(r"joint (\d)", expected)), "{}")
    pairs = [{cause.format(number, last=joints) for cause in pair} for pair in PAIRS]
    partners = set().union(*(pair for pair in pairs if expected in pair))
    if expected not in named:
        return "wrong"
    return "right" if named == {expected} else "pair" if named <= partners else "two"


def run_of(rig, task, fault=None, made=None, frames=False, seed=1):
    """One run as it ended, by a plan that was made or is made now: a row."""
    options = rig.options(at_deg=task[0], fault=fault, frames=frames, seed=seed)
    config, begun = config_of(rig, task, "none.csv", options), time.monotonic()
    row, calibration = {"stage": "plan"}, calibrated(rig)
    LAST.clear()
    try:
        made = made or plan.run(config, calibration)
        row["stage"] = "servo"
        trace = servo.run(config, calibration, made, "exact_track")
        row |= {"verdict": trace.verdict, "steps": trace.steps, "reason": trace.reason}
        row["stated_mm"] = trace.estimated_position_error_mm
        must = trace.verdict != "converged" and trace.law in (config.control.must_converge or (trace.law,))
        row["exit"] = int(trace.verdict == "fault detected" or must)
    except WorkFailed as error:
        row |= {"verdict": "not started", "steps": 0, "reason": str(error), "exit": 1}
    row["seconds"] = round(time.monotonic() - begun, 2)
    if LAST:
        row |= {"sent_deg": float(np.degrees(LAST[0].farthest)), "until_s": LAST[0].time}
    return row


def driven(job):
    """Rows of runs of one rig."""
    rig, drawn = job
    arm, calibration, rows = ARMS[rig.arm], calibrated(rig), []
    for cell, number, level in drawn:
        row = {"cell": cell, "number": number, **rig._asdict(), "fault": level[0]}
        if isinstance(calibration, str):
            rows.append(row | {"verdict": "no calibration", "reason": calibration})
            continue
        rng = np.random.default_rng([SEED, sum(map(ord, cell)), number])
        by_images = bool(rng.integers(2)) or level[0] == "taught"
        start, goal, shown, made = planned(rig, rng, partial(taught, rig) if by_images else list)
        there = [tool_pose(arm, np.radians(q)) for q in (start, goal)]
        fault, expected = fault_of(level, there[level[0] == "taught"], len(arm.home), rng)
        row |= {"goal": "images" if by_images else "joints", "expected": expected}
        row |= {"level": " ".join(map(str, level))}
        more = {
            "made": made,
            "seed": int(rng.integers(2**31)),
            "frames": level[0] == "size" and bool(level[3]),
        }
        if cell == "sound" and fault is not None:
            fault["at"] = float(rng.uniform(0.0, BEFORE_S + made.duration + AFTER_S))
        if cell == "during":
            quiet = run_of(rig, (start, shown), None, **more)
            row |= {"quiet_mm": off_mm(there[1]), "quiet": quiet["verdict"], "quiet_steps": quiet["steps"]}
            # Of every fourth run in one of the last three periods.
            periods = 3 if number % 4 == 0 else quiet["steps"]
            fault["at"] = LAST[0].time - 0.04 * float(rng.uniform(0.0, periods))
        if level[0] == "taught":
            found = run_of(rig, (start, taught(rig, goal, fault)), None, **(more | {"made": None}))
        else:
            found = run_of(rig, (start, shown), fault, **more)
        row |= {"at": (fault or {}).get("at", 0.0), "task": [start, goal], "by": json.dumps(fault)} | found
        row["error_mm"] = off_mm(there[1]) if LAST else float("nan")
        named = named_in(found["reason"]) if found["verdict"] not in BLAMELESS else set()
        if level[0] == "taught":  # why the goal is not of the calibration is said beside it
            named -= {f"{('left', 'right')[level[1]]} camera"}
        row |= {"named": ", ".join(sorted(named)), "judged": judged(expected, named, len(arm.home))}
        rows.append(row)
    return rows


def blinded(job):
    """Rows of runs in which the noise of pixels grows with what images are off, as it once did."""
    test = ErrorModel.residual

    def residual(errors, pair):
        one = test(errors, pair)
        seen = np.repeat(one.seen.ravel(), 2)
        off = GROWS * float(np.sqrt(np.square(one.r[seen]).mean())) if seen.any() else 0.0
        return one._replace(R=one.R + off**2 * np.eye(len(one.r)), noise=np.hypot(one.noise, off))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ErrorModel, "residual", residual)
        return driven(job)


def off_mm(there):
    """How far the tool of the last run is from a pose, mm."""
    return 1e3 * float(np.linalg.norm(LAST[0].pose()[:3, 3] - there[:3, 3]))


def jobs_of(cells, runs, kinds, each=10, most=40):
    """Jobs: a rig, and cell, number and level of up to so many runs of it."""
    parts = [("before", CAMERA, kinds), ("during", CAMERA, kinds)]
    parts += [("faults", levels, kinds) for levels in FAULTS.values()]
    parts += [("sound", SOUND, [kind]) for kind in KINDS]
    drawn: dict[Rig, list] = {rig: [] for rig in rigs(kinds)}
    for part, (cell, levels, some) in enumerate(parts):
        if cell not in cells or not set(some) <= set(kinds):
            continue
        rng, known = np.random.default_rng([SEED, part]), rigs(some)[: max(len(some), runs // each)]
        turns = [[rng.permutation(len(x)) for _ in range(-(-runs // len(x)))] for x in (levels, known)]
        for k, (level, rig) in enumerate(zip(*map(np.concatenate, turns), strict=False)):
            if k < runs:
                drawn[known[rig]].append((cell, 10_000 * part + k, levels[level]))
    return [(rig, rows[i : i + most]) for rig, rows in drawn.items() for i in range(0, len(rows), most)]


COLUMNS = (
    *("cell", "number", *Rig._fields, "goal", "fault", "level", "expected", "judged", "named", "verdict"),
    *("exit", "stage", "steps", "sent_deg", "error_mm", "quiet_mm", "quiet", "quiet_steps", "at", "until_s"),
    *("seconds", "task", "by", "stated_mm", "reason"),
)


def tell(rows):
    """Lines on each cell, against its bars."""
    for (kind, why), count in Counter((r["corners"], r["reason"]) for r in rows if "level" not in r).items():
        print(f"no calibration, {kind}, {count} runs: {why}"[:260])
    rows = [row for row in rows if "level" in row]
    for px in ("3.0", "8.0", "15.0"):
        some = [row for row in rows if row["cell"] == "before" and row["level"].endswith(px)]
        if some:
            still = sum(row["exit"] == 1 and row.get("sent_deg", 0.0) <= HOLD_DEG for row in some)
            named = sum(row["judged"] in ("right", "pair") for row in some)
            zero = sum(row["exit"] == 0 for row in some)
            print(
                f"before, {px} px: stopped before motion {still} of {len(some)}, {rate(still, len(some))} %; "
                f"named {named}, {rate(named, len(some))} %; exit code 0 {zero}; {said(some)}"
            )
    some = [row for row in rows if row["cell"] == "during"]
    if some:
        worse = [r for r in some if r["verdict"] == "converged" and r["error_mm"] > 1.5 * r["quiet_mm"]]
        zero = [row for row in some if row["exit"] == 0]
        # What begins in the last three periods may show in no frame that is read.
        unseen = sum(row["until_s"] - row["at"] <= 0.12 for row in zero)
        off = quantiles([row["error_mm"] for row in worse])
        print(
            f"during: exit code 0 in {len(zero)} of {len(some)}, {unseen} of them struck in their last three "
            f"periods; converged beyond 1.5 times the undisturbed error {len(worse)}, off by (mm) {off}; "
            f"{said(some)}"
        )
    for fault in FAULTS:
        some = [row for row in rows if row["cell"] == "faults" and row["fault"] == fault]
        if some:
            print(f"faults, {fault}: {said(some)}; exit code 0 {sum(row['exit'] == 0 for row in some)}")
    for kind in KINDS:
        some = [row for row in rows if row["cell"] == "sound" and row["corners"] == kind]
        if some:
            alarms = [r for r in some if r["verdict"] in ("fault detected", "not started")]
            arrived = [row for row in some if row["verdict"] == "converged"]
            print(
                f"sound, {kind}: alarms {len(alarms)} of {len(some)}; arrived {len(arrived)}; error (mm) "
                f"{quantiles([row['error_mm'] for row in some])}; {dict(Counter(r['verdict'] for r in some))}"
            )
    for row in rows:
        alarm = row["cell"] == "sound" and row["verdict"] in ("fault detected", "not started")
        bad = row["judged"] in ("wrong", "two") or alarm
        if bad:
            print(f"    {row['cell']} {row['number']} {row['corners']} {row['level']}: {row['reason']}"[:260])


def said(rows):
    """How often each judgement was passed, in percent."""
    count = Counter(row["judged"] for row in rows)
    return ", ".join(
        f"{name} {100 * count[name] / len(rows):.1f} %" for name in ("right", "pair", "two", "wrong", "none")
    )


def main():
    """Drive the runs of all cells and print a summary."""
    counted = [("runs", 300, "of each cell, fault and sound kind of corners")]
    cells = ["before", "during", "faults", "sound"]
    parser = parser_of("monitoring_study", __doc__, counted, cells=cells, corners=KINDS)
    parser.add_argument("--blind", action="store_true", help="with noise that grows: the study must fail")
    given = parser.parse_args()
    jobs = jobs_of(given.cells, given.runs, given.corners)
    batches = in_two_processes(blinded if given.blind else driven, jobs, "rigs")
    tell(written(given.output, COLUMNS, batches))


if __name__ == "__main__":
    main()
