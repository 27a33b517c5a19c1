"""Fits of one start: a robust search, then least squares of the readings that count."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.epipolar import OUTLIER, Epipolar
from projservo_cli.calibration.optimization import (
    Fit,
    Problem,
    Stalled,
    Weighting,
    fixed,
    minimize,
    prepare,
)
from projservo_cli.calibration.quality import LEAST_SIGMA, REFUSE_RATIO, Agreement
from projservo_cli.calibration.readings import restrict
from projservo_cli.records import BoolArray, FloatArray

# Median of the length of a two-dimensional normal vector of unit deviation.
RAYLEIGH = 1.1774100225154747
# Width of the Cauchy loss in robust standard deviations: 95 % efficient on normal residuals.
CAUCHY = 2.385
MASK_ROUNDS = 4
# Least share of the readings of a marker that must count for it to be part of the model.
LEAST_SHARE = 0.25
# A start that leaves this many times the epipolar noise after the robust search is a wrong one.
HOPELESS = 10.0
# A robust search that would still be refused and has come nearer by less than this share over so many
# steps is not continued.
CRAWL, PATIENCE = 0.01, 10
# A step of the screws alone that moves the images by less than this fraction of the residual is the last.
ROUGHLY = 1e-2


@dataclass(frozen=True, eq=False)
class Solution:
    """The problem solved, the scene found and what it leaves of the images."""

    problem: Problem
    scene: Scene
    agreement: Agreement


def hopeless_px(epipolar: Epipolar) -> float:
    """Noise beyond which least squares is not worth its time, px."""
    return HOPELESS * max(epipolar.sigma_px, LEAST_SIGMA)


def far_px(epipolar: Epipolar) -> float:
    """Noise with which a fit would be refused, px."""
    return REFUSE_RATIO * max(epipolar.sigma_px, LEAST_SIGMA)


def usable_rows(problem: Problem, trusted: BoolArray) -> BoolArray:
    """Readings (2, N) seen at trusted poses (K,)."""
    result: BoolArray = problem.readings.seen & trusted[problem.readings.pose_of]
    return result


def distances(residual: FloatArray, mask: BoolArray) -> FloatArray:
    """Lengths of the residuals (2, N, 2) in a mask (2, N), px."""
    result: FloatArray = np.linalg.norm(residual[mask], axis=1)
    return result


def typical(solution: Solution) -> float:
    """Median residual over all readings seen, outliers included, px."""
    return float(np.median(distances(solution.agreement.residual, solution.problem.readings.seen)))


def cauchy(seen: BoolArray) -> Weighting:
    """Weights of a Cauchy loss whose width follows the median residual of what was seen (2, N)."""

    def weighting(residual: FloatArray) -> FloatArray:
        distance = np.linalg.norm(residual, axis=2)
        width = CAUCHY * max(float(np.median(distance[seen])) / RAYLEIGH, 1e-9)
        return np.where(seen, 1.0 / (1.0 + (distance / width) ** 2), 0.0)

    return weighting


def crawling(seen: BoolArray, far: float) -> Stalled:
    """Whether a search is far from the noise and hardly comes nearer, asked after each of its steps.

    Parameters
    ----------
    seen : (2, N) readings that count.
    far : noise from which on a search counts as far, px.
    """
    levels: list[float] = []

    def stalled(residual: FloatArray) -> bool:
        levels.append(float(np.median(distances(residual, seen))))
        if len(levels) <= PATIENCE or levels[-1] <= RAYLEIGH * far:
            return False
        return levels[-1] > (1.0 - CRAWL) * levels[-1 - PATIENCE]

    return stalled


def robust_search(problem: Problem, scene: Scene, trusted: BoolArray, far: float) -> Fit:
    """Screws alone, then everything, under a Cauchy loss over the trusted poses (K,).

    Parameters
    ----------
    problem : what to explain.
    scene : start.
    trusted : (K,) poses that count.
    far : noise beyond which a search that hardly proceeds is given up, px.
    """
    rows = usable_rows(problem, trusted)
    weighting = cauchy(rows)
    scene = minimize(problem, scene, weighting, cameras=False, most=20, settled_at=ROUGHLY).scene
    return minimize(problem, scene, weighting, most=100, stalled=crawling(rows, far))


def least_squares(problem: Problem, scene: Scene, sigma: float, hopeless: float) -> Solution | None:
    """Least squares of the readings within 5σ, in rounds until they no longer change.

    Parameters
    ----------
    problem : what to explain.
    scene : start.
    sigma : robust noise at the start, px.
    hopeless : noise beyond which least squares is not worth its time, px.

    Returns
    -------
    None where the fit does not put the points in front of both cameras.
    """
    residual = problem.residual(scene)
    if sigma > hopeless:
        seen = problem.readings.seen
        dof = degrees_of_freedom(problem, scene, seen)
        return Solution(problem, scene, Agreement(residual, seen, dof)) if dof > 0 else None
    used = _within(problem, residual, OUTLIER * max(sigma, 1e-9))
    for _ in range(MASK_ROUNDS):
        fit = minimize(problem, scene, fixed(used.astype(np.float64)))
        scene = fit.scene
        dof = degrees_of_freedom(problem, scene, used)
        if dof <= 0:
            return None
        sigma = max(float(np.sqrt(fit.cost / dof)), 1e-9)
        before, used = used, _within(problem, fit.residual, OUTLIER * sigma)
        if np.array_equal(before, used):
            break
    used = before
    _, depth = adjustment.predict_pixels(scene, problem.readings, problem.q)
    if not (np.sign(depth) == np.sign(depth.sum(axis=1))[:, None])[used].all():
        return None
    return Solution(problem, scene, Agreement(fit.residual, used, dof))


def determined(solution: Solution) -> tuple[Solution, BoolArray]:
    """The solution without markers of which hardly any reading counts, and which markers (m,) stay.

    One reading is less than the three coordinates of a marker, and a few among many wrong ones agree by
    chance; either would spoil what is said about the body as a whole.

    Parameters
    ----------
    solution : the fit.
    """
    problem, scene, agreement = solution.problem, solution.scene, solution.agreement
    readings = problem.readings
    count = [np.bincount(readings.marker_of, mask.sum(axis=0)) for mask in (agreement.used, readings.seen)]
    keep = count[0] >= np.maximum(2, LEAST_SHARE * count[1])
    if keep.all():
        return solution, keep
    rows = keep[readings.marker_of]
    lens = scene.lens is not None
    smaller = prepare(restrict(readings, keep), problem.q_reference, lens)
    scene = Scene(scene.P, scene.H_hat, scene.M[keep], scene.lens)
    used = agreement.used[:, rows]
    dof = degrees_of_freedom(smaller, scene, used)
    return Solution(smaller, scene, Agreement(agreement.residual[:, rows], used, dof)), keep


def _within(problem: Problem, residual: FloatArray, limit: float) -> BoolArray:
    """Readings (2, N) within a limit, px, at poses where at least half of those seen are."""
    readings = problem.readings
    good = readings.seen & (np.linalg.norm(residual, axis=2) <= limit)
    K = len(readings.q)
    seen_at = np.bincount(readings.pose_of, readings.seen.sum(axis=0), K)
    good_at = np.bincount(readings.pose_of, good.sum(axis=0), K)
    result: BoolArray = good & (good_at >= 0.5 * seen_at)[readings.pose_of]
    return result


def degrees_of_freedom(problem: Problem, scene: Scene, used: BoolArray) -> int:
    """Coordinates used minus the rank of their derivative."""
    free = problem.place.size - adjustment.gauge(scene, problem.readings, problem.place).shape[1]
    return 2 * int(np.count_nonzero(used)) - int(free)
