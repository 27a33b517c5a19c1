"""Objects that a goal was taught on: located again, and the goal carried along."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from projservo_cli import messages
from projservo_cli.calibration.prediction import error_factor_with_model
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.metric.frame import Metric, Scale
from projservo_cli.records import Calibration, CarriedByObject, FloatArray, InputError, Plan, WorkFailed
from projservo_cli.robots.session import Session
from projservo_cli.stages.scenario import Scenario
from projservo_cli.stages.stage_inputs import CarryingObject, KnownLengths
from projservo_cli.task.objects.displaced_object import DisplacedObject
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView, UncertainPoints


def in_metres(calibration: Calibration, known: KnownLengths) -> tuple[Metric | None, str]:
    """A calibration in metres by the longest known length, or why there is none."""
    at = np.flatnonzero(np.isin(known.numbers, calibration.marker))
    apart = np.nan_to_num(known.apart[np.ix_(at, at)], nan=0.0)
    length_m: float | None = None
    between: Scale = "joint"
    if calibration.flange_chart is not None:
        pass  # its poses are in metres
    elif known.tag_size_m is not None:
        length_m, between = known.tag_size_m, "tags"
    elif apart.any():
        i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
        length_m, between = float(apart[i, j]), (known.numbers[at[i]], known.numbers[at[j]])
    elif not calibration.prismatic.any():
        keys = "markers.positions_m, markers.tag_size_m or markers.board.size_m"
        return None, f"no length on the tool is known: set {keys}"
    face = [number for number in known.face if number in calibration.marker]
    try:
        factor = error_factor_with_model(calibration)
        return Metric.of(calibration, factor, length_m=length_m, between=between, face=face or None), ""
    except (InputError, WorkFailed) as error:
        return None, str(error)


def carried_by(
    scenario: Scenario, carriers: Sequence[CarryingObject], before: Plan | None, session: Session | None
) -> tuple[CarriedByObject, ...]:
    """Locate objects again, and carry the goal along with each.

    before : plan to the same goal from elsewhere, for which they were looked at; None to look now.
    session : connection to the robot that looks; None to open one.
    Raises WorkFailed where images do not show an object or the goal well enough.
    """
    if before is not None and before.carried:
        return before.carried
    return tuple(_carried(scenario, carrier, session) for carrier in carriers)


def _carried(scenario: Scenario, carrier: CarryingObject, session: Session | None) -> CarriedByObject:
    """Locate an object again, and carry the goal along with it; arguments as above."""
    c = scenario.world.calibration
    metric, _ = in_metres(c, carrier.lengths)
    taught, now = scenario.world.observe_object(carrier, session, scenario.exact, scenario.q_taught)
    try:
        found = DisplacedObject.of(c, carrier.numbers, [taught, now], metric)
        goal = found.carry(taught_goal(scenario))
    except WorkFailed as error:
        raise messages.failed(error.findings, stage=f"objects.{carrier.name}") from error
    rigid, limits = found.coordinates == 6, carrier.objects
    carried = CarriedByObject(
        object_name=carrier.name,
        object_shift_mm=known(found.shift_mm),
        object_angle_deg=known(found.angle_deg),
        object_shift_px=found.shift_px,
        goal_deviation_mm=known(goal.position_mm),
        goal_deviation_deg=goal.rotation_deg if rigid else None,
        goal_deviation_px=goal.rms_px,
        object_marker=np.array(carrier.numbers, dtype=np.int64),
        object_left_out=", ".join(map(str, found.left_out)) or None,
        s_object=now.s,
        s_object_taught=taught.s,
        sigma_object_taught=taught.sigma,
        sigma_object=now.sigma,
        s_carried=np.ascontiguousarray(goal.s[:, c.indices_of(scenario.world.numbers)]),
        M_object=_in_body(found, goal.H, carrier.numbers),
    )
    # One that is followed is found again while it moves.
    for unit in () if carrier.settings.follow else ("mm", "px"):
        key, at = f"max_goal_deviation_{unit}", getattr(carried, f"goal_deviation_{unit}")
        if at is not None and at > (most := getattr(limits, key)):
            per, of = {"mm": (1e-3, "m")}.get(unit, (1.0, unit)), Subject(name=key)
            inexact = Finding("carried_inexact", REFUSES, of, per[0] * at, limit=per[0] * most, unit=per[1])
            raise messages.failed([inexact], stage=f"objects.{carrier.name}")
    return carried


@lru_cache(maxsize=8)  # the same for all laws of a plan
def markers_now(c: Calibration, carried: CarriedByObject) -> UncertainPoints:
    """Return the markers of an object of a plan where it is now."""
    numbers = carried.object_marker.tolist()
    return DisplacedObject.of(c, numbers, observations_of(carried)).markers(numbers)


def observations_of(carried: CarriedByObject) -> tuple[ObjectView, ObjectView]:
    """Return an object of a plan as it was seen when its goal was taught, and when it was planned."""
    taught = ObjectView(carried.s_object_taught, carried.sigma_object_taught)
    return taught, ObjectView(carried.s_object, carried.sigma_object)


def _in_body(found: DisplacedObject, H: FloatArray, numbers: Sequence[int]) -> FloatArray:
    """Markers (k, 4) of an object in the frame of the body, which the carried goal displaces by H (4, 4)."""
    M = np.full((len(numbers), 4), np.nan)
    M[[numbers.index(number) for number in found.marker]] = found.M @ (np.linalg.inv(H) @ found.D).T
    return M


def too_far(carried: CarriedByObject, carrier: CarryingObject) -> Finding | None:
    """Return the reason to check a carried goal before the robot goes there; None if there is none."""
    limits, subject = carrier.objects, Subject(name=carrier.name)
    for at, most, unit in (
        (carried.object_shift_mm and 1e-3 * carried.object_shift_mm, limits.max_displacement_m, "m"),
        (
            carried.object_angle_deg and math.radians(carried.object_angle_deg),
            math.radians(limits.max_rotation_deg),
            "rad",
        ),
    ):
        if at is not None and at > most:
            return Finding("object_far", REFUSES, subject, at, limit=most, unit=unit)
    return None


def known(number: float) -> float | None:
    """A number; None for NaN."""
    return None if math.isnan(number) else number


def taught_goal(scenario: Scenario) -> ObjectView:
    """Images of the markers of the calibration at the goal as it was taught, and their deviations."""
    c = scenario.world.calibration
    if (given := scenario.goal_pixels) is not None:
        return ObjectView(*given)
    s = np.full((len(c.view), len(c.marker), 2), np.nan)
    s[:, c.indices_of(scenario.world.numbers)] = scenario.world.averaged_images(
        scenario.exact, scenario.q_taught, scenario.world.inputs.seed
    ).s_star
    noise = scenario.world.inputs.noise.at_rest_px
    return ObjectView(s, np.full(s.shape[:2], noise) if noise > 0.0 else None)
