"""Causes that may explain why images disagree, each by the images that it predicts."""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, expm

from projservo_cli.calibration.detections import in_chain_order
from projservo_cli.calibration.prediction import Parameters, from_reference
from projservo_cli.deviations import CHANGES, Deviation
from projservo_cli.geometry.least_squares import Equations, levenberg_marquardt
from projservo_cli.image_size import FACTORS
from projservo_cli.monitoring.frame_pairs import FramePair
from projservo_cli.monitoring.innovation_tests import ErrorModel, Residual, Sums
from projservo_cli.records import CORNERS, BoolArray, FloatArray, IntArray

# A point that a cause puts behind a camera gets this error, px.
_HIDDEN_PX = 1e3
# Steps of a fit, and the change of parameters that derivatives are taken by.
_STEPS, _EPSILON = 14, 1e-6
# A cause that changes images by more than this, px, is large.
_NEAR_PX = 5.0
# Causes of several parameters that are fitted, the likeliest after one step; a fall of χ² that ends a fit.
_FITTED, _FALLS = 8, 0.05
# Starts of a joint that was homed again.
_TURNS = 12
# Angle by which a link may flex under its load, rad, which looks like a joint that slipped.
_MOST_FLEXIBLE = np.radians(3.0)
# Numbers of all joints, views or markers of a cause, and of some of several.
ALL, _SOME = -1, -2
# Readings that differ by no more are at rest, rad or m.
_STILL = 1e-9
# Most observations that are explained together.
_MAX_PAIRS = 12


class _Changed(NamedTuple):
    """Scene and joints as a cause leaves them."""

    P: FloatArray  # (V, 3, 4)
    lens: FloatArray | None  # (V, 5)
    M: FloatArray  # (m, 4)
    away: FloatArray  # (K, V, n) joints from the reference along the arm, rad or m
    scale: FloatArray  # (V,) of images
    shift: FloatArray  # (V, 2) px, after that


class _Cause(NamedTuple):
    """A cause, by its row and the joint, view or marker that it is of, or ``ALL`` or ``_SOME`` of them."""

    kind: str  # key of ``CHANGES``
    which: int
    starts: FloatArray  # (s, p) parameters that a fit starts from
    change: Callable[[_Changed, FloatArray], _Changed]
    markers: tuple[int, ...] = ()  # that it touches alone
    # views whose cameras it concerns; for an exchange the camera that each view shows
    views: tuple[int, ...] = ()

    @property
    def row(self) -> Deviation:
        """Its row of the table."""
        return CHANGES[self.kind]


class Explanation(NamedTuple):
    """A cause as fitted."""

    cause: _Cause
    theta: FloatArray  # (p,)
    gain: float  # decrease of χ²
    cost: float  # cost of its parameters, by their prior
    left: float  # χ² that stays
    changed_px: float  # rms change of images of the markers that it touches
    min_px: float  # the same in the second view, or in the only one
    seen_px: float  # length of this change that the images show, rms: errors of joints take none of it

    @property
    def score(self) -> float:
        """Twice the logarithm of its odds against no cause."""
        return self.gain - self.cost


class Evidence:
    """Observations that disagree, whitened; errors of calibration, joints and instants are nuisances.

    errors : covariance of images; pairs, residuals, weights : of each observation, and its weight.
    agreed : sums of the observations before.
    """

    def __init__(
        self,
        errors: ErrorModel,
        pairs: list[FramePair],
        residuals: list[Residual],
        weights: FloatArray,
        agreed: Sums,
    ) -> None:
        few = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MAX_PAIRS)).round().astype(int))
        self.pairs, residuals = [pairs[i] for i in few], [residuals[i] for i in few]
        self._weights, self._agreed = weights[few] * (weights.sum() / weights[few].sum()), agreed
        factor = np.sqrt(self._weights)
        self._errors = errors
        self.twists, self.directions = errors.twists, errors.directions
        self.q_reference, self.prismatic = errors.calibration.q_reference, errors.calibration.prismatic
        self.scene: Parameters = errors.scene
        q = np.array([pair.q for pair in self.pairs])
        away = from_reference(errors.calibration, q.reshape(-1, q.shape[-1]))
        self.away = in_chain_order(errors.calibration.mount, away).reshape(q.shape)
        self._images = np.array([pair.images for pair in self.pairs])
        self.seen = np.array([residual.seen for residual in residuals])
        self._images[~self.seen] = 0.0
        bias = (errors.bias_px / np.array([residual.noise for residual in residuals])) ** 2
        self.bias = float(2.0 * (bias * self.seen).sum())
        n = len(errors.sigma_q)
        roots = np.linalg.cholesky(np.array([residual.R for residual in residuals]))
        self._inverses = factor[:, None, None] * np.linalg.inv(roots)
        onset = float(self.pairs[0].t.mean())
        seconds = float(self.pairs[-1].t.mean()) - onset
        nuisance = np.array([np.hstack([r.B, r.F[:, : errors.fixed]]) for r in residuals])
        drift = slice(errors.e + n, errors.e + 2 * n)  # drift of joints, with time from the onset
        nuisance[..., drift] -= onset * nuisance[..., errors.e : errors.e + n]
        self._beside = self._whitened(nuisance)
        sigma_t = np.maximum(np.max([pair.sigma_t for pair in self.pairs], axis=0), 1e-6)
        prior = np.zeros((errors.e + errors.fixed,) * 2)
        prior[: errors.e, : errors.e] = np.eye(errors.e) + agreed.normal[: errors.e, : errors.e]
        prior[errors.e :, errors.e :] = errors.persistent_prior(seconds, sigma_t)
        self._known = np.append(agreed.normal[: errors.e, -1], np.zeros(errors.fixed))
        self._factor = cho_factor(prior + self._beside.T @ self._beside)
        self._offset = float(self._known @ cho_solve(cho_factor(prior), self._known))
        self.rows = float(2.0 * (self.seen * factor[:, None, None] ** 2).sum())
        self.nothing = _Changed(
            P=self.scene.P,
            lens=self.scene.lens,
            M=self.scene.M,
            away=self.away,
            scale=np.ones(len(self.scene.P)),
            shift=np.zeros((len(self.scene.P), 2)),
        )
        self.at_first = self._off(self.nothing)
        self.before = self._square(self._whitened(self.at_first))
        seen = max(float(self.seen.sum()), 1.0)
        self.off_px = float(np.sqrt(np.square(self.at_first).sum() / seen))  # rms of each detection

    def _whitened(self, rows: FloatArray) -> FloatArray:
        """Rows (K, 2 V m, …) over the root of their covariance, (K 2 V m, …)."""
        whitened = self._inverses @ rows.reshape(*rows.shape[:2], -1)
        return np.asarray(whitened.reshape(-1, *rows.shape[2:]))

    def _off(self, changed: _Changed) -> FloatArray:
        """Return the residuals (K, 2 V m) of images from the prediction of a cause, px; zero if unseen."""
        K, V, n = changed.away.shape
        scene = Parameters(
            P=changed.P,
            H_hat=self.scene.H_hat,
            prismatic=self.scene.prismatic,
            M=changed.M,
            lens=changed.lens,
            curve=self.scene.curve,
        )
        away, own = in_chain_order(self._errors.calibration.mount, changed.away), np.arange(V)
        s = scene.predict(away.reshape(V * K, n)).reshape(K, V, V, -1, 2)[:, own, own]
        s = changed.scale[:, None, None] * (s + 0.5) - 0.5 + changed.shift[:, None]
        off = np.where(np.isfinite(s), self._images - s, _HIDDEN_PX)
        off[~self.seen] = 0.0
        return np.asarray(off.reshape(K, -1))

    def _square(self, r: FloatArray) -> float:
        """χ² of whitened residuals, after a fit of the nuisance errors with their priors."""
        b = self._beside.T @ r + self._known
        return float(r @ r + self._offset - b @ cho_solve(self._factor, b))

    def explanations(self, causes: Iterable[_Cause]) -> list[Explanation]:
        """Fits of the causes that a first step of each makes the likeliest, and of all with one parameter.

        The first step of a joint with a large error says little, since its images move on curves.
        """
        tried = [self._tried(cause) for cause in causes]
        tried.sort(key=lambda trial: -trial[0])
        return [
            self._refitted(self._fitted(cause, start))
            for rank, (_, cause, start) in enumerate(tried)
            if rank < _FITTED or start.size <= 1
        ]

    def _refitted(self, fit: Explanation) -> Explanation:
        """Explanation of a large cause, with errors of joints and calibration as they act there.

        The fit takes observations back to the state without the cause, and fits its remainder there.
        """
        kind, changed = fit.cause.kind, fit.cause.change(self.nothing, fit.theta)
        if not fit.cause.row.undone or fit.changed_px < _NEAR_PX:
            return fit
        # Images of each view as calibrated: for an exchange of another view, or of other markers.
        order = np.argsort(fit.cause.views) if kind == "exchanged" else np.arange(self.seen.shape[1])
        pairs, seen_there = [], self.seen[:, order]
        for pair, seen, away in zip(self.pairs, seen_there, changed.away, strict=True):
            images, noise = np.where(seen[..., None], pair.images[order], np.nan), pair.noise[order]
            images = (images - changed.shift[:, None] + 0.5) / changed.scale[:, None, None] - 0.5
            noise = noise / changed.scale[:, None]
            q = away + self.q_reference
            pairs.append(pair._replace(q=q, images=images, noise=noise))
        residuals = [self._errors.residual(pair) for pair in pairs]
        if any((there.seen != seen).any() for there, seen in zip(residuals, seen_there, strict=True)):
            return fit  # a point behind a camera has no prediction: there is no state to go back to
        there = Evidence(self._errors, pairs, residuals, self._weights, self._agreed)
        left, theta = there.before, fit.theta
        if theta.size:
            nearer = there._fitted(fit.cause, np.full(1, 1.0 if kind == "sized" else 0.0))
            left, theta = nearer.left, theta * nearer.theta if kind == "sized" else theta + nearer.theta
        return fit._replace(theta=theta, gain=self.before - left, left=left)

    def _changed_by(self, cause: _Cause, theta: FloatArray) -> FloatArray:
        return self._off(cause.change(self.nothing, theta))

    def _tried(self, cause: _Cause) -> tuple[float, _Cause, FloatArray]:
        """Score of a cause after one step from the best of its starts, and that start."""
        rows = [self._changed_by(cause, start) for start in cause.starts]
        squares = [self._square(self._whitened(row)) for row in rows]
        best = int(np.argmin(squares))
        start, cost, falls = cause.starts[best], 0.0, 0.0
        if start.size:
            there, cost = self._linearized(cause, start)
            falls = float(there.g[0] @ np.linalg.solve(there.A[0], there.g[0]))
        return self.before - squares[best] + falls - cost, cause, start

    def _linearized(self, cause: _Cause, theta: FloatArray) -> tuple[Equations, float]:
        """Normal equations of one problem, and the cost of the parameters by their prior.

        The nuisance errors are eliminated.
        """
        here = self._changed_by(cause, theta)
        F = np.stack(
            [(self._changed_by(cause, theta + h) - here) / _EPSILON for h in _EPSILON * np.eye(theta.size)],
            axis=-1,
        )
        r = self._whitened(here)
        size = np.sqrt(np.square(F).sum(axis=(0, 1)) / self._count(cause))  # px rms a unit
        unit = cause.row.size / np.maximum(size, 1e-12)
        F = self._whitened(F)
        across = self._beside.T @ F
        solved = cho_solve(self._factor, across)
        A = F.T @ F - across.T @ solved + np.diag(unit**-2)
        g = F.T @ r - solved.T @ (self._beside.T @ r + self._known)
        cost = float(np.linalg.slogdet(A * np.outer(unit, unit))[1])
        return Equations(A[None], g[None], np.array([self._square(r)])), cost

    def _touched(self, cause: _Cause) -> BoolArray:
        """Detections (K, V, m') that a cause touches."""
        return self.seen[..., list(cause.markers)] if cause.markers else self.seen

    def _count(self, cause: _Cause) -> float:
        """Coordinates seen that a cause touches."""
        return max(2.0 * float(self._touched(cause).sum()), 1.0)

    def _fitted(self, cause: _Cause, theta: FloatArray) -> Explanation:
        """Fit of a cause, with the prior of its parameters."""
        cost = 0.0
        if theta.size:
            (ends,), _ = levenberg_marquardt(
                (theta[None],),
                lambda thetas: self._linearized(cause, thetas[0])[0],
                lambda step, thetas: (thetas + step,),
                _STEPS,
                enough=_FALLS,
            )
            theta, cost = ends[0], self._linearized(cause, ends[0])[1]
        here = self._changed_by(cause, theta)
        square = self._square(self._whitened(here))
        shift = self.at_first - here
        change = np.square(shift).reshape(*self.seen.shape, 2).sum(axis=-1)
        changed_px = float(np.sqrt(change[change > 0.0].mean())) if change.any() else 0.0
        share = abs(float((self.at_first * shift).sum())) / max(float(change.sum()), 1e-12)
        by_view = change.sum(axis=(0, 2)) / np.maximum(self._touched(cause).sum(axis=(0, 2)), 1)
        return Explanation(
            cause=cause,
            theta=theta,
            gain=self.before - square,
            cost=cost,
            left=square,
            changed_px=changed_px,
            min_px=float(np.sqrt(np.sort(by_view)[-min(2, len(by_view))])),
            seen_px=share * changed_px,
        )


def causes_of(evidence: Evidence, numbers: IntArray, centre: FloatArray | None) -> Iterator[_Cause]:
    """All causes that may be named, the simplest of a kind first.

    numbers : (m,) of the markers; centre : (V, 2) of the images, px; None if their size is not known.
    """
    views = len(evidence.scene.P)
    yield from _exchanges(views)
    yield from _joint_causes(evidence)
    yield from _image_causes(views, centre)
    yield from _camera_causes(views, evidence.twists)
    yield from _body_causes(evidence, numbers)


def _exchanges(views: int) -> Iterator[_Cause]:
    """Causes in which two cameras take each other's place, or three in turn."""

    def exchanged(s: _Changed, _: FloatArray, order: list[int]) -> _Changed:
        return s._replace(P=s.P[order], lens=None if s.lens is None else s.lens[order])

    for some in (some for count in (2, 3) for some in combinations(range(views), count)):
        for turn in range(1, len(some)):
            order = np.arange(views)
            order[[*some]] = np.roll(some, turn)
            permuted = order.tolist()
            yield _Cause(
                "exchanged", ALL, _start(0), partial(exchanged, order=permuted), views=tuple(permuted)
            )


def _every_and_all(views: int) -> list[tuple[int, tuple[int, ...]]]:
    """Each view by itself, with its number, and all of several together."""
    every: tuple[int, ...] = tuple(range(views))
    return [*((v, (v,)) for v in every), *([(ALL, every)] if views > 1 else [])]


def _start(parameters: int) -> FloatArray:
    """The start (1, p) of a fit without a change."""
    return np.zeros((1, parameters))


def _joint_causes(evidence: Evidence) -> Iterator[_Cause]:
    """Causes in the joints, their readings and when these were taken."""
    q = np.array([pair.q for pair in evidence.pairs])
    velocity = np.array([pair.q_dot for pair in evidence.pairs])
    (K, V, n), q_reference = q.shape, evidence.q_reference

    def mirrored(s: _Changed, _: FloatArray, i: int) -> _Changed:
        away = s.away.copy()
        away[..., i] = -(away[..., i] + 2.0 * q_reference[i])
        return s._replace(away=away)

    def slipped(s: _Changed, theta: FloatArray, i: int) -> _Changed:
        return s._replace(away=s.away + theta[0] * np.eye(n)[i])

    def frozen(s: _Changed, theta: FloatArray, which: slice) -> _Changed:
        away = s.away.copy()
        away[..., which] += theta.reshape(K, 1, -1)
        return s._replace(away=away)

    def flexible(s: _Changed, theta: FloatArray) -> _Changed:
        return s._replace(away=s.away + theta)

    def delayed(s: _Changed, theta: FloatArray, views: tuple[int, ...]) -> _Changed:
        delays = np.zeros(V)
        delays[[*views]] = theta
        return s._replace(away=s.away - delays[:, None] * velocity)

    turns = np.linspace(-np.pi, np.pi, _TURNS, endpoint=False)[:, None] + np.pi / _TURNS
    for i in range(n):
        yield _Cause("mirrored", i, _start(0), partial(mirrored, i=i))
        starts = _start(1) if evidence.prismatic[i] else np.concatenate([_start(1), turns])
        yield _Cause("slipped", i, starts, partial(slipped, i=i))
    still, lately = np.ptp(q, axis=(0, 1)) <= _STILL, np.ptp(q[K // 2 :], axis=(0, 1)) <= _STILL
    if K > 1 and not still.all():
        # The first images may precede the onset: disagreement reveals an onset, and images have latency.
        for i in np.flatnonzero(still | (lately & (not lately.all()))).tolist():
            yield _Cause("frozen", i, _start(K), partial(frozen, which=slice(i, i + 1)))
    elif K > 2:
        yield _Cause("frozen", ALL, _start(n * K), partial(frozen, which=slice(n)))
    yield _Cause("flexible", ALL, _start(n), flexible)
    for v, views in _every_and_all(V) if velocity.any() else ():
        yield _Cause("late", v, _start(len(views)), partial(delayed, views=views), views=views)


def _image_causes(count: int, centre: FloatArray | None) -> Iterator[_Cause]:
    """Causes in the images of a number of views: cropped, of another size, or of another focal length."""

    def shifted(s: _Changed, theta: FloatArray, views: FloatArray) -> _Changed:
        return s._replace(shift=s.shift + views[:, None] * theta)

    def sized(s: _Changed, theta: FloatArray, views: FloatArray) -> _Changed:
        factor = 1.0 + views * (theta[0] - 1.0)
        return s._replace(scale=factor * s.scale, shift=factor[:, None] * s.shift)

    def focused(s: _Changed, theta: FloatArray, views: FloatArray) -> _Changed:
        factor = 1.0 + views * theta[0]
        about_centre = (
            views[:, None] * theta[1:] if centre is None else (1.0 - factor)[:, None] * (centre + 0.5)
        )
        return s._replace(scale=factor, shift=about_centre)

    for v, some in _every_and_all(count):
        views = np.isin(np.arange(count), some).astype(np.float64)
        yield _Cause(
            "shifted" if v >= 0 else "cropped", v, _start(2), partial(shifted, views=views), views=some
        )
        yield _Cause("sized", v, np.array(FACTORS)[:, None], partial(sized, views=views), views=some)
        if v >= 0:
            start = _start(3 if centre is None else 1)
            yield _Cause("focused", v, start, partial(focused, views=views), views=some)


def _camera_causes(count: int, twists: FloatArray) -> Iterator[_Cause]:
    """Causes in the poses of some cameras, by rigid motions (d, 4, 4).

    Of one camera alone, motions of itself and of all cameras are the same.
    """
    d = len(twists)

    def turned(s: _Changed, theta: FloatArray, views: tuple[int, ...]) -> _Changed:
        P = s.P.copy()
        for part, v in zip(theta.reshape(-1, d), views, strict=True):
            P[v] = P[v] @ expm(np.tensordot(part, twists, 1))
        return s._replace(P=P)

    def each_shifted(s: _Changed, theta: FloatArray, views: tuple[int, ...]) -> _Changed:
        shift = s.shift.copy()
        shift[[*views]] += theta.reshape(-1, 2)
        return s._replace(shift=shift)

    def rig(s: _Changed, theta: FloatArray) -> _Changed:
        return s._replace(P=s.P @ expm(np.tensordot(theta, twists, 1)))

    every = tuple(range(count))
    for v in every:
        yield _Cause("camera", v, _start(d), partial(turned, views=(v,)), views=(v,))
    several: list[tuple[int, ...]] = [*combinations(every, 2)] if count > 2 else []
    for some in [*several, *([every] if count > 1 else [])]:
        kind, which = ("all_cameras", ALL) if some == every else ("cameras", _SOME)
        yield _Cause(kind, which, _start(len(some) * d), partial(turned, views=some), views=some)
        yield _Cause(kind, which, _start(2 * len(some)), partial(each_shifted, views=some), views=some)
    if count > 1:
        yield _Cause("rig", ALL, _start(d), rig, views=every)


def _body_causes(evidence: Evidence, numbers: IntArray) -> Iterator[_Cause]:
    """Causes in the markers, on the tool or in the scene: each, all of a tag, and all of them."""
    twists, d = evidence.twists, len(evidence.twists)
    visible: BoolArray = np.any(evidence.seen, axis=(0, 1))
    tags = [np.flatnonzero(numbers // CORNERS == t) for t in np.unique(numbers // CORNERS)]
    tags = [tag for tag in tags if len(tag) == CORNERS]

    def displaced(s: _Changed, theta: FloatArray, which: IntArray) -> _Changed:
        M = s.M.copy()
        M[which] = M[which] @ expm(np.tensordot(theta, twists, 1)).T
        return s._replace(M=M)

    def larger(s: _Changed, theta: FloatArray) -> _Changed:
        M = s.M.copy()
        for tag in tags:
            centre = M[tag].mean(axis=0)
            M[tag] = centre + (1.0 + theta[0]) * (M[tag] - centre)
        return s._replace(M=M)

    def moved(s: _Changed, theta: FloatArray, j: int) -> _Changed:
        M = s.M.copy()
        M[j] += evidence.directions.T @ theta * np.linalg.norm(M[j])
        return s._replace(M=M)

    yield _Cause("tool", ALL, _start(d), partial(displaced, which=np.arange(len(numbers))))
    if tags:
        yield _Cause("larger", ALL, _start(1), larger)
    for tag in tags if len(tags) > 1 else ():
        if visible[tag].any():
            yield _Cause("tag", int(tag[0]), _start(d), partial(displaced, which=tag), tuple(tag.tolist()))
    for j in np.flatnonzero(visible).tolist():
        yield _Cause("marker", j, _start(3), partial(moved, j=j), (j,))


def together(moved: list[Explanation]) -> Explanation:
    """Displacements of markers, each fitted by itself, as one cause."""
    first = moved[0]
    markers = tuple(j for fit in moved for j in fit.cause.markers)
    return first._replace(
        cause=first.cause._replace(markers=markers),
        gain=sum(fit.gain for fit in moved),
        cost=sum(fit.cost for fit in moved),
        left=first.left - sum(fit.gain for fit in moved[1:]),
        changed_px=max(fit.changed_px for fit in moved),
        min_px=min(fit.min_px for fit in moved),
        seen_px=max(fit.seen_px for fit in moved),
    )


def contains(cause: _Cause, other: _Cause) -> bool:
    """Whether a cause explains the same as another one, with more parameters."""
    alike = set(other.views) <= set(cause.views) if cause.views else cause.which in (ALL, other.which)
    alike |= set(other.markers) <= set(cause.markers) != set()
    more = cause.starts.shape[1] > other.starts.shape[1]
    return alike and more and other.kind in cause.row.contains


def is_possible(fit: Explanation) -> bool:
    """Whether a cause can be of that size: links flex by a little only."""
    return fit.cause.kind != "flexible" or bool(np.abs(fit.theta).max() <= _MOST_FLEXIBLE)
