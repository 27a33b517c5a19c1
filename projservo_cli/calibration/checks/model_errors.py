"""Errors of the model: score tests of named nuisances after a fit, and their effect on predictions.

An arm or a rig that is not as the model says leaves residuals. Each nuisance, such as the gear ratio of a
joint, changes the images by known columns Z to first order. Cleared of all fitted parameters they give its
amplitude b without a refit (C. R. Rao, "Large sample tests of statistical hypotheses concerning several
parameters", 1948). The fit absorbs a part of it, so images at other joints err by (Z* − J* J⁺ Z) b.

Nuisances are selected one by one, by their posterior odds under a prior of the width that suits each best
(E. George, D. Foster, "Calibration and empirical Bayes variable selection", Biometrika 87, 2000): a gain of
Δχ² by d amplitudes costs d (1 + log(Δχ²/d)), and each kind is as likely as another. A selected one must be
significant both by the F test and by a Wald test whose covariance counts each posture once, since the corners
of an image share errors (K.-Y. Liang, S. Zeger, "Longitudinal data analysis using generalized linear models",
Biometrika 73, 1986).
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.special import fdtrc

from projservo_cli.calibration.bundle_adjustment import LeastSquares, minimize
from projservo_cli.calibration.detections import SAME_READING, Detections, per_rad
from projservo_cli.calibration.prediction import LENS, Images, Parameters
from projservo_cli.calibration.robust_fit import Solution
from projservo_cli.deviations import (
    ALWAYS,
    DEVIATIONS,
    DRIFT,
    JOINT,
    PAIR,
    PAST,
    PX,
    READING,
    SHARE,
    STEP,
    Deviation,
)
from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.geometry.displacements import cross_matrix, generators
from projservo_cli.geometry.joint_curve import OF_READING
from projservo_cli.records import CORNERS, BoolArray, Errors, FloatArray, IntArray

# Probability of chance above which no nuisance is found.
_CHANCE = 1e-4
# Maximum number of nuisances that are found together.
_MAX_FOUND = 8
# Number of best candidates of which one must pass both tests.
_TRIED = 4
# Share of the gain of a nuisance from which one of fewer parameters is preferred.
_AS_MUCH = 0.995
# Logarithm of the odds, doubled, below which one nuisance explains the images as well as another: 20 to 1.
_UNDECIDED = 6.0
# Maximum number of others that are named with a nuisance.
_MAX_OTHERS = 2
# Number of rounds in which a nuisance found may give way to a better one.
_ROUNDS = 2
# Standard deviations of an amplitude that the tests find in half of the cases.
_DETECTED = 3.9
# Standard deviations of a variance ratio above which postures share errors.
_CORRELATED = 3.9
# Deviation of an amplitude, in units of its usual size, above which the data leave it open.
_OPEN = 30.0
# Minimum number of poses before and after a marker slips, and difference of the shares of rejected images.
_MIN_SLIP, _SLIPPED = 5, 0.5
# Maximum number of tags of which each may slip on its own, as more take too long.
_MAX_TAGS = 4
# Minimum number of corners of a tag that slip.
_MIN_CORNERS = 2
# Maximum leverage of the images of a posture, whose residuals say nothing beyond.
_MAX_LEVERAGE = 0.999
# Maximum number of terms of the root of leverages as a series, and their share at which it ends.
_TERMS, _ROUNDING = 60, 1e-14
# Maximum share of the squared image errors that a named step leaves.
_UNEXPLAINED = 0.2
# Effect over the stated error from which a nuisance that the data could not have shown is named.
_UNSHOWN = 2.0
# Cycles over the range of a joint that are tried, and maximum number for each of its readings that differ.
_CYCLES, _SHOWN = np.arange(2.0, 16.1, 0.5), 0.25


class _Nuisance(NamedTuple):
    """Changes of the images of observations by one thing that the model leaves out."""

    kind: str
    joints: tuple[int, ...]  # from 0
    view: int | None
    columns: FloatArray  # (V, N, 2, d) weighted, by its amplitudes
    timed: int = ALWAYS  # when it acts
    tag: int | None = None  # number, for a single tag
    period: float = np.nan  # rad or m, the best of those tried

    @property
    def row(self) -> Deviation:
        """Its row of the table."""
        return DEVIATIONS[self.kind]

    @property
    def like(self) -> tuple[str, int, int, bool]:
        """Key of those that differ in the joint, the view or the tag alone."""
        return self.kind, len(self.joints), self.timed, self.tag is None

    @property
    def cause(self) -> tuple[str, tuple[int, ...], int | None]:
        """Key of those that have the same cause: a curve of any order, a lens and its centre."""
        return self.row.cause or self.kind, self.joints, self.view


class _Extent(NamedTuple):
    """Ranges of the recorded data, which give nuisances their units."""

    middle: FloatArray  # (n,) of the readings from the reference
    half: FloatArray  # (n,) half their range
    center: FloatArray  # (V, 2) of the images, px
    radius: FloatArray  # (V,) half the size of the images, px
    depth: FloatArray  # (V, 2) mean and deviation of depths
    cycles: FloatArray  # (n,) over the range of each joint that explain most; NaN where too few are shown

    @classmethod
    def of(cls, solution: Solution) -> "_Extent":
        """Return the ranges of the detections that count, and how often residuals swing over them."""
        problem, detections, used = solution.problem, solution.problem.detections, solution.used
        q, depths = problem.q[np.unique(detections.pose_of)], problem.pixels(solution.params)[1]
        low, high = (
            np.stack([end(seen[u], axis=0) for seen, u in zip(detections.pixels, used, strict=True)])
            for end in (np.min, np.max)
        )
        depth = np.array([[d[u].mean(), max(d[u].std(), 1e-12)] for d, u in zip(depths, used, strict=True)])
        half = np.maximum(0.5 * np.ptp(q, axis=0), 1e-9)
        middle = 0.5 * (q.min(axis=0) + q.max(axis=0))
        radius = np.maximum(0.5 * (high - low).max(axis=1), 1.0)  # a view may have one detection left
        x = (problem.q - middle) / half
        return cls(middle, half, 0.5 * (low + high), radius, depth, _cycles(solution, x))


def _cycles(solution: Solution, x: FloatArray) -> FloatArray:
    """Cycles (n,) over the range of each joint, x (K, n) from −1 to 1, that explain most of the residuals.

    Joint by joint, at each pose by the error of the reading that explains its residuals best.
    """
    problem = solution.problem
    G = problem.joint_derivative(solution.params) * solution.used[..., None, None]
    weight = problem.at_poses(np.square(G).sum(axis=(0, 2)))  # (K, n)
    score = -problem.at_poses((G * solution.raw[..., None]).sum(axis=(0, 2)))
    found = np.full(x.shape[1], np.nan)
    for i, angle in enumerate(np.pi * x.T):
        readings = np.unique(np.round(problem.q[:, i] / SAME_READING)).size
        gains = []
        root = np.sqrt(weight[:, i])
        y = score[:, i] / np.maximum(root, 1e-300)
        plain = np.stack([np.ones_like(angle), angle]) * root
        Q = np.linalg.qr(plain.T)[0]
        y = y - Q @ (Q.T @ y)
        for cycles in _CYCLES[_SHOWN * readings >= _CYCLES]:
            waves = (np.stack([np.sin(cycles * angle), np.cos(cycles * angle)]) * root).T
            waves -= Q @ (Q.T @ waves)
            gains.append(float(y @ waves @ np.linalg.lstsq(waves, y)[0]))
        if gains:
            found[i] = _CYCLES[int(np.argmax(gains))]
    return found


def _nuisances(problem: LeastSquares, params: Parameters, extent: _Extent) -> list[_Nuisance]:
    """Return all nuisances at the observations of a problem, in one order for all problems of a fit."""
    detections, q = problem.detections, problem.joints(params)
    images = params.images(q, detections.pose_of, detections.marker_of)
    found = _of_readings(problem, params, q, extent, images)
    for v in range(len(params.P)):
        found += _of_view(problem, params, extent, images, v)
    before = replace(detections, pose_of=np.maximum(detections.pose_of - 1, 0))
    change = replace(problem, detections=before).pixels(params)[0] - images.pixels
    columns = (change * detections.weight[..., None])[..., None]
    found.append(_Nuisance("memory", (), None, columns, PAST))
    rigid = generators(cross_matrix(np.eye(3)), params.M[:, :3].mean(axis=0))
    for kind, behind in (("base", 0), ("tool", -1)):
        columns = images.by_motion(rigid, behind) * detections.weight[..., None, None]
        found += [_Nuisance(kind, (), None, columns, timed) for timed in DEVIATIONS[kind].times]
    tag_of = detections.marker[detections.marker_of] // CORNERS
    tags, corners = np.unique(detections.marker // CORNERS, return_counts=True)
    tags = tags[corners == CORNERS]
    if 1 < tags.size <= _MAX_TAGS:
        for tag in tags.tolist():
            of_tag = columns * (tag_of == tag)[:, None, None]
            found.append(_Nuisance("tool", (), None, of_tag, STEP, tag))
    return found


def _of_readings(
    problem: LeastSquares, params: Parameters, q: FloatArray, extent: _Extent, images: Images
) -> list[_Nuisance]:
    """Nuisances of joints: curves of readings, coupling, sag under a weight at the tool, drift, step."""
    detections, n, found = problem.detections, len(params.H_hat), list[_Nuisance]()
    G = images.by_joint(params.H_hat) * detections.weight[..., None, None]
    x, unit, loads = (q - extent.middle) / extent.half, per_rad(params.prismatic), _loads(params, q)

    def of_joint(kind: str, i: int, change: FloatArray, *others: int, period: float = np.nan) -> None:
        """Add a nuisance that changes readings of joint i by (K, d)."""
        columns = G[..., [i]] * change[detections.pose_of][:, None]
        (timed,) = DEVIATIONS[kind].times
        found.append(_Nuisance(kind, (*others, i), None, columns, timed, period=period))

    def by_curve(row: Deviation, i: int, by: int) -> FloatArray:
        """Change (K, d) of the readings of joint i by the functions of a row of the readings of another."""
        if "torque" in row.curve:
            return loads[:, i]
        if row.unit == SHARE:
            return np.stack([OF_READING[name](q[:, by]) * unit[i] / unit[by] for name in row.curve], axis=1)
        # Powers are about the middle of the range; each has its lower ones too.
        reading = q[:, by] if row.turns else x[:, by]
        return np.asarray(unit[i] * np.stack([OF_READING[name](reading) for name in row.curve], axis=1))

    for i, (kind, row) in product(range(n), DEVIATIONS.items()):
        if (row.turns and params.prismatic[i]) or 2.0 * extent.half[i] < row.range_rad:
            continue
        if detections.chart is not None and not (kind == "scale" and params.prismatic[i]):
            continue  # turns of a flange are of no gear
        if row.curve:
            for by in [j for j in range(n) if j != i] if row.part == PAIR else [i]:
                of_joint(kind, i, by_curve(row, i, by), *([by] if by != i else []))
        elif kind == "cyclic":
            if np.isfinite(cycles := extent.cycles[i]):
                angle = np.pi * cycles * x[:, i]
                waves = np.stack([np.sin(angle), np.cos(angle)], axis=1)
                of_joint(kind, i, unit[i] * waves, period=2.0 * extent.half[i] / cycles)
        elif row.part == JOINT:  # a zero that changes with time
            of_joint(kind, i, np.full((len(q), 1), unit[i]))
    if n > 1 and detections.chart is None:
        columns = G * q[detections.pose_of][:, None]
        found.append(_Nuisance("scale", tuple(range(n)), None, columns))
    return found


def _of_view(
    problem: LeastSquares, params: Parameters, extent: _Extent, images: Images, v: int
) -> list[_Nuisance]:
    """Nuisances of a camera: drift and step of its images, lens or its centre, focus with depth."""
    detections, found = problem.detections, list[_Nuisance]()
    pixels, depths = problem.pixels(params)
    x = (pixels[v] - extent.center[v]) / extent.radius[v]

    def add(kind: str, change: FloatArray) -> None:
        """Add a nuisance that changes the images by (N, 2, d)."""
        columns = np.zeros((*pixels.shape, change.shape[-1]))
        columns[v] = change * detections.weight[v][:, None, None]
        found.append(_Nuisance(kind, (), v, columns, *DEVIATIONS[kind].times))

    motions = image_motions(x)
    add("camera_drift", motions)
    add("camera_step", motions)
    if images.by_lens is None:
        square = (x**2).sum(axis=1)[:, None, None]
        add("lens", x[..., None] * np.concatenate([square, square**2], axis=2))
    if images.by_lens is not None and problem.lens_terms == LENS:
        add("lens_center", images.by_lens[v][..., LENS:])
    else:  # a lens estimated with its centre, or not at all: decentring, after Brown
        square, axes = (x**2).sum(axis=1)[:, None, None], np.broadcast_to(np.eye(2), (len(x), 2, 2))
        add("lens_center", square * axes + 2.0 * x[..., None] * x[:, None])
    mean, deviation = extent.depth[v]
    add("focus", x[..., None] * ((depths[v] - mean) / deviation)[:, None, None])
    return found


def image_motions(x: FloatArray) -> FloatArray:
    """Return the changes (N, 2, 4) of an image at places (N, 2) from its middle by shift, scale and turn."""
    motions = np.zeros((len(x), 2, 4))
    motions[..., :2], motions[..., 2] = np.eye(2), x
    motions[:, 0, 3], motions[:, 1, 3] = -x[:, 1], x[:, 0]
    return motions


def _loads(params: Parameters, q: FloatArray) -> FloatArray:
    """Return torques (K, n, 3) of a weight at the tool about each joint by the components of gravity.

    The torque of joint i is the velocity of the weight under it, H̄_i Ĥ_i H̄_i⁻¹ applied to the weight, along
    gravity; a deflection follows it. The largest one of each joint has length one.
    """
    center, joints = np.append(params.M[:, :3].mean(axis=0), 1.0), np.arange(q.shape[1])
    q, ideal = params.turned(q), replace(params, curve=None)
    truncated = [ideal.motion(np.where(joints <= i, q, 0.0)) for i in joints]
    loads = np.empty((*q.shape, 3))
    for i, H_bar in enumerate(truncated):
        behind = np.linalg.solve(H_bar, truncated[-1] @ center[:, None])
        loads[:, i] = (H_bar @ (params.H_hat[i] @ behind))[:, :3, 0]
    return np.asarray(loads / np.maximum(np.linalg.norm(loads, axis=2).max(axis=0), 1e-12)[:, None])


class _Choice(NamedTuple):
    """A nuisance by its number, and the pose at which it begins, if it is a step."""

    number: int
    onset: int


class _Tests:
    """Score tests of nuisances on the whitened residuals of a fit, cleared of its parameters."""

    def __init__(self, solution: Solution, errors: Errors, nuisances: Sequence[_Nuisance]) -> None:
        problem, params, used = solution.problem, solution.params, solution.used
        pose_of = np.repeat(np.tile(problem.detections.pose_of, len(used)), 2)
        counted = np.flatnonzero(np.repeat(used.ravel(), 2))
        counted = counted[np.argsort(pose_of[counted], kind="stable")]
        self.poses, starts = np.unique(pose_of[counted], return_index=True)
        self.edges = np.append(starts, counted.size)
        self.dof = max(solution.dof, 1)
        self.detections = problem.detections
        # Weights of residuals in each view, and in the last entry in all: weights of two views are near one.
        weights = [problem.detections.weight[v, u] for v, u in enumerate(used)]
        weights.append(problem.detections.weight[used])
        self.weight = [1.0 if len(used) == 2 else float(np.sqrt(np.mean(w**2))) for w in weights]
        self.posture = _postures(problem.q[self.poses])

        def whitened(columns: FloatArray) -> FloatArray:
            """Rows (L, c) of the detections that count, pose by pose."""
            return problem.whitened(params, columns, used)[counted]

        # U Uᵀ projects on all that the parameters can do; seen less predicted images r are cleared of it.
        self.F = errors.dense()
        self.U = whitened(problem.dense(problem.derivative(params), used)) @ self.F
        r = -whitened(solution.raw.reshape(-1, 1))[:, 0]
        self.r = self.r_first = r - self.U @ (self.U.T @ r)
        self.parts = np.cumsum([0, *(one.columns.shape[3] for one in nuisances)])
        self.units = list[FloatArray]()
        self.Z = np.empty((len(r), int(self.parts[-1])))
        for number, one in enumerate(nuisances):
            columns = whitened((one.columns * used[..., None, None]).reshape(2 * used.size, -1))
            self.units.append(_unit(one.row, columns))
            self.Z[:, self.part(number)] = columns @ self.units[-1]
            if one.timed == DRIFT:
                self.Z[:, self.part(number)] *= self._over_rows(DRIFT, 0)
        self.nuisances = [one._replace(columns=np.zeros(0)) for one in nuisances]  # as large again
        self.W = self.U.T @ self.Z  # (p, c)
        self.steps = [number for number, one in enumerate(nuisances) if one.timed == STEP]
        self.grams = self._grams()
        self.Q = np.zeros((len(r), 0))  # orthonormal columns of the nuisances chosen
        self.periods = False  # whether an error that repeats over a joint is a candidate

    def part(self, number: int) -> slice:
        """Columns of a nuisance among all."""
        return slice(*self.parts[number : number + 2].tolist())

    def _over_rows(self, timed: int, onset: int) -> FloatArray:
        """Amplitudes (L, 1) over the detections of a drift, or of a step at a pose."""
        return np.repeat(_over_time(timed, len(self.poses), onset), np.diff(self.edges))[:, None]

    def _grams(self) -> list[FloatArray]:
        """Gram matrices of cleared nuisances, (d, d); of steps at each pose (K - 1, d, d)."""
        parts = [self.part(number) for number in range(len(self.nuisances))]
        grams = [self.Z[:, at].T @ self.Z[:, at] - self.W[:, at].T @ self.W[:, at] for at in parts]
        for number in self.steps:
            grams[number] = np.zeros((max(len(self.poses) - 1, 0), *grams[number].shape))
        after = np.zeros_like(self.W)
        square = [np.zeros((at.stop - at.start,) * 2) for at in parts]
        which = np.isin(np.repeat(np.arange(len(parts)), np.diff(self.parts)), self.steps)
        for k in range(len(self.poses) - 1, 0, -1):
            rows = slice(*self.edges[k : k + 2])
            after[:, which] += self.U[rows].T @ self.Z[rows][:, which]
            for number in self.steps:
                at, Z = parts[number], self.Z[rows, parts[number]]
                square[number] += Z.T @ Z
                grams[number][k - 1] = square[number] - after[:, at].T @ after[:, at]
        return grams

    def columns(self, choice: _Choice) -> FloatArray:
        """Columns (L, d) of a nuisance in units of its usual size."""
        own = self.Z[:, self.part(choice.number)]
        return own * self._over_rows(STEP, choice.onset) if choice.number in self.steps else own

    def cleared(self, columns: FloatArray) -> FloatArray:
        """Columns (L, d) cleared of the parameters and of the nuisances chosen."""
        columns = columns - self.U @ (self.U.T @ columns)
        return np.asarray(columns - self.Q @ (self.Q.T @ columns))

    def choose(self, choices: Sequence[_Choice]) -> None:
        """Clear the residuals of some nuisances."""
        self.Q = np.zeros((len(self.r), 0))
        if choices:
            self.Q = self._known(self.cleared(np.hstack([self.columns(one) for one in choices])))
        self.r = self.r_first - self.Q @ (self.Q.T @ self.r_first)

    @property
    def sigma(self) -> float:
        """Noise that the residuals show, px."""
        return float(np.sqrt(self.r @ self.r / self.dof))

    def _known(self, cleared: FloatArray) -> FloatArray:
        """Orthonormal directions (L, k) of cleared columns that the data do not leave open."""
        values, basis = np.linalg.eigh(cleared.T @ cleared)
        known = values > max(self.sigma / _OPEN, 1e-9) ** 2
        return np.linalg.qr(cleared @ basis[:, known])[0]

    def candidates(self) -> list[tuple[float, _Choice, float]]:
        """Return criterion, nuisance and gain of all that the criterion prefers to none, best first."""
        square, K = float(self.r @ self.r), len(self.poses)
        alike = Counter(one.like for one in self.nuisances)
        plain = [
            number
            for number, one in enumerate(self.nuisances)
            if one.timed != STEP and (self.periods or one.kind != "cyclic")
        ]
        s, W = self.Z.T @ self.r, self.Q.T @ self.Z
        found = []

        def judge(gain: float, choice: _Choice, onsets: int) -> None:
            """Keep a nuisance whose gain in squares is worth its amplitudes and the choice of it."""
            one, d = self.nuisances[choice.number], len(self.units[choice.number])
            likelihood = -self.dof * np.log1p(-min(gain / max(square, 1e-300), 1.0 - 1e-12))
            tries = alike[one.like] * onsets * (len(_CYCLES) if one.kind == "cyclic" else 1)
            criterion = d * (1.0 + np.log(max(likelihood / d, 1.0))) + 2.0 * np.log(tries) - likelihood
            if criterion < 0.0:
                found.append((float(criterion), choice, gain))

        for number in plain:
            at = self.part(number)
            gram = self.grams[number] - W[:, at].T @ W[:, at]
            judge(float(self._gain(gram, s[at])), _Choice(number, 0), 1)
        for number, gains in self._step_gains() if K > 2 else ():
            onset = int(np.argmax(gains)) + 1
            judge(float(gains[onset - 1]), _Choice(number, onset), K)
        return sorted(found)

    def _gain(self, gram: FloatArray, score: FloatArray) -> FloatArray:
        """Squared residuals (…) that cleared columns take away, by Gram matrices and scores (…, d)."""
        values, basis = np.linalg.eigh(gram)
        along = (basis.swapaxes(-1, -2) @ score[..., None])[..., 0]
        return np.asarray((along**2 / np.maximum(values, (self.sigma / _OPEN) ** 2 + 1e-18)).sum(axis=-1))

    def _step_gains(self) -> Iterator[tuple[int, FloatArray]]:
        """Number and gains (K - 1,) of each step, at each pose from the second on."""
        first = self.edges[:-1]

        def later(rows: FloatArray) -> FloatArray:
            """Sums (K - 1, …) of rows (L, …) from each pose on, but the first."""
            return np.asarray(np.cumsum(np.add.reduceat(rows, first, axis=0)[::-1], axis=0)[::-1][1:])

        for number in self.steps:
            Z, gram = self.Z[:, self.part(number)], self.grams[number]
            if self.Q.shape[1]:
                W = later(self.Q[:, :, None] * Z[:, None])
                gram = gram - W.swapaxes(1, 2) @ W
            yield number, self._gain(gram, later(Z * self.r[:, None]))

    def chance(self, choice: _Choice) -> float:
        """Probability of chance: the larger of the F test and of the Wald test by postures."""
        Q = self._known(self.cleared(self.columns(choice)))
        b, d = Q.T @ self.r, Q.shape[1]
        left = self.r - Q @ b
        freedom = float(max(self.dof - d, 1))
        square = max(float(left @ left), 1e-300)
        chance = float(fdtrc(d, freedom, float(b @ b) / d / (square / freedom))) if d else 1.0
        groups, count = np.repeat(self.posture, np.diff(self.edges)), int(self.posture.max()) + 1
        weight = np.bincount(groups, (Q**2).sum(axis=1), count)
        freedom = weight.sum() ** 2 / max(float((weight**2).sum()), 1e-300) - d
        if freedom < 1.0:
            return 1.0
        scores = np.stack([np.bincount(groups, column, count) for column in (Q * left[:, None]).T], axis=1)
        V = scores.T @ scores * count / max(count - 1, 1) + 1e-9 * square / self.dof * np.eye(d)
        wald = float(b @ np.linalg.solve(V, b)) / d * freedom / (freedom + d - 1.0)
        tries = len(self.poses) - 1 if choice.onset else 1
        return tries * max(chance, float(fdtrc(d, freedom, wald)))

    def select(self) -> list[_Choice]:
        """Choose nuisances one by one, then exchange each for a better one in the presence of the others.

        Waves over a joint mimic much, so they are candidates if nothing else is found.
        """
        chosen = list[_Choice]()
        for self.periods in (False, True):
            while len(chosen) < _MAX_FOUND and (best := self._best()) is not None:
                chosen.append(best)
                self.choose(chosen)
            if chosen:
                break
        for _ in range(_ROUNDS if chosen else 0):
            before = list(chosen)
            for one in before:
                self.choose(others := [other for other in chosen if other != one])
                best = self._best()
                chosen = others if best is None else [*others, best]
            if set(chosen) == set(before):
                break
        self.choose(chosen)
        return chosen

    def as_likely(self, choice: _Choice, chosen: Sequence[_Choice]) -> tuple[Finding, ...]:
        """Other nuisances that explain the images about as well as one of those chosen."""
        self.choose([other for other in chosen if other != choice])
        candidates = self.candidates()
        self.choose(chosen)
        own = [criterion for criterion, other, _ in candidates if other.number == choice.number]
        near = [
            self.nuisances[other.number]
            for criterion, other, _ in candidates
            if own and criterion < own[0] + _UNDECIDED
        ]
        named = {one.cause: one for one in near[::-1]}
        named.pop(self.nuisances[choice.number].cause, None)
        others = [_finding(one, self.detections, 0.0, 0.0, 0.0, None) for one in named.values()]
        return tuple(others[::-1][:_MAX_OTHERS])

    def _best(self) -> _Choice | None:
        """Best candidate that is significant, or the one of fewer parameters that explains nearly as much."""
        candidates = self.candidates()
        for _, best, gain in candidates[:_TRIED]:
            if self.chance(best) >= _CHANCE:
                continue
            for _, simple, its_gain in candidates:  # to first order, a large gear bends like a curve
                fewer = len(self.units[simple.number]) < len(self.units[best.number])
                if fewer and its_gain >= _AS_MUCH * gain and self.chance(simple) < _CHANCE:
                    return simple
            return best
        return None


def _unit(row: Deviation, Z: FloatArray) -> FloatArray:
    """Amplitudes (d, d) of the usual size of a deviation, for columns (L, d): of the images by their rms."""
    if row.unit != PX:
        return row.size * np.eye(Z.shape[1])
    count = max(int(np.count_nonzero(np.abs(Z).max(axis=1))), 1)
    values, basis = np.linalg.eigh(Z.T @ Z / count)
    return np.asarray(row.size * basis / np.sqrt(np.maximum(values, 1e-12 * values[-1] + 1e-300)))


def _over_time(timed: int, poses: int, onset: int) -> FloatArray:
    """Amplitudes (K,) over the poses of a drift, from −½ to ½, or of a step at a pose."""
    if timed == DRIFT:
        return np.linspace(-0.5, 0.5, poses)
    return (np.arange(poses) >= onset).astype(np.float64)


def _postures(q: FloatArray) -> IntArray:
    """Number the posture of each pose (K, n), rad or m: poses that are nearly the same share one."""
    if len(q) < 2:
        return np.zeros(len(q), dtype=np.int64)
    groups = fcluster(linkage(q, "single", "chebyshev"), SAME_READING, "distance")
    return np.asarray(groups - 1, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class ModelCheck:
    """Errors of predictions, and the deviations from the model that explain them."""

    errors: tuple[Finding, ...]  # tags that slipped, and those that dominate noise, largest effect first
    effect_px: float  # rms error per marker and view at other poses by all of them
    noise_px: float  # that by noise, with the correlation of the corners of a posture
    noise_factor: float  # noise_px over the noise of independent corners
    recorded_px: float  # rms error at the recorded poses
    unshown: Finding | None  # with the largest effect that the data could not have shown
    bias: FloatArray  # (p, errors) error of the parameters by each of them

    @property
    def predicted_px(self) -> float:
        """Expected error at other poses, rms per marker and view, px."""
        return float(np.hypot(self.noise_px, self.effect_px))


def examine(
    solution: Solution,
    errors: Errors,
    there: LeastSquares,
    inside: BoolArray,
    T: FloatArray,
    sigma_px: float,
    share: float = 1.0,
) -> ModelCheck:
    """Test a fit for nuisances, and return their effect at other poses.

    solution : fit, of few markers; errors : of its parameters at a noise of one pixel.
    there : problem of the same markers at the other poses; inside : (V, N) its images that count.
    T : (rows, r) changes of these images by ``errors``; sigma_px : noise of a coordinate, px; share : that
    these detections are of those by whose noise a deviation is hidden.
    """
    extent = _Extent.of(solution)
    tests = _Tests(solution, errors, _nuisances(solution.problem, solution.params, extent))
    effects = _Effects(tests, _nuisances(there, solution.params, extent), inside, T)
    independent_px = sigma_px * effects.rms(T.ravel()) * np.sqrt(T.shape[1])
    chosen = tests.select()
    found, total, bias = _estimated(tests, effects, chosen)
    slipped, slip_px = _slipped_tags(solution)
    if len(slipped) > 1:  # several tags do not slip at once, but their carrier may move
        detections = solution.problem.detections
        kept, seen = (detections.count_at(mask) for mask in (solution.used, detections.seen))
        lost = 1.0 - kept / np.maximum(seen, 1)
        change = [abs(lost[k:].mean() - lost[:k].mean()) for k in range(1, len(lost))]
        moved = stepped(solution, 1 + int(np.argmax(change)))
        if moved is not None:
            slipped = [replace(moved, effect_px=slip_px)]
        elif 2 * len(slipped) > np.unique(detections.marker // CORNERS).size:
            slipped, slip_px = [], 0.0
    total = float(np.hypot(total, slip_px))
    factor = np.sqrt(_design(tests, tests.r, T, sigma_px))
    at_recorded = sigma_px * np.sqrt(2.0 * np.square(tests.U).sum() / max(len(tests.r), 1))
    explained = tests.r_first - tests.r
    if total <= factor * independent_px * np.sqrt(share):  # noise hides it
        factor = np.sqrt(_design(tests, tests.r_first, T, sigma_px)) if chosen else factor
        found, total, bias, explained = [], 0.0, bias[:, :0], np.zeros(1)
    at_recorded = float(np.hypot(factor * at_recorded, effects.rms(explained)))
    order = sorted(range(len(found)), key=lambda k: -found[k].effect_px)
    noise_px = float(factor * independent_px)
    unshown = effects.unshown({one.number for one in chosen}, sigma_px)
    if unshown is not None and unshown.effect_px <= _UNSHOWN * np.hypot(noise_px, total):
        unshown = None
    named = (*slipped, *(found[k] for k in order))
    bias = np.hstack([np.zeros((len(bias), len(slipped))), bias[:, order]])
    return ModelCheck(named, total, noise_px, float(factor), at_recorded, unshown, bias)


def suspected(few: Solution) -> list[tuple[str, tuple[int, ...]]]:
    """Return kinds and joints, from 1, of nuisances that explain images better than none, likeliest first.

    Those that significance selects, each with others about as likely, come before the rest. For few markers.
    """
    tests = _Tests(few, few.errors(), _nuisances(few.problem, few.params, _Extent.of(few)))
    chosen, found = tests.select(), list[_Choice]()
    for own in chosen:
        tests.choose([other for other in chosen if other != own])
        better = tests.candidates()
        min_criterion = min(
            (criterion for criterion, one, _ in better if one.number == own.number), default=-np.inf
        )
        found += [one for criterion, one, _ in better if criterion < min_criterion + _UNDECIDED]
    tests.choose(chosen)
    found += [one for _, one, _ in tests.candidates()]
    nuisances = [tests.nuisances[one.number] for one in found]
    named = [(one.kind, tuple(int(tests.detections.numbers[i]) for i in one.joints)) for one in nuisances]
    return list(dict.fromkeys(named))


def stepped(solution: Solution, onset: int) -> Finding | None:
    """Return the part that moved at a pose, by its row, of a recording that no single fit describes, or None.

    The part in which all joints move more is fitted; a step explains the other's images as far as it can.
    """
    plain, detections = solution.problem.with_noise(None), solution.problem.detections
    span = [(np.ptp(part, axis=0) / np.ptp(plain.q, axis=0)).min() for part in np.split(plain.q, [onset])]
    fitted = (detections.pose_of < onset) == (span[0] > span[1])
    params = minimize(plain, solution.params, detections.seen & fitted, robust=True).params
    rows = np.repeat((detections.seen & ~fitted).ravel(), 2)
    off = plain.residual(params).ravel()[rows]
    weight = np.repeat(detections.weight.ravel(), 2)[rows].clip(1e-300)
    best, left = None, _UNEXPLAINED * float(off @ off)
    for one in _nuisances(plain, params, _Extent.of(solution)):
        if one.timed != STEP:
            continue
        Z = one.columns.reshape(len(rows), -1)[rows]
        b = np.linalg.lstsq(Z, off)[0]
        if (square := float(np.square(off - Z @ b).sum())) < left:
            size = float(np.sqrt(np.mean((Z @ b / weight) ** 2)) if one.row.unit == PX else -b[0])
            left = square
            best = _finding(one, detections, size, 0.0, abs(size), int(detections.pose[onset]))
    return best


def _slipped_tags(solution: Solution) -> tuple[list[Finding], float]:
    """Tags that moved on the tool: corners rejected from a pose on, or up to it; and the effect of all, px.

    A corner stays where most of its images show it. A corner that stays where it was before is wrong at the
    end, by as much as its rejected images; the effect is rms over all markers.
    """
    problem, found, square = solution.problem, list[Finding](), 0.0
    detections, number = problem.detections, problem.detections.marker
    out = detections.seen & ~solution.used
    far = np.linalg.norm(solution.residual / detections.weight.clip(1e-300)[..., None], axis=2)
    for tag in np.unique(number // CORNERS):
        corners = np.flatnonzero(number // CORNERS == tag)
        slips = [] if corners.size < CORNERS else [_slip(detections, out, int(corner)) for corner in corners]
        onsets = [onset for onset, _ in slips if onset]
        if len(onsets) < _MIN_CORNERS or np.ptp(onsets) > _MIN_SLIP:
            continue
        onset = int(np.median(onsets))
        rows = out & np.isin(detections.marker_of, corners)
        off = float(np.median(far[rows]))
        at_end = sum(lost_after for _, lost_after in slips)
        effect = off * float(np.sqrt(at_end / number.size))
        square += effect**2
        spread = off / float(np.sqrt(np.count_nonzero(rows)))
        moved = _Nuisance("tool", (), None, np.zeros(0), STEP, int(tag))
        found.append(_finding(moved, detections, off, spread, effect, int(detections.pose[onset])))
    return found, float(np.sqrt(square))


def _slip(detections: Detections, out: BoolArray, marker: int) -> tuple[int, bool]:
    """Pose at which a marker begins or ceases to be rejected, 0 if none, and whether it is rejected later."""
    of_marker = detections.seen & (detections.marker_of == marker)
    seen, lost = (detections.count_at(mask) for mask in (of_marker, of_marker & out))
    after = np.array([np.cumsum(counts[::-1])[::-1] for counts in (lost, seen)])
    before = after[:, :1] - after
    enough = np.minimum(after[1], before[1]) >= _MIN_SLIP * max(int(seen.max()), 1)
    change = after[0] / np.maximum(after[1], 1) - before[0] / np.maximum(before[1], 1)
    onset = int(np.argmax(np.where(enough, np.abs(change), -1.0)))
    slipped = bool(enough[onset]) and abs(change[onset]) > _SLIPPED
    return (onset, bool(change[onset] > 0.0)) if slipped else (0, False)


def _estimated(
    tests: _Tests, effects: "_Effects", chosen: Sequence[_Choice]
) -> tuple[list[Finding], float, FloatArray]:
    """Amplitudes of nuisances together, with their effects; the effect of all, px; the bias of parameters."""
    if not chosen:
        return [], 0.0, np.zeros((len(tests.F), 0))
    parts = [tests.columns(one) for one in chosen]
    Z = np.hstack(parts)
    cleared = Z - tests.U @ (tests.U.T @ Z)
    information = cleared.T @ cleared / tests.sigma**2 + np.eye(Z.shape[1]) / _OPEN**2
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    b = covariance @ (cleared.T @ tests.r_first) / tests.sigma**2
    edges = np.cumsum([0, *(part.shape[1] for part in parts)])
    own = [slice(*ends) for ends in pairwise(edges.tolist())]
    moved = [effects.of(one.number, part) @ b[at] for one, part, at in zip(chosen, parts, own, strict=True)]
    found = []
    for one, at, change in zip(chosen, own, moved, strict=True):
        first = int(tests.detections.pose[tests.poses[one.onset]]) if one.onset else None
        error = _described(tests, one.number, b[at], covariance[at, at], effects.rms(change), first)
        found.append(replace(error, others=tests.as_likely(one, chosen)))
    of_images = np.stack([part @ b[at] for part, at in zip(parts, own, strict=True)], axis=1)
    return found, effects.rms(np.sum(moved, axis=0)), tests.F @ (tests.U.T @ of_images)


class _Effects:
    """Changes of images at other poses by nuisances, less the part that the fit absorbs."""

    def __init__(self, tests: _Tests, there: Sequence[_Nuisance], inside: BoolArray, T: FloatArray) -> None:
        self.tests, self.there, self.T = tests, there, T
        self.rows = np.repeat(inside.ravel(), 2)

    def of(self, number: int, Z: FloatArray) -> FloatArray:
        """Changes (rows, d) at the end of the recording by a nuisance of columns (L, d) in the data."""
        return self._moved(number, self.T @ (self.tests.U.T @ Z))

    def _moved(self, number: int, absorbed: FloatArray) -> FloatArray:
        """The same, of which the fit absorbs a part (rows, d)."""
        one = self.there[number]
        columns = one.columns.reshape(len(self.rows), -1)[self.rows] @ self.tests.units[number]
        share = {DRIFT: 0.5, PAST: 0.0}.get(one.timed, 1.0)  # at rest, images are of nothing before
        return np.asarray(share * columns - absorbed)

    def rms(self, change: FloatArray) -> float:
        """Root mean square per marker and view of a change (rows,)."""
        return float(np.sqrt(2.0 / max(len(change), 1)) * np.linalg.norm(change))

    def unshown(self, found: set[int], sigma_px: float) -> Finding | None:
        """Nuisance that has the largest effect of those too small for the tests and no larger than usual."""
        worst: tuple[float, int, FloatArray] | None = None
        absorbed = self.T @ self.tests.W
        for number, one in enumerate(self.tests.nuisances):
            if number in found or one.timed != ALWAYS or (one.kind == "scale" and len(one.joints) > 1):
                continue
            values, basis = np.linalg.eigh(self.tests.grams[number] / (_DETECTED * sigma_px) ** 2)
            root = basis / np.sqrt(1.0 + np.maximum(values, 0.0))
            moved = self._moved(number, absorbed[:, self.tests.part(number)])
            _, s, Vt = np.linalg.svd(moved @ root, full_matrices=False)
            if worst is None or s[0] > worst[0]:
                worst = float(s[0]), number, root @ Vt[0]
        if worst is None:
            return None
        effect, number, b = worst
        effect *= float(np.sqrt(2.0 / max(len(self.T), 1)))
        return _described(self.tests, number, b, np.zeros((len(b), len(b))), effect, None)


def _described(
    tests: _Tests, number: int, b: FloatArray, covariance: FloatArray, effect: float, first: int | None
) -> Finding:
    """Finding on a nuisance of amplitudes b (d,), in units of its usual size, with their covariance."""
    one, length = tests.nuisances[number], max(float(np.linalg.norm(b)), 1e-300)
    sign = -1.0 if (len(b) == 1 or one.kind == "scale") and (b < 0.0).all() else 1.0
    deviation = float(np.sqrt(max(float(b @ covariance @ b), 0.0))) / length
    size = one.row.size
    if one.kind == "scale":  # for several joints, the root mean square
        size /= np.sqrt(len(one.joints))
    if one.row.unit == PX:  # px as seen
        size /= tests.weight[-1 if one.view is None else one.view]
    return _finding(one, tests.detections, sign * size * length, size * deviation, effect, first)


def _finding(
    one: _Nuisance, detections: Detections, size: float, deviation: float, effect: float, first: int | None
) -> Finding:
    """Finding on a nuisance: its size, a share, rad (prismatic × 0.3 m/rad) or px, and its effect, px."""
    unit, factor = one.row.unit, 1.0
    if unit == READING:
        i = one.joints[-1]
        unit, factor = detections.units[i], float(per_rad(detections.prismatic)[i])
    subject = Subject(
        joints=tuple(int(detections.numbers[i]) for i in one.joints),
        views=() if one.view is None else (detections.view[one.view],),
        tag=one.tag,
        poses=() if first is None else (first,),
    )
    sizes = factor * size, factor * deviation
    return Finding(one.kind, LIMITS, subject, *sizes, unit=unit, effect_px=effect, period=one.period)


def _design(tests: _Tests, r: FloatArray, T: FloatArray, sigma_px: float) -> float:
    """Variance of predictions by residuals (L,) correlated within postures, relative to independent ones.

    Residuals are adjusted for leverage (R. Bell, D. McCaffrey, "Bias reduction in standard errors for linear
    regression with multi-stage samples", Survey Methodology 28, 2002). One if it is not significant.
    """
    groups, root = np.repeat(tests.posture, np.diff(tests.edges)), np.linalg.qr(T, mode="r")
    order, count = np.argsort(groups, kind="stable"), int(groups.max()) + 1
    ends, explained, expected = np.searchsorted(groups[order], np.arange(count + 1)), [], []
    for rows in (order[slice(*pair)] for pair in pairwise(ends.tolist())):
        U = tests.U[rows]
        explained.append(float(np.square(root @ (U.T @ _adjusted(U, r[rows]))).sum()))
        expected.append(sigma_px**2 * float(np.square(root @ U.T).sum()))
    e = np.array(expected)
    ratio, noise = sum(explained) / max(e.sum(), 1e-300), np.sqrt(2.0 * (e**2).sum()) / max(e.sum(), 1e-300)
    return float(ratio) if ratio > 1.0 + _CORRELATED * noise else 1.0


def _adjusted(U: FloatArray, r: FloatArray) -> FloatArray:
    """Residuals (l,) of a posture for its leverage, (I − U Uᵀ)^-½ r, by a series if it is short."""
    adjusted, term = r.copy(), r
    for k in range(1, _TERMS):
        term = (1.0 - 0.5 / k) * (U @ (U.T @ term))
        adjusted += term
        if np.linalg.norm(term) <= _ROUNDING * np.linalg.norm(r):
            return adjusted
    leverage, P = np.linalg.eigh(U @ U.T)
    return np.asarray(P @ (P.T @ r / np.sqrt(1.0 - np.minimum(leverage, _MAX_LEVERAGE))))
