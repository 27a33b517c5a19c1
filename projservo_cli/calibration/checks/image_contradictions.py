"""Images that contradict each other: tags exchanged, late or of another size, or a camera that moved.

A robot fits such a table with half of these detections rejected: only the epipolar geometry shows it.
"""

from contextlib import suppress

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

from projservo_cli.calibration.detections import Detections, beginning_in
from projservo_cli.calibration.initial.epipolar import OUTLIER, Epipolar, ImageFrame, ImageGeometry, sampson
from projservo_cli.calibration.initial.single_view import RigidBody
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.geometry.displacements import homogeneous
from projservo_cli.image_size import FACTORS
from projservo_cli.messages import failed
from projservo_cli.records import BoolArray, FloatArray, IntArray, Observation, WorkFailed

# Minimum number of poses at which both views saw a marker, to judge its number.
_MIN_POSES = 8
# Share of poses at which a marker misfits the epipolar geometry, above which its number is in doubt.
_DOUBTED = 0.5
# Maximum share of the poses at which markers misfit under their true numbers.
_ALIKE = 0.1
# Noise of the epipolar geometry, px, above which most of the numbers may be wrong.
_MUCH_NOISE_PX = 1.0
# Maximum noise of images paired with images of the next pose, over the noise within one pose, of a late view.
_LESS = 0.7
# Residual of a corner, in deviations of the geometry of few points, above which it misfits.
_OF_FEW = 15.0
# Share of the detections of a pose that misfit the geometry of others if a camera moved, and minimum
# number of such poses.
_MISFIT, _LEAST_MOVED = 0.5, 5
# Minimum number of poses before and after images change their size, number of onsets that are tried, and
# noise of images of one size over that as they are.
_LEAST_RESIZED, _ONSETS, _ONE_SIZE = 4, 3, 0.5
# Noise of images of one size over the noise before they changed, which counts as much again.
_LIKE_FIRST = 1.5
# Maximum number of tags whose own geometry is tried.
_MAX_TAGS = 6
# Corners of a tag, numbered 4 t to 4 t + 3.
_CORNERS = 4
# Maximum number of tags or markers that a message names.
_EXAMPLES = 3


def checked_geometry(detections: Detections, frame: ImageFrame, rng: np.random.Generator) -> ImageGeometry:
    """Estimate the geometry of images; refuse views that number markers differently, or show other poses.

    The images do not show which view is right, and goals are given by numbers, so nothing is renumbered.

    Raises WorkFailed naming the tags or markers, the view that is late or the pose at which one moved, or as
    ``Epipolar.of`` does.
    """
    alone = len(detections.pair) == 1
    try:
        found = RigidBody.of(detections, frame) if alone else Epipolar.of(detections, rng)
    except WorkFailed:
        noise_px = np.inf if alone else _noise_px(detections)
        _require_one_size(detections, frame, noise_px)
        if not alone:
            _require_alike(detections, _by_tags(detections))
            _require_one_pose(detections, noise_px)
            _require_one_rig(detections)
        raise
    _require_one_size(detections, frame, found.sigma_px)
    if not isinstance(found, Epipolar):
        return found
    order = _true_order(detections, found, OUTLIER)
    if found.sigma_px > _MUCH_NOISE_PX and (order == np.arange(order.size)).all():
        order = _by_tags(detections)
        _require_one_pose(detections, found.sigma_px)
    _require_alike(detections, order)
    return found


def _noise_px(detections: Detections) -> float:
    """Noise of the epipolar geometry, px, though it shows no depth; infinite if there is none."""
    try:
        return Epipolar.fitted(detections, np.random.default_rng(0)).sigma_px
    except WorkFailed:
        return np.inf


def _require_one_pose(detections: Detections, noise_px: float) -> None:
    """Refuse images of one view that lag the other by a pose, if shifting them lowers the noise much.

    noise_px : of the images as they are paired.
    """
    limit_px = min(_MUCH_NOISE_PX, _LESS * noise_px)
    left, right = _dense(detections, np.arange(detections.marker.size))
    for late, together in enumerate(((left[1:], right[:-1]), (left[:-1], right[1:]))):
        pairs = Observation(
            detections.pose[1:], detections.marker, detections.q[1:], np.stack(together, axis=1)
        )
        shifted = _epipolar(Detections.of(pairs, "R" * detections.q.shape[1]))
        if shifted is not None and shifted.sigma_px < limit_px:
            names = [detections.view[v] for v in detections.pair]
            subject = Subject(views=(names[late], names[1 - late]))
            raise failed(
                [Finding("late_view", REFUSES, subject, shifted.sigma_px, limit=limit_px, unit="px")]
            )


def _require_one_size(detections: Detections, frame: ImageFrame, noise_px: float) -> None:
    """Refuse images that are of another size from a pose on: so their noise is far less.

    noise_px : of the images as they are.
    """
    if noise_px <= _MUCH_NOISE_PX:
        return
    for onset, factor in size_changes(detections)[:_ONSETS]:
        one_size = detections.resized(onset, 1.0 / factor)
        before = detections.of_poses(np.arange(len(detections.q)) < onset)
        first, geometry = (_geometry(some, frame) for some in (before, one_size))
        if first is None or geometry is None:
            continue
        of_first_px = _LIKE_FIRST * max(1.0, 1.0 / factor) * first.noise_px
        if geometry.sigma_px < min(_MUCH_NOISE_PX, _ONE_SIZE * noise_px, of_first_px):
            fits = [
                np.bincount(of.pose_of, geometry.within(of, OUTLIER), len(of.q))
                for of in (detections, detections.resized(0, 1.0 / factor))
            ]
            later = np.cumsum((fits[1] - fits[0])[::-1])[::-1]
            subject = Subject(poses=(int(detections.pose[np.argmax(later)]),))
            raise failed([Finding("image_size_changed", REFUSES, subject, factor, unit="1")])


def _epipolar(detections: Detections) -> Epipolar | None:
    """Epipolar geometry of images, or None if they show none."""
    with suppress(WorkFailed):
        return Epipolar.of(detections, np.random.default_rng(0))
    return None


def _geometry(detections: Detections, frame: ImageFrame) -> ImageGeometry | None:
    """Geometry of images of one view or two, or None if they show none."""
    if len(detections.pair) > 1:
        return _epipolar(detections)
    with suppress(WorkFailed):
        return RigidBody.of(detections, frame)
    return None


def size_changes(detections: Detections) -> list[tuple[int, float]]:
    """Rows of poses from which images may be larger, and by which factor, the clearest change first.

    Sizes change with the joints too, by a polynomial of the second order or, of few poses, of the first.
    """
    size = _log_sizes(detections)
    known, found = np.flatnonzero(np.isfinite(size)), list[tuple[float, int, float]]()
    q = detections.q[known]
    x = (q - q.mean(axis=0)) / np.maximum(q.max(axis=0) - q.min(axis=0), 1e-9)
    by_joints = np.hstack([np.ones((known.size, 1)), x, x**2][: 3 if known.size > 6 * x.shape[1] else 2])
    Q = np.linalg.qr(by_joints)[0]
    left = size[known] - Q @ (Q.T @ size[known])
    for k in range(_LEAST_RESIZED, known.size - _LEAST_RESIZED):
        step = (np.arange(known.size) >= k).astype(np.float64)
        step -= Q @ (Q.T @ step)
        square = float(step @ step)
        change = float(step @ left) / max(square, 1e-9)
        factor = min(FACTORS, key=lambda factor: abs(np.log(factor) - change))
        found.append((change**2 * square, int(known[k]), factor))
    return [(onset, factor) for _, onset, factor in sorted(found, reverse=True)]


def _log_sizes(detections: Detections) -> FloatArray:
    """Logarithm (K,) of distance from the corner and extent of the visible markers; NaN if unseen."""
    pixels = detections.dense() + 0.5
    seen = np.isfinite(pixels[..., 0])
    count = np.where(seen.sum(axis=2) > 1, seen.sum(axis=2), np.nan)
    pixels = np.where(seen[..., None], pixels, 0.0)
    middle = pixels.sum(axis=2) / count[..., None]
    square = (np.square(pixels - middle[:, :, None]).sum(axis=-1) * seen).sum(axis=2) / count
    with np.errstate(invalid="ignore", divide="ignore"):
        sizes = np.log(np.linalg.norm(middle, axis=-1)) + np.log(np.sqrt(square))
        known = np.isfinite(sizes)
        return np.asarray(0.5 * np.where(known, sizes, 0.0).sum(axis=0) / known.sum(axis=0))


def _require_one_rig(detections: Detections) -> None:
    """Refuse images amid which one camera moved: one half shows a geometry that the other end misfits."""
    first = np.arange(len(detections.q)) < len(detections.q) // 2
    for half, backwards in ((first, True), (first[::-1], False)):
        count = beginning_in(_misfitting(detections, half)[:: -1 if backwards else 1])
        if count >= _LEAST_MOVED:
            at, which = (-count, "last") if backwards else (count, "first")
            subject = Subject(poses=(int(detections.pose[at]),), name=which)
            raise failed([Finding("camera_amid", REFUSES, subject, count, unit="1")])


def _misfitting(detections: Detections, half: BoolArray) -> BoolArray:
    """Whether each pose (K,) misfits the geometry of some poses (K,); none if these show none."""
    K, geometry = len(detections.q), _epipolar(detections.of_poses(half))
    if geometry is None:
        return np.zeros(K, dtype=np.bool_)
    off = detections.both & ~geometry.within(detections, OUTLIER)
    count, wrong = (np.bincount(detections.pose_of[of], minlength=K) for of in (detections.both, off))
    return np.asarray(wrong > _MISFIT * count)


def _require_alike(detections: Detections, order: IntArray) -> None:
    """Refuse an order (m,) of the markers in the right view, unless the left view has the same order."""
    moved = np.flatnonzero(order != np.arange(order.size))
    if not moved.size:
        return
    number = detections.marker
    pairs = [(int(number[i]), int(number[order[i]])) for i in moved]
    found = tuple(_exchanged(pairs))
    raise failed([Finding("other_numbers", REFUSES, amount=moved.size, unit="1", others=found)])


def _exchanged(pairs: list[tuple[int, int]]) -> list[Finding]:
    """Return numbers in the left view and in the right one, by tags if they are whole tags."""
    right, found, rest = dict(pairs), [], []
    for left, other in pairs:
        t, u = left // _CORNERS, other // _CORNERS
        here = [right.get(_CORNERS * t + k, -1) - _CORNERS * u for k in range(_CORNERS)]
        turn = here[0]
        if here != [(turn + k) % _CORNERS for k in range(_CORNERS)]:
            rest.append(Finding("exchanged_numbers", subject=Subject(markers=(left, other))))
        elif left % _CORNERS == 0:
            code = "begun_tag" if t == u else "exchanged_tag"
            found.append(Finding(code, subject=Subject(markers=(t, u)), amount=-turn % _CORNERS))
    return [*found, *rest]


def _by_tags(detections: Detections) -> IntArray:
    """Indices (m,) of markers in the right view, by the geometry of single tags, if most numbers are wrong.

    That of the centres of flat tags, where their diagonals cross, holds for any order of their corners; that
    of one tag for any order of the others.
    """
    index = {number: i for i, number in enumerate(detections.marker.tolist())}
    tags = [n for n in index if n % _CORNERS == 0 and all(n + k in index for k in range(_CORNERS))]
    corners = [[index[n + k] for k in range(_CORNERS)] for n in tags]
    which = np.array(corners, dtype=np.int64).reshape(-1, _CORNERS)
    c = homogeneous(_dense(detections, which.ravel())).reshape(2, len(detections.q), len(tags), _CORNERS, 3)
    center = np.cross(np.cross(c[..., 0, :], c[..., 2, :]), np.cross(c[..., 1, :], c[..., 3, :]))
    depth = np.where(center[..., 2:] == 0.0, np.nan, center[..., 2:])  # corners in one spot have no centre
    images = (center[..., :2] / depth).swapaxes(0, 1)
    flat = Observation(detections.pose, np.array(tags), detections.q, images)
    parts = [Detections.of(flat, "R" * detections.q.shape[1])]
    parts += [detections.of_markers(np.isin(np.arange(len(index)), of)) for of in which[:_MAX_TAGS]]
    order = np.arange(len(index))
    for part in parts:
        geometry = _epipolar(part)
        if geometry is not None and geometry.sigma_px < _MUCH_NOISE_PX:
            order = _true_order(detections, geometry, _OF_FEW)
        if (order != np.arange(order.size)).any():
            break
    return order


def _true_order(detections: Detections, epipolar: Epipolar, limit: float) -> IntArray:
    """Indices (m,) of markers in the right view, of the one assignment that fits the geometry of the rest."""
    m, both = detections.marker.size, detections.both
    misfit = both & ~epipolar.within(detections, limit)
    count = np.bincount(detections.marker_of[both], minlength=m)
    wrong = np.bincount(detections.marker_of[misfit], minlength=m) > _DOUBTED * count
    order = np.arange(m)
    doubted = np.isin(detections.marker // _CORNERS, detections.marker[wrong] // _CORNERS)
    doubted &= count >= _MIN_POSES  # also the other corners of their tags, which may fit along a line
    if not (wrong & doubted).any():
        return order
    which = np.flatnonzero(doubted)
    share = _misfits(_dense(detections, which), epipolar.F, limit * epipolar.noise_px)
    match = linear_sum_assignment(share)[1]
    graph = np.zeros(share.shape)
    graph[np.arange(which.size), match] = 1.0
    cycle = connected_components(graph, directed=False)[1]
    size = np.bincount(cycle)
    given = np.bincount(cycle, np.diag(share)) / size
    found = np.bincount(cycle, share[np.arange(which.size), match]) / size
    decided: BoolArray = ((given > _DOUBTED) & (found < _ALIKE))[cycle]
    order[which[decided]] = which[match[decided]]
    return order


def _dense(detections: Detections, which: IntArray) -> FloatArray:
    """Pixels (2, K, s, 2) of some markers in both views of the pair, NaN where unseen."""
    return detections.dense()[[*detections.pair]][:, :, which]


def _misfits(pixels: FloatArray, F: FloatArray, limit: float) -> FloatArray:
    """Shares (s, s) of the poses at which markers of the left view misfit markers of the right view."""
    left, right = homogeneous(pixels)
    found = np.ones((left.shape[1], right.shape[1]))
    for i in range(len(found)):
        r = np.abs(sampson(F, np.broadcast_to(left[:, i : i + 1], right.shape), right, np.ones((2, 1)))[0])
        count = np.isfinite(r).sum(axis=0)
        enough = count >= _MIN_POSES
        found[i, enough] = (r > limit).sum(axis=0)[enough] / count[enough]
    return found
