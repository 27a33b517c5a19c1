"""Watch over an object that carries the goal of a run: whether cameras still see it where it was planned."""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.monitoring.innovation_tests import WINDOW
from projservo_cli.records import FloatArray, IntArray
from projservo_cli.robots.contract import Reading

# Frames of a view in a row that show an object elsewhere: as many as are seen before the first motion.
_FRAMES = WINDOW
LOOKS = 20  # after which one view is enough: a camera that was moved has been named by then
# Deviations of their mean beyond which it is elsewhere, and motion that counts as none, px: edges are drawn
# as far aside by another light, or by what hides a part of a tag.
_DEVIATIONS, _LEAST_PX = 4.0, 0.5
_LEAST_MARKERS = 2  # seen in a view in all these frames


class ObjectWatch:
    """Object that stands still while a robot moves, or the finding that it does not.

    A marker that is hidden is where it was seen last.

    name : of the object; marker : (k,) numbers of its markers, at these places (k,) among those of objects.
    s : (V, k, 2) px of them when the motion was planned, NaN where unseen.
    ``moved``: that it has, and by how much; None where it has not.
    """

    def __init__(self, name: str, marker: Sequence[int], places: IntArray, s: FloatArray) -> None:
        self.name, self._marker, self._places = name, marker, places
        self._planned, self._looks = s, 0
        self.moved: Finding | None = None
        self._frames: list[deque[FloatArray]] = [deque(maxlen=_FRAMES) for _ in s]

    @property
    def seen(self) -> bool:
        """Whether the last frame of a view shows the object."""
        return any(f and np.isfinite(f[-1][:, 0]).sum() >= _LEAST_MARKERS for f in self._frames)

    def observe(self, reading: Reading) -> None:
        """Compare a reading with where the object was."""
        off = list[bool]()
        found: Finding | None = None
        for view, frames in enumerate(self._frames):
            seen_now = reading.s_objects[view, self._places]
            if not frames or not np.array_equal(seen_now, frames[-1], equal_nan=True):  # else the same frame
                frames.append(seen_now)
            away = np.linalg.norm(np.mean(frames, axis=0) - self._planned[view], axis=1)
            seen = np.isfinite(away)
            if len(frames) < _FRAMES or seen.sum() < _LEAST_MARKERS:
                continue
            # By the scatter of the frames, with that of the plan, which may be of one.
            sigma = math.sqrt(float(np.var(np.array(frames)[:, seen], axis=0, ddof=1).mean()))
            most = max(_LEAST_PX, _DEVIATIONS * sigma * math.sqrt(1.0 + 1.0 / _FRAMES))
            off.append(bool((px := float(np.median(away[seen]))) > most))
            if off[-1]:
                of = Subject(views=(reading.view[view],), markers=tuple(self._marker), name=self.name)
                found = Finding("moved_object", REFUSES, of, px, limit=most, unit="px")
        self._looks = self._looks + 1 if any(off) else 0
        if off and (all(off) or self._looks >= LOOKS):
            self.moved = self.moved or found
