"""Cameras that moved between episodes: where the images of one, less their predictions, change at once.

Markers that stand in the scene predict their images themselves. Those on the tool, or for cameras on it, are
predicted by a calibration of one half of the episodes. A window of episodes is compared with all others, as
a camera may move twice: A. B. Olshen et al., "Circular binary segmentation for the analysis of array-based
DNA copy number data", Biostatistics 5, 2004. What differs from episode to episode anyway sets the limit.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration import calibrate
from projservo_cli.calibration.detections import even_choice
from projservo_cli.calibration.prediction import predict
from projservo_cli.records import WORLD, BoolArray, Calibration, FloatArray, IntArray, Observation, WorkFailed

# Minimum displacement of images that is one, px: what detected corners, and lenses within an episode, err.
_MOVED_PX = 2.0
# Minimum displacement over that by the scatter of episodes: 190 windows of twenty episodes are compared by
# six numbers each.
_SURE = 6.0
# Maximum scatter of the images of a marker that stands, within an episode, px, and their minimum number.
_STANDS_PX, _LEAST = 1.0, 8
# Poses by which half of the episodes are calibrated: more take longer and show hardly more.
_POSES = 120
# Robust deviations of an image from its episode above which it does not count.
_OUTLYING = 4.0


class Moved(NamedTuple):
    """Camera that moved."""

    view: str
    last: int  # episode before
    first: int  # episode after
    by_px: float  # displacement of its images, rms


class Stretches(NamedTuple):
    """Runs of episodes in which all cameras stood still."""

    moved: list[Moved]
    episodes: list[list[int]]  # of each run
    untested: str = ""  # why nothing could be compared; empty if it was


class _Sums(NamedTuple):
    """Sums over windows of episodes (W,), in which each counts alike, of residuals of one view."""

    episodes: FloatArray  # (W,) number of them
    gram: FloatArray  # (W, 3, 3) mean products of 1, u, v in an episode
    moment: FloatArray  # (W, 3, 2) mean products of these with the residuals
    square: FloatArray  # (W,) mean squares of the affine displacement of each episode, px²

    def __sub__(self, other: "_Sums") -> "_Sums":
        return _Sums(*(a - b for a, b in zip(self, other, strict=True)))

    def at(self, index: IntArray | int) -> "_Sums":
        """Sums of some windows."""
        return _Sums(*(values[index] for values in self))

    def before(self) -> "_Sums":
        """Sums (W + 1,) of all windows before each."""
        return _Sums(*(np.concatenate([0.0 * x[:1], np.cumsum(x, axis=0)]) for x in self))

    def field(self) -> FloatArray:
        """Affine displacement (W, 3, 2) of the images of each window."""
        return np.asarray(np.linalg.pinv(self.gram, hermitian=True) @ self.moment)

    def scatter(self) -> FloatArray:
        """Sum (W,) of squared displacements of episodes against that of their window, px²."""
        return np.asarray(self.square - np.einsum("wij,wij->w", self.field(), self.moment))


def _between(a: _Sums, b: _Sums) -> FloatArray:
    """Displacement (W,) of images of windows b against a, rms where both see markers, px."""
    change = b.field() - a.field()
    squares = [np.einsum("wij,wik,wkj->w", change, x.gram, change) / x.episodes for x in (a, b)]
    return np.asarray(np.sqrt(np.maximum(np.minimum(*squares), 0.0)))


def stretches(
    observation: Observation,
    episode: IntArray,
    mount: str = WORLD,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Stretches:
    """Find the cameras that moved between episodes.

    episode : (K,) of each pose; all joints turn.
    """
    numbers, moved, model, untested = np.unique(episode), list[Moved](), None, ""
    standing = _standing(observation, episode, mount)
    if len(numbers) > 1 and not standing.any(axis=1).all():
        rest = _of_markers(observation, np.asarray(~standing.any(axis=0)))
        model, untested = _half(rest, episode, mount, progress)
    for v, name in enumerate(observation.view):
        if standing[v].any():
            images = observation.images[:, v, standing[v]]
            expected = _at_once(images, episode)
        elif model is not None:
            images = observation.images[:, v, np.isin(observation.marker, model.marker)]
            expected = predict(model, observation.q)[:, v]
        else:
            continue
        expected = np.broadcast_to(expected, images.shape)
        seen, alone = _sums(expected, images - expected, episode)
        moved += [Moved(name, int(seen[k - 1]), int(seen[k]), px) for k, px in _steps(alone)]
    moved.sort(key=lambda one: one.first)
    runs = np.searchsorted([one.first for one in moved], numbers, side="right")
    return Stretches(moved, [numbers[runs == run].tolist() for run in np.unique(runs)], untested)


def _standing(observation: Observation, episode: IntArray, mount: str) -> BoolArray:
    """Mask (V, m) of the markers that stand within episodes, none before cameras on the tool."""
    distance = np.full(observation.images.shape[:3], np.nan)
    for e in np.unique(episode):
        here = observation.images[episode == e]
        twice = np.isfinite(here[..., 0]).sum(axis=0) > 1
        found = np.full(here.shape[:3], np.nan)
        found[:, twice] = np.linalg.norm(here[:, twice] - np.nanmedian(here[:, twice], axis=0), axis=-1)
        distance[episode == e] = found
    judged: BoolArray = (np.isfinite(distance).sum(axis=0) >= _LEAST) & (mount == WORLD)
    judged[judged] = np.nanmedian(distance[:, judged], axis=0) < _STANDS_PX
    return judged


def _at_once(images: FloatArray, episode: IntArray) -> FloatArray:
    """Images (m, 2) of standing markers in the one episode that shows most of them, of (K, m, 2).

    Medians over all episodes may be before it for some markers, and after it for others.
    """
    numbers = np.unique(episode)
    seen = np.array([np.isfinite(images[episode == e, :, 0]).any(axis=0) for e in numbers])
    best = int(np.argmax(seen.sum(axis=1)))
    expected = np.full(images.shape[1:], np.nan)
    expected[seen[best]] = np.nanmedian(images[episode == numbers[best]][:, seen[best]], axis=0)
    return expected


def _of_markers(observation: Observation, keep: BoolArray) -> Observation:
    """Observation of some markers (m,)."""
    sigma = None if observation.sigma is None else observation.sigma[..., keep]
    return replace(
        observation, marker=observation.marker[keep], images=observation.images[:, :, keep], sigma=sigma
    )


def _half(
    observation: Observation, episode: IntArray, mount: str, progress: Callable[[str, int, int], None]
) -> tuple[Calibration | None, str]:
    """Calibration of the half, quarter or all of the episodes that fits best, or None and the reason."""
    reason, types = "no marker moves", "R" * observation.q.shape[1]
    for parts in (2, 4, 1) if observation.marker.size else ():
        found = list[Calibration]()
        for k, some in enumerate(np.array_split(np.unique(episode), parts)):
            rows = np.flatnonzero(np.isin(episode, some))
            progress("compare", k, parts)
            chosen = np.isin(np.arange(len(episode)), rows[even_choice(len(rows), _POSES)])
            few = observation.rows(chosen)
            try:
                found.append(calibrate(few, types, source="recorded", joint_noise=None, mount=mount))
            except WorkFailed as error:
                reason = str(error)
        if found:
            return min(found, key=lambda one: max(one.sigma_px, one.sigma_fitted_px)), ""
    return None, reason


def _sums(expected: FloatArray, residual: FloatArray, episode: IntArray) -> tuple[list[int], _Sums]:
    """Episodes in which a view saw images (K, m, 2), and sums of their residuals, of each alone."""
    finite = np.isfinite(residual).all(axis=-1)
    pixels = expected[finite]
    middle, spread = pixels.mean(axis=0), pixels.std(axis=0) + 1e-9
    grams, moments, seen = list[FloatArray](), list[FloatArray](), list[int]()
    for e in np.unique(episode):
        here = finite & (episode == e)[:, None]
        if here.sum() < _LEAST:
            continue
        r = residual[here]
        distance = np.linalg.norm(r - np.median(r, axis=0), axis=1)
        kept = distance <= _OUTLYING * np.median(distance) + 1e-9
        A = np.column_stack([np.ones(len(r)), (expected[here] - middle) / spread])[kept]
        grams.append(A.T @ A / len(A))
        moments.append(A.T @ r[kept] / len(A))
        seen.append(int(e))
    gram, moment = np.reshape(grams, (-1, 3, 3)), np.reshape(moments, (-1, 3, 2))
    alone = _Sums(np.ones(len(seen)), gram, moment, np.zeros(len(seen)))
    square = np.einsum("wij,wij->w", alone.field(), moment)
    return seen, alone._replace(square=square)


def _steps(alone: _Sums) -> Iterator[tuple[int, float]]:
    """Rows of episodes from which on images are displaced, and by how much, px."""
    E, before = len(alone.episodes), alone.before()
    at = np.array(sorted({0, E, *_cuts(alone, 0)}))
    parts = before.at(at[1:]) - before.at(at[:-1])
    px = _between(parts.at(np.arange(len(at) - 2)), parts.at(np.arange(1, len(at) - 1)))
    yield from ((int(k), float(x)) for k, x in zip(at[1:-1], px, strict=True) if x > _MOVED_PX)


def _cuts(alone: _Sums, first: int) -> list[int]:
    """Rows of episodes, from the first on, where a window begins or ends that differs from all others."""
    E, before = len(alone.episodes), alone.before()
    i, j = np.triu_indices(E + 1, 1)
    some = j - i < E
    i, j = i[some], j[some]
    if not i.size:
        return []
    inside = before.at(j) - before.at(i)
    outside = before.at(np.full(len(i), E)) - inside
    left = np.maximum(inside.scatter() + outside.scatter(), 0.0) / max(E - 2, 1)
    by_chance = np.sqrt(left * (1.0 / inside.episodes + 1.0 / outside.episodes))
    clear = _between(outside, inside) / np.maximum(_MOVED_PX, _SURE * by_chance)
    best = int(np.argmax(clear))
    if clear[best] <= 1.0:
        return []
    ends = sorted({0, int(i[best]), int(j[best]), E})
    found = [first + k for k in ends[1:-1]]
    for a, b in pairwise(ends):
        found += _cuts(alone.at(np.arange(a, b)), first + a)
    return found
