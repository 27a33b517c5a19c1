"""Tables of tracked points with mistakes of every kind, and the truth of which sightings are wrong.

A body is seen by two cameras at poses of an arm; each point is seen at a few poses, as a tracker sees it.
Whole tracks may belong to something else, single sightings may be wrong, and so may the joint readings of
whole poses.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration import predict
from projservo_cli.records import BoolArray, FloatArray, IntArray, Observation
from tests.calibration.simulated_robot import IMAGE_SIZE, Robot, around, random_robot, rig

SIGMA = 0.5  # noise a coordinate, px
# What may be wrong with a sighting, and how a mixture is made of it; 0 stands for nothing.
KINDS = ("right", "swapped", "drift", "drift of one view", "body", "still", "far", "readings")
TRACKS = ("body", "still", "far")
MISTAKES = (*KINDS[1:], "mixture")
_SPEEDS = 1.0, 10.0  # px a sighting by which a track drifts
_PX_PER_M = 850.0  # at the body


@dataclass(frozen=True, eq=False)
class Mistaken:
    """A table with mistakes, its truth, and poses to predict."""

    robot: Robot
    observation: Observation
    kind: IntArray  # (K, m) index into ``KINDS``, -1 where not seen
    off: FloatArray  # (K, m) px by which a sighting is off at the joints as read, the worse view
    noise: FloatArray  # (K, 2, m, 2) px
    ahead: FloatArray  # (60, n) poses held out, within the ranges of the joints

    @property
    def counted(self) -> BoolArray:
        """Tracks (m,) of at least four sightings of which more than half are right."""
        seen = (self.kind >= 0).sum(axis=0)
        return (seen >= 4) & (2 * (self.kind == 0).sum(axis=0) > seen)


def table(
    mistake: str,
    seed: int,
    points: int = 1500,
    poses: int = 24,
    *,
    joint_types: str = "RRRRRR",
    share: float = 0.2,
    length: int = 5,
    sigma: float = SIGMA,
    slip: float = 0.0,
) -> Mistaken:
    """A table with a share of its sightings wrong; of its poses for readings, half of it.

    Every sighting may ``slip`` a little on the body, by so many px a coordinate, in both views alike: the
    epipolar geometry shows none.
    """
    rng = np.random.default_rng([seed, MISTAKES.index(mistake) + 1 if mistake != "right" else 0])
    robot = random_robot(joint_types, rng, points)
    q = around(robot, poses, rng)
    kinds = KINDS[1:] if mistake == "mixture" else () if mistake == "right" else (mistake,)
    part = share / max(len(kinds), 1)
    images = robot.images(q)
    kind = np.zeros((len(q), points), dtype=np.int64)
    left = rng.permutation(points)
    for name in (name for name in kinds if name in TRACKS):
        tracks, left = np.split(left, [round(part * points)])
        images[:, :, tracks] = _elsewhere(name, len(q), len(tracks), rng)
        kind[:, tracks] = KINDS.index(name)
    shown = _shown(images, length, rng)
    kind[~shown] = -1
    for name in (name for name in kinds if name.startswith("drift")):
        left = _drift(robot, q, images, kind, left, (name, part), rng)
    if "swapped" in kinds:
        _swap(images, kind, part, rng)
    read = q.copy()
    if "readings" in kinds:
        wrong = rng.choice(len(q), max(1, round(0.5 * part * len(q))), replace=False)
        read[wrong] = _misread(q, wrong, rng)
        kind[wrong] = np.where(kind[wrong] == 0, KINDS.index("readings"), kind[wrong])
    noise = sigma * rng.standard_normal(images.shape)
    if slip:
        noise += _slip(robot, q, slip, rng)
    off = np.linalg.norm(images - robot.images(read), axis=3).max(axis=1)
    seen = np.where(shown[:, None, :, None], images + noise, np.nan)
    observation = Observation(np.arange(len(q)), np.arange(points), read, seen)
    ahead = rng.uniform(q.min(axis=0), q.max(axis=0), (60, q.shape[1]))
    return Mistaken(robot, observation, kind, off, noise, ahead)


def _elsewhere(name, poses, count, rng):
    """Images (K, 2, count, 2) of points of something else: another body, what stands still, or far away."""
    if name == "body":
        other = random_robot("RRR", rng, count)
        return other.images(around(other, poses, rng))
    if name == "still":
        places = rng.uniform([-0.5, -0.4, -0.3], [0.5, 0.4, 0.8], (count, 3))
        moved = np.broadcast_to(places, (poses, count, 3))
    else:
        depth = np.exp(rng.uniform(np.log(10.0), np.log(200.0), count))
        places = np.stack([*(rng.uniform(-1.0, 1.0, (2, count)) * [[0.45], [0.35]] * depth), depth], axis=1)
        # Clouds pass: half of the points move by up to 2 px on the way.
        slow = rng.uniform(-1.0, 1.0, (count, 3)) * (depth * rng.integers(0, 2, count))[:, None] / 1200.0
        moved = places + np.linspace(-1.0, 1.0, poses)[:, None, None] * slow
    points = np.concatenate([moved, np.ones((poses, count, 1))], axis=2)
    m = np.einsum("vrc,kmc->kvmr", rig(), points)
    return m[..., :2] / m[..., 2:]


def _shown(images, length, rng):
    """Which points (K, m) are seen at which poses: a few that lie in both images."""
    inside = ((images >= 0.0) & (images <= np.array(IMAGE_SIZE) - 1.0)).all(axis=(1, 3))
    rank = np.where(inside, rng.random(inside.shape), np.inf)
    return inside & (np.argsort(np.argsort(rank, axis=0), axis=0) < length)


def _drift(robot, q, images, kind, left, what, rng):
    """Let tracks slip from some sighting on until a share of all sightings is wrong; tracks left."""
    name, share = what
    wanted, wrong = share * (kind >= 0).sum(), 0
    for number, j in enumerate(left):
        if wrong >= wanted:
            return left[number:]
        track = np.flatnonzero(kind[:, j] >= 0)
        if len(track) < 2:
            continue
        first = rng.integers(1, len(track))
        speed = np.exp(rng.uniform(*np.log(_SPEEDS)))
        slip = speed * np.arange(1, len(track) - first + 1)
        poses = track[first:]
        if name == "drift":
            toward = rng.standard_normal(3)
            toward /= np.linalg.norm(toward) * _PX_PER_M
            for k, amount in zip(poses, slip, strict=True):
                moved = dataclasses.replace(
                    robot, markers=np.append(robot.markers[j, :3] + amount * toward, 1)[None]
                )
                images[k, :, j] = moved.images(q[k : k + 1])[0, :, 0]
        else:
            angle = rng.uniform(0.0, 2.0 * np.pi)
            images[poses, rng.integers(2), j] += slip[:, None] * [np.cos(angle), np.sin(angle)]
        kind[poses, j] = KINDS.index(name)
        wrong += len(poses)
    return left[:0]


def _slip(robot, q, slip, rng):
    """Change of all images (K, 2, m, 2) by each point of each pose off by so many px a coordinate."""
    off, step, still = (
        slip / _PX_PER_M * rng.standard_normal((len(q), len(robot.markers), 3)),
        1e-5,
        robot.images(q),
    )
    change = np.zeros_like(still)
    for axis in range(3):
        moved = dataclasses.replace(robot, markers=robot.markers + step * np.eye(4)[axis])
        change += (moved.images(q) - still) / step * off[:, None, :, None, axis]
    return change


def _swap(images, kind, share, rng):
    """Exchange points in rings among a share of the sightings of each pose."""
    for k in range(len(kind)):
        seen = np.flatnonzero(kind[k] == 0)
        count = round(share * (kind[k] >= 0).sum())
        some = rng.permutation(seen)[: max(count, 2)]
        images[k][:, some] = images[k][:, np.roll(some, 1)]
        kind[k, some] = KINDS.index("swapped")


def _misread(q, wrong, rng):
    """Readings of poses: one joint off by 0.1 to 0.5 rad, or those of another pose, in turns."""
    read = q[wrong].copy()
    for row, k in enumerate(wrong):
        if row % 2 == 0:
            read[row, rng.integers(q.shape[1])] += rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.5)
        else:
            read[row] = q[rng.choice(np.delete(np.arange(len(q)), k))]
    return read


def left_out(mistaken, calibration):
    """Sightings (K, m) of which a view was left out, or whose pose or marker was."""
    out = np.zeros(mistaken.kind.shape, dtype=bool)
    out[calibration.outlier[:, 0], calibration.outlier[:, 1]] = True
    for pose, *numbers in calibration.id_switches:
        out[pose, numbers[0]] = True
        # An exchange of two shows in both and is told once.
        out[pose, numbers[1]] |= mistaken.kind[pose, numbers[1]] == 1
    out[calibration.suspect[:, 0]] = True
    out[calibration.rejected_poses] = True
    gone = np.setdiff1d(mistaken.observation.marker, calibration.marker)
    out[:, gone] = True
    return out & (mistaken.kind >= 0)


def shares_left_out(mistaken, calibration):
    """Shares of the wrong sightings off by more than 4 σ and of the right ones, as counted."""
    out = left_out(mistaken, calibration)[:, mistaken.counted]
    kind, off = mistaken.kind[:, mistaken.counted], mistaken.off[:, mistaken.counted]
    wrong, right = (kind > 0) & (off > 4.0 * SIGMA), kind == 0
    return out[wrong].mean() if wrong.any() else np.nan, out[right].mean()


def median_error(mistaken, calibration, markers):
    """Median error of held-out images of markers, px."""
    truth = mistaken.robot.images(mistaken.ahead)[:, :, markers]
    images = predict(calibration, mistaken.ahead)[:, :, np.searchsorted(calibration.marker, markers)]
    return float(np.nanmedian(np.linalg.norm(images - truth, axis=3)))
