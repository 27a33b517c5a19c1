"""Joint limits taught by moving a released arm through its allowed range."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from projservo_cli.findings import REFUSES, Finding
from projservo_cli.hardware.so101 import COUNT, MIDDLE, TURN, Registers, Servos
from projservo_cli.messages import failed
from projservo_cli.records import InputError, WorkFailed

# Pause between readings, s, and readings whose median counts: a false one is none.
_PERIOD_S, _MEDIAN = 0.02, 3
# Least range of a joint that was moved, deg, and how far limits stay within where it was moved, deg.
_MOVED_DEG, _WITHIN_DEG = 20.0, 1.0


class _Moved(NamedTuple):
    """Range of a joint moved by hand, in counts that continue over a whole turn."""

    lowest: int
    highest: int


def watch(servos: Servos, done: Callable[[], bool]) -> dict[int, _Moved]:
    """Return how far each joint is moved until that is done, by the number of its servo."""
    last = {i: measured.at for i, measured in servos.measured().items()}
    counts = {i: deque([float(last[i])] * _MEDIAN, _MEDIAN) for i in servos.ids}
    ranges = {i: _Moved(last[i], last[i]) for i in servos.ids}
    while not done():
        servos.bus.sleep(_PERIOD_S)
        for i, measured in servos.measured().items():
            if i in counts:
                counts[i].append(counts[i][-1] + (measured.at - last[i] + MIDDLE) % TURN - MIDDLE)
                last[i], now = measured.at, int(np.median(counts[i]))
                ranges[i] = _Moved(min(ranges[i].lowest, now), max(ranges[i].highest, now))
    return ranges


def limits_deg(
    servos: Servos, moved: dict[int, _Moved], shift: Sequence[int] = ()
) -> list[tuple[float, float]]:
    """Return lowest and highest angle of each joint, deg, within where it was moved.

    shift : joints, from 1, whose servos may store an offset, so that no range crosses the end of their turn.
    Raises WorkFailed for a joint that was hardly moved, whose range crosses that end, or which its servo
    keeps from most of it.
    """
    kept = servos.registers()
    for k, i in enumerate(servos.ids, 1):
        if wrong := _unusable(moved[i], k, shift) or _kept_from(moved[i], kept[i]):
            raise failed([replace(wrong, subject=servos.subject(i))])
    limits, shifted = [], list[int]()
    for k, i in enumerate(servos.ids, 1):
        low, high = moved[i]
        if _crosses(moved[i]):
            by = round(0.5 * (low + high)) - MIDDLE
            try:
                servos.shift(i, by)
            except WorkFailed as error:
                words = f"; joints {shifted} store a new offset: record again" if shifted else ""
                raise WorkFailed(f"{error}{words}", findings=error.findings) from error
            shifted.append(k)
            low, high = low - by, high - by
        low, high = max(low, kept[i].lowest), min(high, kept[i].highest)
        least, most = (math.degrees((x - MIDDLE) * COUNT) for x in (low, high))
        tenths = math.ceil(10.0 * (least + _WITHIN_DEG)), math.floor(10.0 * (most - _WITHIN_DEG))
        limits.append((tenths[0] / 10.0, tenths[1] / 10.0))
    return limits


def _crosses(moved: _Moved) -> bool:
    """Whether a range crosses the end of the turn of its servo."""
    return moved.lowest < 0 or moved.highest >= TURN


def _kept_from(moved: _Moved, kept: Registers) -> Finding | None:
    """Return how the limits that a servo stores cut the range of its joint; None if they hardly do.

    Limits of a shifted servo must span a whole turn: its counts will mean other angles.
    """
    cut = max(kept.lowest - moved.lowest, moved.highest - kept.highest)
    whole = kept.lowest <= 0 and kept.highest >= TURN - 1
    if whole or (not _crosses(moved) and math.degrees(cut * COUNT) <= _WITHIN_DEG):
        return None
    stored = (Finding("range", amount=kept.lowest, limit=kept.highest, unit="1"),)
    return Finding("kept_range", REFUSES, amount=moved.lowest, limit=moved.highest, unit="1", others=stored)


def _unusable(moved: _Moved, joint: int, shift: Sequence[int]) -> Finding | None:
    """Return the reason why the range of a joint gives no limits; None if it does."""
    span, least = (moved.highest - moved.lowest) * COUNT, math.radians(_MOVED_DEG)
    if span < least:
        return Finding("short_range", REFUSES, amount=span, limit=least, unit="rad")
    if span >= TURN * COUNT:
        return Finding("whole_turn", REFUSES, amount=span, unit="rad")
    return Finding("crossed_turn", REFUSES) if _crosses(moved) and joint not in shift else None


def require_known(joints: Sequence[int], count: int) -> None:
    """Refuse numbers of joints that there are not."""
    for k in joints:
        if not 1 <= k <= count:
            raise InputError(f"--shift {k}: the arm has joints 1 to {count}")
