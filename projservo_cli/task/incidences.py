"""Tasks as lists of incidences: points, lines and planes of the tool that lie on features of the scene.

Everything is made of a point A and a plane b, a_inf·A = 1: e = bᵀA, with the row [bᵀĤ_1 A, ..., bᵀĤ_n A] of
the interaction. Points at infinity are directions, and make lines and planes parallel; with the metric form
that the joints preserve, perpendicular or inclined. The joint motion of J⁺e does not depend on scale, choice
of planes or projective frame where J has full row rank.

Errors e have no unit. They are weighted by the images of the body at the goal, so that their norm is the
minimum motion of its images that meets them; for a pose of six rows it is the image error itself.

Source: J. Hespanha, Z. Dodds, G. Hager, A. Morse, "What tasks can be performed with an uncalibrated stereo
vision system?", International Journal of Computer Vision 35, 1999, for the tasks that can be decided.
"""

import math
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import null_space, qr

from projservo_cli.geometry.algebra import Mat4, apply, apply_transposed, as_array, dot, mat, meet, unit, vec
from projservo_cli.geometry.displacements import to_all_sides, twist_exponential
from projservo_cli.geometry.jit import inline, merged, njit
from projservo_cli.geometry.kinematics import image_jacobian, project
from projservo_cli.geometry.least_squares import Equations, levenberg_marquardt
from projservo_cli.geometry.null_space import COORDINATES
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.metric.frame import invariant_upgrade
from projservo_cli.records import (
    KINDS,
    MEET,
    PARALLEL,
    PERPENDICULAR,
    BoolArray,
    FloatArray,
    InputError,
    Model,
    WorkFailed,
)
from projservo_cli.task.body_pose import Body

# Variance of a combination of errors, of unit variance each, below which it depends on the others.
_DEPENDENT = 1e-9
# Singular value of errors, px, by motions, below which these are free.
_FREE = 1e-6
# Newton steps to a displacement at which all incidences hold: how many, the largest turn of one, rad, and the
# last, over unit motions; singular value over the largest that counts as zero.
_STEPS, _STRIDE, _SETTLED, _SINGULAR = 50, 0.5, 1e-12, 1e-9
# Error, over the change by a unit motion of the body, at which a row is met: of round-off.
_MET = 1e-6
# Error, over the change by a unit of the measured motion, from which no motion lowers it, and the turn, rad,
# that leads away from there.
_FAR, _NUDGE = 1e6, 0.1


# Measure (p, 6) of motions (6, 4, 4) of points (m, 4).
_Moved = Callable[[FloatArray, FloatArray], FloatArray]
Flat = tuple[tuple[int, ...], ...]  # positions of markers in the body; a point is the middle of some


class Incidence(NamedTuple):
    """A feature of the tool and one of the scene that belong together when the task is done."""

    name: str  # as messages and figures write it
    tool: Flat  # one, two or three points that span it
    scene: Flat  # the feature of the tool that was there when the goal was taught, or of the object itself
    relation: str = MEET
    angle_deg: float = math.nan  # between both, for ``ANGLE``
    carrier: int = 0  # carrier of the feature of the scene, by places of the goal: the scene, then objects

    def visible_by(self, markers: Collection[int]) -> bool:
        """Whether the feature of the scene is where one of the tool was, which has these markers."""
        return all(number in markers for point in self.scene for number in point)


class Incidences(NamedTuple):
    """Rows of all incidences, in the frame of a model; a row is of a point and a plane.

    Few arrays, since every step of every law hands them on.
    """

    # (r, 11 + w + d) point of the tool at the reference, plane of the scene, and a sense of 1; or plane of
    # the tool, point of the scene, and a sense of −1; then the offset of e = bᵀA − offset, the number of the
    # incidence, the weight of e in each of w independent errors, and in each of d others, which change with
    # these alone near the goal
    rows: FloatArray
    # (g, 11) direction or plane of the tool at the reference, the direction of the scene, or across its
    # plane, to which the direction of the tool is to point, 1 for planes, the number of the incidence, and
    # the error of half a turn, px
    senses: FloatArray
    # (6 + V + d,) plane a of the face at the reference, number of markers of the body at the goal, once a
    # view, w, a·O of each view there, in the frame of the body, and the residual of each other error, px
    sight: FloatArray

    @property
    def weight(self) -> FloatArray:
        """Weights (w, r) of the rows in independent errors."""
        return self.rows[:, _WEIGHT : _WEIGHT + rank_of(self)].T

    def of(self, numbers: Sequence[int]) -> "Incidences":
        """Select the rows and senses of some incidences, each row by itself."""
        rows = self.rows[np.isin(self.rows[:, _GROUP], numbers)]
        senses = self.senses[np.isin(self.senses[:, _OF], numbers)]
        return _unweighted(self._replace(rows=rows, senses=senses))

    def weighing(self, weight: FloatArray) -> "Incidences":
        """Return the rows with other weights (w, r), and without other errors."""
        sight = self.sight.copy()
        sight[_RANK] = len(weight)
        return self._replace(rows=np.column_stack([self.rows[:, :_WEIGHT], weight.T]), sight=sight)


# Columns of the rows: of the tool, then of the scene, and these.
_SCENE, _SENSE, _OFFSET, _GROUP, _WEIGHT = 4, 8, 9, 10, 11
# Columns of the senses after the senses of the tool and the scene, and entries of the sight after the plane.
_IS_PLANE, _OF, _TURN_PX = 8, 9, 10
_VIEWS_USED, _RANK, SHOWN = 4, 5, 6
NO_INCIDENCES = Incidences(rows=np.zeros((0, _WEIGHT)), senses=np.zeros((0, 11)), sight=np.zeros(SHOWN))


@inline
def rank_of(incidences: Incidences) -> int:
    """Return the number of independent errors."""
    return int(incidences.sight[_RANK])


@merged
def _error_of(row: FloatArray, H: Mat4, H_back: Mat4) -> float:
    """Error e = bᵀA − offset of a row at the displacement H of the body, whose inverse is H_back."""
    if row[_SENSE] > 0.0:
        A, b = apply(H, vec(row)), vec(row[_SCENE:])
    else:
        A, b = apply(H_back, vec(row[_SCENE:])), vec(row)
    return dot(b, A) - float(row[_OFFSET])


@merged
def _rate_of(row: FloatArray, H: Mat4, H_back: Mat4, H_hat: Mat4) -> float:
    """Derivative of the error of a row by the amplitude of an operator Ĥ of the body at H: ±bᵀĤA."""
    if row[_SENSE] > 0.0:
        return dot(vec(row[_SCENE:]), apply(H_hat, apply(H, vec(row))))
    return -dot(vec(row), apply(H_back, apply(H_hat, vec(row[_SCENE:]))))


@merged
def points_away(sense: FloatArray, H: Mat4, H_back: Mat4) -> bool:
    """Whether a direction or plane of the tool points the other way than it should at H."""
    moved = apply_transposed(H_back, vec(sense)) if sense[_IS_PLANE] > 0.0 else apply(H, vec(sense))
    return dot(moved, vec(sense[_SCENE:])) < 0.0


@merged
def turn_rate(sense: FloatArray, H: Mat4, H_back: Mat4, H_hat: Mat4) -> float:
    """Derivative, by the amplitude of an operator Ĥ of the body at H, of its signed value."""
    to = vec(sense[_SCENE:])
    if sense[_IS_PLANE] > 0.0:
        return -dot(apply_transposed(H_hat, apply_transposed(H_back, vec(sense))), to)
    return dot(apply(H_hat, apply(H, vec(sense))), to)


@njit
def image_error(incidences: Incidences, H: Mat4, H_back: Mat4) -> float:
    """Least motion of the images of the body that meets all incidences, px rms per marker and view.

    To first order; of a feature that points the other way, as much more as half a turn moves them. Far away,
    independent errors may vanish where others that depend on them at the goal do not: these count as well.
    """
    rows, sight, total = incidences.rows, incidences.sight, 0.0
    rank, count = rank_of(incidences), rows.shape[1] - _WEIGHT
    for k in range(count):
        error = 0.0 if k < rank else -sight[sight.shape[0] - count + k]
        for i in range(rows.shape[0]):
            error += rows[i, _WEIGHT + k] * _error_of(rows[i], H, H_back)
        total += error * error
    for sense in incidences.senses:
        if points_away(sense, H, H_back):
            total += sense[_TURN_PX] * sense[_TURN_PX]
    return math.sqrt(total / sight[_VIEWS_USED])


@njit
def linearize_into(
    incidences: Incidences, H: Mat4, H_back: Mat4, H_hat: FloatArray, e: FloatArray, J: FloatArray
) -> None:
    """Write the weighted errors (w,) at the displacement H of the body, and their derivatives (w, k).

    H_back : inverse of H; H_hat : (k, 4, 4) operators of the body at H, by whose amplitudes.
    """
    e[:] = 0.0
    J[:] = 0.0
    for row in incidences.rows:
        error = _error_of(row, H, H_back)
        for k in range(e.shape[0]):
            e[k] += row[_WEIGHT + k] * error
        for j in range(H_hat.shape[0]):
            rate = _rate_of(row, H, H_back, mat(H_hat[j]))
            for k in range(e.shape[0]):
                J[k, j] += row[_WEIGHT + k] * rate


def linearized(incidences: Incidences, H: FloatArray, H_hat: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weighted errors (w,) at H (4, 4), and their derivatives (w, k) by operators (k, 4, 4) of the body."""
    rank = rank_of(incidences)
    e, J = np.zeros(rank), np.zeros((rank, len(H_hat)))
    back = np.asarray(np.linalg.inv(H), dtype=np.float64)
    linearize_into(incidences, mat(H), mat(back), np.ascontiguousarray(H_hat), e, J)
    return e, J


def free_motions(incidences: Incidences, H: FloatArray, H_hat: FloatArray) -> FloatArray:
    """Unit motions (f, n) by operators (n, 4, 4) at H (4, 4) that keep all incidences to first order."""
    _, sizes, motions = np.linalg.svd(linearized(incidences, H, H_hat)[1])
    return np.asarray(motions[(sizes > _FREE).sum() :])


def points_of(M: FloatArray, flat: Flat) -> FloatArray:
    """Points (..., k, 4), a_inf·A = 1, that span a feature of markers (..., m, 4) of the body."""
    return np.stack([M[..., list(numbers), :].mean(axis=-2) for numbers in flat], axis=-2)


def images_of(model: Model, features: Sequence[FloatArray], H: FloatArray) -> FloatArray:
    """Images (k, g, 3, V, 2) of the points (…, 4) that span features, at displacements (k, 4, 4).

    NaN beyond the points of a feature, and where a displacement is.
    """
    points = np.full((len(features), len(KINDS), 4), math.nan)
    for spanned, own in zip(points, features, strict=True):
        spanned[: len(own)] = own
    pixels = project(model.P, np.einsum("kab,gsb->kgsa", H, points), model.lens)
    return np.ascontiguousarray(np.moveaxis(pixels, 0, -2))


def whole_pose(A: FloatArray) -> tuple[Incidence, ...]:
    """Return the incidences of a pose: three points of the face (m, 4), far apart, each where it was."""
    far = qr(A.T, mode="r", pivoting=True)[1][:3]
    return tuple(Incidence("pose", ((int(k),),), ((int(k),),)) for k in far)


class JointMetric:
    """Directions and normals in the metric that the joints preserve; S takes points to metric ones.

    name : feature that needs it, for messages.
    """

    def __init__(self, model: Model, name: str) -> None:
        try:
            S = invariant_upgrade(model.H_hat_0, model.prismatic)
        except InputError as error:
            why = str(error).removeprefix("metric: ")
            raise InputError(f"{name} needs the metric form that the joints preserve, and {why}") from error
        self._S, self._back = S, np.linalg.inv(S)

    def unit(self, D: FloatArray) -> FloatArray:
        """Direction (4,) of unit length."""
        return np.asarray(D / np.linalg.norm(self._S[:3] @ D))

    def normal(self, plane: FloatArray) -> FloatArray:
        """Unit direction (4,) of the normal of a plane (4,)."""
        return self.unit(self._back @ np.append((plane @ self._back)[:3], 0.0))

    def along(self, D: FloatArray) -> FloatArray:
        """Plane (4,) whose product with a direction is the product of both directions."""
        return np.asarray(self._S[:3].T @ (self._S[:3] @ D))


def plane_through(points: FloatArray) -> FloatArray:
    """Plane (4,) through three points (3, 4), of unit norm."""
    A, B, C = (vec(row) for row in points)
    return np.array(unit(meet(A, B, C)))


def _directions(points: FloatArray) -> FloatArray:
    """Directions (k − 1, 4) that span the directions of a line or plane through points (k, 4)."""
    return np.asarray(points[1:] - points[0])


_Row = tuple[FloatArray, FloatArray, float, float]  # feature of the tool, of the scene, sense, offset


def _incident(tool: FloatArray, scene: FloatArray, dual_of: FloatArray, own_dual: FloatArray) -> list[_Row]:
    """Rows that put the points (k, 4) of the smaller feature on the planes that hold the other.

    dual_of, own_dual : points that span the feature of the scene and the feature of the tool.
    """
    if len(tool) <= len(scene):
        return [(A, b, 1.0, 0.0) for A in tool for b in null_space(dual_of).T]
    return [(b, A, -1.0, 0.0) for A in scene for b in null_space(own_dual).T]


def _rows(one: Incidence, model: Model, tool: FloatArray, scene: FloatArray) -> list[_Row]:
    """Rows of an incidence between features that points (k, 4) at the reference and (l, 4) span."""
    if one.relation == MEET:
        return _incident(tool, scene, scene, tool)
    if one.relation == PARALLEL:
        return _incident(_directions(tool), _directions(scene), scene, tool)
    metric, t, s = JointMetric(model, f"incidence {one.name}"), _directions(tool), _directions(scene)
    if one.relation == PERPENDICULAR:
        if len(t) == len(s) == 2:  # the normal of one plane is a direction of the other
            return [(metric.normal(plane_through(tool)), plane_through(scene), 1.0, 0.0)]
        return [(D, metric.along(direction), 1.0, 0.0) for D in t for direction in s]
    axes = [
        metric.unit(D[0]) if len(D) == 1 else metric.normal(plane_through(points))
        for D, points in ((t, tool), (s, scene))
    ]
    angle = math.radians(one.angle_deg)
    product = math.cos(angle) if len(t) == len(s) else math.sin(angle)
    return [(axes[0], metric.along(axes[1]), 1.0, product)]


def _across(model: Model, body: Body, plane: FloatArray) -> FloatArray:
    """Direction (4,) to the positive side of a plane (4,), its normal if the joints preserve a metric."""
    try:
        return JointMetric(model, "a sense").normal(plane)
    except InputError:
        return np.asarray(body.D.T @ (body.D @ plane))


def _has_sense(one: Incidence, tool: FloatArray, scene: FloatArray) -> bool:
    """Whether both point the same way: lines or planes that meet or are parallel."""
    return one.relation in (MEET, PARALLEL) and len(tool) == len(scene) > 1


def incidences_of(
    model: Model, body: Body, scenes: Sequence[FloatArray], asked: Sequence[Incidence]
) -> Incidences:
    """Rows of incidences, in the frame of a model, not weighted yet.

    scenes : for each incidence the points (…, 4) that span its feature of the scene.
    Raises InputError for angles whose metric the joints leave open, WorkFailed for points that span no line
    or plane, or that no camera has shown.
    """
    rows, senses = list[FloatArray](), [NO_INCIDENCES.senses]
    for k, (one, scene) in enumerate(zip(asked, scenes, strict=True)):
        tool = points_of(body.M, one.tool)
        if not np.isfinite(scene).all():
            raise WorkFailed(
                f"incidence {one.name}: fewer than two cameras see all markers of its feature of the scene: "
                "name others, or let two see these"
            )
        for points in (tool, scene):
            if np.linalg.matrix_rank(points / np.linalg.norm(points, axis=1)[:, None], 1e-6) < len(points):
                raise WorkFailed(
                    f"incidence {one.name}: its points span no {KINDS[len(points) - 1]}: name others"
                )
        found = _rows(one, model, tool, scene)
        rows += [np.array([*A, *b, sense, offset, k]) for A, b, sense, offset in found]
        if _has_sense(one, tool, scene):
            plane = len(tool) == len(KINDS)
            axes = [plane_through(points) if plane else _directions(points)[0] for points in (tool, scene)]
            to = _across(model, body, axes[1]) if plane else axes[1]
            senses.append(np.array([[*axes[0], *to, plane, k, 0.0]]))
    return NO_INCIDENCES._replace(rows=np.array(rows), senses=np.concatenate(senses))


def _unweighted(incidences: Incidences) -> Incidences:
    """Return the rows with errors in their own scale."""
    return incidences.weighing(np.eye(len(incidences.rows)))


def _motions(body: Body, H: FloatArray) -> FloatArray:
    """Operators (6, 4, 4) at H (4, 4) of three translations and three rotations about the body's middle."""
    shifts = body.D[:, :, None] * body.a_inf
    return np.asarray(H @ np.concatenate([shifts, body.H_hat]) @ np.linalg.inv(H))


def image_velocities(model: Model, shows: BoolArray) -> _Moved:
    """Return the images (p, 6) of shown markers (V, m) by motions of a body, px, to measure these by."""

    def moved(M: FloatArray, motions: FloatArray) -> FloatArray:
        return image_jacobian(model.P, M, motions)[shows].reshape(-1, COORDINATES)

    return moved


def weighted(
    incidences: Incidences, model: Model, body: Body, H: FloatArray, shows: BoolArray, a: FloatArray
) -> Incidences:
    """Give errors the unit of a pixel, their deviation at one pixel of noise, and weigh the independent ones.

    H : (4, 4) displacement of the body at the goal; shows : (V, m) markers that images show there.
    a : (4,) plane of the face at the reference.
    Raises WorkFailed if the images do not determine the body, or no incidence changes with its motion.
    """
    motions = _motions(body, H)
    J = image_velocities(model, shows)(body.M @ H.T, motions)
    _, B = linearized(_unweighted(incidences), H, motions)
    if np.linalg.matrix_rank(J) < COORDINATES:
        raise WorkFailed("the images at the goal do not determine the pose of the body: show more markers")
    half = B @ np.linalg.pinv(J)
    sigma = np.linalg.norm(half, axis=1)
    if not (sigma > 0.0).all():
        raise WorkFailed("an incidence does not change with the motion of the tool: leave it out")
    rows, senses, O = incidences.rows.copy(), incidences.senses.copy(), optical_centers(model.P, model.a_inf)
    rows[:, _SCENE:_SENSE] /= sigma[:, None]
    rows[:, _OFFSET] /= sigma
    senses[:, _TURN_PX] = [_turn_px(sense, H, motions[3:], J[:, 3:]) for sense in senses]
    view_signs = O @ np.linalg.inv(H).T @ a
    sight = np.array([*a, shows.sum(), 0.0, *view_signs], dtype=np.float64)
    weight, rest = _independent(half / sigma[:, None])
    found = Incidences(rows, senses, sight).weighing(weight)
    left = rest @ linearized(_unweighted(found), H, motions)[0]
    return found._replace(
        rows=np.ascontiguousarray(np.column_stack([found.rows, rest.T])),
        sight=np.concatenate([found.sight, left]),
    )


def _independent(half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights (w, r) that turn errors of rows into independent unit ones, and the rest (r − w, r).

    half : (r, p) errors by independent ones, each of unit variance.
    """
    U, s, _ = np.linalg.svd(half)
    kept = int(np.sum(s**2 > _DEPENDENT * s[0] ** 2))
    return np.asarray((U[:, :kept] / s[:kept]).T), np.asarray(U[:, kept:].T)


def _turn_px(sense: FloatArray, H: FloatArray, turns: FloatArray, J: FloatArray) -> float:
    """Motion of all images, px, by half a turn of a direction or plane (11,): as far as to first order.

    turns : operators (3, 4, 4) of rotations per rad; J : (2 k, 3) images by them.
    """
    if sense[_IS_PLANE]:
        rates = -np.einsum("a,rab->rb", sense[:_SCENE] @ np.linalg.inv(H), turns)
    else:
        rates = turns @ (H @ sense[:_SCENE])
    across = np.linalg.svd(rates.T)[2][:2]  # the turns that move it most
    return math.pi * float(np.sqrt(np.mean(np.sum((J @ across.T) ** 2, axis=0))))


def nearest_goal(incidences: Incidences, body: Body, H: FloatArray, moved: _Moved) -> FloatArray:
    """Displacement (4, 4) near H at which all incidences hold in their senses, by Gauss and Newton.

    moved : measures motions of the body; each step is the shortest that meets the incidences.
    If that ends with a feature turned over, or off, the nearest of the places is taken that steps from H,
    turned to all sides, lead to. Incidences that contradict each other leave an error, as of ``image_error``.
    """
    found = _stepped_to(incidences, body, H, moved)
    if _is_met(incidences, body, found):
        return found
    starts = turned_about(body, H)[1:]
    others = [_stepped_to(incidences, body, start, moved) for start in starts]
    met = [one for one in others if _is_met(incidences, body, one)]
    if not met:
        return found
    # smallest turn
    return max(met, key=lambda one: float(np.trace(body.D @ np.linalg.inv(H) @ one @ body.D.T)))


def _is_met(incidences: Incidences, body: Body, H: FloatArray) -> bool:
    """Whether no feature points the other way, and the rows are met to round-off."""
    e, B = linearized(_unweighted(incidences), H, _motions(body, H))
    met = np.abs(e) <= _MET * np.linalg.norm(B, axis=1)
    return bool(met.all()) and not _away_at(incidences, H).any()


def _stepped_to(incidences: Incidences, body: Body, H: FloatArray, moved: _Moved) -> FloatArray:
    """Displacement (4, 4) that the shortest steps from H reach and that meets all incidences."""
    rows = incidences if rank_of(incidences) else _unweighted(incidences)
    for _ in range(_STEPS):
        motions = _motions(body, H)
        J = moved(body.M @ H.T, motions)
        back = np.linalg.pinv(J)
        e, B = linearized(rows, H, motions)
        if np.linalg.norm(e) > _FAR * np.linalg.norm(B @ back):  # as of a line to be turned across itself
            H = as_array(twist_exponential(mat(_NUDGE * motions[3:].sum(axis=0)))) @ H
            continue
        step = -back @ np.linalg.lstsq(B @ back, e, rcond=_SINGULAR)[0]
        turn = float(np.linalg.norm(step[3:]))
        step *= min(1.0, _STRIDE / turn) if turn > 0.0 else 1.0
        H = as_array(twist_exponential(mat(np.tensordot(step, motions, 1)))) @ H
        if np.linalg.norm(J @ step) <= _SETTLED * np.linalg.norm(J):
            break
    return H


def each_in_pixels(
    incidences: Incidences, model: Model, body: Body, H: FloatArray, shows: BoolArray
) -> Incidences:
    """Rows in px as of where each incidence is met by itself; arguments as of ``weighted``."""
    moved, found = image_velocities(model, shows), []
    for k in np.unique(incidences.rows[:, _GROUP]).tolist():
        one = incidences.of([k])
        found.append(weighted(one, model, body, nearest_goal(one, body, H, moved), shows, np.zeros(4)))
    rows = np.concatenate([one.rows[:, :_WEIGHT] for one in found])
    return NO_INCIDENCES._replace(rows=rows, senses=np.concatenate([one.senses for one in found]))


def min_errors(incidences: Incidences, body: Body, H: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacements (s, 4, 4) near given ones of minimum error of all rows, and its squares (s,), px².

    incidences : each row by itself; one that depends on others counts. H : (s, 4, 4). The square of a feature
    that points the other way is half a turn.
    """

    def equations(H: FloatArray) -> Equations:
        parts = [linearized(incidences, at, _motions(body, at)) for at in H]
        e, J = (np.array(part) for part in zip(*parts, strict=True))
        return Equations.of(e, J)

    def moved(step: FloatArray, H: FloatArray) -> tuple[FloatArray]:
        turn = np.linalg.norm(step[:, 3:], axis=1, keepdims=True)
        step = step * _STRIDE / np.maximum(turn, _STRIDE)
        twists = [np.tensordot(one, _motions(body, at), 1) for one, at in zip(step, H, strict=True)]
        return (np.array([as_array(twist_exponential(mat(twist))) for twist in twists]) @ H,)

    (H,), there = levenberg_marquardt((H,), equations, moved, _STEPS)
    turned = [_turned_px(incidences, at) for at in H]
    return H, there.cost + np.square(turned).sum(axis=1)


def _turned_px(incidences: Incidences, H: FloatArray) -> FloatArray:
    """Errors (g,) of senses at H (4, 4): half a turn if a feature points the other way, or zero, px."""
    return np.where(_away_at(incidences, H), incidences.senses[:, _TURN_PX], 0.0)


def _away_at(incidences: Incidences, H: FloatArray) -> BoolArray:
    """Whether features (g,) point the other way at H (4, 4)."""
    here, back = mat(H), mat(np.asarray(np.linalg.inv(H), dtype=np.float64))
    return np.array([points_away(sense, here, back) for sense in incidences.senses], dtype=np.bool_)


def turned_about(body: Body, H: FloatArray) -> FloatArray:
    """Displacements (25, 4, 4): H (4, 4), and with it turned about the body's middle to all sides."""
    return np.concatenate([H[None], to_all_sides(_motions(body, H)[3:]) @ H])


def image_error_at(incidences: Incidences, H: FloatArray) -> float:
    """Error of ``image_error`` at the displacement H (4, 4), px."""
    return float(image_error(incidences, mat(H), mat(np.asarray(np.linalg.inv(H), dtype=np.float64))))


def errors_px(incidences: Incidences, H: FloatArray) -> FloatArray:
    """Error (k, g) of each incidence at displacements H (k, 4, 4) over its deviation at one pixel of noise.

    The root of the mean square over its independent rows, and half a turn if it points the other way, px;
    NaN where a displacement is.
    """
    half, group, own = np.linalg.pinv(incidences.weight), incidences.rows[:, _GROUP], list[Incidences]()
    for k in np.unique(group):
        independent, _ = _independent(half[group == k])
        weight = np.zeros((len(independent), len(group)))
        weight[:, group == k] = independent / math.sqrt(len(independent))
        own.append(incidences.weighing(weight)._replace(senses=incidences.of([int(k)]).senses))
    none = np.zeros((0, 4, 4))

    def error(one: Incidences, at: FloatArray) -> float:
        if not np.isfinite(at).all():
            return math.nan
        return float(np.linalg.norm([*linearized(one, at, none)[0], *_turned_px(one, at)]))

    return np.array([[error(one, at) for one in own] for at in H])
