"""Fits of one start: a robust search, then least squares of the readings that count."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.body import LEAST, Alignment, merge
from projservo_cli.calibration.epipolar import OUTLIER, Epipolar
from projservo_cli.calibration.optimization import Fit, Problem, Stalled, Weighting, fixed, minimize, prepare
from projservo_cli.calibration.quality import LEAST_SIGMA, REFUSE_RATIO, Agreement, Expected, Misfit
from projservo_cli.calibration.readings import Readings, of_poses, restrict
from projservo_cli.calibration.reconstruction import Frame, Guess, guess_at, metric_guesses
from projservo_cli.calibration.start import place, rotation_axes
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

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


# Passes over the starts until one is good enough: factors of the focal length that fits best, for a
# wrong one often leads where the best does not. After a pass, poses whose residual is so many times
# the median are left out of the next.
FOCAL_FACTORS = ((1.0,), (1.0, 0.6), (1.6, 0.4, 2.5))
SPOILT = 8.0
# Most searches a pass: data that fit no robot are refused within seconds.
SEARCHES = 5
# Relative difference of robust residuals below which two starts have ended at one place.
SAME_LEVEL = 1e-3
FOCAL_MINIMA, AXIS_MINIMA = 3, 3

Tell = Callable[[str, int, int], None]


def tell_nobody(what: str, done: int, total: int) -> None:
    """Show nothing of how far a search is."""


def solve(
    readings: Readings,
    q_reference: FloatArray,
    epipolar: Epipolar,
    frame: Frame,
    rng: np.random.Generator,
    expected: Expected,
    tell: Tell = tell_nobody,
) -> Solution:
    """Best fit over the starts; the first that leaves nothing but the expected noise ends the search.

    Parameters
    ----------
    readings : what was seen.
    q_reference : (n,) joint values the model is written about, rad or m.
    epipolar : epipolar geometry of the rig.
    frame : guessed image centres and sizes.
    rng : draws starts.
    expected : noise to measure fits by.
    tell : told before each start how many were tried, of at most how many.

    Raises
    ------
    Misfit
        If no start leads anywhere.
    WorkFailed
        If too little was seen to start from.
    """
    problem = prepare(readings, q_reference)
    hopeless = hopeless_px(epipolar)
    best: Solution | None = None
    trusted = np.ones(len(readings.q), dtype=bool)
    levels: list[float] = []
    for number, factors in enumerate(FOCAL_FACTORS):
        usable = of_poses(readings, trusted)
        tried = islice(starts(problem, usable, epipolar, frame, rng, factors), SEARCHES)
        for done, scene in enumerate(tried, number * SEARCHES):
            tell("calibration, starts", done, len(FOCAL_FACTORS) * SEARCHES)
            searched = robust_search(problem, scene, trusted, far_px(epipolar))
            level = float(np.median(distances(searched.residual, usable_rows(problem, trusted))))
            # Different starts that end at one place need not be followed to the end twice.
            if any(abs(level - other) < SAME_LEVEL * other for other in levels):
                # Twice the same place and no gross misfit: more starts would not better it.
                if best is not None and expected.ratio(best.agreement) <= REFUSE_RATIO:
                    return best
                continue
            levels.append(level)
            found = least_squares(problem, searched.scene, level / RAYLEIGH, hopeless)
            if found is None:
                continue
            if expected.agrees(found.agreement):
                return found
            if best is None or typical(found) < typical(best):
                best = found
            if factors != FOCAL_FACTORS[0] and expected.refusal(best.agreement) is None:
                return best
        if best is not None:
            if expected.refusal(best.agreement) is None:
                return best
            # Wrong joint readings spoil the start: once the rest is roughly explained they stand out.
            before, trusted = trusted, _explained(best)
            if not np.array_equal(before, trusted):
                levels = []
    if best is None:
        raise Misfit(
            "the data contradict the joint readings from the start: check that they belong to their poses, "
            "their units (rad, m) and types (R or P), and that rows of one pose belong together"
        )
    return best


def _explained(solution: Solution) -> BoolArray:
    """Poses (K,) whose median residual is within some times that of all."""
    readings = solution.problem.readings
    distance = np.linalg.norm(solution.agreement.residual, axis=2)
    limit = SPOILT * typical(solution)
    result = np.ones(len(readings.q), dtype=bool)
    for k in np.unique(readings.pose_of):
        here = readings.pose_of == k
        result[k] = np.median(distance[:, here][readings.seen[:, here]]) <= limit
    return result


def starts(
    problem: Problem,
    readings: Readings,
    epipolar: Epipolar,
    frame: Frame,
    rng: np.random.Generator,
    factors: tuple[float, ...],
) -> Iterator[Scene]:
    """Scenes to start from, most promising first: focal lengths, and axes for each.

    Parameters are those of ``solve``; ``readings`` may be those of the problem at some of its poses,
    and ``factors`` multiply the focal lengths that fit best.
    """
    guesses = metric_guesses(epipolar.F, readings, frame, FOCAL_MINIMA)
    for factor in factors:
        for best in guesses:
            guess = best if factor == 1.0 else guess_at(epipolar.F, readings, frame, factor * best.focal)
            alignment = merged(guess, readings)
            if int(np.isfinite(alignment.body[:, 0]).sum()) < LEAST:
                raise WorkFailed(
                    "no three markers are seen together by both cameras: more must be seen at once"
                )
            for w in rotation_axes(alignment, problem.q, readings.prismatic, rng, AXIS_MINIMA):
                screws = place(w, guess.points, readings, problem.q)
                M = np.hstack([screws.body, np.ones((len(screws.body), 1))])
                if np.isfinite(screws.H_hat).all() and np.isfinite(M).all():
                    yield Scene(guess.P, screws.H_hat, M)


def merged(guess: Guess, readings: Readings) -> Alignment:
    """Body and poses from the points of a guessed reconstruction."""
    both = readings.both
    shape = (len(readings.q), readings.marker.size)
    points, seen = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool)
    where = readings.pose_of[both], readings.marker_of[both]
    points[where], seen[where] = guess.points, True
    return merge(points, seen)
