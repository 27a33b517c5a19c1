"""Whether doctor, servo, validate and teach judge one arm at rest alike: the same frames before each of them.

    python -m tests.studies.at_rest [--faults 200] [--sound 60] [-o FILE]

Faults are drawn by seed, most of them as small as images just show; each of a rig of ``monitoring`` stands
where it was calibrated before anything is asked. A row says what each command found, by codes, and whether it
refused.
"""

import json
import math
from contextlib import suppress

import numpy as np

from projservo_cli.config import inputs as given
from projservo_cli.findings import REFUSES
from projservo_cli.records import Observation, WorkFailed
from projservo_cli.stages import doctor, teach
from projservo_cli.stages.validate import compared
from tests.configured import checked, plan, servo
from tests.monitoring.stand_in import ARMS, FPS, StandIn, seen, tool_pose
from tests.studies.common import in_two_processes, parser_of, rate, written
from tests.studies.monitoring import Rig, calibrated, config_of, moved_so_far

SEED = 2068
RIGS = [Rig(arm, corners, 0.0, 0.0) for arm in ARMS for corners in ("finder", "none", "subpix", "noise")]
KINDS = ("shift", "turn", "move", "base", "slip", "home", "reprint", "refocus", "exchange", "size", "sign")
# Of each kind how often of so many; those that images show at once are few.
OFTEN = (5, 4, 4, 5, 5, 5, 2, 2, 1, 1, 1)
COMMANDS = ("doctor", "servo", "validate", "teach")
FRAMES = 38  # that doctor looks at, too


class Standing(StandIn):
    """The arm at rest: the frames of each look are those of its number, whoever looks."""

    def __init__(self, **options):
        super().__init__(**options)
        self.looks = 0

    def read(self):
        self.time += 1.0 / FPS
        self.looks += 1
        return super().read()

    def _newest(self, view):
        return self._frame(view, self.looks, self.time)


def fault_of(rng, arm):
    """A fault, and by what it is called."""
    kind = str(rng.choice(np.repeat(KINDS, OFTEN)))
    T, px = tool_pose(arm, np.radians(arm.home)), math.exp(rng.uniform(math.log(0.3), math.log(8.0)))
    views, sign, axis = [(0,), (1,)][rng.integers(2)], int(rng.choice((-1, 1))), int(rng.integers(3))
    if kind in ("shift", "turn", "move"):
        return moved_so_far(kind, views, axis % 2 if kind == "shift" else axis, sign, px, T)
    if kind == "base":
        return moved_so_far("move", (0, 1), axis, sign, px, T)
    if kind == "slip":
        return {"kind": kind, "by": (sign * rng.uniform(0.0005, 0.006) * np.eye(3)[axis]).tolist()}
    if kind == "home":
        joint = int(rng.integers(1, len(arm.home) + 1))
        return {"kind": kind, "joint": joint, "by": sign * math.radians(rng.uniform(0.05, 2.0))}
    more = {
        "reprint": {"by": float(rng.uniform(0.94, 1.06))},
        "refocus": {"views": list(views), "by": float(rng.uniform(0.985, 1.015))},
        "exchange": {},
        "size": {"by": float(rng.choice((0.5, 2.0))), "crop": [0, 0]},
        "sign": {"joint": int(rng.integers(1, len(arm.home) + 1))},
    }
    return {"kind": kind, **more[kind]}


def causes(findings):
    """Codes of what refuses among findings, those of their causes if they have any."""
    codes = set()
    for one in findings:
        if one.severity != REFUSES:
            continue
        # How far each view is off is no cause.
        parts = [other for other in one.others if other.code != "view_off"]
        for part in parts if one.code == "refuted" else (one,):
            below = [other.code for other in part.others] if part.code == "images_off" else []
            codes |= {*below} or {part.code}
    return codes


def asked(command, config, calibration):
    """Codes of what a command finds."""
    if command == "validate":
        robot = Standing(**config.plant.options)
        q, images, *more = zip(*(robot.read() for _ in range(FRAMES)), strict=True)
        sigma = np.array(more[-1]) if more else None
        shown = Observation(np.arange(FRAMES), np.arange(20), np.array(q), np.array(images), sigma=sigma)
        return causes(compared(calibration, shown)["findings"])
    try:
        if command == "doctor":
            told = doctor.check(given.preflight_inputs(config), calibration).findings
            found = [one for one in told if one.code == "refuted"]  # joints beyond limits are said beside it
        elif command == "teach":
            taught = teach.teach(given.teach_inputs(config), FRAMES)
            found = checked(config, calibration, taught).findings
        else:
            made = plan.run(config, calibration)
            trace = servo.run(config, calibration, made, "exact_track")
            found = trace.findings if trace.verdict == "fault detected" else ()
    except WorkFailed as error:
        found = error.findings
        return causes(found) or {"failed: " + str(error)[:60]}
    return causes(found)


def judged(job):
    """The row of a fault, None for none."""
    number, rig, sound = job
    calibration, arm = calibrated(rig), ARMS[rig.arm]
    if isinstance(calibration, str):
        raise RuntimeError(f"{rig}: {calibration}")
    rng = np.random.default_rng([SEED, number, sound])
    fault = None if sound else fault_of(rng, arm)
    options = rig.options(at_deg=arm.home, fault=fault, seed=int(rng.integers(2**31)))
    config = config_of(rig, (arm.home, arm.home), "none.csv", options)
    use = {"use": "tests.studies.at_rest:Standing", "options": options}
    config = config.model_copy(update={"plant": config.plant.model_copy(update=use)})
    row = {"number": number, "arm": rig.arm, "corners": rig.corners, "fault": json.dumps(fault)}
    off = [seen(tool_pose(arm, np.radians(arm.home)), v, (fault,) * bool(fault)).pixels for v in (0, 1)]
    none = [seen(tool_pose(arm, np.radians(arm.home)), v).pixels for v in (0, 1)]
    row["off_px"] = round(
        max(float(np.sqrt(2.0 * np.mean((a - b) ** 2))) for a, b in zip(off, none, strict=True)), 3
    )
    for command in COMMANDS:
        row[command] = " ".join(sorted(asked(command, config, calibration)))
    return [row]


def main():
    """Ask all commands about each fault."""
    numbers = [("faults", 200, "that are drawn"), ("sound", 60, "arms without a fault")]
    args = parser_of("at_rest", __doc__, numbers).parse_args()
    counts = (args.faults, False), (args.sound, True)
    jobs = [(k, RIGS[k % len(RIGS)], sound) for count, sound in counts for k in range(count)]
    columns = ("number", "arm", "corners", "fault", "off_px", *COMMANDS)
    rows = written(args.output, columns, in_two_processes(judged, jobs, "arms at rest"))
    faulty, sound = rows[: args.faults], rows[args.faults :]
    for what, some in (("faults", faulty), ("sound", sound)):
        same = sum(len({row[name] for name in COMMANDS}) == 1 for row in some)
        exit_codes = sum(len({bool(row[name]) for name in COMMANDS}) == 1 for row in some)
        print(f"{what}: {len(some)}; same codes {rate(same, len(some))} %, same exit code {exit_codes}")
        for name in COMMANDS:
            print(f"  {name}: refused {sum(bool(row[name]) for row in some)}")


if __name__ == "__main__":
    with suppress(BrokenPipeError):
        main()
