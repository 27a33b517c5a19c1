"""One period of the loop without the law: limits, counting, verdict.

Of several verdicts at one instant ``verdict_at`` gives the first of ``behind camera``, ``out of view``,
``markers lost``, ``converged``, ``diverged``, ``singular``, ``no progress`` or ``max steps``, and ``joint
limit``; ``loop.python_loop`` states the rules before and after it, ``messages.verdict_causes`` their causes.
A command that would pass a limit is shortened to end there.

While markers are lost the robot is held where it is for up to ``max_lost_periods`` periods in a row; the run
goes on when they are seen again.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.control.law import LOST, SINGULAR, limit_speed
from projservo_cli.geometry.jit import merged
from projservo_cli.geometry.kinematics import beyond_limits, from_border
from projservo_cli.messages.verdict_causes import VERDICTS
from projservo_cli.records import VIEWS, FloatArray, IntArray
from projservo_cli.simulation.analytic_plant import Plant

RUNNING = -1
WAITING = -3  # for lost markers; no verdict of a run
VERDICT_NAMES = tuple(VERDICTS)
BEHIND_CAMERA = VERDICT_NAMES.index("behind camera")
OUT_OF_VIEW = VERDICT_NAMES.index("out of view")
MARKERS_LOST = VERDICT_NAMES.index("markers lost")
CONVERGED = VERDICT_NAMES.index("converged")
DIVERGED = VERDICT_NAMES.index("diverged")
SINGULAR_VERDICT = VERDICT_NAMES.index("singular")
NO_PROGRESS = VERDICT_NAMES.index("no progress")
MAX_STEPS = VERDICT_NAMES.index("max steps")
JOINT_LIMIT = VERDICT_NAMES.index("joint limit")
FAULT_DETECTED = VERDICT_NAMES.index("fault detected")
FAILED = VERDICT_NAMES.index("failed")
FOLLOWING_ERROR = VERDICT_NAMES.index("following error")
OBJECT_MOVED = VERDICT_NAMES.index("object moved")
INTERRUPTED = VERDICT_NAMES.index("interrupted")
FOLLOWED = VERDICT_NAMES.index("followed")
LOST_GOAL = VERDICT_NAMES.index("lost goal")
OUT_OF_REACH = VERDICT_NAMES.index("out of reach")
TOO_FAST = VERDICT_NAMES.index("too fast")
PLATEAU_FALL = 0.01
# Joint steps below this, rad or m, are none.
_NO_MOTION = 1e-6
# A step ends this share of it before a limit, lest rounding take it beyond.
_ROUND_OFF = 1e-12


class Limits(NamedTuple):
    """End conditions of a run, and bounds of its commands."""

    speed: FloatArray  # (n,) most joint motion per second, rad/s or m/s; infinite for none
    image_error_px: float  # image error that counts as converged, px rms per marker and view
    diverged_factor: float  # growth of error or distance that counts as diverged
    stall_periods: int  # window of the plateau test
    max_steps: int  # most commands
    stop_at_joint_limit: bool
    stop_at_border: bool  # stop_at_joint_limit, stop_at_border: end the run, or only record
    max_lost_periods: int = 0  # maximum consecutive periods with lost markers
    noise_px: float = 0.0  # how much of ``image_error_px`` allows for noise


class Log(NamedTuple):
    """Log of a run; one row more than commands."""

    q: FloatArray  # (k, n) true joints, rad or m
    read: FloatArray  # (k, n) joint readings, the input of the law
    H: FloatArray  # (k, 4, 4) true displacement of the face from the reference
    s: FloatArray  # (k, V, m, 2) measured pixels of the face and, after them, of the pins
    hidden: FloatArray  # (k, V) 1 if a view is self-occluded
    error: FloatArray  # (k,) image error of the face as it is seen, px rms per marker and view
    # (k,) image error by which the run ends: of the body if it is measured, otherwise as seen
    judged: FloatArray
    errors: FloatArray  # (k, 5) control errors of the law
    q_dot: FloatArray  # (k, n) commanded joint velocities after the limit; zero if none was sent
    factor: FloatArray  # (k,) factor of the joint-speed limit
    path: FloatArray  # (k, parts + 1, n) joints at the ends of the parts of each step
    parts: IntArray  # (k,) parts each step was sent in; 0 if the joints went straight to the end
    fit: FloatArray  # (k, 3) residuals of measuring with the body, as in the state of the law
    # (3,) first instant outside an image, first beyond a joint limit, and the joint that passed one or
    # stopped the run at its own; −1 for never
    events: FloatArray
    # (3,) distance of the face from the rig, m, at first, the first image error, and the periods that markers
    # have been waited for
    begun: FloatArray
    M: FloatArray
    scratch: FloatArray  # M, scratch: (m, 4) and (3, n), at least (3, 2), workspaces of the simulated robot


def new_log(n: int, m: int, max_steps: int, errors: int, parts: int = 0, views: int = len(VIEWS)) -> Log:
    """Empty log for n joints, m markers in V views, at most ``max_steps`` commands of some parts."""
    rows = max_steps + 1
    return Log(
        q=np.zeros((rows, n)),
        read=np.zeros((rows, n)),
        H=np.zeros((rows, 4, 4)),
        s=np.zeros((rows, views, m, 2)),
        hidden=np.zeros((rows, views)),
        error=np.zeros(rows),
        judged=np.zeros(rows),
        errors=np.full((rows, errors), np.nan),
        q_dot=np.zeros((rows, n)),
        factor=np.ones(rows),
        path=np.zeros((rows, parts + 1, n)),
        parts=np.zeros(rows, dtype=np.int64),
        fit=np.full((rows, 3), np.nan),
        events=np.full(3, -1.0),
        begun=np.zeros(3),
        M=np.zeros((m, 4)),
        scratch=np.zeros((3, max(n, 2))),
    )


@merged
def note(log: Log, k: int, s_star: FloatArray, plant: Plant, limits: Limits) -> bool:
    """Log the images and readings of an instant; whether a face marker left an image."""
    left = _outside(log.s[k], s_star.shape[1], plant)
    if left and log.events[0] < 0.0:
        log.events[0] = k
    joint = beyond_limits(plant.limits, log.read[k], 0.0)
    if joint >= 0 and log.events[1] < 0.0 and not limits.stop_at_joint_limit:
        log.events[1] = k
        log.events[2] = joint
    log.error[k] = _image_error(log.s[k], s_star)
    log.judged[k] = log.error[k]
    return left


@merged
def _image_error(s: FloatArray, s_star: FloatArray) -> float:
    """Root mean square of the Euclidean pixel error over the markers and views of the face seen.

    NaN if none is. Further markers in ``s`` do not count.
    """
    total = 0.0
    count = 0
    for view in range(s_star.shape[0]):
        for k in range(s_star.shape[1]):
            du = s[view, k, 0] - s_star[view, k, 0]
            dv = s[view, k, 1] - s_star[view, k, 1]
            if math.isfinite(du) and math.isfinite(dv):
                total += du * du + dv * dv
                count += 1
    return math.sqrt(total / count) if count > 0 else math.nan


@merged
def _outside(s: FloatArray, m: int, plant: Plant) -> bool:
    """Whether one of the first m markers was seen outside, in more images than may be left out."""
    left_out = 0
    for view in range(s.shape[0]):
        outside = False
        for k in range(m):
            u, v = s[view, k, 0], s[view, k, 1]
            if math.isfinite(u + v) and from_border(plant.image_size[view], u, v) < 0.0:
                outside = True
        left_out += outside
    return bool(left_out > s.shape[0] - plant.min_views)


class Instant(NamedTuple):
    """Inputs of a verdict in addition to a row of the log, before its command."""

    in_front: bool  # whether enough cameras have every face marker before them; the law is asked only then
    left: bool  # whether a face marker lies outside an image
    distance: float  # distance of the face from the rig, m
    status: int  # status of the law
    q_dot: FloatArray  # (n,) the command, rad/s or m/s
    noise_ratio: float = 1.0  # stated noise of pixels over the noise of the run; at least 1


@merged
def verdict_at(log: Log, k: int, now: Instant, limits: Limits) -> int:
    """Verdict of an instant in the order the module states; ``RUNNING`` for none, ``WAITING`` to hold."""
    if k == 0:
        log.begun[0], log.begun[1], log.begun[2] = now.distance, math.nan, 0.0
    if math.isnan(log.begun[1]):
        log.begun[1] = log.judged[k]
    verdict = _first_cause(log, k, now, limits)
    if verdict == MARKERS_LOST and log.begun[2] < limits.max_lost_periods and k < limits.max_steps:
        log.begun[2] += 1.0
        return WAITING
    log.begun[2] = 0.0
    if verdict == RUNNING and k == limits.max_steps:
        return NO_PROGRESS if on_plateau(log.judged, k, limits.stall_periods) else MAX_STEPS
    return verdict


@merged
def _first_cause(log: Log, k: int, now: Instant, limits: Limits) -> int:
    """The first verdict that an instant gives cause for, as long as steps are left."""
    error = log.judged[k]
    if not now.in_front:
        return BEHIND_CAMERA
    if now.left and limits.stop_at_border:
        return OUT_OF_VIEW
    if now.status == LOST:
        return MARKERS_LOST
    if error <= tolerance(limits, log.fit[k, 2], now.noise_ratio):
        return CONVERGED
    grown = error > limits.diverged_factor * log.begun[1]
    receded = now.distance > limits.diverged_factor * log.begun[0]
    if grown or receded or not _finite(now.q_dot):
        return DIVERGED
    if now.status == SINGULAR:
        return SINGULAR_VERDICT
    return RUNNING


@merged
def tolerance(limits: Limits, views: float, noise_ratio: float) -> float:
    """Image error that counts as converged, px rms per marker and view.

    A body fitted by six coordinates to N markers, counted once per view, keeps √(6 / (2 views)) of
    the noise of their pixels; all of it stays if the face is measured point by point, for NaN.
    noise_ratio : stated noise of pixels over the noise of the run.
    """
    fitted = max(0.0, 1.0 - math.sqrt(3.0 / views)) if views > 0.0 else 0.0
    more = (noise_ratio - 1.0) * (1.0 - fitted)
    return float(limits.image_error_px - limits.noise_px * (fitted - more))


@merged
def _finite(q_dot: FloatArray) -> bool:
    """Whether every entry is a finite number."""
    for i in range(q_dot.shape[0]):
        if not math.isfinite(q_dot[i]):
            return False
    return True


@merged
def on_plateau(errors: FloatArray, k: int, window: int) -> bool:
    """Whether the image error fell by less than 1 % over the last ``window`` steps."""
    return bool(k >= window and errors[k] > (1.0 - PLATEAU_FALL) * errors[k - window])


def plateau_stretches(errors: FloatArray, window: int) -> IntArray:
    """First and last instants (k, 2) of the stretches in which the plateau test holds from its window on.

    errors : (k,) errors that a run is judged by, px; window : of the test, steps.
    """
    flat = errors[window:] > (1.0 - PLATEAU_FALL) * errors[:-window]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flat, [False]])))
    return np.asarray(edges.reshape(-1, 2) + np.array([0, window - 1]))


def plateau_stretch(errors: FloatArray, window: int) -> tuple[int, int] | None:
    """First and last instant of the longest of these stretches; None without any."""
    each = plateau_stretches(errors, window)
    if not len(each):
        return None
    first, last = each[np.argmax(each[:, 1] - each[:, 0])].tolist()
    return first, last


class Command(NamedTuple):
    """Command of a law in a period."""

    q_dot: FloatArray  # (n,) joint velocity, rad/s or m/s; bounded in place
    share: float  # fraction of the amplitude within the law's own joint-speed limit, negative without one
    blocked: int  # joint at whose limit the law ended its step, or −1
    period: float  # control period, s
    scale: float  # factor of every command


@merged
def bounded(log: Log, k: int, asked: Command, plant: Plant, limits: Limits) -> int:
    """Bound a command; its joint step (n,), rad or m, goes to the first row of ``log.scratch``.

    Returns ``JOINT_LIMIT`` if no motion is left, otherwise ``RUNNING``.
    """
    q_dot = asked.q_dot
    dq = log.scratch[0, : q_dot.shape[0]]
    log.factor[k] = limit_speed(q_dot, limits.speed)
    if asked.share >= 0.0:
        log.factor[k] *= asked.share
    for i in range(q_dot.shape[0]):
        q_dot[i] *= asked.scale
        dq[i] = q_dot[i] * asked.period
    if limits.stop_at_joint_limit:
        joint = _shorten(log.read[k], dq, plant.limits.lower, plant.limits.upper)
        if joint >= 0:
            for i in range(q_dot.shape[0]):
                q_dot[i] = dq[i] / asked.period
        joint = max(joint, asked.blocked)
        if joint >= 0 and _stands_still(dq):
            log.events[2] = joint
            return JOINT_LIMIT
    for i in range(q_dot.shape[0]):
        log.q_dot[k, i] = q_dot[i]
    return RUNNING


@merged
def _shorten(q: FloatArray, dq: FloatArray, lower: FloatArray, upper: FloatArray) -> int:
    """Scale a joint step so that it ends where the first joint meets its limit; that joint, or −1.

    A joint already beyond its limit may return, but go no farther.
    """
    share = 1.0
    joint = -1
    for i in range(q.shape[0]):
        room = max(0.0, (upper[i] if dq[i] > 0.0 else -lower[i]) - (q[i] if dq[i] > 0.0 else -q[i]))
        if abs(dq[i]) * share > room:
            share = room / abs(dq[i]) * (1.0 - _ROUND_OFF)
            joint = i
    if joint >= 0:
        for i in range(q.shape[0]):
            dq[i] *= share
    return joint


@merged
def _stands_still(dq: FloatArray) -> bool:
    """Whether a joint step is too short to count as motion."""
    for i in range(dq.shape[0]):
        if abs(dq[i]) > _NO_MOTION:
            return False
    return True
