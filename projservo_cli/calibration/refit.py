"""Fit one camera of a calibration again, after it moved, by images at joint readings.

Operators, markers and all other cameras stay. The camera minimizes residuals weighted by the noise of pixels
and joints, x̂ = G r. Weights by the covariance of operators and markers as well would give the camera itself
smaller errors, but larger ones to predictions, which use these operators and markers. To first order images
are r = J x − T e + n, with errors e of the rest of the calibration and noise n: the camera errs by −G T e +
G n, so that the covariance of old and new numbers stays consistent with one calibration.

Joint readings are judged by generalised least squares of all views, of covariance I + T Tᵀ: G. A. F. Seber,
A. J. Lee, "Linear Regression Analysis", 2nd ed., 2003, section 3.10.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.checks.screening import without_placeholders
from projservo_cli.calibration.checks.validation import of_views
from projservo_cli.calibration.detections import (
    MAX_JUDGED,
    RAYLEIGH,
    Detections,
    cauchy_weights,
    even_choice,
    in_chain_order,
    per_block,
    per_rad,
)
from projservo_cli.calibration.initial.camera_resection import resected
from projservo_cli.calibration.initial.epipolar import OUTLIER
from projservo_cli.calibration.prediction import (
    CAMERA,
    Parameters,
    errors_of,
    parameters_from,
    pixel_changes,
    predict,
    prediction_variance,
    reading_deviations,
)
from projservo_cli.calibration.robust_fit import MAX_PREDICTED, REFUSE_RATIO, inverse_root
from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, Subject
from projservo_cli.geometry.lens import TERMS, undistort
from projservo_cli.image_size import ImageSize, image_sizes
from projservo_cli.messages import failed, with_findings
from projservo_cli.records import (
    TOOL,
    BoolArray,
    Calibration,
    Errors,
    FloatArray,
    InputError,
    IntArray,
    Observation,
    Refits,
    WorkFailed,
    apart,
    changed,
)

# Minimum number of detections: a camera has 11 numbers, and as many are left to judge them.
_LEAST = 12
# Rounds of reweighted least squares, then rounds of the inliers alone.
_ROUNDS, _SETTLING = 10, 5
# Maximum share of the detections of a view that are outliers.
_MAX_OUTLIERS = 0.4
# Width of the Cauchy loss in robust standard deviations: 95 % efficient on normal residuals.
_WIDTH = 2.385
# Probability that noise alone exceeds the χ² from which the noise of a camera is taken as larger.
_CHANCE = 1e-3
# Error of a camera over that before it moved from which more poses are advised.
_MORE = 1.5
# Standard deviations from which the offset of a joint is one, or passes unnoticed below.
_SURE = 4.0
# Effect of an offset of a joint on images, over their noise, from which it matters: below it hides in noise.
_MATTERS = 1.0
# Largest offset of a joint, rad (prismatic × 0.3 m/rad), that may pass into the camera unnoticed.
_UNNOTICED_RAD = np.radians(1.0)
# Share of the square of a joint's effect below which the camera can move images alike.
_ALIKE = 1e-6
# Median distance of images from their prediction, over that expected, from which a view disagrees.
_DISAGREES = 3.0
# Maximum number of markers with a column each for the errors that the camera shares with them.
_MOST_APART = 100
# Poses whose changes of images are computed together, to bound the memory.
_AT_ONCE = 20
# Number of poses within the joint ranges at which the error of the camera is stated.
_POSES = 60


class ViewError(NamedTuple):
    """Distance of the images of a view from their prediction, and the expected one, medians, px."""

    view: str
    off_px: float  # NaN without a detection
    expected_px: float  # error by noise and covariance

    @property
    def disagrees(self) -> bool:
        """Whether noise and covariance do not explain the distance."""
        return self.off_px > _DISAGREES * self.expected_px

    @property
    def finding(self) -> Finding:
        """Distance and limit."""
        limit, severity = _DISAGREES * self.expected_px, LIMITS if self.disagrees else NOTE
        return Finding("view_off", severity, Subject(views=(self.view,)), self.off_px, limit=limit, unit="px")


def view_errors(calibration: Calibration, observation: Observation) -> tuple[ViewError, ...]:
    """Compare the images of each view at joint readings with their prediction.

    Raises InputError if the calibration has no covariance, or readings have another number of joints.
    """
    images = _Images.of(calibration, observation)
    return images.errors_of_views(parameters_from(images.calibration), errors_of(images.calibration))


@dataclass(frozen=True, eq=False)
class _Images:
    """Images at new poses, in the order of a calibration; residuals and derivatives in units of noise."""

    calibration: Calibration  # calibration of the markers seen
    problem: LeastSquares
    which: IntArray  # (m,) indices of these markers

    @classmethod
    def of(cls, c: Calibration, observation: Observation) -> "_Images":
        seen, numbers = observation.at_rest, c.marker.tolist()
        if seen.q.shape[1] != len(c.H_hat_0):
            raise InputError(f"readings of {seen.q.shape[1]} joints, and the arm has {len(c.H_hat_0)}")
        seen = of_views(seen, tuple(name for name in c.view if name in seen.view))
        known, columns = np.isin(seen.marker, c.marker), [c.view.index(name) for name in seen.view]
        shape = (len(seen.q), len(c.view), np.count_nonzero(known))
        pixels, sigma = np.full((*shape, 2), np.nan), None
        pixels[:, columns] = without_placeholders(seen.images, seen.marker)[0][:, :, known]
        if seen.sigma is not None:
            sigma = np.ones(shape)
            sigma[:, columns] = seen.sigma[:, :, known]
        some = Observation(
            seen.pose,
            seen.marker[known],
            seen.q,
            pixels,
            sigma=sigma,
            view=c.view,
            flange_chart=c.flange_chart,
        )
        found = Detections.of(some, c.joint_types, c.mount)
        noise = np.full(len(c.view), max(c.sigma_px, c.sigma_fitted_px))
        noise = noise if c.sigma_view_px is None else c.sigma_view_px
        found = dataclasses.replace(found, weight=found.weight / noise[:, None])
        which = np.array([numbers.index(number) for number in found.marker.tolist()], dtype=np.int64)
        problem = LeastSquares.of(found, in_chain_order(c.mount, c.q_reference))
        deviations = reading_deviations(c)
        tau = (deviations[::-1] if c.mount == TOOL else deviations) if c.sigma_q else None
        return cls(c.with_markers(which), problem.with_noise(tau), which)

    def by_camera(self, params: Parameters, v: int) -> FloatArray:
        """Derivative (V, N, 2, 12 + terms) of the images by a camera and its lens; zero in other views."""
        found = self.problem.detections
        images = params.images(self.problem.q, found.pose_of, found.marker_of)
        terms = params.lens_terms
        J = np.zeros((*found.pixels.shape, CAMERA + terms))
        J[v, ..., :CAMERA] = images.by_camera[v]
        if images.by_lens is not None:
            J[v, ..., CAMERA:] = images.by_lens[v][..., :terms]
        return J * self._weight

    def changes(self, params: Parameters, errors: Errors) -> tuple[FloatArray, FloatArray]:
        """Changes (V, N, 2, r) of the images by common errors, and (V, N, 2, 3) by a marker's own."""
        found, q = self.problem.detections, self.problem.q
        common, own = (
            np.zeros((*found.pixels.shape, part.shape[-1])) for part in (errors.marker, errors.own)
        )
        for first in range(0, len(q), _AT_ONCE):
            rows = np.flatnonzero(found.pose_of // _AT_ONCE == first // _AT_ONCE)
            at = found.pose_of[rows] - first, slice(None), found.marker_of[rows]
            parts = pixel_changes(params, errors, q[first : first + _AT_ONCE])
            for result, part in zip((common, own), parts, strict=True):
                result[:, rows] = part[at].swapaxes(0, 1)
        return common * self._weight, own * self._weight

    def deviation(self, params: Parameters, errors: Errors) -> FloatArray:
        """Expected deviation (V, N) of a coordinate from its prediction, rms of both, in units of noise."""
        common, own = self.changes(params, errors)
        variance = 2.0 + (common**2).sum(axis=(2, 3)) + (own**2).sum(axis=(2, 3))
        if self.problem.tau is not None:
            variance += ((self.problem.joint_derivative(params) * self.problem.tau) ** 2).sum(axis=(2, 3))
        return np.asarray(np.sqrt(0.5 * variance))

    def near(self, params: Parameters, errors: Errors) -> BoolArray:
        """Mask (V, N) of detections that noise and covariance explain."""
        distance = np.linalg.norm(self.problem.residual(params), axis=2)
        return np.asarray(
            self.problem.detections.seen & (distance <= OUTLIER * self.deviation(params, errors))
        )

    def errors_of_views(self, params: Parameters, errors: Errors) -> tuple[ViewError, ...]:
        """Distances of all views from their prediction, and the expected ones."""
        found, result = self.problem.detections, []
        distance = np.linalg.norm(self.problem.residual(params), axis=2) / found.weight
        expected = RAYLEIGH * self.deviation(params, errors) / found.weight
        for v, (name, seen) in enumerate(zip(found.view, found.seen, strict=True)):
            off = (float(np.median(px[v, seen])) if seen.any() else np.nan for px in (distance, expected))
            result.append(ViewError(name, *off))
        return tuple(result)

    @property
    def _weight(self) -> FloatArray:
        return self.problem.detections.weight[..., None, None]


@dataclass(frozen=True, eq=False)
class _Camera:
    """A camera as fitted: its numbers x are P, up to scale, and the terms of its lens, c together."""

    images: _Images
    v: int  # its view
    params: Parameters
    used: BoolArray  # (V, N) inliers, of this view alone
    root: FloatArray  # (c, c − 1) root of the covariance of x by noise of pixels and joints
    G: FloatArray  # (c, V, N, 2) derivative of x by the images, in units of noise


def refit(
    calibration: Calibration,
    observation: Observation,
    view: str,
    image_size: ImageSize | None = None,
    max_predicted_px: float | None = None,
) -> Calibration:
    """Fit a camera, and its lens if the calibration has one, again by images at joint readings.

    Parameters
    ----------
    calibration : with its covariance, of any views and either mount.
    observation : images of its markers by the camera that moved, and perhaps by others that did not.
    view : name of the camera that moved.
    image_size : width and height, px; None takes the extent of the images.
    max_predicted_px : error of predictions above which the calibration is not usable, as of ``calibrate``.

    Returns
    -------
    The calibration with the new camera, and the covariance of all its numbers together.

    Raises
    ------
    InputError
        If the calibration has no such view or no covariance, or the observation has not that view.
    WorkFailed
        If the camera has not moved, or the images do not determine it, or do not confirm the joint readings:
        the number, its limit, and the data that would.
    """
    for names, of in ((calibration.view, "calibration"), (observation.view, "images")):
        if view not in names:
            raise InputError(
                f"no camera {view!r}: the {of} have {', '.join(names)}".replace("on have", "on has")
            )
    images = _Images.of(calibration, observation)
    _require_moved(images, view)
    camera = _fitted(images, calibration.view.index(view))
    ratio = _require_confirmed(camera)
    size = image_sizes(image_size, calibration.view)
    limit = max_predicted_px or MAX_PREDICTED * float(size.max())
    return _record(calibration, observation, camera, ratio, limit)


def _require_moved(images: _Images, view: str) -> None:
    """Refuse to fit a camera again whose images agree with the calibration, or show a joint; a WorkFailed."""
    c = images.calibration
    params, errors = parameters_from(c), errors_of(c)
    views = images.errors_of_views(params, errors)
    of_view = views[c.view.index(view)]
    if not np.isfinite(of_view.off_px) or of_view.disagrees:
        return
    nothing = np.zeros((*images.problem.detections.pixels.shape, 0))
    _JointOffsets.of(images, params, errors, images.near(params, errors), nothing).require_none(images, view)
    reasons = tuple(one.finding for one in views if np.isfinite(one.off_px))
    raise failed([Finding("unmoved_camera", REFUSES, Subject(views=(view,)), others=reasons)])


def since_moved(old: Observation, new: Observation, view: str) -> Observation:
    """Images at rest of old and new poses; a camera that moved between them keeps the new ones."""
    old, new, v = old.at_rest, new.at_rest, old.view.index(view)
    images = np.full((len(old.q) + len(new.q), *old.images.shape[1:]), np.nan)
    images[: len(old.q)], images[: len(old.q), v] = old.images, np.nan
    there, here = np.nonzero(old.marker[:, None] == new.marker)
    for k, name in enumerate(new.view):
        if name in old.view:
            images[len(old.q) :, old.view.index(name), there] = new.images[:, k, here]
    number = np.concatenate([old.pose, old.pose.max() + 1 + np.arange(len(new.q))])
    return Observation(number, old.marker, np.concatenate([old.q, new.q]), images, view=old.view)


def _fitted(images: _Images, v: int) -> _Camera:
    """Resect a camera, then minimize squared residuals, with a Cauchy loss at first.

    Raises WorkFailed if the images do not determine it.
    """
    problem, found, c = images.problem, images.problem.detections, images.calibration
    seen = found.seen & (np.arange(len(found.seen)) == v)[:, None]
    poses = np.unique(found.pose_of[seen[v]]).size
    of, at = Subject(views=(found.view[v],)), (Finding("poses", amount=float(poses), unit="1"),)
    open_ = Finding("open_camera", REFUSES, of, float(seen.sum()), limit=_LEAST, unit="1", others=at)
    if seen.sum() < _LEAST:
        raise failed([open_])
    params = parameters_from(c)
    # Change to a frame whose plane at infinity is the last coordinate, where points have finite ones.
    frame = np.vstack([np.linalg.svd(c.a_inf[None])[2][1:], c.a_inf])
    points = params.moved(problem.q, found.pose_of, found.marker_of)[seen[v]] @ frame.T
    straight = found.pixels if params.lens is None else undistort(params.lens, found.pixels)
    P = params.P.copy()
    P[v] = resected(points, straight[v, seen[v]]) @ frame
    params = dataclasses.replace(params, P=P)
    deviation = images.deviation(params, errors_of_others(c, v))
    used, rows = seen, (images.problem.detections.pixels.size, -1)
    for k in range(_ROUNDS + _SETTLING + 1):
        residual = problem.residual(params)
        distance = np.linalg.norm(residual, axis=2) / deviation
        middle = max(float(np.median(distance[seen])) / RAYLEIGH, 1e-9)
        if k < _ROUNDS:
            weight = seen * np.sqrt(cauchy_weights((distance / (_WIDTH * middle)) ** 2))
        elif k == _ROUNDS:
            used = seen & (distance <= OUTLIER * max(middle, 1.0))
            weight = used.astype(np.float64)
            if used.sum() < max(_LEAST, (1.0 - _MAX_OUTLIERS) * seen.sum()):
                count, total = float((seen & ~used).sum()), float(seen.sum())
                allowed = (Finding("outliers", amount=_MAX_OUTLIERS * total, unit="1"),)
                raise failed(
                    [Finding("refit_outliers", REFUSES, of, count, limit=total, unit="1", others=allowed)]
                )
        J = (images.by_camera(params, v) * weight[..., None, None]).reshape(rows)
        change = (residual * weight[..., None]).reshape(rows)
        if k >= _ROUNDS:
            J, change = np.hsplit(problem.whitened(params, np.hstack([J, change]), used), [J.shape[1]])
        gauge = np.zeros((J.shape[1], 1))
        gauge[:CAMERA, 0] = params.P[v].ravel()
        root = inverse_root(J, np.linalg.norm(J, axis=0), gauge)
        along = J @ root
        if not (np.linalg.norm(along, axis=0) > 0.5).all():  # else of length one
            raise failed([open_])
        if k < _ROUNDS + _SETTLING:
            params = _stepped(params, v, -root @ (along.T @ change[:, 0]))
    G = root @ problem.whitened(params, along, used).T
    scale = 1.0 / np.sqrt(np.mean((points @ np.linalg.inv(frame).T @ params.P[v, 2]) ** 2))
    params.P[v] *= scale
    units = np.ones((len(root), 1))
    units[:CAMERA] = scale
    return _Camera(images, v, params, used, units * root, (units * G).reshape(-1, *found.pixels.shape))


def _stepped(params: Parameters, v: int, x: FloatArray) -> Parameters:
    """Parameters after a step (c,) of a camera and its lens."""
    P, lens = params.P.copy(), params.lens
    P[v] += x[:CAMERA].reshape(3, 4)
    if lens is not None:
        lens = lens.copy()
        lens[v, list(TERMS[: params.lens_terms])] += x[CAMERA:]
    return dataclasses.replace(params, P=P, lens=lens)


def rows_of_camera(c: Calibration, v: int) -> IntArray:
    """Rows (c,) of the numbers of a camera in the covariance of a calibration."""
    terms, lenses = c.lens_terms, c.P.size + c.H_hat_0.size
    return np.concatenate([v * CAMERA + np.arange(CAMERA), lenses + v * terms + np.arange(terms)])


def errors_of_others(c: Calibration, v: int, errors: Errors | None = None) -> Errors:
    """Errors of a calibration except the errors of one camera."""
    errors = errors_of(c) if errors is None else errors
    shared = errors.shared.copy()
    shared[rows_of_camera(c, v)] = 0.0
    return errors._replace(shared=shared)


class _JointOffsets(NamedTuple):
    """Offsets of single joints by images of all views, orthogonal to motions of the camera."""

    offset: FloatArray  # (n,) in rad × ``per_rad``
    square: FloatArray  # (n,) information on each; infinite if the camera moves images alike
    effect: FloatArray  # (n,) rms motion of the images by each, over their noise
    left: float  # sum of squares that the camera leaves
    coordinates: float  # number of those seen
    numbers: int  # number of parameters of the camera

    @classmethod
    def of(
        cls, images: _Images, params: Parameters, errors: Errors, mask: BoolArray, by_cameras: FloatArray
    ) -> "_JointOffsets":
        """Test each joint by residuals of covariance I + T Tᵀ and noise of joints.

        mask : (V, N) detections that count; by_cameras : (V, N, 2, k) changes by parameters of the cameras.
        """
        problem, found = images.problem, images.problem.detections
        mask = mask & np.isin(found.marker_of, even_choice(found.marker.size, MAX_JUDGED))
        common, own = images.changes(params, errors)
        T = apart(
            common, own, np.broadcast_to(found.marker_of[:, None], (*found.seen.shape, 2)), found.marker.size
        )
        per = per_rad(params.prismatic)
        columns = (
            *(by_cameras, problem.joint_derivative(params) * per),
            *(problem.residual(params)[..., None], T),
        )
        stacked = np.concatenate(columns, axis=-1) * mask[..., None, None]
        stacked = problem.whitened(params, stacked.reshape(-1, stacked.shape[-1]), mask)
        n, k = len(per), by_cameras.shape[-1]
        Y, T = np.hsplit(stacked, [k + n + 1])
        crossed = T.T @ Y
        gram = Y.T @ Y - crossed.T @ np.linalg.solve(np.eye(T.shape[1]) + T.T @ T, crossed)
        left = gram[k:, k:] - gram[k:, :k] @ np.linalg.solve(gram[:k, :k], gram[:k, k:])
        own_square = np.diagonal(left)[:n]
        square = np.where(own_square > _ALIKE * np.diagonal(gram)[k : k + n], own_square, np.inf)
        offset, count = -left[:n, n] / square, 2.0 * float(mask.sum())
        effect = np.abs(offset) * np.sqrt(np.diagonal(Y.T @ Y)[k : k + n] / count)
        return cls(offset, square, effect, float(left[n, n]), count, k)

    @property
    def ratio(self) -> float:
        """Noise over that expected, with the camera alone."""
        return float(np.sqrt(self.left / (self.coordinates - self.numbers)))

    def require_none(self, images: _Images, name: str) -> None:
        """Refuse the offset of a joint that images show, if it matters to them. Raises WorkFailed."""
        gain = self.offset**2 * np.where(np.isfinite(self.square), self.square, 0.0)
        i = int(np.argmax(gain))
        freedom = self.coordinates - self.numbers - 1
        std = float(np.sqrt(max((self.left - gain[i]) / freedom, 1.0) / self.square[i]))
        if abs(self.offset[i]) > _SURE * std and self.effect[i] > _MATTERS:
            times = (Finding("effect", amount=float(self.effect[i]), limit=_MATTERS, unit="1"),)
            raise _of_joint(images, name, "refit_slip", i, self.offset[i], deviation=std, others=times)


def _of_joint(images: _Images, view: str, code: str, i: int, amount: float, **more: Any) -> WorkFailed:
    """Return the refusal by a finding on a joint, its numbers in rad × ``per_rad``."""
    found = images.problem.detections
    per = float(per_rad(found.prismatic)[i])
    scaled = {name: per * x for name, x in more.items() if name in ("deviation", "limit")}
    subject = Subject(joints=(int(found.numbers[i]),), views=(view,))
    one = Finding(code, REFUSES, subject, per * float(amount), unit=found.units[i], **(more | scaled))
    return failed([one])


def _require_confirmed(camera: _Camera) -> float:
    """Refuse joint readings that images contradict, or that nothing confirms; the noise over that expected.

    Orthogonal to motions of the camera, an offset of each joint is tested for what it is, and for what would
    pass unnoticed.
    """
    images, v, params = camera.images, camera.v, camera.params
    found, c = images.problem.detections, images.calibration
    name, errors = found.view[v], errors_of_others(c, v)
    for one in images.errors_of_views(params, errors):
        if one.view != name and one.disagrees:
            raise failed([Finding("other_view_off", REFUSES, others=(one.finding,))])
    mask = camera.used | (images.near(params, errors) & (np.arange(len(found.seen)) != v)[:, None])
    of_camera = images.by_camera(params, v) @ camera.root
    offsets = _JointOffsets.of(images, params, errors, mask, of_camera)
    offsets.require_none(images, name)
    ratio, freedom = offsets.ratio, offsets.coordinates - offsets.numbers
    if ratio > REFUSE_RATIO:
        raise failed([Finding("refit_misfit", REFUSES, amount=ratio, limit=REFUSE_RATIO, unit="1")])
    unnoticed = _SURE * max(ratio, 1.0) / np.sqrt(offsets.square)
    limit, i = max(_UNNOTICED_RAD, 2.0 * (c.sigma_q or 0.0)), int(np.argmax(unnoticed))
    if unnoticed[i] > limit:
        raise _of_joint(images, name, "refit_unnoticed", i, unnoticed[i], limit=limit)
    return ratio if ratio**2 > chdtri(freedom, _CHANCE) / freedom else 1.0


def _record(
    c: Calibration, observation: Observation, camera: _Camera, ratio: float, limit_px: float
) -> Calibration:
    """Calibration with a camera as fitted, at a ratio to the expected noise.

    limit_px : error above which it is not usable; infinite to take the limit by the extent of the images.
    """
    images, v, which, rows = camera.images, camera.v, camera.images.which, rows_of_camera(c, camera.v)
    found, count, errors = images.problem.detections, len(rows), errors_of_others(images.calibration, v)
    common, own = images.changes(camera.params, errors)
    by_common = -np.einsum("cvni,vnir->cr", camera.G, common, optimize=True)
    by_own = -per_block(found.marker_of, np.einsum("cvni,vnid->ncd", camera.G, own), which.size)
    by_own = by_own.swapaxes(0, 1).reshape(count, -1)
    noise, marker, own_errors = ratio * camera.root, c.sqrt_cov_marker, c.sqrt_cov_own.copy()
    apart_ = which.size <= _MOST_APART
    if not apart_:
        # Each of many markers hardly matters to the camera: their errors count as independent ones.
        noise, by_own = np.asarray(np.linalg.qr(np.hstack([noise, by_own]).T, mode="r")).T, by_own[:, :0]
    first, more = c.sqrt_cov_shared.shape[1], by_own.shape[1] + noise.shape[1]
    shared = np.pad(c.sqrt_cov_shared, ((0, 0), (0, more)))
    shared[rows] = np.hstack([by_common, by_own, noise])
    marker = np.pad(marker, ((0, 0), (0, 0), (0, more)))
    if apart_:
        for k, j in enumerate(which):
            marker[j, :, first + 3 * k : first + 3 * k + 3] = own_errors[j]
        own_errors[which] = 0.0
    fields: dict[str, Any] = {"P": camera.params.P, "lens": camera.params.lens}
    fields |= {"sqrt_cov_shared": shared, "sqrt_cov_marker": marker, "sqrt_cov_own": own_errors}
    if c.model_error_bias is not None:
        fields["model_error_bias"] = _bias(c, camera)
    if c.corner_squares is not None and c.corner_q is not None:
        squares = np.full((len(found.q), *c.corner_squares.shape[1:]), np.nan)
        square = np.square(images.problem.residual(camera.params)).mean(axis=-1)
        squares[found.pose_of, v, which[found.marker_of]] = np.where(camera.used[v], square[v], np.nan)
        old = c.corner_squares.copy()
        old[:, v] = np.nan
        fields["corner_squares"] = np.concatenate([old, squares])
        fields["corner_q"] = np.concatenate([c.corner_q, observation.at_rest.q])
    new = changed(c, **fields)
    pixels = found.pixels[v, camera.used[v]]
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    wide = 0.5 * (high - low)
    error = [_error_px(one, v, low - wide, high + wide) for one in (new, c)]
    limit_px = limit_px if np.isfinite(limit_px) else MAX_PREDICTED * float((high - low).max())
    return _judged(new, v, error, found.pose_of[camera.used[v]], limit_px)


def _bias(c: Calibration, camera: _Camera) -> FloatArray:
    """Errors of all parameters by deviations from the model: the camera errs by them in images as before."""
    images, v, s = camera.images, camera.v, len(c.sqrt_cov_shared)
    bias = np.array(c.model_error_bias)
    by_marker = bias[s:].reshape(len(c.M), 4, -1)[images.which]
    of_bias = changed(
        images.calibration,
        sqrt_cov_shared=bias[:s],
        sqrt_cov_marker=by_marker,
        sqrt_cov_own=by_marker[..., :0],
    )
    before = images.changes(parameters_from(images.calibration), errors_of(of_bias))[0]
    change = before - images.changes(camera.params, errors_of_others(of_bias, v))[0]
    bias[rows_of_camera(c, v)] = np.einsum("cvni,vnir->cr", camera.G, change, optimize=True)
    return bias


def _error_px(c: Calibration, v: int, low: FloatArray, high: FloatArray) -> float:
    """Expected error of the images of a view within the joint ranges and a region, rms of distances, px."""
    few = c.with_markers(even_choice(len(c.M), MAX_JUDGED))
    q = c.joint_min + np.random.default_rng(0).random((_POSES, len(c.joint_min))) * c.excitation
    pixels, variance = predict(few, q)[:, v], prediction_variance(few, q)[:, v].sum(axis=-1)
    inside = ((pixels >= low) & (pixels <= high)).all(axis=-1)
    inside = inside if inside.any() else np.isfinite(pixels[..., 0])
    return float(np.sqrt(variance[inside].mean())) if inside.any() else np.inf


def _judged(c: Calibration, v: int, error: list[float], pose_of: IntArray, limit: float) -> Calibration:
    """Calibration with the error of its new camera, now and before, and whether it is usable."""
    name, (now, before), poses = c.view[v], error, np.unique(pose_of).size
    code, severity = ("refit_too_coarse", REFUSES) if now > limit else ("refitted_camera", LIMITS)
    from_poses = (Finding(code, amount=poses, unit="1"),)
    held, subject = limit if now > limit else before, Subject(views=(name,))
    reasons = Finding(code, severity, subject, now, limit=held, unit="px", effect_px=now, others=from_poses)
    grown: dict[str, Any] = {}
    for field in ("predicted_rms_px", "predicted_p99_px", "predicted_recorded_px", "predicted_worst_px"):
        if (px := getattr(c, field)) is not None:
            grown[field] = float(np.sqrt(max(px**2 + (now**2 - before**2) / len(c.view), 0.0)))
    numbers = np.array([[poses, now, before]])
    refits = Refits(refit=(name,), refit_numbers=numbers)
    if (old := c.refits) is not None:
        numbers = np.concatenate([old.refit_numbers, numbers])
        refits = Refits(refit=(*old.refit, name), refit_numbers=numbers)
    c = changed(c, refits=refits, **grown)
    return with_findings(c, (), [reasons] if now > min(limit, _MORE * before) else [])
