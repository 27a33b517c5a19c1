"""Watch over an object that carries the goal of a run: whether cameras still see it where it was planned."""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.monitoring.innovation_tests import WINDOW
from projservo_cli.records import FloatArray, IntArray
from projservo_cli.robots.contract import Reading
from projservo_cli.task.objects.displaced_object import ALIKE_PX

# Frames of a view in a row that show an object elsewhere: as many as are seen before the first motion.
_FRAMES = WINDOW
LOOKS = 20  # after which one view is enough: a camera that was moved has been named by then
# Deviations of their mean beyond which it is elsewhere, and motion that counts as none, px: edges are drawn
# as far aside by another light, or by a cover of a part of a tag.
_DEVIATIONS, _LEAST_PX = 4.0, 0.5
_LEAST_MARKERS = 2  # seen in a view in all these frames
# Chance by which an object at rest has moved, and of the residual of one that did; its least
# motion, rms px.
_BY_CHANCE, _UNLIKE, _LEAST_MOTION_PX = 1e-6, 1e-4, 0.25


class ObjectWatch:
    """Object that rests while a robot moves, or the finding that it does not.

    A marker that is hidden is where it was seen last.

    name : of the object; marker : (k,) numbers of its markers, at these places (k,) among the markers of
    objects.
    s : (V, k, 2) px of them when the motion was planned, NaN where unseen.
    sigma : (V, k) their deviation, NaN if it is the deviation of a frame.
    by_motion : (V, k, 2, g) derivatives of them by displacements of the object.
    ``moved``: that it has, and by how much; None if it has not.
    """

    def __init__(
        self,
        name: str,
        marker: Sequence[int],
        indices: IntArray,
        s: FloatArray,
        sigma: FloatArray,
        by_motion: FloatArray,
    ) -> None:
        self.name, self._marker, self._places = name, marker, indices
        self._planned, self._sigma, self._by_motion, self._looks = s, sigma, by_motion, 0
        self.moved: Finding | None = None
        self._frames: list[deque[FloatArray]] = [deque(maxlen=_FRAMES) for _ in s]

    @property
    def seen(self) -> bool:
        """Whether the last frame of a view shows the object."""
        return any(f and np.isfinite(f[-1][:, 0]).sum() >= _LEAST_MARKERS for f in self._frames)

    def observe(self, reading: Reading) -> None:
        """Compare a reading with where the object was."""
        off, shown = list[bool](), list[int]()
        away, scatter = np.full(self._planned.shape, np.nan), np.zeros(len(self._planned))
        found: Finding | None = None
        for view, frames in enumerate(self._frames):
            seen_now = reading.s_objects[view, self._places]
            if not frames or not np.array_equal(seen_now, frames[-1], equal_nan=True):  # else the same frame
                frames.append(seen_now)
            by = np.mean(frames, axis=0) - self._planned[view]
            seen = np.isfinite(by[:, 0])
            if len(frames) < _FRAMES or seen.sum() < _LEAST_MARKERS:
                continue
            # The scatter of the frames, with the plan's, which may be of one frame.
            sigma = math.sqrt(float(np.var(np.array(frames)[:, seen], axis=0, ddof=1).mean()))
            away[view], scatter[view] = by, sigma
            shown.append(view)
            max_px = max(_LEAST_PX, _DEVIATIONS * sigma * math.sqrt(1.0 + 1.0 / _FRAMES))
            off.append(bool((px := float(np.median(np.linalg.norm(by[seen], axis=1)))) > max_px))
            if off[-1]:
                of = Subject(views=(reading.view[view],), markers=tuple(self._marker), name=self.name)
                found = Finding("moved_object", REFUSES, of, px, limit=max_px, unit="px")
        if (px := self._displaced_px(away, scatter)) > _LEAST_MOTION_PX:
            of = Subject(
                views=tuple(reading.view[v] for v in shown), markers=tuple(self._marker), name=self.name
            )
            self.moved = self.moved or Finding(
                "moved_object", REFUSES, of, px, limit=_LEAST_MOTION_PX, unit="px"
            )
        self._looks = self._looks + 1 if any(off) else 0
        if off and (all(off) or self._looks >= LOOKS):
            self.moved = self.moved or found

    def _displaced_px(self, away: FloatArray, scatter: FloatArray) -> float:
        """Motion of the images, rms px, by the displacement that explains how far they are away (V, k, 2).

        Zero within chance, and if a displacement leaves more than chance, as of light, of a cover of a
        part, or of one camera that moved. scatter : (V,) deviation of a frame, px.
        """
        seen = np.isfinite(away[..., 0]) & np.isfinite(self._by_motion[..., 0, 0])
        of_plan = np.where(np.isfinite(self._sigma), self._sigma, scatter[:, None])
        sigma = np.sqrt(scatter[:, None] ** 2 / _FRAMES + of_plan**2 + ALIKE_PX**2)
        A = self._by_motion[seen].reshape(-1, self._by_motion.shape[-1])
        weight = np.repeat(1.0 / sigma[seen], 2)
        r, free = weight * away[seen].ravel(), len(weight) - A.shape[1]
        if free < 1:
            return 0.0
        motion = np.linalg.lstsq(weight[:, None] * A, r)[0]
        left = float(np.square(r - weight * (A @ motion)).sum())
        if r @ r - left <= chdtri(A.shape[1], _BY_CHANCE) or left > chdtri(free, _UNLIKE):
            return 0.0
        return float(np.sqrt(np.square(A @ motion).sum() / seen.sum()))
