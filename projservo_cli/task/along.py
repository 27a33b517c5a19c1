"""Margins along a path of shares, and the time it takes."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.mechanisms import Work, span_of, workspace
from projservo_cli.records import FloatArray
from projservo_cli.task.lattice import slowness
from projservo_cli.task.margins import (
    CONDITIONING,
    IMAGE,
    VISIBILITY,
    WORST,
    Reaching,
    image_margin,
    limit_margin,
)
from projservo_cli.task.path import follow, view_path

# Points of a path at which its joints and margins are looked at.
CHECKS = 151
# Shares of this part of the best one are as good, joints being interpolated; the quicker path is better.
EQUALLY = 0.95


class Along(NamedTuple):
    """Margins along a path of s instants.

    Attributes
    ----------
    q : (s, n) joints, rad or m; NaN from where they cannot follow.
    visibility : (s, 2) margins a·O, 1 at the start.
    distance : (s, 2) least distance of a marker from the image border, px.
    limit : (s,) margins of the joint limits, NaN from where the joints cannot follow.
    condition : (s,) reciprocal conditions of the image Jacobian, NaN likewise.
    miss : (s,) how far the images of the face stay behind the planned ones, px; 0 where joints follow.
    """

    q: FloatArray
    visibility: FloatArray
    distance: FloatArray
    limit: FloatArray
    condition: FloatArray
    miss: FloatArray

    def margins(self, reaching: Reaching) -> FloatArray:
        """Smallest margin (s, 4) of each of ``CONSTRAINTS``; ``WORST`` where the joints cannot follow."""
        demands = reaching.demands
        nearest = self.distance.min(axis=1)
        columns = np.stack(
            [
                self.visibility.min(axis=1),
                np.array([image_margin(value, demands) for value in nearest]),
                self.limit,
                self.condition - demands.conditioning,
            ],
            axis=1,
        )
        columns[np.isnan(self.condition), CONDITIONING] = WORST
        return np.where(np.isnan(columns), 1.0, columns)


class Path(NamedTuple):
    """A planned path, looked at in ``CHECKS`` places.

    Attributes
    ----------
    reaching : the task with the senses of both rotations that were chosen.
    mu : (s, 3) shares.
    time : (s,) when they are reached at the joint-speed limit, s, see ``timed``.
    along : margins there.
    duration : at the joint-speed limit, s; NaN where nothing limits or the joints cannot follow.
    """

    reaching: Reaching
    mu: FloatArray
    time: FloatArray
    along: Along
    duration: float

    def shares(self) -> FloatArray:
        """Smallest share (s, 4) of each of ``CONSTRAINTS``."""
        return np.asarray(self.along.margins(self.reaching) / self.reaching.scale)

    def holds(self) -> bool:
        """Whether all constraints hold, as far as its demands go."""
        return bool(self.shares().min() > 0.0)

    def at(self, sigma: FloatArray) -> FloatArray:
        """Shares (k, 3) at parts sigma (k,) of the duration."""
        mu = np.stack([np.interp(sigma * self.time[-1], self.time, column) for column in self.mu.T], axis=1)
        mu[sigma <= 0.0], mu[sigma >= 1.0] = self.mu[0], self.mu[-1]
        return mu


def planning_workspace(reaching: Reaching) -> Work:
    """Workspace for the joints and the face of a task, and for damped steps."""
    n = len(reaching.q_start)
    return workspace(n, 4 * len(reaching.A) + n, span_of(reaching.model, reaching.A))


def along(reaching: Reaching, mu: FloatArray) -> Along:
    """Joints and margins at the shares mu (s, 3), whose first row is zero."""
    n = len(reaching.q_start)
    work = planning_workspace(reaching)
    q, condition, miss = np.empty((len(mu), n)), np.empty(len(mu)), np.empty(len(mu))
    rows = follow(reaching, mu, q, condition, miss, work, np.empty((4, max(n, 4))))
    visibility, distance = np.empty((len(mu), 2)), np.empty((len(mu), 2))
    view_path(reaching, mu, visibility, distance)
    limit = np.full(len(mu), math.nan)
    limit[:rows] = [limit_margin(row, reaching.demands) for row in q[:rows]]
    return Along(q, visibility, distance, limit, condition, miss)


def timed(reaching: Reaching, corners: FloatArray) -> Path:
    """Path through corners, with the time it takes at the joint-speed limit.

    Where nothing limits the speed, time counts as the motion of the joint that moves most; where the
    joints cannot follow or nothing moves, as the length of the path in shares.
    """
    length = np.r_[0.0, np.cumsum(np.abs(np.diff(corners, axis=0)).max(axis=1))]
    places = np.linspace(0.0, length[-1], CHECKS)
    mu = np.stack([np.interp(places, length, column) for column in corners.T], axis=1)
    speed = reaching.demands.speed
    weight = np.empty(len(speed))
    slowness(speed, weight)
    found = along(reaching, mu)
    steps = (np.abs(np.diff(found.q, axis=0)) * weight).max(axis=1)
    time = np.r_[0.0, np.cumsum(steps)]
    duration = float(time[-1]) if np.isfinite(speed).any() else math.nan
    if not time[-1] > 0.0:
        time = places
    return Path(reaching, mu, time, found, duration)


def best_of(paths: list[Path]) -> Path | None:
    """Of the paths in view, or of all if none is, the quickest whose smallest share is as good as any."""
    in_view = [path for path in paths if path.shares()[:, [VISIBILITY, IMAGE]].min() > 0.0]
    paths = in_view or paths
    if not paths:
        return None
    least = [float(path.shares().min()) for path in paths]
    good = min(EQUALLY * max(least), max(least))
    paths = [path for path, share in zip(paths, least, strict=True) if share >= good]
    return min(paths, key=lambda path: path.duration if math.isfinite(path.duration) else math.inf)
