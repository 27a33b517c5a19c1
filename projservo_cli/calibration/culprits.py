"""What is wrong with readings that do not fit: joint readings, marker numbers, or single detections."""

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.epipolar import OUTLIER, Epipolar, homogeneous, sampson
from projservo_cli.calibration.optimization import Problem
from projservo_cli.calibration.prediction import image_points
from projservo_cli.calibration.readings import Readings
from projservo_cli.geometry.lens import through
from projservo_cli.records import NO_LENS, BoolArray, FloatArray, IntArray, Model

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
