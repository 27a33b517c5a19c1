"""Small motions of one joint at a time, and findings of how joints, images and tags follow."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from projservo_cli.calibration.detections import per_rad
from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, Subject
from projservo_cli.messages.placeholders import quantity
from projservo_cli.records import CORNERS, VIEWS, BoolArray, FloatArray, IntArray
from projservo_cli.robots.contract import Reading
from projservo_cli.robots.pacing import Steered

# Angles are of revolute joints. Prismatic ones go the lengths that make as much of a difference to images.
# How far a joint goes to each side, and how fast: quick strokes show the latency, slow ones the hysteresis.
_REACH, _QUICK, _SLOW = math.radians(3.0), math.radians(20.0), math.radians(5.0)
# Minimum motion from one end to the other, rad, and distance kept from limits.
_LEAST_WAY, _KEPT = math.radians(2.0), math.radians(0.5)
# Pause after each stroke, s, and the part at its end in which all is at rest.
_PAUSE_S, _STILL_S = 0.6, 0.3
# Share of strokes that a joint must go, otherwise it is stuck: hysteresis takes much of the first one, and
# of those to the middle.
_HELD = {0: 0.1, 1: 0.4, 2: 0.4, 3: 0.4}
# Motion after a turn of direction within which backlash is passed, rad: at first, and if more shows.
_PASSING, _MAX_PASSING = math.radians(1.4), math.radians(2.6)
# Motion back that counts as a turn of direction, rad.
_TURN = math.radians(0.35)
# Latencies that are tried, s; for a parabola through the best one and its neighbours.
_LATENCIES = np.arange(-0.05, 0.7, 0.005)
# Motion of images over the whole way, px, below which none moves with the joint.
_MOVES_PX = 1.0
# Hysteresis or sag from which it is parts, and backlash that goals of images bear, rad.
_NOTABLE, _WIDE = math.radians(0.15), math.radians(1.5)
# Latency from which frames queue somewhere, s.
_MAX_LATENCY_S = 0.3
# Motion of one tag against the others, px, and in standard deviations, from which it is loose.
_LOOSE_PX, _LOOSE = 0.7, 4.0


class Strokes(NamedTuple):
    """Readings of a robot while one joint went to and fro."""

    joint: int  # from 0
    slides: bool  # whether it is prismatic
    end: IntArray  # (k,) number of the stroke of each reading
    target: FloatArray  # (k,) rad, as is q
    readings: tuple[Reading, ...]
    given_up: Finding | None = None  # why it was broken off

    @property
    def q(self) -> FloatArray:
        """Readings (k,) of the joint, rad; of a prismatic one angles that make as much of a difference."""
        return np.array([reading.q[self.joint] for reading in self.readings]) / _unit(self.slides)

    def rest(self, stroke: int) -> list[int]:
        """Indices of the readings at rest at the end of a stroke."""
        rows = np.flatnonzero(self.end == stroke)
        last = self.readings[rows[-1]].t_q
        return [int(k) for k in rows if self.readings[k].t_q > last - _STILL_S]


def _unit(slides: bool) -> float:
    """Motion of a joint, rad or m, that makes as much of a difference as one rad of a revolute one."""
    return float(per_rad(np.array(slides)))


def _name(slides: bool) -> str:
    """Unit of a joint."""
    return "m" if slides else "rad"


def reach_of(types: str) -> str:
    """Return how far joints of these types, R or P each, go to either side, in words."""
    turns, slides = quantity(_REACH, "rad"), quantity(_REACH * _unit(True), "m")
    if "P" not in types:
        return turns
    return f"{turns}, prismatic ones by {slides}," if "R" in types else slides


# Ends of the strokes, in reaches, and whether they are quick. The last three end in the middle from below, at
# the upper end, and in the middle from above.
_STROKES = (*((1, True), (-1, True)) * 3, (0, False), (1, False), (0, False))
_UP, _DOWN, _FROM_BELOW, _FROM_ABOVE = 4, 5, 6, 8


def strokes(steered: Steered, joint: int) -> Strokes | Finding:
    """Move a joint to and fro about its present position; a finding if it has no room for that.

    steered : the robot, one for all joints: each set-point that begins at a reading lets an arm sag further.
    """
    bounds = steered.robot.bounds
    q = steered.observe().q
    for _ in range(math.ceil(_PAUSE_S / bounds.period)):
        steered.hold()
    slides = [*bounds.units][joint : joint + 1] == ["m"]
    unit, subject = _unit(slides), Subject(joints=(joint + 1,))
    low = max(-_REACH * unit, bounds.limits.lower[joint] + _KEPT * unit - q[joint])
    high = min(_REACH * unit, bounds.limits.upper[joint] - _KEPT * unit - q[joint])
    if high - low < _LEAST_WAY * unit or not low < 0.0 < high:
        return Finding("joint_without_room", LIMITS, subject, _LEAST_WAY * unit, unit=_name(slides))
    middle = float(steered.target[joint])
    rows: list[tuple[int, float, Reading]] = []
    for number, (end, quick) in enumerate(_STROKES):
        goal = middle + (high if end > 0 else low if end < 0 else 0.0)
        speed = min((_QUICK if quick else _SLOW) * unit, float(bounds.limits.speed[joint]))
        begun, from_q = float(steered.target[joint]), float(steered.reading.q[joint])
        pauses = math.ceil(_PAUSE_S / bounds.period)
        while pauses > 0:
            step = np.zeros(len(q))
            left = goal - steered.target[joint]
            step[joint] = math.copysign(min(abs(left), speed * bounds.period), left)
            steered.command(step, bounds.period)
            pauses -= left == 0.0 or bool(steered.set_point.short[joint])
            rows.append((number, float(steered.target[joint]) / unit, steered.observe()))
        way, gone = abs(goal - begun), abs(float(steered.reading.q[joint]) - from_q)
        if number in _HELD and gone < _HELD[number] * way:
            stuck = Finding("held_joint", REFUSES, subject, gone, limit=way, unit=_name(slides))
            return Strokes(joint, slides, *_columns(rows), stuck)
    return Strokes(joint, slides, *_columns(rows))


def _columns(rows: Sequence[tuple[int, float, Reading]]) -> tuple[IntArray, FloatArray, tuple[Reading, ...]]:
    ends, targets, readings = zip(*rows, strict=True)
    return np.array(ends, dtype=np.int64), np.array(targets), readings


class _Signal(NamedTuple):
    """Motion of the markers of a view along its main direction, rms."""

    t: FloatArray  # (f,) stamps of new frames, s
    p: FloatArray  # (f,) px


def _signal(moved: Strokes, view: int) -> _Signal:
    """Motion of the markers of a view in all of its new frames."""
    readings = moved.readings
    new = [k for k in range(1, len(readings)) if readings[k].new_views(readings[k - 1])[view]]
    s = np.array([readings[k].s[view] for k in new]).reshape(len(new), len(readings[0].s[view]), 2)
    stamps = np.array(
        [readings[k].t_q if np.isnan(readings[k].t_view[view]) else readings[k].t_view[view] for k in new]
    )
    s = s[:, np.isfinite(s).all(axis=(0, 2))]
    if not s.size:
        return _Signal(stamps, np.zeros(len(new)))
    off = (s - s.mean(axis=0)).reshape(len(s), -1)
    return _Signal(stamps, off @ np.linalg.svd(off, full_matrices=False)[2][0] / math.sqrt(s.shape[1]))


class _Fit(NamedTuple):
    """Motion of an image by the reading of a joint, for each latency that was tried."""

    squares: FloatArray  # (d,) px², that it leaves, of the sum of all frames that count
    slope: FloatArray  # (d,) px/rad
    backlash: FloatArray  # (d,) rad, between reading and link


def _fit(moved: Strokes, signal: _Signal, passing: float) -> _Fit | None:
    """Fit p(t) = c± + b q(t − d) + e q(t − d)², c+ if the joint went up last, or c−; None for no motion.

    passing : motion, rad, after a turn of direction, that passes the backlash: frames there do not count.
    """
    t_q, q = np.array([reading.t_q for reading in moved.readings]), moved.q
    mid = 0.5 * (q.min() + q.max())
    course = PchipInterpolator(t_q, q)  # straight lines would lag behind a joint that slows down
    rows = []
    for d in _LATENCIES:
        x = course(np.clip(signal.t - d, t_q[0], t_q[-1])) - mid
        up, far = _direction(t_q, q, signal.t - d, passing)
        counts = far & (signal.t - d > t_q[0])
        A = np.column_stack([up, ~up, x, x * x])[counts].astype(float)
        if (
            counts.sum() < 12
            or np.ptp(x[counts]) < _LEAST_WAY / 2
            or not (up[counts].any() and (~up[counts]).any())
        ):
            return None
        c, *_ = np.linalg.lstsq(A, signal.p[counts])
        r = signal.p[counts] - A @ c
        rows.append(
            (float(r @ r) * len(signal.p) / counts.sum(), c[2], (c[1] - c[0]) / c[2] if c[2] else 0.0)
        )
    return _Fit(*(np.array(column) for column in zip(*rows, strict=True)))


def _passed(moved: Strokes, signal: _Signal) -> _Fit | None:
    """Fit without the frames in which the backlash is passed, by the backlash of the fit before."""
    passing, fit = _PASSING, _fit(moved, signal, _PASSING)
    while fit is not None and passing < _MAX_PASSING:
        wider = 1.2 * float(fit.backlash[np.argmin(fit.squares)]) + math.radians(0.4)
        if wider <= passing:
            break
        passing = min(max(wider, passing + math.radians(0.3)), _MAX_PASSING)
        fit = _fit(moved, signal, passing) or fit
    return fit


def _direction(t_q: FloatArray, q: FloatArray, t: FloatArray, passing: float) -> tuple[BoolArray, BoolArray]:
    """Whether a joint went up last at instants (f,), and has passed its backlash since it turned."""
    up, far, turned, rising = np.zeros(len(q), dtype=bool), np.zeros(len(q), dtype=bool), q[0], True
    extreme = q[0]
    for k, x in enumerate(q):
        ahead = x - extreme if rising else extreme - x
        if ahead >= 0.0:
            extreme = x
        elif -ahead > _TURN:  # it turned
            rising, turned, extreme = not rising, extreme, x
        up[k], far[k] = rising, abs(x - turned) > passing
    at = np.clip(np.searchsorted(t_q, t, side="right") - 1, 0, len(q) - 1)
    return up[at], far[at]


def findings_of(
    moved: Sequence[Strokes], numbers: Sequence[int], view: Sequence[str] = VIEWS
) -> Iterator[Finding]:
    """Findings of the strokes of all joints.

    numbers : of the markers; view : names of the views.
    """
    still, total = [], np.zeros((len(view), len(_LATENCIES)))
    max_px = np.zeros(len(view))  # motion of each image, px
    for trial in moved:
        signals = [_signal(trial, v) for v in range(len(view))]
        fits = [_passed(trial, signal) for signal in signals]
        if trial.given_up:
            yield trial.given_up
            continue
        spans = [np.ptp(signal.p) if len(signal.p) else 0.0 for signal in signals]
        max_px, span = np.maximum(max_px, spans), max(spans)
        if span < _MOVES_PX:
            still.append(trial.joint)
        else:
            for v, fit in enumerate(fits):
                total[v] += 0.0 if fit is None else fit.squares
        yield _of_servo(trial, [fit for fit in fits if fit is not None] if span >= _MOVES_PX else [])
    if still:
        yield _of_still(still, len(moved))
    for name, squares, px in zip(view, total, max_px, strict=True):
        if px < _MOVES_PX <= max_px.max():
            yield Finding("still_image", REFUSES, Subject(views=(name,)), px, limit=_MOVES_PX, unit="px")
        elif squares.any():
            latency = _minimum(squares)
            code, level = ("long_latency", LIMITS) if latency > _MAX_LATENCY_S else ("latency", NOTE)
            yield Finding(code, level, Subject(views=(name,)), latency, limit=_MAX_LATENCY_S, unit="s")
    if max_px.max() >= _MOVES_PX:
        yield from _of_loose_tags(moved, numbers)


def _minimum(squares: FloatArray) -> float:
    """Latency, s, by a parabola through the minimum of the sums (d,) and its neighbours."""
    k = int(np.clip(np.argmin(squares), 1, len(squares) - 2))
    before, here, after = squares[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return float(_LATENCIES[k] + 0.005 * np.clip(shift, -1.0, 1.0))


def _of_servo(moved: Strokes, fits: Sequence[_Fit]) -> Finding:
    """Hysteresis and sag of a joint, and backlash between its reading and the images."""
    below, above = (moved.rest(stroke) for stroke in (_FROM_BELOW, _FROM_ABOVE))
    hysteresis = float(moved.q[above].mean() - moved.q[below].mean())
    sag = float((moved.target - moved.q)[below + above].mean())
    best = [int(np.argmin(fit.squares)) for fit in fits]
    backlash = float(np.mean([fit.backlash[k] for fit, k in zip(fits, best, strict=True)])) if fits else 0.0
    amounts = {"hysteresis": hysteresis, "sag": abs(sag)}
    if fits:
        hidden = abs(sag) > 2.0 * _NOTABLE and backlash < _NOTABLE
        amounts["backlash"] = math.nan if hidden else max(backlash, 0.0)
    unit, name = _unit(moved.slides), _name(moved.slides)
    parts = tuple(Finding("part", NOTE, Subject(name=one), unit * x, unit=name) for one, x in amounts.items())
    code, level = ("wide_play", LIMITS) if max(hysteresis, backlash) > _WIDE else ("play", NOTE)
    return Finding(code, level, Subject(joints=(moved.joint + 1,)), others=parts)


def _of_still(still: Sequence[int], n: int) -> Finding:
    """Joints of n with which no tag moves in the images."""
    last = [*still] == [*range(still[0], n)]
    code = "still_tags" if len(still) == n else "early_link" if last else "still_joint"
    return Finding(code, REFUSES, Subject(joints=tuple(joint + 1 for joint in still)))


def _of_loose_tags(moved: Sequence[Strokes], numbers: Sequence[int]) -> Iterator[Finding]:
    """Tags that moved against the others between rests in the middle, come to from either side.

    Hysteresis and backlash leave small motions of the joints, which all tags follow by the images of the
    strokes; the other tags show the motions of the joints, and the rest is motion of the tag itself.
    """
    sound = [trial for trial in moved if not trial.given_up]
    rests = [_at_rest(trial, stroke) for trial in sound for stroke in (_FROM_BELOW, _FROM_ABOVE)]
    spans = [_at_rest(trial, _UP) - _at_rest(trial, _DOWN) for trial in sound]
    tag = np.array(numbers) // CORNERS
    worst: dict[int, float] = {}
    for rest in rests[1:]:
        columns = np.stack([*spans, rest - rests[0]], axis=-1)  # (V, m, 2, j + 1)
        detected = np.isfinite(columns).all(axis=(2, 3))
        for number in sorted(set(tag.tolist())):
            own, others = detected & (tag == number), detected & (tag != number)
            if own.sum() < CORNERS or others.sum() < 2 * len(columns[0, 0, 0]):
                continue
            A, b = np.split(columns[others].reshape(-1, len(spans) + 1), [-1], axis=1)
            c, *_ = np.linalg.lstsq(A, b[:, 0])
            noise = float(np.sqrt(np.mean((b[:, 0] - A @ c) ** 2)))
            left = np.abs(columns[own] @ [*-c, 1.0]).mean()
            if left > max(_LOOSE_PX, _LOOSE * noise):
                worst[number] = max(worst.get(number, 0.0), float(left))
    if worst:
        number = max(worst, key=lambda trial: worst[trial])
        yield Finding("loose_tag", REFUSES, Subject(tag=number), worst[number], unit="px")
    elif len(rests) > 1 and len(set(tag.tolist())) > 1:
        yield Finding("fast_tags", NOTE)


def _at_rest(moved: Strokes, stroke: int) -> FloatArray:
    """Mean pixels (V, m, 2) at rest at the end of a stroke."""
    return np.asarray(np.mean([moved.readings[k].s for k in moved.rest(stroke)], axis=0))
