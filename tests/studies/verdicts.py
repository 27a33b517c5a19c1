"""What each fault of a robot ends in: the verdict, and whether it names the cause.

    python -m tests.studies.verdicts [--arms ur5 hobby] [--tasks 5] [-o runs.csv]

Planned runs of the first tasks by seed, with a fault at period 10. A tolerable fault must end in
``converged``; every other in the expected verdict and words. ``no progress`` and ``max steps`` without a
cause are catch-alls, and count as wrong.
"""

import re

import pytest

from projservo_cli.records import WorkFailed
from projservo_cli.simulation.robot_with_faults import FaultyRobot
from tests.configured import calibrate, plan, servo
from tests.known import configured
from tests.studies.common import in_two_processes, parser_of, write_rows
from tests.studies.conditions import ARMS, SEEDS, task_config

AT = 10
GUIDED = (
    "trajectory.profile=auto",
    "control.mode=track",
    "plant.joint_limits=stop",
    "noise.averaged_frames=8",
)
NOISE = ("noise.calibration_px=0.5", "noise.servo_px=0.5")
TICKS = "encoder_counts_per_turn=4096"


class Blocked(FaultyRobot):
    """Its first joint is blocked from a period on."""

    def command(self, target, speed, due):
        if self.now() > AT * 0.04:
            held = getattr(self, "held", None)
            self.held = target[0] if held is None else held
            target = target.copy()
            target[0] = self.held
        super().command(target, speed, due)


class Protected(FaultyRobot):
    """It makes a protective stop at a period."""

    def command(self, target, speed, due):
        if self.now() > AT * 0.04:
            raise RuntimeError("protective stop")
        super().command(target, speed, due)


class Hung(FaultyRobot):
    """Its left camera hangs from a period on."""

    def read(self):
        answer = super().read()
        if self.now() < AT * 0.04:
            self.last = answer[1][0]
        answer[1][0] = self.last
        return answer


class Delayed(FaultyRobot):
    """Its images come 0.2 s later from a period on."""

    def read(self):
        if self.now() > AT * 0.04:
            for camera in self._cameras:
                camera._delay = 0.2
        return super().read()


# The words or verdict that are expected, and keys of disturbance.
FAULTS = {
    "300 ms late": ("converged", "camera_latency_s=0.3"),
    "30 Hz, free-running, jitter": (
        *("converged", "frame_rate_hz=30", "frame_offset_s=0.016", "jitter_s=0.008"),
    ),
    "ticks": ("converged", TICKS),
    "set-points in ticks": ("converged", TICKS, "quantize_setpoints=true"),
    "lag 150 ms": ("converged", "servo_time_constant_s=0.15"),
    "sag 0.5 deg": ("converged", "gravity_sag_deg=0.5"),
    "flex 0.02 deg": ("converged", "link_deflection_deg=0.02"),
    "flex 0.5 deg": ("converged|link flexes|links flex", "link_deflection_deg=0.5"),
    "play 0.5 deg": ("converged|backlash", "backlash_deg=0.5"),
    "joint struck by 3 deg": ("converged", f"joint_moved={{at_step: {AT}, joint: 2, by_deg: 3}}"),
    "markers lost for 10 periods": ("converged", f"lost_markers={{from_step: {AT}, steps: 10}}"),
    "markers lost for ever": ("markers lost", f"lost_markers={{from_step: {AT}}}"),
    "joint slipped by 3 deg": (
        "joint 2 slipped",
        f"joint_moved={{at_step: {AT}, joint: 2, by_deg: 3, encoder_slip: true}}",
    ),
    "reading frozen": (
        "the reading of joint [0-9] stands still",
        f"stuck_encoder={{joint: 1, from_step: {AT}}}",
    ),
    "left camera moved by 2 px": (
        "left camera",
        f"camera_moved={{at_step: {AT}, view: left, by_px: [2, 1]}}",
    ),
    "marker moved by 5 mm": (
        "marker 1 moved",
        f"marker_moved={{at_step: {AT}, marker: 1, by_m: [0.004, -0.003, 0]}}",
    ),
    "images later by 0.2 s": ("later than was taken|converged",),
    "joint blocked": ("joint 1 .*look whether it is blocked",),
    "protective stop": ("protective stop",),
    "camera hangs": ("left image has stood still",),
}
# Robots of faults that no key makes.
ROBOTS = {
    "images later by 0.2 s": Delayed,
    "joint blocked": Blocked,
    "protective stop": Protected,
    "camera hangs": Hung,
}


def driven(job):
    """Runs of an arm with a fault."""
    arm, fault, count = job
    expected, *keys = FAULTS[fault]
    # Late by a millisecond at least, so that the robot is driven by the contract.
    keys = [f"disturbance.{key}" for key in ("camera_latency_s=0.001", *keys)]
    config = configured(arm, *NOISE, *GUIDED, *keys)
    told = {"arm": arm, "fault": fault, "expected": expected}
    try:
        calibration = calibrate.run(config)[1]
    except WorkFailed as error:
        return [told | {"verdict": "no calibration", "reason": str(error), "right": False}]
    rows = []
    for seed in list(SEEDS)[:count]:
        mine = task_config(config, arm, seed)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                "projservo_cli.simulation.robot_with_faults.FaultyRobot", ROBOTS.get(fault, FaultyRobot)
            )
            try:
                trace = servo.run(mine, calibration, plan.run(mine, calibration), "exact_track")
                found = {"verdict": trace.verdict, "reason": trace.reason, "steps": trace.steps}
            except WorkFailed as error:
                found = {"verdict": "failed", "reason": str(error)}
        right = bool(re.search(expected, f"{found['verdict']}: {found['reason']}"))
        rows.append(told | {"seed": seed} | found | {"right": right})
    return rows


def main():
    """Print a line for each arm and fault, and every other verdict."""
    counted = [("tasks", 5, "of each arm and fault")]
    given = parser_of("verdicts_study", __doc__, counted, arms=ARMS).parse_args()
    jobs = [(arm, fault, given.tasks) for arm in given.arms for fault in FAULTS]
    rows = []
    for mine in in_two_processes(driven, jobs, "arms and faults"):
        rows += mine
        right = sum(row["right"] for row in mine)
        arm, fault, expected = (mine[0][name] for name in ("arm", "fault", "expected"))
        print(f"{arm}, {fault}: {right} of {len(mine)} as expected ({expected})", flush=True)
        for row in mine:
            if not row["right"]:
                print(f"    {row.get('seed')}: {row['verdict']}: {row['reason']}", flush=True)
    write_rows(given.output, rows)


if __name__ == "__main__":
    main()
