"""Whether images in the loop agree with the calibration, and what is to blame where they do not."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtri

from projservo_cli.calibration.forward import CAMERA
from projservo_cli.calibration.prediction import all_changed, scene_of
from projservo_cli.calibration.readings import LEAST_SIGMA, even_choice, per_rad
from projservo_cli.records import BoolArray, Calibration, FloatArray, IntArray

# Looks in a row that must agree on a gross disturbance: one may be blurred, or a marker taken for another.
WINDOW = 3
# Chance that a run of undisturbed looks is called disturbed, if all windows were independent. They overlap:
# it comes to a twentieth of that. More of it is spent on the first looks.
_FALSE_ALARM, _SOON = 1e-2, 10.0
# Windows in which an onset is looked for, one longer than the other by this factor.
_LONGER = 1.5
# What the first order leaves out of a prediction's error, at most, as a share of the calibration's own noise:
# nearer than that no image need come to what is predicted, however good the detector.
_BEYOND_FIRST_ORDER = 0.02
# Lasting errors of a joint, by play and ticks, differ between two times by √2 of their deviation.
_LASTING = np.sqrt(2.0)
# Errors of joints that last, by play, are bounded by so many deviations of each joint in every look.
_WANDERS = 1.0
# Between readings joints are taken to go straight: they are off by this share of the time times the change of
# their speed at most.
_STRAIGHT = 1.0 / 8.0
# Much of what a finder states of a corner is the same while the view of it is: it does not average away, and
# of many corners some are off by so many deviations.
_LASTING_CORNER = 2.0
# Where a finder states deviations, a marker that seems to have moved by less, px, is a wrong edge, and so is
# perhaps one that a single camera shows: something may hide it there.
_LEAST_MOVED_PX = 1.0
# A corner that is so many times less certain than most is not tested: its error is the finder's, and lasts.
_VAGUE = 10.0
# Joints (rad or m) and instants (s) are known no better than this, whatever is said.
_LEAST_ERROR = 1e-6
# A direction counts where it keeps this share of its size beside the others; what is added for solving.
_RANK, _RIDGE = 1e-6, 1e-9
# Share of what a look is off that the first order leaves out: the cause need not explain more.
_BENT = 0.2
# Advantage over the next cause, twice the logarithm of odds, at which one is named; looks that are waited for
# that; share of what a cause explains that, left to others, shows that there are several.
_CLEAR, _PATIENCE, _LEFT = 2.0 * np.log(100.0), 12, 0.25
# What a joint slipped by is told once it differs by no more than this share from what it was looks before.
_STEADY = 0.1
# By so much a link may flex under its load, rad, which looks like a joint that slipped.
_FLEXIBLE, _MOST_FLEXIBLE = np.radians(1.0), np.radians(3.0)
# Frames of both views so near to each other, s, are one look; so many are kept for those of the other view.
_TOGETHER_S, _WAITING = 0.025, 25
# Frames that are so near show joints of one reading.
_AT_ONCE_S = 1e-4
# Markers that are tested, at most.
_MOST_TESTED = 40
# Joints that differ by no more stand still, rad or m: as they were read, and since the first look.
_STILL, _AT_REST = 1e-9, 1e-3


class _Cause(NamedTuple):
    """What may be wrong."""

    kind: str
    which: int  # joint, view or marker; −1 all of them
    columns: IntArray  # its regressors
    touches: BoolArray  # (2, m) images that it changes


class _Frame(NamedTuple):
    """An image of one view."""

    t: float  # when it was taken, s
    q: FloatArray  # (n,) joint readings then, rad or m
    q_dot: FloatArray  # (n,) and their velocities
    sigma: float  # uncertainty of the instant, s
    image: FloatArray  # (m, 2) px, NaN where unseen
    noise: FloatArray  # (m,) standard deviation of the pixels, px


class _Look(NamedTuple):
    """Residuals of one look: rows by view, marker and coordinate, zero where unseen."""

    seen: BoolArray  # (2, m)
    r: FloatArray  # (4 m,) seen less predicted, px
    B: FloatArray  # (4 m, e) derivatives by the errors of the calibration, in units of their deviations
    F: FloatArray  # (4 m, f) derivatives by what may be wrong
    R: FloatArray  # (4 m, 4 m) covariance of what is new in each look, px²


class _Sums(NamedTuple):
    """Normal equations of looks."""

    looks: int  # number of the last of them
    t: float  # and when it was taken, s from the first one
    normal: FloatArray  # (c, c) of errors of the calibration, of what may be wrong, and of the residual
    seen: FloatArray  # (2, m) coordinates seen of each marker


class _Evidence(NamedTuple):
    """What speaks for each cause since an onset, likelihoods as twice their logarithms."""

    since: _Sums
    lasting: float  # what lasting errors of joints and instants gain
    prior: float  # what that costs by their prior
    gain: FloatArray  # (h,) what each cause gains beside them
    amount: FloatArray  # (h, p) of each the factors of its regressors, zeros behind
    touched: FloatArray  # (h,) coordinates seen that it touches
    rows: float  # coordinates seen


class _Blame(NamedTuple):
    """A cause that may be named, or markers together."""

    score: float
    causes: list[int]
    evidence: _Evidence


class Innovation:
    """Whether a sequence of looks still agrees with a calibration, and what happened where it does not.

    At given joint readings the calibration predicts the pixels of every marker. What is seen differs by

        r = J δ + J_q δq + (J_q q̇) δd + ε

    to first order: δ ~ N(0, Σ), errors of the calibration, the same all along; δq of the joint readings, the
    same in both views of one instant; δd of the instant of each frame; ε ~ N(0, σ² I), pixel noise. Errors of
    joints and instants are taken to be new in each look *and* to last, those of joints along a straight line
    since an onset: they do not average away. Nor does an error of the model, which may add to the root of a
    statistic what it can if it is ``model_px`` everywhere.

    All looks add up in one normal matrix. From it follow the likelihood ratios of all causes for any onset,
    beside δ and the lasting errors with their priors. Each look is first tested by itself, each view and each
    marker: one that is grossly off stays out of the sums, and is a disturbance if that lasts. The cause of
    the largest likelihood, less a penalty for its parameters, is named as soon as it is clear.

    Sources: A. S. Willsky, H. L. Jones, "A Generalized Likelihood Ratio Approach to the Detection and
    Estimation of Jumps in Linear Systems", IEEE Trans. Automatic Control 21 (1976) 108–112; G. Schwarz,
    "Estimating the Dimension of a Model", Annals of Statistics 6 (1978) 461–464.

    calibration : what predicts the pixels, with its covariance.
    sigma_px : pixel noise per coordinate.
    observations : most looks of one sequence, which sets the thresholds.
    shown : indices of the markers that images may show, None all; of many, some stand for all.
    """

    def __init__(
        self,
        calibration: Calibration,
        sigma_px: float,
        observations: int,
        shown: IntArray | None = None,
    ) -> None:
        shown = np.arange(len(calibration.M)) if shown is None else shown
        self._shown = shown[even_choice(len(shown), _MOST_TESTED)]
        self.calibration = calibration = calibration.with_markers(self._shown)
        m, n = len(calibration.M), len(calibration.H_hat_0)
        self._scene = scene_of(calibration)
        self._errors, self._e = calibration.errors, calibration.shared_error.shape[1] + 3 * m
        bent = _BEYOND_FIRST_ORDER * calibration.sigma_px
        self._least = max(bent, LEAST_SIGMA)
        self._sigma = max(sigma_px, self._least)
        self._stated = self._sigma / max(calibration.sigma_px, LEAST_SIGMA)
        self._floor = max(calibration.model_px, bent) / self._sigma
        sigma_q = calibration.sigma_q or 0.0
        if calibration.sigma_q_interval is not None:
            sigma_q = max(sigma_q, float(calibration.sigma_q_interval[1]))
        self._sigma_q = np.maximum(sigma_q * per_rad(calibration.prismatic), _LEAST_ERROR)
        self._wanders = _WANDERS if calibration.sigma_q and not calibration.ticks else 0.0
        self._delay_sigma = np.full(2, _LEAST_ERROR)
        # Directions of points at infinity, of rigid motions, and of changes of a camera but for its scale.
        self._directions = np.linalg.svd(calibration.a_inf[None])[2][1:]
        self._twists = _rigid_motions(calibration.H_hat_0, self._directions, calibration.a_inf)
        self._cameras = [np.linalg.svd(P.reshape(1, CAMERA))[2][1:].T for P in calibration.P]
        self._causes, self._f = _table_of(n, m, len(self._twists))
        self._is_flexible = np.array([cause.kind == "flexible" for cause in self._causes])
        self._sizes = np.array([len(cause.columns) for cause in self._causes])
        self._by_size = [
            (which, np.array([self._causes[i].columns for i in which]))
            for which in (np.flatnonzero(self._sizes == size) for size in np.unique(self._sizes))
        ]
        self._touches = np.array([cause.touches.ravel() for cause in self._causes], dtype=np.float64)
        tail = _FALSE_ALARM / observations
        self._chance = _FALSE_ALARM / np.log1p(observations / _SOON)
        self._most_once = np.sqrt(chdtri(np.maximum(np.arange(4 * m + 1), 1), tail / (2 + m)))
        c = self._e + self._f + 1
        self._sums = [_Sums(0, 0.0, np.zeros((c, c)), np.zeros((2, m)))]
        self._pending: list[tuple[BoolArray, _Sums]] = []
        self._readings: list[FloatArray] = []
        self._last: _Frame | None = None
        self._doubtful, self._by_edges = 0, False
        self._amounts: list[tuple[int, float]] = []
        self._waiting: tuple[list[_Frame], list[_Frame]] = ([], [])
        self._reached = np.full(2, -np.inf)
        self._first: FloatArray | None = None
        self._start: float | None = None
        self._t = np.zeros(2)
        self._at_rest = True

    @property
    def doubtful(self) -> bool:
        """Whether something is wrong of which it is not clear yet what; further looks make it clear."""
        return self._doubtful > 0

    def disturbed(
        self,
        t: FloatArray,
        q: FloatArray,
        q_dot: FloatArray,
        delay_sigma: FloatArray,
        images: FloatArray,
        fresh: BoolArray,
        *,
        stated: FloatArray | None = None,
    ) -> str:
        """What is wrong, in words; empty while nothing is, or while it is not clear what.

        Frames are looked at in the order in which they were taken: those of a view that comes earlier wait
        for those of the other one, so that both show what happens at once.

        t : (2,) instants of both frames, s.
        q : (2, n) joint readings then, rad or m; q_dot : (2, n) their velocities, rad/s or m/s.
        delay_sigma : (2,) uncertainty of these instants, of the delay and its jitter together, s.
        images : (2, m, 2) raw pixels of the markers of the calibration, NaN where unseen.
        fresh : (2,) whether the frame of a view is new; one that comes twice is no second measurement.
        stated : (2, m) standard deviations of the pixels, px, if they are told: by how much more than what
            it was told the calibration found is added.
        """
        images, stated = images[:, self._shown], None if stated is None else stated[:, self._shown]
        noise = np.full(images.shape[:2], self._sigma)
        if stated is not None:
            noise = np.where(stated > 0.0, np.maximum(self._stated * stated, self._least), noise)
            seen = np.isfinite(images[..., 0])
            vague = noise > _VAGUE * np.median(noise[seen]) if seen.any() else ~seen
            images = np.where(vague[..., None], np.nan, images)
            self._floor, self._by_edges = max(self._floor, _LASTING_CORNER), True
        self._first = q[0] if self._first is None else self._first
        if self._at_rest:
            self._at_rest = bool(np.abs(q - self._first).max() <= _AT_REST)
        for v in np.flatnonzero(fresh):
            late = max(float(delay_sigma[v]), _LEAST_ERROR)
            self._waiting[v].append(_Frame(float(t[v]), q[v], q_dot[v], late, images[v], noise[v]))
        self._reached = np.maximum(self._reached, t)
        said = ""
        while not said and any(frames := self._next()):
            said = self._tested(frames)
        return said

    def _next(self) -> list[_Frame | None]:
        """Frames to be looked at together, left and right; none where a view has none at that time."""
        left, right = (frames[0].t if frames else np.inf for frames in self._waiting)
        first = int(right < left)
        due = self._at_rest or len(self._waiting[first]) > _WAITING or max(left, right) < np.inf
        due |= min(left, right) + _TOGETHER_S < self._reached[1 - first]
        together = self._at_rest or abs(left - right) <= _TOGETHER_S
        return [
            frames.pop(0) if frames and due and (together or v == first) else None
            for v, frames in enumerate(self._waiting)
        ]

    def _tested(self, frames: list[_Frame | None]) -> str:
        """What is wrong by frames of one time."""
        one = frames[0] or frames[1]
        assert one is not None
        both = [frame or one._replace(image=np.full_like(one.image, np.nan)) for frame in frames]
        self._delay_sigma = np.array([frame.sigma for frame in both])
        self._start = one.t if self._start is None else self._start
        self._t = np.array([frame.t for frame in both]) - self._start
        q, q_dot, images, noise = (np.stack([frame[i] for frame in both]) for i in (1, 2, 4, 5))
        look = self._look(q, q_dot, images, noise, self._curved(one))
        self._readings.append(q[0])
        beyond, off = self._beyond_chance(look)
        self._pending.append((beyond, self._added(look, off)))
        if not beyond.any():
            self._keep(self._pending[-1][1])
            self._pending.clear()
        lasting = np.all([row for row, _ in self._pending[-WINDOW:]], axis=0)
        gross = len(self._pending) >= WINDOW and bool(lasting.any())
        if gross or self._doubtful or self._significant():
            return self._named(look, gross)
        return ""

    def _curved(self, frame: _Frame) -> FloatArray:
        """How far joints (n,) may be off since they do not go straight between readings, rad or m."""
        last, self._last = self._last or frame, frame
        return np.asarray(_STRAIGHT * np.abs(frame.q_dot - last.q_dot) * abs(frame.t - last.t))

    def _look(
        self, q: FloatArray, q_dot: FloatArray, images: FloatArray, noise: FloatArray, curved: FloatArray
    ) -> _Look:
        """Residuals and derivatives of one look: each view at its own joints (2, n), noise (2, m) px."""
        scene, away, views = self._scene, q - self.calibration.q_reference, np.arange(2)
        m, n, rows = len(scene.M), len(scene.H_hat), 4 * len(scene.M)
        r = images - scene.seen(away)[views, views]
        seen = np.isfinite(r[..., 0])
        at = scene.everywhere(away)
        B = all_changed(scene, self._errors, away, at)[views, views]
        D = at.by_point.reshape(n + 1, 2, 2, m, 2, 4)[:, views, views]
        Y = at.points.reshape(n + 1, 2, m, 4)
        by_camera = at.by_camera.reshape(2, 2, m, 2, CAMERA)[views, views]
        F = self._causes_derivative(D, Y, by_camera, q_dot)
        for part in (r, B, F):
            part[~seen] = 0.0
        F = F.reshape(rows, -1)
        new = F[:, [*range(n), 2 * n, 2 * n + 1]] * np.append(
            np.hypot(self._sigma_q, curved), self._delay_sigma
        )
        late = new[:, n:]
        if abs(self._t[0] - self._t[1]) > _AT_ONCE_S:  # joints were read anew for the other view
            left = np.arange(rows)[:, None] < rows // 2
            new = np.concatenate([new * left, new * ~left], axis=1)
        # An instant so uncertain that the arm moves on a curve: half the square of the angle.
        bend = 0.5 * np.abs(q_dot).sum(axis=1).max() * (late @ self._delay_sigma)
        R = new @ new.T + np.diag(np.repeat(noise.ravel(), 2) ** 2 + bend**2)
        return _Look(seen, r.ravel(), B.reshape(rows, -1), F, R)

    def _causes_derivative(
        self, D: FloatArray, Y: FloatArray, by_camera: FloatArray, q_dot: FloatArray
    ) -> FloatArray:
        """Derivatives (2, m, 2, f) of pixels by what may be wrong, in the order of ``_table_of``.

        D : (n + 1, 2, m, 2, 4) by the points Y (n + 1, 2, m, 4) behind each joint; by_camera : (2, m, 2, 12).
        """
        n, _, m = Y[1:, ..., 0].shape
        F, d = np.zeros((2, m, 2, self._f)), len(self._twists)
        velocity = Y[:n] @ self._scene.H_hat[:, None].swapaxes(2, 3)
        J_q = np.moveaxis((D[:n] @ velocity[..., None])[..., 0], 0, -1)
        t = self._t[:, None, None, None]
        F[..., :n], F[..., n : 2 * n], F[..., -n:] = J_q, J_q * t, J_q * t**2
        by_marker, first = D[n] @ self._directions.T, 2 * n + 2
        for v in (0, 1):
            F[v, ..., 2 * n + v] = -J_q[v] @ q_dot[v]
            F[v, ..., first : first + CAMERA - 1] = by_camera[v] @ self._cameras[v]
            first += CAMERA - 1
        for j in range(m):
            F[:, j, :, first : first + 3] = by_marker[:, j]
            first += 3
        F[..., first : first + d] = D[n] @ np.moveaxis(self._scene.M @ self._twists.swapaxes(1, 2), 0, -1)
        F[..., first + d : -n] = D[0] @ np.moveaxis(Y[0] @ self._twists[:, None].swapaxes(2, 3), 0, -1)
        return F

    def _error_root(self, sums: _Sums) -> FloatArray:
        """Root (e, e) of the information on the errors of the calibration."""
        e = self._e
        return np.asarray(np.linalg.cholesky(np.eye(e) + sums.normal[:e, :e]))

    def _beyond_chance(self, look: _Look) -> tuple[BoolArray, float]:
        """Whether χ² of what is seen of each view and marker is beyond chance, (2 + m,); rms of all, px."""
        e, m = self._e, look.seen.shape[1]
        both = np.concatenate([look.B.T, self._sums[-1].normal[:e, -1:]], axis=1)
        both = solve_triangular(self._error_root(self._sums[-1]), both, lower=True, check_finite=False)
        W = both[:, :-1]
        S, r = W.T @ W + look.R, look.r - W.T @ both[:, -1]
        rows, seen = np.arange(4 * m).reshape(2, m, 2), np.repeat(look.seen.ravel(), 2)
        beyond = []
        for part in (rows.reshape(2, -1), rows.swapaxes(0, 1).reshape(m, -1)):
            count = seen[part].sum(axis=1)
            most = self._most_once[count] + self._floor * np.sqrt(count)
            beyond.append(_gains(S, r, part, 0.0)[0] > most**2)
        return np.concatenate(beyond), float(np.sqrt(r @ r / max(1, seen.sum())))

    def _added(self, look: _Look, off: float) -> _Sums:
        """What one look adds to the sums, off the prediction by so many px rms."""
        rows = np.concatenate([look.B, look.F, look.r[:, None]], axis=1)
        root = np.linalg.cholesky(look.R + (_BENT * off) ** 2 * np.eye(len(look.R)))
        rows = solve_triangular(root, rows, lower=True, check_finite=False)
        t = float(self._t.mean())
        return _Sums(len(self._readings), t, rows.T @ rows, 2.0 * look.seen.astype(np.float64))

    def _keep(self, new: _Sums) -> None:
        """Add a look; of earlier sums those are kept that tell an onset to a quarter of its age."""
        self._sums.append(_with(self._sums[-1], new))
        age = [max(1, (new.looks - sums.looks) // 4) for sums in self._sums]
        self._sums = [
            sums
            for sums, a in zip(self._sums, age, strict=True)
            if sums.looks % (1 << (a.bit_length() - 1)) == 0
        ]

    def _evidence(self, since: _Sums, total: _Sums, *held: IntArray) -> _Evidence:
        """What speaks for each cause since an onset, beside regressors that are free anyway.

        Lasting errors of joints and instants are beside them always, with their priors.
        """
        e, n = self._e, len(self._sigma_q)
        across = (total.normal - since.normal)[:, e:]
        for part in (across.T, across[e:]):  # time is from the onset
            part[-1 - n : -1] += since.t * (since.t * part[:n] - 2.0 * part[n : 2 * n])
            part[n : 2 * n] -= since.t * part[:n]
        least = _RIDGE * across[e:].diagonal()
        across[:e, -1] = total.normal[:e, -1]
        W = solve_triangular(self._error_root(total), across[:e], lower=True, check_finite=False)
        normal = across[e:] - W.T @ W
        beside = np.concatenate([np.arange(2 * n + 2), *held])
        weight = np.diag(least[beside])
        weight[: 2 * n + 2, : 2 * n + 2] = self._lasting(total.t - since.t)
        information = normal[np.ix_(beside, beside)] + weight
        solved = np.linalg.solve(information, normal[beside])
        lasting = float(normal[beside, -1] @ solved[:, -1])
        cost = float(np.linalg.slogdet(information)[1] - np.linalg.slogdet(weight)[1])
        normal -= normal[:, beside] @ solved
        gain, amount = np.zeros(len(self._causes)), np.zeros((len(self._causes), self._sizes.max()))
        for which, columns in self._by_size:
            gain[which], amount[which, : columns.shape[1]] = _gains(normal, normal[:, -1], columns, least)
        count = (total.seen - since.seen).ravel()
        return _Evidence(since, lasting, cost, gain, amount, self._touches @ count, float(count.sum()))

    def _lasting(self, seconds: float) -> FloatArray:
        """Information (2 n + 2, 2 n + 2) on errors of joints, their drift with time, and of instants.

        Over that time joints are off by a straight line, its middle and its slope by what lasts.
        """
        n = len(self._sigma_q)
        weight = np.diag(
            (_LASTING * np.concatenate([self._sigma_q, self._sigma_q, self._delay_sigma])) ** -2.0
        )
        line = np.eye(2 * n + 2)
        line[:n, n : 2 * n] = 0.5 * seconds * np.eye(n)
        line[n : 2 * n, n : 2 * n] = max(seconds, _LEAST_ERROR) / np.sqrt(12.0) * np.eye(n)
        return np.asarray(line.T @ weight @ line)

    def _beyond(self, evidence: _Evidence) -> BoolArray:
        """Which causes (h,) are beyond what chance and errors of the model allow; what stands still must."""
        tail = self._chance / (len(self._readings) + _SOON) / len(self._sizes)
        most = np.sqrt(chdtri(self._sizes, tail)) + self._floor * np.sqrt(evidence.touched)
        looks = len(self._readings) - evidence.since.looks
        # Joints move all markers together: of what they do, a cause explains what it touches.
        share = evidence.touched / max(evidence.rows, 1.0)
        most += self._wanders * np.sqrt(len(self._sigma_q) * looks * share)
        flexed = np.abs(evidence.amount).max(axis=1) <= _MOST_FLEXIBLE
        possible = (np.sqrt(evidence.gain) > most) & (flexed | ~self._is_flexible)
        if possible.any():
            # It may have begun while the first look of them was taken.
            rows = self._readings[min(evidence.since.looks + 1, len(self._readings) - 1) :]
            still = np.ptp(rows, axis=0) <= _STILL
            for i, cause in enumerate(self._causes):
                if cause.kind == "frozen":
                    possible[i] &= still.all() if cause.which < 0 else still[cause.which] and not still.all()
        return np.asarray(possible)

    def _significant(self) -> bool:
        """Whether anything is beyond chance since an onset: at each look for a window of another length."""
        total = self._sums[-1]
        if self._pending or total.looks < WINDOW:
            return False
        lengths = WINDOW * _LONGER ** np.arange(1 + int(np.log(total.looks / WINDOW) / np.log(_LONGER)))
        length = lengths[total.looks % len(lengths)]
        since = min(self._sums, key=lambda sums: abs(total.looks - length - sums.looks))
        return bool(self._beyond(self._evidence(since, total)).any())

    def _named(self, look: _Look, gross: bool) -> str:
        """The cause in words, once it is clear or has been waited for; empty until then."""
        total = self._sums[-1]
        # It may have happened while the first look of them was taken, which then shows half of it.
        for _, added in self._pending[1:] if gross else ():
            total = _with(total, added)
        blamed = self._blamed(total)
        if not blamed:
            self._doubtful = 0
            self._amounts.clear()
            return ""
        self._doubtful += 1
        best, *others = sorted(blamed, key=lambda blame: -blame.score)
        who = self._causes[best.causes[0]][:2]
        if who[0] == "marker" and self._by_edges and self._is_wrong_edge(best, look):
            self._doubtful = 0
            self._pending.clear()
            return ""
        others = [blame for blame in others if self._causes[blame.causes[0]][:2] != who]
        clear = not others or best.score - others[0].score >= _CLEAR
        clear &= self._is_steady(best)
        if not clear and self._doubtful < _PATIENCE:
            return ""
        rms = np.sqrt(np.square(look.r).sum() / max(2.0 * look.seen.sum(), 1.0))
        fit = f"images are {rms:.3g} px rms per coordinate off what the calibration predicts"
        left = self._evidence(best.evidence.since, total, *self._columns(best))
        share = np.where(self._beyond(left), left.gain, 0.0) / best.evidence.gain[best.causes].sum()
        if share.max() > _LEFT:
            second = self._said(_Blame(0.0, [int(np.argmax(share))], left), look)
            return f"{fit}, for more than one cause: {self._said(best, look)}; {second}"
        return f"{fit}: {self._said(best, look)}" + (
            "" if clear or not others else f"; or {self._said(others[0], look)}"
        )

    def _is_wrong_edge(self, blame: _Blame, look: _Look) -> bool:
        """Whether what moved may be the edges that a finder took for those of a marker."""
        which = [self._causes[i].which for i in blame.causes]
        alone = not look.seen[:, which].all(axis=0).any()
        return alone or self._changed(blame, look) < _LEAST_MOVED_PX

    def _is_steady(self, blame: _Blame) -> bool:
        """Whether what a joint slipped by stays: a reading that stands still is off by ever more."""
        who, amount = blame.causes[0], float(blame.evidence.amount[blame.causes[0], 0])
        self._amounts.append((who, amount))
        before = self._amounts[-WINDOW:]
        return self._causes[who].kind != "slipped" or (
            len(before) == WINDOW
            and all(i == who and abs(a - amount) <= _STEADY * abs(amount) for i, a in before)
        )

    def _blamed(self, total: _Sums) -> list[_Blame]:
        """What may be named, each cause since its best onset, by the criterion of Schwarz."""
        onsets = [since for since in self._sums if since.seen.sum() < total.seen.sum()]
        found = [self._evidence(since, total) for since in onsets]
        possible = np.array([self._beyond(evidence) for evidence in found])
        if not possible.any():
            return []
        gain = np.array([evidence.lasting + evidence.gain for evidence in found])
        penalty = [evidence.prior + self._sizes * np.log(evidence.rows) for evidence in found]
        score = np.where(possible, gain - penalty, -np.inf)
        best = score.argmax(axis=0)
        blamed = [_Blame(score[t, i], [i], found[t]) for i, t in enumerate(best) if possible[t, i]]
        markers = [blame for blame in blamed if self._causes[blame.causes[0]].kind == "marker"]
        if not markers:
            return blamed
        together = self._with_others(max(markers, key=lambda blame: blame.score), total)
        return [together, *(blame for blame in blamed if blame.causes[0] not in together.causes)]

    def _with_others(self, blame: _Blame, total: _Sums) -> _Blame:
        """A marker and those that moved too, one after the other, up to half of them."""
        markers = np.array([cause.kind == "marker" for cause in self._causes])
        while len(blame.causes) < markers.sum() // 2:
            left = self._evidence(blame.evidence.since, total, *self._columns(blame))
            more = left.gain - self._sizes * np.log(left.rows)
            more[~(self._beyond(left) & markers)] = 0.0
            i = int(np.argmax(more))
            if more[i] <= 0.0:
                break
            blame = blame._replace(score=blame.score + more[i], causes=[*blame.causes, i])
        return blame

    def _columns(self, blame: _Blame) -> list[IntArray]:
        """Regressors of a cause, or of markers together."""
        return [self._causes[i].columns for i in blame.causes]

    def _said(self, blame: _Blame, look: _Look) -> str:
        """Which, how far, what to do."""
        first = blame.causes[0]
        kind, i = self._causes[first].kind, self._causes[first].which
        amount, px = blame.evidence.amount[first], self._changed(blame, look)
        side = "both cameras" if i < 0 else f"the {('left', 'right')[min(i, 1)]} camera"
        if kind == "slipped":
            slides = self.calibration.joint_types[i] == "P"
            far = f"{1e3 * amount[0]:.2g} mm" if slides else f"{np.degrees(amount[0]):.2g} deg"
            alike = " or the base turned likewise" if i == 0 else ""
            alike += " or the tool turned likewise in its holder" if i == len(self._sigma_q) - 1 else ""
            alike += " or its link flexes" if not slides and abs(amount[0]) <= _FLEXIBLE else ""
            return f"joint {i + 1} slipped by {far}{alike}; home it again, or recalibrate"
        if kind == "flexible":
            return f"links flex, or several joints slipped, by {px:.2g} px; less load, or recalibrate"
        if kind == "frozen":
            which = "all joints" if i < 0 else f"joint {i + 1}"
            return f"the reading of {which} stands still while the arm moves; look at its encoder and cable"
        if kind == "late":
            ms = " and ".join(f"{1e3 * value:+.3g}" for value in amount[: self._sizes[first]])
            return f"images of {side} come {ms} ms later than was taken; give plant.delay_s, or recalibrate"
        if kind == "camera":
            return f"{side} was moved, by {px:.2g} px; put it back, or recalibrate"
        if kind == "marker":
            numbers = sorted(int(self.calibration.marker[self._causes[c].which]) for c in blame.causes)
            which = f"marker{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))} moved on the tool"
            return f"{which}, by {px:.2g} px; put back what moved, or recalibrate"
        if kind == "tool":
            return f"the tool was moved in its holder, by {px:.2g} px; put it back, or recalibrate"
        return f"both cameras were moved alike, or the base was, by {px:.2g} px; recalibrate"

    def _changed(self, blame: _Blame, look: _Look) -> float:
        """By how much a cause changes the coordinates that it touches and a look shows, rms, px."""
        change, touched = np.zeros(len(look.r)), np.zeros(look.seen.shape, dtype=np.bool_)
        for i in blame.causes:
            columns = self._causes[i].columns
            change += look.F[:, columns] @ blame.evidence.amount[i, : len(columns)]
            touched |= self._causes[i].touches & look.seen
        return float(np.sqrt(np.square(change).sum() / max(2.0 * touched.sum(), 1.0)))


def _with(sums: _Sums, new: _Sums) -> _Sums:
    """Sums and a look more."""
    return _Sums(new.looks, new.t, sums.normal + new.normal, sums.seen + new.seen)


def _gains(
    normal: FloatArray, right: FloatArray, parts: IntArray, least: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """bᵀ A⁻¹ b (h,) and A⁻¹ b (h, p) for parts (h, p) of A x = b, its diagonal not below a least."""
    size = np.sqrt(np.maximum(np.maximum(normal.diagonal(), least), 1e-300))[parts]
    blocks = normal[parts[:, :, None], parts[:, None, :]] / (size[:, :, None] * size[:, None, :])
    b = right[parts] / size
    x = np.linalg.solve(blocks + _RIDGE * np.eye(parts.shape[1]), b[..., None])[..., 0]
    return np.maximum((b * x).sum(axis=1), 0.0), x / size


def _rigid_motions(H_hat: FloatArray, directions: FloatArray, a_inf: FloatArray) -> FloatArray:
    """Basis (d, 4, 4) of rigid motions: translations, and what the joints generate together."""
    brackets = [A @ B - B @ A for A in H_hat for B in H_hat]
    known = np.concatenate([H_hat, np.array(brackets), directions[:, :, None] * a_inf])
    sizes, rows = np.linalg.svd(known.reshape(-1, 16))[1:]
    return np.asarray(rows[:6][sizes[:6] > _RANK * sizes[0]].reshape(-1, 4, 4))


def _table_of(n: int, m: int, d: int) -> tuple[list[_Cause], int]:
    """All causes, and how many regressors they have.

    Those are: joints, joints that go on, delays, cameras, markers, rigid motions of the tool and of the rig,
    joints that go on ever faster.
    """
    everything = np.ones((2, m), dtype=np.bool_)
    views = [everything & (np.arange(2)[:, None] == v) for v in (0, 1)]
    at_camera, free = 2 * n + 2, CAMERA - 1
    at_marker = at_camera + 2 * free
    at_tool = at_marker + 3 * m
    causes = [_Cause("slipped", i, np.array([i]), everything) for i in range(n)]
    at_faster = at_tool + 2 * d
    for i in range(n):
        causes.append(_Cause("frozen", i, np.array([n + i]), everything))
        causes.append(_Cause("frozen", i, np.array([i, n + i, at_faster + i]), everything))
    causes.append(_Cause("frozen", -1, n + np.arange(n), everything))
    causes.append(_Cause("flexible", -1, np.arange(n), everything))
    for v in (0, 1):
        causes.append(_Cause("late", v, np.array([2 * n + v]), views[v]))
        causes.append(_Cause("camera", v, at_camera + v * free + np.arange(free), views[v]))
    causes.append(_Cause("late", -1, 2 * n + np.arange(2), everything))
    for j in range(m):
        columns = at_marker + 3 * j + np.arange(3)
        causes.append(_Cause("marker", j, columns, everything & (np.arange(m) == j)))
    causes.append(_Cause("tool", -1, at_tool + np.arange(d), everything))
    causes.append(_Cause("rig", -1, at_tool + d + np.arange(d), everything))
    return causes, at_faster + n
