"""Degenerate and adverse tasks of the paper's arm, each run by the direct laws: what becomes of them.

Goals are given in the frame of the tool at the start, whose z axis is the normal of the face.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.records import Calibration, Trace, WorkFailed
from projservo_cli.robots.truth import rotation_about_axis
from projservo_cli.stages import Progress, plan, servo, silent

if TYPE_CHECKING:
    from projservo_cli.config import Config

# Limits would only make tasks unreachable; one case of its own is about them.
UNLIMITED = tuple(f"robot.dh.joints.{i}.limits_deg=[-360, 360]" for i in range(6))
LAWS = ("exact", "direct_two", "direct_three")
# Centre of the face and a point beside it, in the frame of the tool, m.
CENTER = (0.0, 0.0, 0.05)
BESIDE = (0.06, 0.0, 0.05)
NORMAL = (0.0, 0.0, 1.0)
TILTED = (math.sin(math.radians(15.0)), 0.0, math.cos(math.radians(15.0)))


@dataclass(frozen=True)
class Case:
    """A task and what befalls it, as what it sets in the configuration."""

    name: str
    sets: tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """What became of a case: a trace of each law, or why the task was refused before any motion."""

    case: Case
    traces: dict[str, Trace]
    refused: str = ""


def turn(angle_deg: float) -> tuple[str, ...]:
    """Goal turned about the roll axis of the rig."""
    return (f"task.goal={{turn_deg: {angle_deg}}}",)


def displaced(
    angle_deg: float,
    axis: Sequence[float] = NORMAL,
    point: Sequence[float] = CENTER,
    shift: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[str, ...]:
    """Goal turned about an axis through a point, then shifted, m, all in the frame of the tool."""
    angle = math.radians(angle_deg)
    T = rotation_about_axis(np.array(point), np.array(axis), angle)
    translation = (T[:3, 3] + np.array(shift)).tolist()
    rotation = [angle * a for a in axis]
    where = f"{{translation_m: {translation}, rotation_rad: {rotation}}}"
    return (f"task.goal={{turn_deg: 0, perturbation: {where}}}",)


def lost(steps: str) -> tuple[str, ...]:
    """All markers lost from the tenth step on."""
    return (*turn(180), f"disturbance.lost_markers={{from_step: 10, steps: {steps}}}")


def frozen(steps: str) -> tuple[str, ...]:
    """Reading of the fourth joint frozen from the tenth step on."""
    return (*turn(180), f"disturbance.frozen_joint={{joint: 4, from_step: 10, steps: {steps}}}")


# A place where the last three joints reach the face with the wrist stretched, and both sides of it.
WRIST = "{{joints: [10, -40, 130, 0, {}, 20], unit: deg}}"

CASES = (
    Case("start equal to goal", turn(0)),
    *(Case(f"turn of {angle} deg about the roll axis", turn(angle)) for angle in (90, 170, 179.9, 180)),
    *(
        Case(f"turn of {angle} deg about a tilted axis", displaced(angle, TILTED, BESIDE))
        for angle in (90, 170, 179.9, 180)
    ),
    Case("faces parallel", displaced(60, shift=(0.05, -0.03, -0.08))),
    Case("faces coplanar", displaced(60, shift=(-0.05, 0.03, 0.0))),
    Case("faces opposite", displaced(180, (0.0, 1.0, 0.0), shift=(0.0, 0.0, -0.3))),
    Case("zero translation", displaced(60, TILTED)),
    Case("pure translation", displaced(0, shift=(0.06, -0.04, -0.08))),
    Case(
        "across the wrist singularity",
        (
            f"task.start={WRIST.format(-25)}",
            f"task.goal={{joints: {WRIST.format(25)}}}",
        ),
    ),
    Case("noise of 1 px", (*turn(180), "noise.servo_px=1.0")),
    Case("markers lost for 1 step", lost("1")),
    Case("markers lost for 20 steps", lost("20")),
    Case("markers lost for ever", lost("null")),
    Case(
        "a joint limit in the way",
        (*turn(90), "robot.dh.joints.3.limits_deg=[20, 400]", "plant.joint_limits=stop"),
    ),
    Case("bump of 3 deg", (*turn(180), "disturbance.bump={at_step: 10, joint: 2, by_deg: 3}")),
    Case("slip of 3 deg", (*turn(180), "disturbance.bump={at_step: 10, joint: 2, by_deg: 3, read: false}")),
    Case("reading frozen for 20 steps", frozen("20")),
    Case("reading frozen for ever", frozen("null")),
    *(Case(f"images {n} periods late", (*turn(180), f"disturbance.delay_periods={n}")) for n in (1, 2, 3)),
)


def run_cases(
    configs: Sequence[tuple[Case, "Config"]], calibration: Calibration, progress: Progress = silent
) -> list[Row]:
    """Run every case with every law; a task that is refused is a row that says why."""
    rows = []
    for done, (case, config) in enumerate(configs):
        progress("cases", done, len(configs))
        rows.append(_row(case, config, calibration))
    progress("cases", len(configs), len(configs))
    return rows


def _row(case: Case, config: "Config", calibration: Calibration) -> Row:
    try:
        planned = plan.run(config, calibration)
        return Row(case, {law: servo.run(config, calibration, planned, law) for law in LAWS})
    except WorkFailed as error:
        return Row(case, {}, " ".join(str(error).split()))
