"""The goal of a run that an object carries while a law runs: made, and its history."""

import math
from collections.abc import Callable

import numpy as np

from projservo_cli.laws import BODY_LAWS, INCIDENCES
from projservo_cli.loop.goal_monitor import FollowedGoal, FollowLimits, GoalMonitor
from projservo_cli.records import MM, FloatArray, FollowedErrors, GoalHistory, InputError, Plan
from projservo_cli.robots.latency_compensation import Tracked
from projservo_cli.robots.session import Session
from projservo_cli.stages.carried_goals import in_metres, known, observations_of, taught_goal
from projservo_cli.stages.scenario import RunScenario
from projservo_cli.task.objects.moving_goal import MovingGoal
from projservo_cli.task.objects.object_tracker import ObjectTracker
from projservo_cli.task.target import TaskImages

_NONE = np.full(3, np.nan)
_POSE = 6  # joints that a whole pose needs wherever its object takes it


def followed_goal(
    scenario: RunScenario, law: str, images: Callable[[], TaskImages], plan: Plan | None, session: Session
) -> FollowedGoal | None:
    """Return the goal of a law that its object carries while it runs; None for a goal that stays.

    It stays once the tool has taken the object in the session. A retreat from an object that is followed goes
    along with it.

    images : start and goal as the law measures them.

    Raises InputError for a law that does not measure with the calibrated body, or that needs more joints.
    """
    inputs, displaced = scenario.world.inputs, scenario.world.inputs.displaced
    if session.followed is not None and session.robot is not None and displaced and displaced.of_start:
        left: FollowedGoal = session.followed.goal
        return left.retreat(images(), session.robot.now())
    if plan is None or not plan.carried or not inputs.carriers[0].settings.follow:
        return None
    if inputs.carriers[0].name in session.held.values():
        return None
    if law not in BODY_LAWS or not len(scenario.world.body.M):
        laws = ", ".join(BODY_LAWS)
        raise InputError(
            f"{law} cannot follow objects.{inputs.carriers[0].name}: a goal that moves needs a law that "
            f"measures with the body: {laws}, and a calibration that is usable"
        )
    (carried,), carrier, c = plan.carried, inputs.carriers[0], scenario.world.calibration
    contract, asked = scenario.servo.required_contract, carrier.settings
    numbers = carried.object_marker.tolist()
    if contract.time_offset_s is None and c.time_offset is None:
        raise InputError(
            f"objects.{carrier.name}.follow: the latency of the cameras is not known, and the object moves "
            "meanwhile: calibrate from images of a moving arm (projservo record), or set plant.time_offset_s"
        )
    whole = not scenario.exact.goal.incidences
    if not whole and law != INCIDENCES and len(c.q_reference) < _POSE:
        raise InputError(
            f"{law} takes the whole pose of the plan along with objects.{carrier.name}, for which "
            f"{len(c.q_reference)} joints are too few: {INCIDENCES} leaves open what the goal leaves open"
        )
    metric = in_metres(c, carrier.lengths)[0]
    tracker = ObjectTracker.of(
        c,
        numbers,
        observations_of(carried),
        metric=metric,
        acceleration=asked.acceleration,
        max_acceleration=asked.max_acceleration,
        name=carrier.name,
    )
    D, taught = tracker.planned.D, taught_goal(scenario)
    goal = MovingGoal(images(), scenario.world.model, tracker, whole, D, taught)
    max_speed = math.inf if asked.max_speed_mm_s is None else asked.max_speed_mm_s
    limits = FollowLimits(
        seconds=scenario.servo.stop.follow_s,
        max_speed=max_speed,
        lost_s=asked.lost_s,
        approach_mm=asked.approach_mm,
        replans=scenario.servo.laws.max_replan_attempts,
    )
    indices = [contract.driven.further.index(number) for number in numbers]
    tracked = Tracked(carried.object_name, indices, tracker)
    return FollowedGoal(goal, limits, tracked, scenario.world.true_motion)


def _errors_of(monitor: GoalMonitor) -> FollowedErrors:
    """Return how well a goal was followed from its arrival on."""
    since, carried = monitor.followed, monitor.carried
    left = np.array([one.error for one in since]).reshape(-1, 3)
    rms, maximum, speed = _NONE, math.nan, math.nan
    if since:
        rms, maximum = np.sqrt(np.nanmean(left**2, axis=0)), float(np.max(left[np.isfinite(left[:, 0]), 1]))
        speed = float(np.mean([one.speed for one in since])) if math.isfinite(maximum) else math.nan
    px, mm, deg, max_mm, mm_s = map(known, (*rms, maximum, speed))
    return FollowedErrors(
        followed_rms_px=px,
        followed_rms_mm=mm,
        followed_max_mm=max_mm,
        followed_rms_deg=deg,
        followed_seconds=since[-1].t - since[0].t if since else 0.0,
        followed_speed_mm_s=mm_s,
        followed_deviation_mm=known(math.nan if carried is None else carried.position_mm),
        followed_deviation_deg=known(math.nan if carried is None else carried.rotation_deg),
        followed_motion=monitor.motion,
    )


def history_of(monitor: GoalMonitor, goal: FloatArray, times: int) -> GoalHistory:
    """Return the history of a goal at some times of a run.

    goal : (4,) its true centre when the motion was planned, m.
    """
    rows = monitor.periods
    rows = [*rows, *[rows[-1]._replace(error=(math.nan,) * 3)] * (times - len(rows))]
    t = np.array([one.t for one in rows])
    errors = np.array([one.error for one in rows]).reshape(-1, 3)
    T, middle = monitor.true_motion(t)
    seconds = np.maximum(np.diff(t, prepend=t[0]), 1e-9)
    steps = np.linalg.norm(np.diff((T @ middle)[:, :3], axis=0, prepend=np.nan), axis=1)
    return GoalHistory(
        followed=_errors_of(monitor),
        goal_time=t,
        goal_error_px=errors[:, 0],
        goal_error_mm=errors[:, 1],
        goal_error_deg=errors[:, 2],
        goal_sigma_px=np.array([one.sigma_px for one in rows]),
        goal_s=np.array([one.s_star for one in rows]),
        goal_displacement=np.array([one.D for one in rows]),
        goal_speed=np.array([one.speed for one in rows]),
        goal_unseen_s=np.array([one.unseen_s for one in rows]),
        goal_center=(T @ goal)[:, :3],
        goal_true_speed=MM * steps / seconds,
    )
