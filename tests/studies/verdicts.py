"""What each fault of a robot ends in: the verdict, and whether it names the cause.

    python -m tests.studies.verdicts [--arms ur5 hobby] [--tasks 5] [-o runs.csv]

Planned runs of the first tasks by seed, with a fault at period 10. A tolerable fault must end in
``converged``; every other in the expected verdict and words. ``no progress`` and ``max steps`` without a
cause are catch-alls, and count as wrong.
"""

import argparse
import re
from pathlib import Path

import pytest

from projservo_cli.records import WorkFailed
from projservo_cli.simulation.faults import FaultyRobot
from tests.configured import calibrate, plan, servo
from tests.known import configured
from tests.studies.conditions import ARMS, SEEDS, task_config
from tests.studies.planning_tables import in_two_processes, write_rows

AT = 10
GUIDED = (
    "trajectory.profile=auto",
    "control.mode=track",
    "plant.joint_limits=stop",
    "noise.averaged_frames=8",
)
NOISE = ("noise.calibration_px=0.5", "noise.servo_px=0.5")
TICKS = "disturbance.encoder_counts_per_turn=4096"


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


# The words or verdict that are expected, keys of the configuration, and the robot.
FAULTS = {
    "300 ms late": ("converged", ("disturbance.camera_latency_s=0.3",), FaultyRobot),
    "30 Hz, free-running, jitter": (
        "converged",
        ("disturbance.frame_rate_hz=30", "disturbance.frame_offset_s=0.016", "disturbance.jitter_s=0.008"),
        FaultyRobot,
    ),
    "ticks": ("converged", (TICKS,), FaultyRobot),
    "set-points in ticks": ("converged", (TICKS, "disturbance.quantize_setpoints=true"), FaultyRobot),
    "lag 150 ms": ("converged", ("disturbance.servo_time_constant_s=0.15",), FaultyRobot),
    "sag 0.5 deg": ("converged", ("disturbance.gravity_sag_deg=0.5",), FaultyRobot),
    "flex 0.02 deg": ("converged", ("disturbance.link_deflection_deg=0.02",), FaultyRobot),
    "flex 0.5 deg": (
        "converged|link flexes|links flex",
        ("disturbance.link_deflection_deg=0.5",),
        FaultyRobot,
    ),
    "play 0.5 deg": ("converged|backlash", ("disturbance.backlash_deg=0.5",), FaultyRobot),
    "joint struck by 3 deg": (
        "converged",
        (f"disturbance.joint_moved={{at_step: {AT}, joint: 2, by_deg: 3}}",),
        FaultyRobot,
    ),
    "markers lost for 10 periods": (
        "converged",
        (f"disturbance.lost_markers={{from_step: {AT}, steps: 10}}",),
        FaultyRobot,
    ),
    "markers lost for ever": (
        "markers lost",
        (f"disturbance.lost_markers={{from_step: {AT}}}",),
        FaultyRobot,
    ),
    "joint slipped by 3 deg": (
        "joint 2 slipped",
        (f"disturbance.joint_moved={{at_step: {AT}, joint: 2, by_deg: 3, encoder_slip: true}}",),
        FaultyRobot,
    ),
    "reading frozen": (
        "the reading of joint [0-9] stands still",
        (f"disturbance.stuck_encoder={{joint: 1, from_step: {AT}}}",),
        FaultyRobot,
    ),
    "left camera moved by 2 px": (
        "left camera",
        (f"disturbance.camera_moved={{at_step: {AT}, view: left, by_px: [2, 1]}}",),
        FaultyRobot,
    ),
    "marker moved by 5 mm": (
        "marker 1 moved",
        (f"disturbance.marker_moved={{at_step: {AT}, marker: 1, by_m: [0.004, -0.003, 0]}}",),
        FaultyRobot,
    ),
    "images later by 0.2 s": ("later than was taken|converged", (), Delayed),
    "joint blocked": ("joint 1 .*look whether it is blocked", (), Blocked),
    "protective stop": ("protective stop", (), Protected),
    "camera hangs": ("left image has stood still", (), Hung),
}


def driven(job):
    """Runs of an arm with a fault."""
    arm, fault, count = job
    expected, keys, robot = FAULTS[fault]
    # Late by a millisecond at least, so that the robot is driven by the contract.
    config = configured(arm, *NOISE, *GUIDED, "disturbance.camera_latency_s=0.001", *keys)
    told = {"arm": arm, "fault": fault, "expected": expected}
    try:
        calibration = calibrate.run(config)[1]
    except WorkFailed as error:
        return [told | {"verdict": "no calibration", "reason": str(error), "right": False}]
    rows = []
    for seed in list(SEEDS)[:count]:
        mine = task_config(config, arm, seed)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("projservo_cli.simulation.faults.FaultyRobot", robot)
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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--tasks", type=int, default=5, help="of each arm and fault")
    parser.add_argument("-o", "--output", type=Path, default=Path("verdicts_study.csv"), help="every run")
    given = parser.parse_args()
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
