"""Settings of a robot: its joints and their limits, and its servos."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.detections import per_rad
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.records import Calibration, FloatArray, InputError, JointLimits
from projservo_cli.robots.contract import Bounds


class SpeedLimits(NamedTuple):
    """Speed and acceleration limits of joints: per s and per s², rad (revolute) and m (prismatic)."""

    revolute: float = math.inf
    prismatic: float = math.inf
    turning: float = math.inf  # acceleration
    sliding: float = math.inf


class Joints(NamedTuple):
    """Knowledge of the joints of a robot."""

    types: str  # one letter a joint, R or P
    limits: JointLimits  # infinite where none is set; accelerations of the profile joint_space alone
    units: tuple[str, ...]  # in which messages give readings: deg, rad or m

    def length_of(self, degrees: float) -> FloatArray:
        """An angle as (n,) rad, for prismatic joints the length, m, that makes as much of a difference."""
        return math.radians(degrees) * per_rad(np.array([*self.types]) == "P")

    def limit_passed(self, q: FloatArray) -> Finding | None:
        """Return which of the readings (n,), rad or m, lies beyond its limits; None if none does."""
        return limit_passed(q, self.limits, self.types)


def limit_passed(q: FloatArray, limits: JointLimits, types: str) -> Finding | None:
    """Return which of the readings (n,), rad or m, lies beyond its limits; None if none does."""
    for i in np.flatnonzero((q < limits.lower) | (q > limits.upper)).tolist():
        unit, joint = "m" if types[i] == "P" else "rad", Subject(joints=(i + 1,))
        ends = (Finding("range", amount=limits.lower[i], limit=limits.upper[i], unit=unit),)
        return Finding("limit_passed", REFUSES, joint, q[i], unit=unit, others=ends)
    return None


class JointSettings(NamedTuple):
    """Joints as far as they are configured; data give the rest."""

    types: str  # one letter a joint, R or P; empty where only a table gives them
    ranges: tuple[tuple[float, float], ...] | None  # lowest and highest readings; None for no limits
    in_degrees: bool  # whether those of revolute joints are in degrees
    widened: float | None  # the limits are what joints cover in the data, widened by this share of it
    unit: str  # in which somebody gave readings of revolute joints, deg or rad
    known: int  # of how many joints readings were given; 0 where nobody did
    speeds: SpeedLimits = SpeedLimits()

    def joints(self, default_types: str = "", calibration: Calibration | None = None) -> Joints:
        """Joints of the robot; of ``default_types``, else revolute ones, where their types are unknown.

        calibration : whose data give limits where they are taken from there; without, none are.
        """
        types, pace = self.types or default_types or "R" * self.known, self.speeds
        lower, upper = self._limits(types, calibration)
        slides = [kind == "P" for kind in types]
        speed = np.where(slides, pace.prismatic, pace.revolute)
        acceleration = np.where(slides, pace.sliding, pace.turning)
        units = tuple("m" if kind == "P" else self.unit for kind in types)
        return Joints(types, JointLimits(lower, upper, speed, acceleration), units)

    def _limits(self, types: str, calibration: Calibration | None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limits (n,), rad or m; infinite where unknown."""
        if self.widened is not None and calibration is not None:
            share, span = self.widened, calibration.excitation
            return calibration.joint_min - share * span, calibration.joint_min + (1.0 + share) * span
        pairs = self.ranges or ((-math.inf, math.inf),) * len(types)
        if len(pairs) != len(types):
            raise InputError(f"robot.limits.joints: give a pair for each of {len(types)} joints")
        turn = math.radians if self.in_degrees else float
        rows = [
            [turn(x) if kind == "R" else float(x) for x in pair]
            for pair, kind in zip(pairs, types, strict=True)
        ]
        lower, upper = np.array(rows, dtype=np.float64).reshape(-1, 2).T.copy()
        return lower, upper


class Following(NamedTuple):
    """Pace of commands to a robot of the contract, and limits of its servos."""

    period: float  # of commands, s
    speed_scale: float  # factor of every command
    max_servo_lag_s: float  # by how much joints may lag behind their set-points
    max_steady_state_error_deg: float  # how far a joint at rest may stay from its set-point
    # How far a set-point may lead the reading; None for what lag and sag ask for.
    max_relative_target_deg: float | None

    def bounds(self, joints: Joints) -> Bounds:
        """Return the bounds of commands, and limits of the servos."""
        speed, sag = joints.limits.speed * self.speed_scale, joints.length_of(self.max_steady_state_error_deg)
        lead = speed * (self.max_servo_lag_s + self.period) + sag
        if self.max_relative_target_deg is not None:
            lead = joints.length_of(self.max_relative_target_deg)
        limits = joints.limits._replace(speed=speed)
        return Bounds(limits, lead, self.period, self.max_servo_lag_s, sag, joints.units)
