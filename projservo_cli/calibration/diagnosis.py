"""Which joint a misfit is due to: its type, or readings that move although it stands still."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.body import Alignment
from projservo_cli.calibration.culprits import unexplained
from projservo_cli.calibration.epipolar import Epipolar
from projservo_cli.calibration.fit import (
    RAYLEIGH,
    ROUGHLY,
    cauchy,
    distances,
    far_px,
    hopeless_px,
    least_squares,
    robust_search,
)
from projservo_cli.calibration.optimization import Problem, minimize, prepare
from projservo_cli.calibration.quality import require_explained
from projservo_cli.calibration.readings import Readings
from projservo_cli.calibration.reconstruction import Frame, Guess, metric_guesses
from projservo_cli.calibration.refined import Tell, merged
from projservo_cli.calibration.start import place, rotation_axes
from projservo_cli.records import FloatArray, WorkFailed

# Hypotheses that are followed to the end, and steps of the axes and of the screws by which they are
# compared before.
FOLLOWED, TURNS, STEPS = 2, 25, 8
# A joint that stands still is a prismatic one of no speed: it is preferred unless the residuals with the
# other are smaller by more than this share.
SIMPLER = 0.1


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What may be wrong with one joint.

    Attributes
    ----------
    words : it, and what to do.
    readings : as they then are.
    q_reference : (n,) joint values the model is then written about, rad or m.
    handicap : logarithm of the residuals that an equal hypothesis must be better by.
    """

    words: str
    readings: Readings
    q_reference: FloatArray
    handicap: float


def hypotheses(readings: Readings, q_reference: FloatArray) -> Iterator[Hypothesis]:
    """Every joint of the other type, and every joint standing still.

    Parameters
    ----------
    readings : as they were given.
    q_reference : (n,) joint values the model is written about, rad or m.
    """
    for i, slides in enumerate(readings.prismatic):
        flipped = readings.prismatic.copy()
        flipped[i] = not slides
        given, fits = ("prismatic", "revolute") if slides else ("revolute", "prismatic")
        yield Hypothesis(
            f"by the images joint {i + 1} is {fits}, not {given}: check --joints",
            dataclasses.replace(readings, prismatic=flipped),
            q_reference,
            SIMPLER,
        )
    for i in range(len(q_reference) if len(q_reference) > 1 else 0):
        yield Hypothesis(
            f"by the images joint {i + 1} stands still while its readings move: check that they are its own",
            dataclasses.replace(
                readings, q=np.delete(readings.q, i, axis=1), prismatic=np.delete(readings.prismatic, i)
            ),
            np.delete(q_reference, i),
            0.0,
        )


def blamed_joint(
    readings: Readings,
    q_reference: FloatArray,
    epipolar: Epipolar,
    frame: Frame,
    most_px: float,
    rng: np.random.Generator,
    tell: Tell,
) -> str:
    """The one change of one joint with which the model does describe the data, in words; empty if none.

    All changes are compared in one guessed metric frame, which owes nothing to the joints; the best are
    followed to the maximum of the likelihood and believed only where that passes as a calibration would.

    Parameters
    ----------
    readings : as they were given.
    q_reference : (n,) joint values the model is written about, rad or m.
    epipolar : epipolar geometry of the rig.
    frame : guessed image centres and sizes.
    most_px : noise per coordinate that a change must not leave more than, px.
    rng : draws axes.
    tell : told before each change how many were compared, of how many.
    """
    try:
        guess = metric_guesses(epipolar.F, readings, frame, keep=1)[0]
    except WorkFailed:
        return ""
    alignment = merged(guess, readings)
    candidates = []
    changes = list(hypotheses(readings, q_reference))
    for done, hypothesis in enumerate(changes):
        tell("calibration, joint at fault", done, len(changes))
        problem = prepare(hypothesis.readings, hypothesis.q_reference)
        for scene in _starts(problem, guess, alignment, rng):
            level = _level(problem, scene) + hypothesis.handicap
            candidates.append((level, hypothesis.words, problem, scene))
    candidates.sort(key=lambda candidate: candidate[0])
    for _, words, problem, scene in candidates[:FOLLOWED]:
        if _describes(problem, scene, epipolar, most_px):
            return words
    return ""


def _starts(
    problem: Problem, guess: Guess, alignment: Alignment, rng: np.random.Generator
) -> Iterator[Scene]:
    """Screws roughly fitted in the guessed metric frame, if any are."""
    readings = problem.readings
    weighting = cauchy(readings.seen)
    for w in rotation_axes(alignment, problem.q, readings.prismatic, rng, 1, TURNS):
        screws = place(w, guess.points, readings, problem.q)
        scene = Scene(guess.P, screws.H_hat, np.hstack([screws.body, np.ones((len(screws.body), 1))]))
        if np.isfinite(scene.H_hat).all() and np.isfinite(scene.M).all():
            yield minimize(problem, scene, weighting, cameras=False, most=STEPS, settled_at=ROUGHLY).scene


def _level(problem: Problem, scene: Scene) -> float:
    """Mean logarithm of the residuals: neither a few gross errors nor many small ones outweigh the rest."""
    return float(np.mean(np.log(distances(problem.residual(scene), problem.readings.seen) + 1e-9)))


def _describes(problem: Problem, scene: Scene, epipolar: Epipolar, most_px: float) -> bool:
    """Whether a scene leads to a fit that leaves little noise and little out."""
    readings, hopeless = problem.readings, hopeless_px(epipolar)
    searched = robust_search(problem, scene, np.ones(len(readings.q), dtype=np.bool_), far_px(epipolar))
    level = float(np.median(distances(searched.residual, readings.seen)))
    found = least_squares(problem, searched.scene, level / RAYLEIGH, hopeless)
    if found is None or found.agreement.sigma_px > most_px:
        return False
    used = found.agreement.used
    try:
        require_explained(*unexplained(readings, used, np.zeros_like(used), epipolar), 0, len(readings.q))
    except WorkFailed:
        return False
    return True
