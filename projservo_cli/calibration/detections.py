"""Detections of a calibration as flat lists, and refusals of data without motion or without two dimensions.

The checks need joint readings, marker numbers and pixels, and no geometry yet. At the end come deviations
and weights of residuals. Fits by reweighting solve other equations in each round, in closed form and many at
once, so that each keeps its own loop: two-view geometry, rigid motions, axis points and the adjustment.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from numbers import Real
from typing import Any

import numpy as np
from scipy.special import chdtri

from projservo_cli.findings import LIMITS, REACH_M, REACH_RAD, Finding, Subject
from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.messages.placeholders import quantity
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.records import (
    TOOL,
    VIEWS,
    WORLD,
    BoolArray,
    FloatArray,
    InputError,
    IntArray,
    Observation,
    WorkFailed,
    coordinate_names,
    prismatic_of,
)

# Difference, rad or m, below which two joint readings are equal: far below any encoder's resolution.
_SAME_READING = 1e-7
# Minimum pixel noise, px per coordinate: exact images have round-off.
MIN_SIGMA = 1e-4
# Median of |x| over the standard deviation of a normal variable.
MAD = 0.6744897501960817
# Median of the length of a two-dimensional normal vector of unit deviation.
RAYLEIGH = 1.1774100225154747
# Maximum trial motion to advise, in reaches.
MAX_REACHES = 4.0
# Codes of joints that no motion determines, that moved with others alone, seldom, or too little.
_WEAK = ("hopeless_joint", "joint_together", "joint_in_few_poses", "little_motion")
# Minimum image motion over the range of a joint, in units of the pixel noise.
MIN_MOTION = 5.0
# Range of a joint without image motion, in reaches, above which it did not follow its readings.
_STANDING = 0.1
# Minimum range of a joint that counts as motion, rad or m.
_MIN_SPAN = 1e-6
# Maximum number of markers in computations that only assess a fit.
MAX_JUDGED = 50
# Minimum spread of a view's pixels across their main direction, in units of the noise.
_MIN_SPREAD = 5.0
# Ratio of both spreads above which pixels lie on a line rather than in one spot.
_ELONGATED = 10.0
# Share of observations, assumed wrong, that may move more than the rest while the robot is at rest.
_MAX_WRONG = 0.1
# A view is at rest if its images move less than this share of another view's motion, and less than that, px.
STILL_SHARE, STILL_PX = 0.03, 3.0
# Minimum share of a beginning, or an end, of the poses that is nearly all of it.
_NEARLY_ALL = 0.9
# Probability that noise alone puts the markers of an image farther off their best line.
_OFF_LINE_TAIL = 0.1
ON_A_LINE = "the markers lie on one line: a turn about it shows in no image; add a marker off the line"
# Difference of joint readings, rad or m, below which they are equal: a robot holds a joint with jitter.
SAME_READING = 2e-3


@dataclass(frozen=True, eq=False)
class Detections:
    """Pixels of every marker seen at a pose by at least one camera, ordered by marker and then by pose.

    A row (N,) is an observation, of one marker at one pose; a detection is its pixel in one view (V, N).
    """

    q: FloatArray  # (K, n) joint readings, rad or m
    prismatic: BoolArray  # (n,) whether the joint is prismatic
    pose: IntArray  # (K,) numbers of the poses
    marker: IntArray  # (m,) numbers of the markers
    pose_of: IntArray  # (N,) row of ``q``
    marker_of: IntArray  # (N,) index into ``marker``, never falling
    pixels: FloatArray  # (V, N, 2) px, zero if not seen
    seen: BoolArray  # (V, N) whether the view saw the marker
    weight: FloatArray  # (V, N) weights of residuals: ``stated_px`` over the standard deviation, or one
    stated_px: float | None  # median of the stated standard deviations, px, if any
    view: tuple[str, ...] = VIEWS  # names of the views
    mount: str = WORLD  # with cameras on the tool, the chain ends at the scene: joints in reverse, negated
    pair: tuple[int, ...] = (0, 1)  # the one or two views by which a fit begins and noise is known
    chart: FlangeChart | None = None  # of poses of the flange; None for joints
    # (m,) index of the board of known shape that holds a marker, −1 for none; None without such boards
    board: IntArray | None = None

    @classmethod
    def of(cls, observation: Observation, joint_types: str, mount: str = WORLD) -> "Detections":
        """Flatten the poses at rest of an observation; one letter a joint, R or P.

        On the tool X_camera = (∏ exp(q_i Ĥ_i))⁻¹ X: the product of the exponentials of −q_n Ĥ_n to −q_1 Ĥ_1.
        Raises InputError if the arrays or the letters do not fit each other, or values are not finite.
        """
        require_shapes(observation)
        observation = observation.at_rest
        letters = joint_types.upper()
        n = observation.q.shape[1]
        if len(letters) != n or set(letters) - {"R", "P"}:
            raise InputError(f"joint types {joint_types!r}: expected {n} letters R or P, one per joint")
        if not np.isfinite(observation.q).all():
            raise InputError("joint readings must be finite numbers")
        if np.isinf(observation.images).any():
            raise InputError("pixels must be finite numbers, or missing if a marker was not seen")
        finite = np.asarray(np.isfinite(observation.images).all(axis=3))
        marker_of, pose_of = np.nonzero(finite.any(axis=1).T)
        seen = finite[pose_of, :, marker_of].T
        weight, stated_px = np.ones(seen.shape), None
        if observation.sigma is not None and seen.any():
            sigma = np.maximum(observation.sigma[pose_of, :, marker_of].T[seen], MIN_SIGMA)
            # Their root mean square would come from the few loosest, which hardly count.
            stated_px = float(np.median(sigma))
            weight[seen] = stated_px / sigma
        q, prismatic = np.array(observation.q, dtype=np.float64), prismatic_of(letters)
        if mount == TOOL:
            q, prismatic = in_chain_order(mount, q), prismatic[::-1].copy()
        present, marker_of_present = np.unique(marker_of, return_inverse=True)
        return cls(
            q=q,
            prismatic=prismatic,
            pose=observation.pose,
            marker=observation.marker[present],
            pose_of=pose_of,
            marker_of=marker_of_present,
            pixels=np.where(seen[..., None], observation.images[pose_of, :, marker_of].swapaxes(0, 1), 0.0),
            seen=seen,
            weight=weight,
            stated_px=stated_px,
            view=observation.view,
            mount=mount,
            pair=(0, 1)[: len(observation.view)],
            chart=FlangeChart.from_optional(observation.flange_chart),
        )

    def everywhere(self, q: FloatArray, which: IntArray | None = None) -> "Detections":
        """Detections of all markers, or some, at joints (K, n), rad or m, all seen in every view at zero."""
        which = np.arange(self.marker.size) if which is None else which
        marker_of, pose_of = np.repeat(which, len(q)), np.tile(np.arange(len(q)), which.size)
        V = len(self.seen)
        pixels, weight = np.zeros((V, marker_of.size, 2)), np.ones((V, marker_of.size))
        return dataclasses.replace(
            self,
            q=q,
            pose=np.arange(len(q)),
            pose_of=pose_of,
            marker_of=marker_of,
            pixels=pixels,
            seen=weight > 0.0,
            weight=weight,
            stated_px=None,
        )

    @property
    def known_operators(self) -> FloatArray | None:
        """Operators (6, 4, 4) in the base, m, of poses of the flange along the chain; None for joints."""
        if self.chart is None:
            return None
        H_hat = self.chart.H_hat
        return H_hat[::-1] if self.mount == TOOL else H_hat

    def by_twist(self) -> FloatArray | None:
        """Derivatives (K, 6, 6) of ``q`` by a twist of the flange; None for joints."""
        if self.chart is None:
            return None
        by_twist = self.chart.by_twist(in_chain_order(self.mount, self.q))
        return -by_twist[:, ::-1, ::-1] if self.mount == TOOL else by_twist

    @property
    def numbers(self) -> IntArray:
        """Numbers (n,) of the joints along the arm, from 1."""
        numbers = np.arange(1, self.prismatic.size + 1)
        return numbers[::-1] if self.mount == TOOL else numbers

    @property
    def units(self) -> list[str]:
        """Unit of each joint (n,), rad or m."""
        return ["m" if slides else "rad" for slides in self.prismatic]

    @property
    def setup(self) -> Setup:
        """Arm and cameras, for words."""
        names = coordinate_names(None if self.chart is None else self.chart.record)
        return Setup(self.mount, self.view, self.prismatic.size, names)

    def name_of(self, i: int) -> str:
        """Name of a joint by its column, or of a coordinate of a pose of the flange."""
        number, names = int(self.numbers[i]), self.setup.coordinates
        return f"{names[number - 1]} of the flange" if names else f"joint {number}"

    @property
    def both(self) -> BoolArray:
        """Mask (N,) of the observations by both views of the pair, or by the only view."""
        return np.asarray(self.seen[[*self.pair]].all(axis=0))

    def rows(self, keep: BoolArray | IntArray | slice) -> "Detections":
        """Select observations (N,); the lists of poses and markers stay."""
        return dataclasses.replace(
            self,
            pose_of=self.pose_of[keep],
            marker_of=self.marker_of[keep],
            pixels=self.pixels[:, keep],
            seen=self.seen[:, keep],
            weight=self.weight[:, keep],
        )

    def dense(self) -> FloatArray:
        """Pixels (V, K, m, 2) of all markers at all poses, NaN where unseen."""
        pixels = np.full((len(self.seen), len(self.q), self.marker.size, 2), np.nan)
        for here, seen, found in zip(pixels, self.seen, self.pixels, strict=True):
            here[self.pose_of[seen], self.marker_of[seen]] = found[seen]
        return pixels

    def of_views(self, which: list[int]) -> "Detections":
        """Select views, in an order, of which the first two are the pair; and the observations by them."""
        seen = self.seen[which]
        some = dataclasses.replace(
            self,
            pixels=self.pixels[which],
            seen=seen,
            weight=self.weight[which],
            view=tuple(self.view[v] for v in which),
            pair=(0, 1),
        ).rows(np.asarray(seen.any(axis=0)))
        return some.of_markers(np.isin(np.arange(self.marker.size), some.marker_of))

    def of_pair(self) -> "Detections":
        """Select the observations by the pair of views."""
        return self if len(self.view) <= 2 else self.of_views([*self.pair])

    def of_poses(self, keep: BoolArray) -> "Detections":
        """Select the observations at some poses (K,); the lists of poses and markers stay."""
        return self.rows(keep[self.pose_of])

    def resized(self, onset: int, factor: float) -> "Detections":
        """Images from a row of poses on by a factor larger; the middle of their first pixel is at zero."""
        later = (self.pose_of >= onset)[:, None]
        return dataclasses.replace(
            self, pixels=np.where(later, factor * (self.pixels + 0.5) - 0.5, self.pixels)
        )

    def of_markers(self, keep: BoolArray) -> "Detections":
        """Select markers (m,) and their observations."""
        left = self.rows(keep[self.marker_of])
        numbers = (np.cumsum(keep) - 1)[left.marker_of]
        board = None if self.board is None else self.board[keep]
        return dataclasses.replace(left, marker=self.marker[keep], marker_of=numbers, board=board)

    @property
    def on_board(self) -> BoolArray:
        """Mask (m,) of markers on boards of known shape."""
        return np.zeros(self.marker.size, dtype=np.bool_) if self.board is None else self.board >= 0

    @property
    def boards(self) -> IntArray:
        """Indices (b,) of the boards of known shape that hold some marker."""
        return np.empty(0, dtype=np.int64) if self.board is None else np.unique(self.board[self.on_board])

    @property
    def board_key(self) -> tuple[int, ...]:
        """``board`` as a key of what depends on it."""
        return () if self.board is None else tuple(self.board.tolist())

    def covering(self, order: IntArray, wanted: int) -> BoolArray:
        """Mask (m,) of markers, taken in an order until each pose has as many as wanted, seen by the pair."""
        rows = np.flatnonzero(self.both)
        count = np.bincount(self.marker_of[rows], minlength=self.marker.size)
        edge = np.cumsum(count) - count
        lack, chosen = np.full(len(self.q), wanted), np.zeros(self.marker.size, dtype=np.bool_)
        for j in order:
            poses = self.pose_of[rows[edge[j] : edge[j] + count[j]]]
            if count[j] > 1 and (lack[poses] > 0).any():
                chosen[j] = True
                lack[poses] -= 1
        return chosen

    def count_at(self, mask: BoolArray) -> IntArray:
        """Number (K,) of detections in a mask (V, N) at each pose."""
        return np.bincount(self.pose_of, mask.sum(axis=0), len(self.q)).astype(np.int64)

    def count_of(self, mask: BoolArray) -> IntArray:
        """Number (m,) of detections in a mask (V, N) of each marker."""
        return np.bincount(self.marker_of, mask.sum(axis=0), self.marker.size).astype(np.int64)

    def home(self) -> int | None:
        """Row of q that all others differ from in at most one joint, the reference of single-joint trials."""
        if self.chart is not None:
            return None
        q = self.q
        candidates = np.arange(len(q))
        for row in q:
            changed = (np.abs(q[candidates] - row) > _SAME_READING).sum(axis=1)
            candidates = candidates[changed <= 1]
        if candidates.size == 0:
            return None
        # Given trials of a single joint every row qualifies: take the one in the middle.
        travel = [np.abs(q[candidate] - q).sum() for candidate in candidates]
        return int(candidates[np.argmin(travel)])

    def trials(self, home: int) -> list[IntArray]:
        """Rows of q in which each joint differs from the reference, one array a joint."""
        moved = np.abs(self.q - self.q[home]) > _SAME_READING
        return [np.flatnonzero(column) for column in moved.T]

    def reference(self) -> FloatArray:
        """Reference joints (n,) of the model: the reference of trials, else the most central pose."""
        if self.chart is not None:
            return np.zeros(self.q.shape[1])
        row = self.home()
        if row is None:
            span = np.ptp(self.q, axis=0)
            deviation = (self.q - np.median(self.q, axis=0)) / np.where(span > 0.0, span, 1.0)
            row = int(np.argmin((deviation**2).sum(axis=1)))
        return np.asarray(self.q[row].copy())


def in_chain_order(mount: str, values: FloatArray) -> FloatArray:
    """Joint values (…, n) in the order and sense of the chain of a mount, or back from these."""
    return np.ascontiguousarray(-values[..., ::-1]) if mount == TOOL else values


def per_block(block_of: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Sums (b, …) of values (N, …) over the observations of each marker or of each pose."""
    sums = [np.bincount(block_of, column, count) for column in values.reshape(len(values), -1).T]
    return np.stack(sums, axis=1).astype(np.float64).reshape(count, *values.shape[1:])


def require_shapes(observation: Observation) -> None:
    """Refuse an observation whose arrays do not fit each other, naming the array and its shape."""
    if observation.q.ndim != 2:
        raise InputError(f"joint readings of shape {observation.q.shape}: expected (poses, joints)")
    for name, numbers in (("pose", observation.pose), ("marker", observation.marker)):
        if numbers.ndim != 1:
            raise InputError(f"{name} numbers of shape {numbers.shape}: expected one dimension")
        values, count = np.unique(numbers, return_counts=True)
        if (count > 1).any():
            raise InputError(f"{name} number {values[count > 1][0]} occurs twice: number each {name} once")
    K, V, m = len(observation.q), len(observation.view), len(observation.marker)
    shapes = {"pose": (K,), "images": (K, V, m, 2), "sigma": (K, V, m), "moving": (K,), "t_q": (K,)}
    for name, shape in (shapes | {"t_view": (K, V)}).items():
        given = getattr(observation, name)
        if given is not None and given.shape != shape:
            raise InputError(
                f"{name} of shape {given.shape}: expected {shape} for {K} poses, {V} views, {m} markers"
            )
    if observation.sigma is not None:
        stated = observation.sigma[np.isfinite(observation.images).all(axis=3)]
        if not ((stated > 0.0) & (stated < np.inf)).all():
            raise InputError("sigma must be a positive number wherever a marker was seen, px")


def even_choice(count: int, max_count: int) -> IntArray:
    """Indices below ``count``, all or ``max_count`` evenly spaced from the first to the last."""
    if count <= max_count:
        return np.arange(count)
    return np.linspace(0, count - 1, max_count).round().astype(np.int64)


def per_rad(prismatic: BoolArray) -> FloatArray:
    """Joint motions (n,), rad or m, equivalent to one rad of a revolute joint."""
    return np.where(prismatic, REACH_M / REACH_RAD, 1.0)


def require_motion(detections: Detections) -> FloatArray:
    """Range of each joint over the poses, (n,) rad or m.

    Raises WorkFailed if a joint never moves, fewer than three markers were seen, or there is only one pose.
    """
    m = detections.marker.size
    if m < 3:
        what = ("no marker was", "only one marker was", "only two markers, which lie on a line, were")[m]
        raise WorkFailed(
            f"{what} seen: a rotation about a line through them shows in no image; "
            "use three or more markers that are not on one line"
        )
    if len(detections.q) < 2:
        raise WorkFailed("only one pose: trial motions of every joint are needed")
    span: FloatArray = np.ptp(detections.q[np.unique(detections.pose_of)], axis=0)
    for i in np.flatnonzero(span <= _MIN_SPAN):
        raise WorkFailed(
            f"{detections.name_of(int(i))} has no trial motion: it never moves in the data; record poses in "
            "which it does"
        )
    return span


def require_no_copies(detections: Detections) -> None:
    """Refuse two joints with the same readings at all poses, or two views with the same pixels."""
    q, seen, view = detections.q, detections.seen, detections.view
    for a, b in combinations(range(q.shape[1]), 2):
        if (q[:, a] == q[:, b]).all():
            first, second = sorted(int(detections.numbers[i]) for i in (a, b))
            raise InputError(
                f"the readings of joints {first} and {second} are the same at all {len(q)} poses: one column "
                "is a copy of the other; put the joint's own readings there"
            )
    for a, b in combinations(range(len(view)), 2):
        both = seen[a] & seen[b]
        if both.any() and (detections.pixels[a, both] == detections.pixels[b, both]).all():
            raise InputError(
                f"the pixels of the views {view[a]} and {view[b]} are the same in all {both.sum()} rows that "
                "have both: one is a copy of the other; put the camera's own pixels there, or leave it out"
            )


def weak_joints(
    which: IntArray, span: FloatArray, needed: FloatArray, detections: Detections, alone: FloatArray
) -> list[Finding]:
    """Find out why joints are hardly determined: those without a remedy, moved together, seldom, or little.

    which : (k,) indices of these joints.
    span : (n,) range of each joint in the data, rad or m.
    needed : (n,) range of a trial motion that would determine it, rad or m; NaN if none would.
    alone : (n,) range over which it moved alone, rad or m.
    """
    reach = np.where(detections.prismatic, REACH_M, REACH_RAD)
    found = list[tuple[int, Finding]]()
    for i in which.tolist():
        if not needed[i] <= MAX_REACHES * reach[i]:
            order = 0
        elif span[i] >= reach[i] and len(span) > 1 and not needed[i] <= alone[i]:
            order = 1
        else:
            order = 2 if needed[i] <= span[i] else 3
        limit = "amplitude" if span[i] < reach[i] else "geometry"
        subject = Subject(joints=(int(detections.numbers[i]),), name=limit)
        min_span = math.nan if order == 0 else float(needed[i])
        finding = Finding(
            _WEAK[order], LIMITS, subject, float(span[i]), limit=min_span, unit=detections.units[i]
        )
        found.append((order, finding))
    return [finding for _, finding in sorted(found, key=lambda one: one[0])]


def require_moved(name: str, span: float, unit: str, motion_px: float, sigma_px: float) -> None:
    """Refuse a joint if its range moves the images by no more than noise: too short, or it did not follow."""
    if motion_px >= MIN_MOTION * sigma_px:
        return
    seen = (
        f"the images by {motion_px:.3g} px, less than {MIN_MOTION:g} times their noise of {sigma_px:.3g} px"
    )
    reach = REACH_M if unit == "m" else REACH_RAD
    if span < _STANDING * reach:
        needed = quantity(0.5 * reach, unit)
        advice = f"{name} moved only {quantity(span, unit)}: move it at least {needed}"
        raise WorkFailed(f"too little excitation: the range of {name} moves {seen}; {advice}")
    raise WorkFailed(
        f"{name} does not move: its readings range over {quantity(span, unit)} but "
        f"move {seen}; check that it moved and that its readings are its own, or move a marker off its axis"
    )


def require_size_and_noise(image_size: Any, sigma_px: Any) -> None:
    """Refuse a width and height of images, px, or a noise of pixels, px, that are none; None is unknown."""
    if sigma_px is not None and not _is_positive(sigma_px):
        raise InputError(f"pixel noise {sigma_px!r}: give a positive number, or none to estimate it")
    if image_size is not None:
        each = image_size.values() if isinstance(image_size, Mapping) else image_size
        given = tuple(each) if np.iterable(each) else ()
        for lengths in given if given and all(map(np.iterable, given)) else (given,):
            if len(lengths) != 2 or not all(map(_is_positive, lengths)):
                raise InputError(
                    f"image size {image_size!r}: give a positive width and height, px, or one pair a camera"
                )


def _is_positive(value: Any) -> bool:
    return isinstance(value, Real) and 0.0 < float(value) < np.inf


def require_images(detections: Detections, sigma_px: float | None) -> None:
    """Refuse images that show one spot, one line, or no motion.

    Raises WorkFailed naming the view or the joint.
    """
    sigma = max(sigma_px or 0.0, MIN_SIGMA)
    _require_spread(detections, sigma)
    _require_moving(detections, sigma)
    _require_all_moving(detections)
    _require_no_line(detections, sigma)


def _spread(pixels: FloatArray) -> FloatArray:
    """Robust deviations (2,) of pixels (N, 2) along and across their main direction, px.

    The direction comes from the second moment of the unit vectors from the median, so that far
    outliers weigh no more than others. Source: S. Visuri, V. Koivunen, H. Oja, "Sign and rank
    covariance matrices", J. Statistical Planning and Inference 91(2), 2000.
    """
    offset = pixels - np.median(pixels, axis=0)
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    signs = offset / np.where(length > 0.0, length, 1.0)
    axes = np.linalg.eigh(signs.T @ signs)[1][:, ::-1]
    return np.asarray(np.median(np.abs(offset @ axes), axis=0) / MAD)


def _require_spread(detections: Detections, sigma: float) -> None:
    """Refuse a view that saw nothing, or whose pixels do not spread in two directions."""
    for v, view in enumerate(detections.view):
        if not detections.seen[v].any():
            raise WorkFailed(f"the {view} camera saw no marker: each must see them")
        along, across = _spread(detections.pixels[v][detections.seen[v]])
        if across >= _MIN_SPREAD * sigma:
            continue
        if along > _ELONGATED * max(across, sigma):
            raise WorkFailed(
                f"the {view} images show all markers at all poses on one line, within {across:.3g} px: check "
                "the pixel columns, and move the robot and its markers in all directions"
            )
        raise WorkFailed(
            f"the {view} images show no more than noise: their markers spread over {along:.3g} px, "
            f"less than {_MIN_SPREAD:g} times the noise of {sigma:.3g} px; check the pixel columns, and "
            "that the pixels of a row are of one marker at one pose"
        )


def _require_moving(detections: Detections, sigma: float) -> None:
    """Refuse images that do not move while the joint readings move: all, or the trials of a joint."""
    limit = MIN_MOTION * sigma
    if _farthest(detections) < limit:
        raise WorkFailed(
            f"the images stand still within {limit:.3g} px although the joint readings move: check that the "
            "robot moved, and that images and readings belong together"
        )
    home = detections.home()
    if home is None:
        return
    for i, rows in enumerate(detections.trials(home)):
        poses = np.zeros(len(detections.q), dtype=bool)
        poses[np.append(rows, home)] = True
        # A point that moves evenly along a path of length L has variance L² / 12; noise adds the variance of
        # both coordinates.
        square = 12.0 * _variances(*_tracks(detections.of_poses(poses))).sum(axis=1)
        path = np.sqrt(max(float(square.mean()) - 24.0 * sigma**2, 0.0)) if square.size else np.inf
        span = float(np.ptp(detections.q[poses, i]))
        require_moved(detections.name_of(i), span, detections.units[i], path, sigma)


def _require_all_moving(detections: Detections) -> None:
    """Refuse a view at rest while another moves: the fit would name the joints or the other."""
    moved = [_farthest(detections.of_views([v])) for v in range(len(detections.view))]
    still, moving = int(np.argmin(moved)), int(np.argmax(moved))
    if np.isfinite(moved[moving]) and moved[still] < min(STILL_SHARE * moved[moving], STILL_PX):
        raise WorkFailed(
            f"the {detections.view[still]} images stand still within {moved[still]:.3g} px, while the "
            f"{detections.view[moving]} images move by {moved[moving]:.3g} px: check whether that camera "
            "hangs, and whether its markers have the numbers of the markers that move"
        )


def beginning_in(mask: BoolArray) -> int:
    """Length of the longest beginning of a mask (K,) that is nearly all in it, its end too; 0 for none."""
    share = np.cumsum(mask) / np.arange(1, len(mask) + 1)
    return int(np.flatnonzero(mask & (share >= _NEARLY_ALL)).max(initial=-1)) + 1


def _tracks(detections: Detections) -> tuple[FloatArray, IntArray]:
    """Pixels (L, 2) of each marker in each view that shows it twice or more, and their track index (L,)."""
    views = [np.flatnonzero(seen) for seen in detections.seen]
    pixels = np.concatenate([detections.pixels[v, rows] for v, rows in enumerate(views)])
    track = np.concatenate([len(views) * detections.marker_of[rows] + v for v, rows in enumerate(views)])
    often = np.bincount(track)[track] > 1
    return pixels[often], np.unique(track[often], return_inverse=True)[1]


def _variances(values: FloatArray, group: IntArray) -> FloatArray:
    """Unbiased variances (G, d) of the values (L, d) of each group, 0 to G - 1, of two or more."""
    count = np.bincount(group)
    mean, square = np.empty((2, count.size, values.shape[1]))
    for i, column in enumerate(values.T):
        mean[:, i] = np.bincount(group, column) / count
        square[:, i] = np.bincount(group, (column - mean[group, i]) ** 2) / (count - 1)
    return square


def medians(values: FloatArray, group: IntArray) -> FloatArray:
    """Medians (G, d) of the values (L, d) of each group, 0 to G - 1, none of them empty."""
    count = np.bincount(group)
    first = np.cumsum(count) - count
    ordered = np.stack([column[np.lexsort((column, group))] for column in values.T], axis=1)
    return np.asarray(0.5 * (ordered[first + (count - 1) // 2] + ordered[first + count // 2]))


def _farthest(detections: Detections) -> float:
    """Distance of detections from the median of their track, at the quantile 1 − ``_MAX_WRONG``, px."""
    pixels, track = _tracks(detections)
    distance = np.linalg.norm(pixels - medians(pixels, track)[track], axis=1)
    return float(np.quantile(distance, 1.0 - _MAX_WRONG)) if distance.size else np.inf


def _require_no_line(detections: Detections, sigma: float) -> None:
    """Refuse a body whose markers lie on a line, up to the noise, in most images; two of them always do."""
    off = []
    for seen, positions in zip(detections.seen, detections.pixels, strict=True):
        rows = np.flatnonzero(seen)
        rows = rows[np.argsort(detections.pose_of[rows], kind="stable")]
        for pixels in np.split(positions[rows], np.flatnonzero(np.diff(detections.pose_of[rows])) + 1):
            across = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)[-1]
            chance = chdtri(max(len(pixels) - 2, 1), _OFF_LINE_TAIL)
            off.append(len(pixels) < 3 or across**2 > sigma**2 * chance)
    if off and np.mean(off) < 0.5:
        raise WorkFailed(ON_A_LINE)


def robust_deviation(residual: FloatArray, floor: float) -> float:
    """Robust standard deviation of residuals about zero, at least ``floor``."""
    return max(float(np.median(np.abs(residual))) / MAD, floor)


def cauchy_weights(square: FloatArray) -> FloatArray:
    """Weights (…) of the Cauchy loss log(1 + x²), by the squares x² of residuals over its width."""
    return np.asarray(1.0 / (1.0 + square))
