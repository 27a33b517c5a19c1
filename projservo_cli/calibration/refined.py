"""Maximum likelihood from pixels and joint readings alone: starts, and the choice of the best fit."""

from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np

from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.body import LEAST, Alignment, merge
from projservo_cli.calibration.epipolar import Epipolar
from projservo_cli.calibration.fit import (
    RAYLEIGH,
    Solution,
    distances,
    far_px,
    hopeless_px,
    least_squares,
    robust_search,
    typical,
    usable_rows,
)
from projservo_cli.calibration.optimization import (
    Problem,
    prepare,
)
from projservo_cli.calibration.quality import REFUSE_RATIO, Expected, Misfit
from projservo_cli.calibration.readings import Readings, of_poses
from projservo_cli.calibration.reconstruction import Frame, Guess, guess_at, metric_guesses
from projservo_cli.calibration.start import place, rotation_axes
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

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
