"""The planned motion: what it must keep to, how near it comes to failing that, and in words."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.records import BoolArray, FloatArray
from projservo_cli.stages.calibrate import image_size_of
from projservo_cli.stages.motion import joints_of
from projservo_cli.stages.pace import AS_FAST_AS_ALLOWED, Pace, least_time, timed
from projservo_cli.task.along import Along, along
from projservo_cli.task.margins import (
    CONSTRAINTS,
    IMAGE,
    JOINTS,
    VISIBILITY,
    Demands,
    Reaching,
    limit_margin,
)
from projservo_cli.task.planning import plan_path
from projservo_cli.task.trajectory import profile_shares

if TYPE_CHECKING:
    from projservo_cli.config import Config

CONSTRAINED = "constrained"
VIEWS = ("left", "right")


@dataclass(frozen=True, eq=False)
class Motion:
    """Shares of a plan at equal steps of σ, with their margins.

    Attributes
    ----------
    reaching : the task in the senses that were chosen, with the demands that the motion keeps to.
    asked : the demands that it was to keep to.
    mu : (s, 3) shares.
    along : margins at the shares.
    checked, checked_mu : margins and shares (k, 3) by which the motion is judged.
    time : (s,) when each is reached, s; NaN without a limit or where the joints cannot follow.
    """

    reaching: Reaching
    asked: Demands
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

    def given_up(self, found: Along) -> BoolArray:
        """Where (s,) along the motion something asked for was given up, so that the joints can follow."""
        if self.reaching.demands.miss_px == 0.0:
            return np.zeros(len(found.miss), dtype=np.bool_)
        return np.asarray((found.condition <= self.asked.conditioning) | (found.miss > 0.0))

    def relaxed(self) -> str:
        """What was given up, in words; empty where nothing was."""
        where = np.flatnonzero(self.given_up(self.checked))
        if not len(where):
            return ""
        first, last = ("{:.2f}, {:.2f}, {:.2f}".format(*self.checked_mu[i]) for i in where[[0, -1]])
        condition, miss = self.checked.condition.min(), self.checked.miss.max()
        said = []
        if condition <= self.asked.conditioning:
            said += [f"with conditioning below its bound ({condition:.2g} of {self.asked.conditioning:.2g})"]
        if miss > 0.0:
            allowed = self.asked.miss_px
            said += [f"with joints up to {miss:.2g} px behind the planned images ({allowed:g} px allowed)"]
        return f"{' and '.join(said)}, from mu_t, mu_r, mu_p {first} to {last}"

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
        config.trajectory.most_miss_px,
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
        found = along(path.reaching, mu)
        return Motion(path.reaching, reaching.demands, mu, found, path.along, path.mu, time)
    mu = profile_shares(profile, sigma, pure_translation)
    demands = reaching.demands._replace(miss_px=0.0)
    reaching = reaching._replace(demands=demands)
    found = along(reaching, mu)
    shortest = least_time(found.q, reaching.demands.speed)
    return Motion(reaching, demands, mu, found, found, mu, timed(shortest, sigma, pace))


def constrained_verdict(motion: Motion) -> tuple[bool, str]:
    """Whether all constraints hold along a motion, and which is nearest to failing, in words."""
    constraint, least, instant = motion.nearest()
    words = motion.words(constraint, instant)
    relaxed = motion.relaxed()
    if least > 0.0 and relaxed:
        return True, f"no path was found that keeps all constraints; planned {relaxed}; all else holds"
    if least > 0.0:
        return True, f"all constraints hold; nearest is {CONSTRAINTS[constraint]}: {words}"
    return (
        False,
        f"no path was found that keeps all constraints; {CONSTRAINTS[constraint]} fails first: {words}",
    )
