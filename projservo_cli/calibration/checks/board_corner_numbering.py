"""Boards that look the same turned, of which a detector numbers the corners from any end in each image.

Between two poses a board turns by no more than the sum of the joint motions: a numbering that contradicts
this is turned before any fit. The epipolar geometry makes views agree. A fit then decides on the images that
have no neighbour.
"""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from projservo_cli.calibration.detections import Detections, even_choice
from projservo_cli.calibration.initial.epipolar import Epipolar
from projservo_cli.calibration.initial.single_view import moved_plane
from projservo_cli.calibration.prediction import predict
from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.geometry.displacements import homogeneous
from projservo_cli.records import (
    BoolArray,
    Calibration,
    FloatArray,
    IntArray,
    Observation,
    WorkFailed,
    board_numberings,
)

# Minimum number of rows and of columns of a grid: four points lie on any.
_LEAST_SIDE = 3
# Number of images that show the shape of a grid, and distance of a corner from it, in cells.
_SHOWN, _OFF_GRID = 10, 0.5
# Focal lengths over the extent of the pixels, under each of which a turn must be impossible.
_FOCALS = (0.6, 1.2, 2.4)
# Rotation that joint motions do not explain, rad: errors of readings, of the guessed middle, and of a lens.
_MARGIN = np.radians(25.0)
# Noise of a geometry, px, below which views number alike.
_MUCH_NOISE_PX = 1.0
# Maximum number of fits that may turn further images.
_MAX_LOOKS = 2
# Noise of a geometry, or median error of an image, over that as numbered, up to which another one holds.
_DECIDED = 0.25


@dataclass(frozen=True, eq=False)
class _Grid:
    """Corners numbered row by row."""

    rows: int
    columns: int

    @classmethod
    def in_images(cls, observation: Observation) -> "_Grid | None":
        """Infer the grid on which the markers lie in every image; None if there is none."""
        number, N = observation.marker, observation.marker.size
        if N < _LEAST_SIDE**2 or int(number[-1] - number[0]) != N - 1:
            return None
        images = observation.images.reshape(-1, N, 2)
        whole = images[np.isfinite(images).all(axis=(1, 2))]
        for rows in range(_LEAST_SIDE, N // _LEAST_SIDE + 1):
            if len(whole) == 0 or N % rows:
                continue
            grid = cls(rows, N // rows)
            off = [grid._off(image) for image in whole[even_choice(len(whole), _SHOWN)]]
            if np.median(off) < _OFF_GRID:
                return grid
        return None

    @property
    def numberings(self) -> IntArray:
        """Indices (g, N) of the corners by each numbering."""
        return board_numberings(self.rows, self.columns)

    @property
    def grid_points(self) -> FloatArray:
        """Places (N, 2) of the corners on the board, in cells."""
        return np.indices((self.rows, self.columns))[::-1].reshape(2, -1).T.astype(np.float64)

    def _off(self, image: FloatArray) -> float:
        """Largest distance of corners (N, 2) from a plane grid, over the median cell."""
        moved = homogeneous(self.grid_points) @ moved_plane(self.grid_points, image).T
        cell = np.median(np.linalg.norm(np.diff(image.reshape(self.rows, self.columns, 2), axis=1), axis=2))
        return float(np.linalg.norm(moved[:, :2] / moved[:, 2:] - image, axis=1).max() / cell)

    def orientations(self, image: FloatArray, camera: FloatArray) -> FloatArray:
        """Rotations (g, 3, 3) of the board by each numbering of pixels (N, 2), NaN if few are seen."""
        seen = np.isfinite(image[:, 0])
        if seen.sum() <= 2 * _LEAST_SIDE:
            return np.full((len(self.numberings), 3, 3), np.nan)
        H = np.linalg.solve(camera, moved_plane(self.grid_points[seen], image[seen]))
        H *= np.sign(H[2] @ homogeneous(self.grid_points[seen]).mean(axis=0))
        U, _, Vt = np.linalg.svd(H[:, :2], full_matrices=False)
        across = U @ Vt
        R = np.column_stack([across, np.cross(across[:, 0], across[:, 1])])
        angles = 2.0 * np.pi * np.arange(len(self.numberings)) / len(self.numberings)
        c, s, zero = np.cos(angles), np.sin(angles), np.zeros_like(angles)
        turns = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1.0], axis=1).reshape(-1, 3, 3)
        return np.asarray(R @ turns)


@dataclass(eq=False)
class BoardNumbering:
    """Observations of a board, and the turn of its numbering in each image."""

    given: Observation  # as numbered by the detector
    grid: _Grid | None  # None if the markers are none of a board
    turn: IntArray  # (K, V) index of the numbering that is right
    decided: BoolArray  # (K, V) whether neighbours decide on an image, with most others of its view
    fits: int = 0  # how many fits turned further images

    @classmethod
    def of(cls, observation: Observation) -> "BoardNumbering":
        """Infer the board from the images; every number stays as it is."""
        shape, grid = observation.images.shape[:2], _Grid.in_images(observation)
        return cls(observation, grid, np.zeros(shape, dtype=np.int64), np.ones(shape, dtype=np.bool_))

    @classmethod
    def by_joints(cls, observation: Observation, joint_types: str) -> "BoardNumbering":
        """Turn the images whose numbers joint readings or other views contradict; one letter a joint."""
        found = cls.of(observation)
        if found.grid is not None:
            found.turn, found.decided = _proven_turns(found.grid, observation, joint_types)
        return found

    @property
    def observation(self) -> Observation:
        """The observations, numbered alike."""
        if self.grid is None or not self.turn.any():
            return self.given
        order = self.grid.numberings[self.turn]
        images = np.take_along_axis(self.given.images, order[..., None], axis=2)
        sigma = self.given.sigma
        sigma = None if sigma is None else np.take_along_axis(sigma, order, axis=2)
        return replace(self.given, images=images, sigma=sigma)

    @property
    def of_decided(self) -> Observation:
        """The observations in images on which neighbours decide."""
        found = self.observation
        found = replace(found, images=np.where(self.decided[..., None, None], found.images, np.nan))
        return found.rows(np.asarray(self.decided.any(axis=1)))

    def turn_by(self, calibration: Calibration) -> bool:
        """Turn images that fit a calibration far better so; whether there were any, at ever fewer looks."""
        if self.grid is None or self.fits >= _MAX_LOOKS:
            return False
        more = _turns_by(self.grid, self.observation, calibration)
        self.turn, self.fits = (self.turn + more) % len(self.grid.numberings), self.fits + 1
        return bool(more.any())

    @property
    def images(self) -> IntArray | None:
        """Images (t, 2) that were turned: number of the pose, index of the view; None without a board."""
        rows = np.argwhere(self.turn)
        return None if self.grid is None else np.stack([self.given.pose[rows[:, 0]], rows[:, 1]], axis=1)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """A finding on the images that were turned, of each view, if there are any."""
        if self.grid is None or not self.turn.any():
            return ()
        seen = np.isfinite(self.given.images[..., 0]).any(axis=2)
        turned = (np.count_nonzero(self.turn, axis=0), np.count_nonzero(seen, axis=0))
        each = tuple(
            Finding("turned_board", subject=Subject(views=(name,)), amount=int(n), limit=int(of), unit="1")
            for name, n, of in zip(self.given.view, *turned, strict=True)
        )
        angle = 2.0 * np.pi / len(self.grid.numberings)
        return (Finding("turned_board", LIMITS, amount=angle, unit="rad", others=each),)


def _proven_turns(grid: _Grid, observation: Observation, joint_types: str) -> tuple[IntArray, BoolArray]:
    """Turns (K, V) of images that joint readings and views prove, otherwise zero, and which they decide."""
    K, V = observation.images.shape[:2]
    turns = np.array([letter.upper() == "R" for letter in joint_types])
    step = np.abs(np.angle(np.exp(1j * (observation.q[:, None] - observation.q)[..., turns]))).sum(axis=-1)
    turn, largest, g = np.zeros((K, V), dtype=np.int64), list[BoolArray](), len(grid.numberings)
    for v in range(V):
        turn[:, v], of_largest = _turns_of_view(grid, observation.images[:, v], step)
        largest.append(of_largest)
    corners = [0, grid.columns - 1, (grid.rows - 1) * grid.columns, grid.rows * grid.columns - 1]
    few = observation.marker[[*corners, grid.columns * (grid.rows // 2) + 1]]
    for v in range(1, V):
        both, noise = largest[0] & largest[v], np.full(g, np.inf)
        for k in range(g):
            if noise[0] < _MUCH_NOISE_PX:
                break
            there = turn.copy()
            there[:, v] = (there[:, v] + k) % g
            alike = BoardNumbering(observation, grid, there, there >= 0).observation.rows(both)
            with suppress(WorkFailed):
                pair = Detections.of(alike, joint_types).of_views([0, v])
                pair = pair.of_markers(np.isin(pair.marker, few))
                noise[k] = Epipolar.of(pair, np.random.default_rng(0)).sigma_px
        if noise.min() < _DECIDED * noise[0]:
            turn[largest[v], v] = (turn[largest[v], v] + int(np.argmin(noise))) % g
    # No image shows which end is the first: take the end that most images take.
    kept = np.stack(largest, axis=1)
    counts = np.bincount(turn[kept], minlength=g)
    turn[kept] = (turn[kept] - int(np.argmax(counts))) % g
    return turn, kept


def _turns_of_view(grid: _Grid, images: FloatArray, step: FloatArray) -> tuple[IntArray, BoolArray]:
    """Turns (K,) of images (K, N, 2) of a view, and the mask (K,) of the largest group that is decided.

    step : (K, K) sums of the joint motions between poses, rad.
    """
    K, g = len(images), len(grid.numberings)
    middle = np.nanmedian(images, axis=(0, 1)) if np.isfinite(images).any() else np.zeros(2)
    extent = float(np.nanmax(np.abs(images - middle), initial=1.0))
    possible = np.zeros((K, K, g), dtype=np.bool_)
    for focal in 2.0 * extent * np.array(_FOCALS):
        camera = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
        R = np.stack([grid.orientations(image, camera) for image in images])
        cosine = 0.5 * (np.einsum("aij,bsij->abs", R[:, 0], R) - 1.0)
        possible |= ~(np.arccos(np.clip(cosine, -1.0, 1.0)) > (step + _MARGIN)[..., None])
    decided = np.triu(possible.sum(axis=2) == 1, 1)
    tree = minimum_spanning_tree(csr_array(np.where(decided, step + 1e-6, 0.0)))
    group = connected_components(tree, directed=False)[1]
    turn, between = np.zeros(K, dtype=np.int64), np.argmax(possible, axis=2)
    for one in np.unique(group):
        order, before = breadth_first_order(tree, int(np.flatnonzero(group == one)[0]), directed=False)
        for k in order[1:]:
            a = before[k]
            turn[k] = (turn[a] + (between[a, k] if a < k else -between[k, a])) % g
        turn[order] = (turn[order] - np.argmax(np.bincount(turn[order], minlength=g))) % g
    return turn, np.asarray(group == np.argmax(np.bincount(group)))


def _turns_by(grid: _Grid, observation: Observation, calibration: Calibration) -> IntArray:
    """Turns (K, V) with which images fit a calibration far better than as numbered; otherwise zero."""
    predicted = np.full(observation.images.shape, np.nan)
    of_known = predict(calibration, observation.q)[:, :, np.isin(calibration.marker, observation.marker)]
    predicted[:, :, np.isin(observation.marker, calibration.marker)] = of_known
    off = [np.linalg.norm(observation.images[:, :, order] - predicted, axis=-1) for order in grid.numberings]
    error = np.full((len(off), *predicted.shape[:2]), np.inf)
    some = np.isfinite(off).any(axis=(0, 3))
    error[:, some] = np.nanmedian(np.array(off)[:, some], axis=2)
    return np.where(error.min(axis=0) < _DECIDED * error[0], np.argmin(error, axis=0), 0)
