"""Maximum likelihood from pixels and joint readings alone: starts, robust search, choice of the best."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.body import Alignment, merge
from projservo_cli.calibration.epipolar import OUTLIER, Epipolar
from projservo_cli.calibration.optimization import Problem, Weighting, fixed, minimize, prepare
from projservo_cli.calibration.quality import LEAST_SIGMA, Agreement, require_body
from projservo_cli.calibration.readings import Readings
from projservo_cli.calibration.reconstruction import Frame, Guess, metric_guesses
from projservo_cli.calibration.start import place, rotation_axes
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

# Median of the length of a two-dimensional normal vector of unit deviation.
RAYLEIGH = 1.1774100225154747
# Width of the Cauchy loss in robust standard deviations: 95 % efficient on normal residuals.
CAUCHY = 2.385
MASK_ROUNDS = 4
# A start that leaves this many times the epipolar noise after the robust search is a wrong one.
HOPELESS = 10.0
FOCAL_MINIMA, AXIS_MINIMA = 3, 2


@dataclass(frozen=True, eq=False)
class Solution:
    """The problem solved, the scene found and what it leaves of the images."""

    problem: Problem
    scene: Scene
    agreement: Agreement


def solve(
    readings: Readings,
    q_reference: FloatArray,
    epipolar: Epipolar,
    frame: Frame,
    rng: np.random.Generator,
    accept: Callable[[Agreement], bool],
) -> Solution:
    """Best fit over the starts; the first that ``accept`` approves ends the search.

    Parameters
    ----------
    readings : what was seen.
    q_reference : (n,) joint values the model is written about, rad or m.
    epipolar : epipolar geometry of the rig.
    frame : guessed image centres and sizes.
    rng : draws starts.
    accept : whether a solution needs no rival.

    Raises
    ------
    WorkFailed
        If no start leads anywhere.
    """
    problem = prepare(readings, q_reference)
    hopeless = HOPELESS * max(epipolar.sigma_px, LEAST_SIGMA)
    best: Solution | None = None
    for scene in starts(problem, epipolar, frame, rng):
        found = robust_fit(problem, scene, hopeless)
        if found is None:
            continue
        if accept(found.agreement):
            return found
        if best is None or _typical(found) < _typical(best):
            best = found
    if best is None:
        raise WorkFailed(
            "no start of the adjustment puts all points in front of both cameras: check that rows of one "
            "pose belong together and that joint readings are in rad and m"
        )
    return best


def _typical(solution: Solution) -> float:
    """Median residual over all readings seen, outliers included, px."""
    distance = np.linalg.norm(solution.agreement.residual, axis=2)
    return float(np.median(distance[solution.problem.readings.seen]))


def starts(problem: Problem, epipolar: Epipolar, frame: Frame, rng: np.random.Generator) -> Iterator[Scene]:
    """Scenes to start from, most promising first: focal lengths, and axes for each.

    Parameters are those of ``solve``.
    """
    readings = problem.readings
    for guess in metric_guesses(epipolar.F, readings, frame, FOCAL_MINIMA):
        alignment = _merged(guess, readings)
        require_body(alignment.body)
        for w in rotation_axes(alignment, problem.q, readings.prismatic, rng, AXIS_MINIMA):
            screws = place(w, guess.points, readings, problem.q)
            M = np.hstack([screws.body, np.ones((len(screws.body), 1))])
            if np.isfinite(screws.H_hat).all() and np.isfinite(M).all():
                yield Scene(guess.P, screws.H_hat, M)


def _merged(guess: Guess, readings: Readings) -> Alignment:
    """Body and poses from the points of a guessed reconstruction."""
    both = readings.both
    shape = (len(readings.q), readings.marker.size)
    points, seen = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool)
    where = readings.pose_of[both], readings.marker_of[both]
    points[where], seen[where] = guess.points, True
    return merge(points, seen)


def cauchy(seen: BoolArray) -> Weighting:
    """Weights of a Cauchy loss whose width follows the median residual of what was seen (2, N)."""

    def weighting(residual: FloatArray) -> FloatArray:
        distance = np.linalg.norm(residual, axis=2)
        width = CAUCHY * max(float(np.median(distance[seen])) / RAYLEIGH, 1e-9)
        return np.where(seen, 1.0 / (1.0 + (distance / width) ** 2), 0.0)

    return weighting


def robust_fit(problem: Problem, scene: Scene, hopeless: float = np.inf) -> Solution | None:
    """Screws alone, then everything under a Cauchy loss, then least squares of the readings within 5σ.

    Parameters
    ----------
    problem : what to explain.
    scene : start.
    hopeless : robust noise after the Cauchy loss, px, beyond which least squares is not worth its time.

    Returns
    -------
    None where the fit does not put the points in front of both cameras.
    """
    seen = problem.readings.seen
    scene = minimize(problem, scene, cauchy(seen), cameras=False, most=20).scene
    fit = minimize(problem, scene, cauchy(seen), most=100)
    distance = np.linalg.norm(fit.residual, axis=2)
    sigma = max(float(np.median(distance[seen])) / RAYLEIGH, 1e-9)
    used = seen & (distance <= OUTLIER * sigma)
    if sigma > hopeless:
        dof = degrees_of_freedom(problem, fit.scene, seen)
        return Solution(problem, fit.scene, Agreement(fit.residual, seen, dof)) if dof > 0 else None
    for _ in range(MASK_ROUNDS):
        fit = minimize(problem, fit.scene, fixed(used.astype(np.float64)))
        dof = degrees_of_freedom(problem, fit.scene, used)
        if dof <= 0:
            return None
        sigma = max(float(np.sqrt(fit.cost / dof)), 1e-9)
        before, used = used, seen & (np.linalg.norm(fit.residual, axis=2) <= OUTLIER * sigma)
        if np.array_equal(before, used):
            break
    used = before
    _, depth = adjustment.predict_pixels(fit.scene, problem.readings, problem.q)
    if not (np.sign(depth) == np.sign(depth.sum(axis=1))[:, None])[used].all():
        return None
    return Solution(problem, fit.scene, Agreement(fit.residual, used, dof))


def degrees_of_freedom(problem: Problem, scene: Scene, used: BoolArray) -> int:
    """Coordinates used minus the rank of their derivative."""
    free = problem.place.size - adjustment.gauge(scene, problem.readings, problem.place).shape[1]
    return 2 * int(np.count_nonzero(used)) - int(free)
