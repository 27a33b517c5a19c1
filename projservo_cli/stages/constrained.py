"""The planned motion: what it must keep to, how near it comes to failing that, and in words."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from projservo_cli.records import FloatArray, WorkFailed
from projservo_cli.stages.calibrate import image_size_of
from projservo_cli.stages.motion import joints_of
from projservo_cli.task.margins import (
    CONSTRAINTS,
    IMAGE,
    JOINTS,
    VISIBILITY,
    Demands,
    Reaching,
    limit_margin,
)
from projservo_cli.task.planning import Along, along, plan_path
from projservo_cli.task.trajectory import profile_shares

if TYPE_CHECKING:
    from projservo_cli.config import Config

CONSTRAINED = "constrained"
VIEWS = ("left", "right")


class Pace(NamedTuple):
    """How fast a planned motion is to be.

    Attributes
    ----------
    duration : time it is given, s; None for as little as the joint-speed limit lets it take.
    ramp : time in which it comes up to its pace, and to rest again at its end, s.
    """

    duration: float | None = None
    ramp: float = 0.0


AS_FAST_AS_ALLOWED = Pace()


@dataclass(frozen=True, eq=False)
class Motion:
    """Shares of a plan at equal steps of σ, with their margins.

    Attributes
    ----------
    reaching : the task in the senses that were chosen.
    mu : (s, 3) shares.
    along : margins at the shares.
    checked, checked_mu : margins and shares (k, 3) by which the motion is judged.
    time : (s,) when each is reached, s; NaN without a limit or where the joints cannot follow.
    """

    reaching: Reaching
    mu: FloatArray
    along: Along
    checked: Along
    checked_mu: FloatArray
    time: FloatArray

    @property
    def duration(self) -> float | None:
        """When it arrives, s; None where there is no time."""
        return float(self.time[-1]) if math.isfinite(self.time[-1]) else None

    def least(self) -> tuple[FloatArray, FloatArray]:
        """Smallest value (4,) of each constraint in its own unit, and the shares (4, 3) where it is."""
        columns = self._values()
        where = [_argmin(column) for column in columns]
        values = [column[i] for column, i in zip(columns, where, strict=True)]
        return np.array(values), self.checked_mu[where]

    def _values(self) -> list[FloatArray]:
        found = self.checked
        return [found.visibility.min(axis=1), found.distance.min(axis=1), found.limit, found.condition]

    def nearest(self) -> tuple[int, float, int]:
        """Constraint that is nearest to failing, its smallest margin, and the instant.

        Nearest is the smallest share of the margin at the worse of both ends; where the constraint fails,
        the instant is the first at which it does.
        """
        margins = self.checked.margins(self.reaching)
        scale = np.minimum(margins[0], margins[-1])
        shares = margins / np.where(scale > 0.0, scale, 1.0)
        constraint = int(np.argmin(shares.min(axis=0)))
        column = margins[:, constraint]
        least = float(column.min())
        instant = int(np.argmax(column <= 0.0)) if least <= 0.0 else int(np.argmin(shares[:, constraint]))
        return constraint, least, instant

    def words(self, constraint: int, instant: int) -> str:
        """What one constraint says at one instant, and where that is."""
        found, demands = self.checked, self.reaching.demands
        at = "at mu_t {:.2f}, mu_r {:.2f}, mu_p {:.2f}".format(*self.checked_mu[instant])
        if constraint == VISIBILITY:
            view = int(np.argmin(found.visibility[instant]))
            margin = found.visibility[instant, view]
            return f"visibility from the {VIEWS[view]} camera is {margin:.3f} of the start's {at}"
        if constraint == IMAGE:
            view = int(np.argmin(found.distance[instant]))
            return f"{_border_words(found.distance[instant, view], VIEWS[view], demands)} {at}"
        if math.isnan(found.condition[instant]):
            return f"the joints cannot follow: the operators become dependent {at}"
        if constraint == JOINTS:
            return f"{_joint_words(found.q[instant], demands)} {at}"
        return (
            f"the reciprocal condition of the image Jacobian is {found.condition[instant]:.2g} "
            f"({demands.conditioning:.2g} allowed) {at}"
        )


def _argmin(column: FloatArray) -> int:
    return 0 if np.isnan(column).all() else int(np.nanargmin(column))


def _border_words(distance: float, view: str, demands: Demands) -> str:
    if distance <= -1e9:
        return f"a marker of the face is behind the {view} camera"
    if distance < 0.0:
        return f"a marker of the face is {-distance:.1f} px outside the {view} image"
    return (
        f"a marker of the face is {distance:.1f} px from the border of the {view} image "
        f"({demands.border_px:g} px asked for)"
    )


def _joint_words(q: FloatArray, demands: Demands) -> str:
    each = [
        limit_margin(
            q[i : i + 1], demands._replace(lower=demands.lower[i : i + 1], upper=demands.upper[i : i + 1])
        )
        for i in range(len(q))
    ]
    i = int(np.argmin(each))
    return (
        f"joint {i + 1} is at {q[i]:.4g}, its limits are {demands.lower[i]:.4g} to {demands.upper[i]:.4g} "
        "(rad or m),"
    )


def demands_of(config: "Config", joint_types: str = "") -> Demands:
    """What the planned motion must keep to, as configured.

    Parameters
    ----------
    joint_types : one letter a joint, where the configuration does not tell.
    """
    joints = joints_of(config, joint_types)
    return Demands(
        joints.lower,
        joints.upper,
        joints.speed,
        np.array(image_size_of(config) or (math.inf, math.inf), dtype=np.float64),
        config.trajectory.border_px,
        config.trajectory.least_condition,
    )


def motion_of(
    profile: str,
    reaching: Reaching,
    sigma: FloatArray,
    pure_translation: float,
    pace: Pace = AS_FAST_AS_ALLOWED,
) -> Motion:
    """Motion of a profile: one of the paper's, or planned under constraints.

    Parameters
    ----------
    sigma : (s,) path parameter in [0, 1]; of a planned motion the part of its duration.
    pure_translation : most share of the translation before any rotation, δ τ_0 / τ.
    pace : time it is given.

    Raises
    ------
    WorkFailed
        If the joints would be too fast.
    """
    if profile == CONSTRAINED:
        path = plan_path(reaching)
        mu = path.at(sigma)
        time = timed(sigma * path.duration, sigma, pace)
        return Motion(path.reaching, mu, along(path.reaching, mu), path.along, path.mu, time)
    mu = profile_shares(profile, sigma, pure_translation)
    found = along(reaching, mu)
    shortest = least_time(found.q, reaching.demands.speed)
    return Motion(reaching, mu, found, found, mu, timed(shortest, sigma, pace))


def least_time(q: FloatArray, speed: FloatArray) -> FloatArray:
    """Time (s,) at which joints q (s, n) are reached where one is always at its speed limit (n,), s.

    NaN throughout where no joint has a limit.
    """
    if not np.isfinite(speed).any():
        return np.full(len(q), math.nan)
    steps = (np.abs(np.diff(q, axis=0)) / speed).max(axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def timed(shortest: FloatArray, sigma: FloatArray, pace: Pace) -> FloatArray:
    """Time (s,) of a motion: its shortest time, from rest to rest, stretched to the duration it is given.

    Where nothing limits the speed, the path parameter sigma (s,) passes evenly but for the ramps.

    Raises
    ------
    WorkFailed
        If the joints would be too fast.
    """
    duration = pace.duration
    eased = from_rest(shortest, pace.ramp)
    least = float(eased[-1])
    if duration is None:
        return eased
    if least > duration:
        raise WorkFailed(
            f"trajectory.duration_s {duration:g}: the joint-speed limit lets the motion take {least:.4g} s "
            "or more: give it longer, or null for as short as that"
        )
    if not least > 0.0:
        eased = from_rest(sigma * duration, pace.ramp)
    return np.asarray(eased * (duration / eased[-1]))


def from_rest(time: FloatArray, ramp: float) -> FloatArray:
    """Times (s,) of a motion that comes up to its pace evenly in so many s, and so to rest again at its end.

    The pace, seconds of ``time`` a second, is a trapezoid, of a short motion a triangle of the same slope:
    the motion never is faster, and takes longer by the ramp.
    """
    total = float(time[-1])
    if not (ramp > 0.0 and total > 0.0):
        return time
    half = 0.5 * min(total, ramp)
    end = total + ramp if total >= ramp else 2.0 * math.sqrt(total * ramp)
    before = np.sqrt(2.0 * ramp * np.maximum(time, 0.0))
    after = end - np.sqrt(2.0 * ramp * np.maximum(total - time, 0.0))
    return np.select([time <= half, time >= total - half], [before, after], time + 0.5 * ramp)


def constrained_verdict(motion: Motion) -> tuple[bool, str]:
    """Whether all constraints hold along a motion, and which is nearest to failing, in words."""
    constraint, least, instant = motion.nearest()
    words = motion.words(constraint, instant)
    if least > 0.0:
        return True, f"all constraints hold; nearest is {CONSTRAINTS[constraint]}: {words}"
    return (
        False,
        f"no path was found that keeps all constraints; {CONSTRAINTS[constraint]} fails first: {words}",
    )
