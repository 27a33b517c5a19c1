"""What is wrong with readings that do not fit: joint readings, marker numbers, or single detections."""

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.body import Alignment
from projservo_cli.calibration.epipolar import OUTLIER, Epipolar, homogeneous, sampson
from projservo_cli.calibration.fit import (
    ROUGHLY,
    Tell,
    cauchy,
    distances,
    far_px,
    hopeless_px,
    least_squares,
    merged,
    robust_search,
)
from projservo_cli.calibration.optimization import Problem, minimize, prepare
from projservo_cli.calibration.prediction import image_points
from projservo_cli.calibration.quality import require_explained
from projservo_cli.calibration.readings import Readings
from projservo_cli.calibration.reconstruction import Frame, Guess, metric_guesses
from projservo_cli.calibration.start import place, rotation_axes
from projservo_cli.geometry.lens import through
from projservo_cli.records import NO_LENS, BoolArray, FloatArray, IntArray, Model, WorkFailed

RAYLEIGH = 1.1774100225154747
# A pose is explained by a corrected joint reading when its median residual falls below so many σ.
CORRECTED = 3.0
STEPS = 12
# Sightings both views agree on, in units of the epipolar noise, are no errors of detection.
CONSISTENT = 3.0


@dataclass(frozen=True, eq=False)
class Culprits:
    """Explanations of what was left out.

    Attributes
    ----------
    suspect : (S, 2) row of the pose and index of the joint whose reading no image agrees with.
    swapped : (W, 3) row of the pose, index of the marker that was read and of the one it is.
    explained : (2, N) readings that these explain.
    """

    suspect: IntArray
    swapped: IntArray
    explained: BoolArray


def find(problem: Problem, scene: Scene, used: BoolArray, sigma: float) -> Culprits:
    """Explain the readings left out by exchanged marker numbers first, then by wrong joint readings.

    Parameters
    ----------
    problem, scene : the fit.
    used : (2, N) readings that count.
    sigma : noise per coordinate, px.
    """
    readings = problem.readings
    out = readings.seen & ~used
    swapped, explained = _swaps(problem, scene, out, OUTLIER * sigma)
    suspects: list[tuple[int, int]] = []
    used_at = np.bincount(readings.pose_of, used.sum(axis=0), len(readings.q))
    for k in np.flatnonzero(used_at == 0):
        here = readings.pose_of == k
        if int((readings.seen & ~explained)[:, here].any(axis=0).sum()) < 3:
            continue
        joints = wrong_joints(_one_pose(readings, here, explained), scene, problem.q[k], sigma)
        suspects += [(int(k), i) for i in joints]
        if joints:
            explained[:, here] |= out[:, here]
    return Culprits(np.array(suspects, dtype=np.int64).reshape(-1, 2), swapped, explained)


def _one_pose(readings: Readings, here: BoolArray, explained: BoolArray) -> Readings:
    """Readings of one pose as a list of their own, without the explained ones."""
    return dataclasses.replace(
        readings,
        pose_of=np.zeros(int(here.sum()), dtype=np.int64),
        marker_of=readings.marker_of[here],
        pixels=readings.pixels[:, here],
        seen=(readings.seen & ~explained)[:, here],
    )


def _swaps(problem: Problem, scene: Scene, out: BoolArray, limit: float) -> tuple[IntArray, BoolArray]:
    """Sightings (W, 3) that lie where another marker belongs in every view, and their readings (2, N)."""
    readings = problem.readings
    types = readings.prismatic.astype(np.int64)
    lens = NO_LENS if scene.lens is None else scene.lens
    model = Model(scene.P, scene.H_hat, types, np.zeros(len(types)), np.array([0.0, 0.0, 0.0, 1.0]))
    m = image_points(model, scene.M, problem.q)
    predicted = through(lens[:, None], m[..., :2] / m[..., 2:])
    rows = np.flatnonzero(out.any(axis=0))
    distance = np.linalg.norm(
        predicted[readings.pose_of[rows]] - readings.pixels[:, rows].transpose(1, 0, 2)[:, :, None], axis=3
    )
    # A view that did not see the marker has no say.
    distance = np.where(readings.seen[:, rows].T[..., None], distance, 0.0)
    fits: BoolArray = np.max(distance, axis=1) <= limit
    fits[np.arange(rows.size), readings.marker_of[rows]] = False
    matched = fits.sum(axis=1) == 1
    explained = np.zeros_like(out)
    explained[:, rows[matched]] = out[:, rows[matched]]
    read, actual = readings.marker_of[rows[matched]], np.argmax(fits[matched], axis=1)
    triples = zip(readings.pose_of[rows[matched]].tolist(), read.tolist(), actual.tolist(), strict=True)
    found = set(triples)
    # An exchange shows in both markers and is one finding.
    listed = sorted((k, a, b) for k, a, b in found if a < b or (k, b, a) not in found)
    return np.array(listed, dtype=np.int64).reshape(-1, 3), explained


def wrong_joints(pose: Readings, scene: Scene, q: FloatArray, sigma: float) -> tuple[int, ...]:
    """The joint, or else the pair of joints, whose correction explains the images of a pose; empty if none.

    Parameters
    ----------
    pose : readings of the pose.
    scene : the fit.
    q : (n,) joint values from the reference as they were read, rad or m.
    sigma : noise per coordinate, px.
    """
    for size in (1, 2):
        best = np.inf
        culprit: tuple[int, ...] = ()
        for joints in itertools.combinations(range(len(q)), size):
            level = _corrected_level(pose, scene, q, list(joints))
            if level < best:
                best, culprit = level, joints
        if best <= CORRECTED * RAYLEIGH * sigma:
            return culprit
    return ()


def _corrected_level(pose: Readings, scene: Scene, q: FloatArray, joints: list[int]) -> float:
    """Median residual after some joints of a pose are fitted to its images under a Cauchy loss, px."""
    q = q.copy()
    best = np.inf
    for _ in range(STEPS):
        pixels, J = adjustment.joint_derivative(scene, pose, q[None])
        residual = np.where(pose.seen[..., None], pixels - pose.pixels, 0.0)
        distance = np.linalg.norm(residual, axis=2)
        level = float(np.median(distance[pose.seen]))
        if not np.isfinite(level) or level > 0.999 * best:
            break
        best = level
        weight = np.where(pose.seen, 1.0 / (1.0 + (distance / max(2.0 * level, 1e-9)) ** 2), 0.0)
        rows = (J[..., joints] * np.sqrt(weight)[..., None, None]).reshape(-1, len(joints))
        q[joints] -= np.linalg.lstsq(rows, (residual * np.sqrt(weight)[..., None]).ravel(), rcond=None)[0]
    return best


def unexplained(
    readings: Readings, used: BoolArray, explained: BoolArray, epipolar: Epipolar
) -> tuple[int, int]:
    """Sightings left out although both views agree on them, and all sightings in both views.

    Errors of detection break the epipolar geometry; what obeys it and still does not fit speaks
    against the model of the robot.

    Parameters
    ----------
    readings : what was seen.
    used, explained : (2, N) readings that count, and those a culprit explains.
    epipolar : epipolar geometry of the rig.
    """
    both = readings.both
    out = (both & ~used.all(axis=0) & ~explained.any(axis=0))[both]
    left, right = (homogeneous(readings.pixels[v][both]) for v in (0, 1))
    agree = np.abs(sampson(epipolar.F, left, right)) <= CONSISTENT * epipolar.sigma_px
    return int((out & agree).sum()), int(both.sum())


# Hypotheses that are followed to the end, and steps of the axes and of the screws by which they are
# compared before.
FOLLOWED, TURNS, HYPOTHESIS_STEPS = 2, 25, 8
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
            yield minimize(
                problem, scene, weighting, cameras=False, most=HYPOTHESIS_STEPS, settled_at=ROUGHLY
            ).scene


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
