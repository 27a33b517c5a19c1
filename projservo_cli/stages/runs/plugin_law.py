"""User-defined laws, as the loop drives them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from projservo_cli.control.law import ERRORS, LOST, OK, Gains
from projservo_cli.plugins import what_failed
from projservo_cli.records import (
    FloatArray,
    InputError,
    IntArray,
    Plan,
    WorkFailed,
)
from projservo_cli.results import ImageModel


@dataclass(frozen=True, eq=False)
class LawSetup:
    """Inputs of a plug-in law.

    Attributes
    ----------
    calibration : with ``predict(q)`` and ``jacobian(q)``.
    face : (k,) indices of the face markers among the markers of the calibration.
    s_start, s_star : (V, k, 2) pixels of the face at the start and at the goal.
    plan : the planned motion.
    gains : configured gains, limits and period.
    period : control period, s.
    """

    calibration: ImageModel
    face: IntArray
    s_start: FloatArray
    s_star: FloatArray
    plan: Plan
    gains: Gains
    period: float


class PluginLaw:
    """A law ``law(s, q) -> q_dot`` whose answers are checked; None holds the robot for a period.

    Parameters
    ----------
    law : pixels (V, k, 2) of the face and joint readings (n,) to joint velocities (n,), rad/s or m/s.
    name : of it, for messages.
    least_views : number of views that are to see the face.
    image_error_px : image error at which a run converges, px, unless the law states an own error:
        ``error(s, q)``, a number, and its ``tolerance``.
    """

    def __init__(
        self,
        law: Callable[[FloatArray, FloatArray], Any],
        name: str,
        least_views: int,
        image_error_px: float = math.inf,
    ) -> None:
        self.law, self.name, self.least_views = law, name, least_views
        self.errors = np.full(len(ERRORS), np.nan)
        self.face_px = np.full(1, math.nan)
        self._error: Any = getattr(law, "error", None)
        self.states_error, self.tolerance = callable(self._error), math.nan
        if self.states_error:
            stated = getattr(law, "tolerance", None)
            if isinstance(stated, bool) or not isinstance(stated, int | float) or not 0.0 < stated < math.inf:
                raise InputError(
                    f"{name}: has error(s, q) and tolerance {stated!r}: make it a positive number, in the "
                    "unit of the error"
                )
            self.tolerance, self._px = float(stated), image_error_px

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity of one instant; the law is asked where enough views show the face."""
        if np.isfinite(s).all(axis=(1, 2)).sum() < self.least_views:
            return LOST, np.zeros_like(q)
        try:
            answer = self.law(s.copy(), q.copy())
            if answer is None:
                return LOST, np.zeros_like(q)
            q_dot = np.array(answer, dtype=np.float64)
            if self.states_error:
                error = float(self._error(s.copy(), q.copy()))
                self.face_px[0] = error / self.tolerance * self._px
        except Exception as error:
            raise WorkFailed(f"{self.name}: failed: {what_failed(error)}") from error
        if q_dot.shape != q.shape or not np.isfinite(q_dot).all():
            raise WorkFailed(
                f"{self.name}: gave {answer!r:.80}: expected {len(q)} finite joint velocities, or None"
            )
        return OK, q_dot
