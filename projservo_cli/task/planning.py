"""A motion that keeps its distance from everything that must not happen: [RH00] section 4.3.

The coupled constraint of the paper on μ_t and μ_r, for both cameras, beside the image borders, the
joint limits and the conditioning of the operators. Of all monotone paths from (0, 0, 0) to (1, 1, 1)
the one whose smallest share (``task.margins``) is largest is taken, among equals the quickest.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import apply, mat, sub, vec
from projservo_cli.geometry.composition import wrap
from projservo_cli.geometry.mechanisms import Work, workspace
from projservo_cli.geometry.span import span_of
from projservo_cli.records import FloatArray
from projservo_cli.task.lattice import (
    COARSE,
    NODES,
    shortest,
    slowness,
    solve_joints,
    view_shares,
    widest,
    with_joints,
)
from projservo_cli.task.margins import (
    CONDITIONING,
    IMAGE,
    JOINTS,
    VISIBILITY,
    WORST,
    Reaching,
    image_margin,
    limit_margin,
)
from projservo_cli.task.path import follow, straightened, view_path
from projservo_cli.task.search import WAYS, carry, traced
from projservo_cli.task.visibility import margin_coefficients

# Points of a path at which its joints and margins are looked at.
CHECKS = 151
# A margin of conditioning that no path is bounded by.
ENDLESS = 1e9
# Shares of this part of the best one are as good, joints being interpolated; the quicker path is better.
EQUALLY = 0.95
# The lattices of joints that were not looked at.
NOTHING = np.empty(0)


class Along(NamedTuple):
    """Margins along a path of s instants.

    Attributes
    ----------
    q : (s, n) joints, rad or m; NaN from where they cannot follow.
    visibility : (s, 2) margins a·O, 1 at the start.
    distance : (s, 2) least distance of a marker from the image border, px.
    limit : (s,) margins of the joint limits, NaN from where the joints cannot follow.
    condition : (s,) reciprocal conditions of the image Jacobian, NaN likewise.
    """

    q: FloatArray
    visibility: FloatArray
    distance: FloatArray
    limit: FloatArray
    condition: FloatArray

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
    time : (s,) when they are reached at the joint-speed limit, s, see ``_timed``.
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

    def at(self, sigma: FloatArray) -> FloatArray:
        """Shares (k, 3) at parts sigma (k,) of the duration."""
        mu = np.stack([np.interp(sigma * self.time[-1], self.time, column) for column in self.mu.T], axis=1)
        mu[sigma <= 0.0], mu[sigma >= 1.0] = self.mu[0], self.mu[-1]
        return mu


class Candidate(NamedTuple):
    """Lattices of one choice of senses, and what their best path is worth.

    Attributes
    ----------
    reaching : the task in these senses.
    views : (k, k, k) best smallest share in view of the paths up to each node.
    in_view : of those to the last node.
    field, joints, value : joints at coarse nodes, at all nodes, and best smallest share of the paths up
        to each node; without meaning where ``least`` is −∞.
    least : largest smallest share; −∞ where the views alone keep it from being good enough.
    """

    reaching: Reaching
    views: FloatArray
    in_view: float
    field: FloatArray
    joints: FloatArray
    value: FloatArray
    least: float


def along(reaching: Reaching, mu: FloatArray) -> Along:
    """Joints and margins at the shares mu (s, 3), whose first row is zero."""
    n = len(reaching.q_start)
    work = workspace(n, 4 * len(reaching.A), span_of(reaching.model, reaching.A))
    q, condition = np.empty((len(mu), n)), np.empty(len(mu))
    rows = follow(reaching, mu, q, condition, work, np.empty((4, max(n, 4))))
    visibility, distance = np.empty((len(mu), 2)), np.empty((len(mu), 2))
    view_path(reaching, mu, visibility, distance)
    limit = np.full(len(mu), math.nan)
    limit[:rows] = [limit_margin(row, reaching.demands) for row in q[:rows]]
    return Along(q, visibility, distance, limit, condition)


def turning_sense(reaching: Reaching) -> float:
    """Sense of the rotation onto the plane that keeps the face in sight: θ_r or the rest of a whole turn.

    At every share μ_t a camera sees the face for half a turn of θ around an angle φ(μ_t), [RH00]
    eqs. (13), (14) with p_0 = 0. That band moves with the translation, by less than half a turn; only
    the sense that ends in it can be reached in sight of the camera, whatever path is taken.
    """
    tau, theta, _ = (float(x) for x in reaching.amplitudes)
    if theta == 0.0:
        return theta
    senses = (theta, theta - math.copysign(2.0 * math.pi, theta))
    inside = [0, 0]
    H_t, H_r, a = mat(reaching.H_hat[0]), mat(reaching.H_hat[1]), vec(reaching.a)
    for row in reaching.O:
        O = vec(row)
        drift = apply(H_t, O)
        moved = sub(O, (tau * drift[0], tau * drift[1], tau * drift[2], tau * drift[3]))
        sign = math.copysign(1.0, float(reaching.a @ row))
        middle = [
            math.atan2(sign * c_s, sign * c_c)
            for _, c_s, c_c in (margin_coefficients(a, H_r, O), margin_coefficients(a, H_r, moved))
        ]
        end = middle[0] + wrap(middle[1] - middle[0])
        for i, sense in enumerate(senses):
            inside[i] += abs(sense - end) < 0.5 * math.pi
    return senses[1] if inside[1] > inside[0] else senses[0]


def plan_path(reaching: Reaching) -> Path:
    """Path whose smallest share is largest, and among those the quickest.

    Both senses of the rotation within the plane are looked at where either may be the better: from a
    quarter turn on, or where the shorter one leads through an image border. Where no path keeps all
    constraints, one that keeps at least the face in sight and in both images is taken, if there is one.

    Parameters
    ----------
    reaching : the task; its scale is not used.
    """
    n = len(reaching.q_start)
    work, newton = workspace(n, 4 * len(reaching.A), span_of(reaching.model, reaching.A)), np.empty(n)
    theta_p = float(reaching.amplitudes[2])
    reaching = _turned(reaching, turning_sense(reaching), theta_p)
    other = _turned(reaching, reaching.amplitudes[1], theta_p - math.copysign(2.0 * math.pi, theta_p))
    candidates = [_candidate(reaching, 0.0, work, newton)]
    least = candidates[0].least
    if theta_p != 0.0 and (abs(theta_p) > 0.5 * math.pi or least <= 0.0):
        candidates.append(_candidate(other, max(EQUALLY * least, 0.0), work, newton))
    good = max(EQUALLY * max(candidate.least for candidate in candidates), 0.0)
    paths = [_quickest(candidate) for candidate in candidates if candidate.least > good]
    best = _best(paths)
    if best is None or best.shares().min() <= 0.0:
        if theta_p != 0.0 and len(candidates) == 1:
            candidates.append(_candidate(other, 0.0, work, newton))
        best = _best([*paths, *_narrow(candidates, work)])
    if best is None or best.shares().min() <= 0.0:
        best = _best([*paths, _in_view(candidates)])
    assert best is not None
    return best


def _turned(reaching: Reaching, theta_r: float, theta_p: float) -> Reaching:
    """The same task with other senses of the rotations, and the scales of visibility and image."""
    turned = reaching._replace(amplitudes=np.array([reaching.amplitudes[0], theta_r, theta_p]))
    ends = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    visibility, distance = np.empty((2, 2)), np.empty((2, 2))
    view_path(turned, ends, visibility, distance)
    scale = np.ones(4)
    scale[VISIBILITY] = _positive(visibility.min())
    scale[IMAGE] = _positive(image_margin(distance.min(), reaching.demands))
    return turned._replace(scale=scale)


def _positive(margin: float) -> float:
    return margin if margin > 0.0 else 1.0


def _candidate(reaching: Reaching, good: float, work: Work, newton: FloatArray) -> Candidate:
    """Fill the lattices of one choice of senses; those of the joints only where the views let it be good."""
    n = len(reaching.q_start)
    shares, views = np.empty((NODES, NODES, NODES)), np.empty((NODES, NODES, NODES))
    view_shares(reaching, shares, np.empty((2 * len(reaching.A), 7)))
    in_view = widest(shares, views)
    if not in_view > good:
        return Candidate(reaching, views, in_view, NOTHING, NOTHING, NOTHING, -math.inf)
    field = np.empty((COARSE, COARSE, COARSE, n + 1))
    solve_joints(reaching, work, newton, np.empty((2, 4)), np.empty(field.shape[:3]), field)
    ends = field[0, 0, 0], field[-1, -1, -1]
    reaching.scale[JOINTS] = _positive(min(limit_margin(end[:n], reaching.demands) for end in ends))
    reaching.scale[CONDITIONING] = _positive(min(float(end[n]) for end in ends))
    joints, value = np.empty((*shares.shape, n)), np.empty_like(shares)
    with_joints(reaching, field, np.empty((COARSE, n + 1)), shares, joints)
    return Candidate(reaching, views, in_view, field, joints, value, widest(shares, value))


def _quickest(candidate: Candidate) -> Path:
    """Quickest path of a candidate among those of the largest smallest share."""
    reaching, field = candidate.reaching, candidate.field
    mu = _corners(reaching, field, candidate.value, candidate.least, candidate.joints)
    return _timed(reaching, mu)


def _narrow(candidates: list[Candidate], work: Work) -> list[Path]:
    """Widest path for joints carried through all nodes, of the first candidate that has one that holds."""
    for reaching, views, in_view, *_ in candidates:
        if not in_view > 0.0:
            continue
        n = len(reaching.q_start)
        value, came = np.empty((*views.shape, WAYS)), np.empty((*views.shape, WAYS), dtype=np.int64)
        joints, start, scratch = np.empty((*value.shape, n)), np.empty((n, 4, 4)), np.empty((10, max(n, 4)))
        carry(reaching, views, value, joints, came, start, scratch, work)
        path = np.empty((3 * NODES, 3), dtype=np.int64)
        count = traced(value, came, path)
        if count > 0:
            found = _timed(reaching, path[:count] / (NODES - 1))
            if found.shares().min() > 0.0:
                return [found]
    return []


def _in_view(candidates: list[Candidate]) -> Path:
    """Shortest path in shares of the candidate that keeps its distance best, joints left aside."""
    candidate = max(candidates, key=lambda candidate: candidate.in_view)
    demands = candidate.reaching.demands
    endless = np.full(3, math.inf)
    free = candidate.reaching._replace(demands=demands._replace(lower=-endless, upper=endless, speed=endless))
    shares = _grid(NODES)
    field = np.concatenate([_grid(COARSE), np.full((COARSE,) * 3 + (1,), ENDLESS)], axis=3)
    return _timed(candidate.reaching, _corners(free, field, candidate.views, candidate.in_view, shares))


@lru_cache(maxsize=2)
def _grid(nodes: int) -> FloatArray:
    """Shares at the nodes of a lattice (k, k, k, 3)."""
    axis = np.linspace(0.0, 1.0, nodes)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=3)


def _corners(
    reaching: Reaching, field: FloatArray, value: FloatArray, least: float, joints: FloatArray
) -> FloatArray:
    """Corners (c, 3) of the straightened shortest path through nodes of at least that share."""
    weight = np.empty(joints.shape[3])
    slowness(reaching.demands.speed, weight)
    path = np.empty((3 * NODES, 3), dtype=np.int64)
    cost, came = np.empty_like(value), np.empty(value.shape, dtype=np.int64)
    path = path[: shortest(value, least, joints, weight, cost, came, path)]
    kept = np.empty(len(path) + 1, dtype=np.int64)
    count = straightened(reaching, field, weight, path, NODES - 1, least, kept)
    return np.asarray(path[kept[:count]] / (NODES - 1))


def _timed(reaching: Reaching, corners: FloatArray) -> Path:
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


def _best(paths: list[Path]) -> Path | None:
    """Of the paths in view, or of all if none is, the quickest whose smallest share is as good as any."""
    in_view = [path for path in paths if path.shares()[:, [VISIBILITY, IMAGE]].min() > 0.0]
    paths = in_view or paths
    if not paths:
        return None
    least = [float(path.shares().min()) for path in paths]
    good = min(EQUALLY * max(least), max(least))
    paths = [path for path, share in zip(paths, least, strict=True) if share >= good]
    return min(paths, key=lambda path: path.duration if math.isfinite(path.duration) else math.inf)
