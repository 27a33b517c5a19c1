"""Bundle adjustment: fit cameras, screws and markers to all detections at once by least squares.

The frame of the parameters is metric up to a similarity (``a_inf`` is (0, 0, 0, 1), operators are twists,
markers end in one), so all operators are conjugate to rigid motions by one common matrix by construction.
Both cameras are general 3×4 matrices. The frame only serves to write the constraint down: the images alone
determine how it relates to the world.

Where joint readings err, the true joints of each pose are unknowns too, with their noise as a prior.
Each step eliminates the markers one by one, or these offsets pose by pose if they are more (Schur
complement), so the cost is linear in the markers: W. A. Fuller, "Measurement error models", Wiley 1987,
section 3.2; B. Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6.

Levenberg–Marquardt with geodesic acceleration and a gauge penalty: M. Transtrum, J. Sethna,
"Improvements to the Levenberg–Marquardt algorithm", arXiv:1201.5885. SciPy's solvers know neither the
elimination nor the gauge, and hold the whole derivative.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, expm, lu_factor, lu_solve
from scipy.sparse import csr_array

from projservo_cli.calibration.detections import RAYLEIGH, Detections, cauchy_weights, per_block
from projservo_cli.calibration.prediction import CAMERA, Parameters, image_points
from projservo_cli.geometry.displacements import cross_matrix
from projservo_cli.geometry.invariant_forms import UPPER, intrinsics_derivative, intrinsics_of
from projservo_cli.geometry.lens import TERMS, distort
from projservo_cli.records import BoolArray, Errors, FloatArray, IntArray


def _axis_of(H_hat: FloatArray) -> FloatArray:
    """Axes (…, 3) of the rotation parts of twists (…, 4, 4)."""
    return np.stack([H_hat[..., 2, 1], H_hat[..., 0, 2], H_hat[..., 1, 0]], axis=-1)


@lru_cache(maxsize=2)  # asked for by derivative and steps of the same parameters
def _generators(params: Parameters) -> list[FloatArray]:
    """Rigid motions (b, 4, 4) that move each joint's screw: two turns and two shifts, or two turns."""
    H_hat, prismatic = params.H_hat, params.prismatic
    center = params.M[:, :3].mean(axis=0)
    size = float(np.linalg.norm(params.M[:, :3] - center, axis=1).mean()) or 1.0
    if params.known_arm:
        return [np.zeros((0, 4, 4))] * len(H_hat)
    w = np.where(prismatic[:, None], H_hat[:, :3, 3], _axis_of(H_hat))
    w = w / np.linalg.norm(w, axis=1, keepdims=True)
    # Two unit vectors across w, from the coordinate axis farthest from it so that neither is short.
    across = np.empty((len(w), 2, 3))
    W = cross_matrix(w)
    across[:, 0] = W[np.arange(len(w)), :, np.argmin(np.abs(w), axis=1)]
    across[:, 0] /= np.linalg.norm(across[:, 0], axis=1, keepdims=True)
    across[:, 1] = (W @ across[:, 0, :, None])[..., 0]
    velocity = H_hat[:, :3] @ np.append(center, 1.0)
    near = center + (W @ velocity[..., None])[..., 0]
    B = np.zeros((len(w), 4, 4, 4))
    B[:, :2, :3, :3] = cross_matrix(across)
    B[:, :2, :3, 3] = -(B[:, :2, :3, :3] @ near[:, None, :, None])[..., 0]
    B[:, 2:, :3, 3] = across * size
    B[prismatic, :2, :3, 3] = 0.0
    return [B[i, : 2 if slides else 4] for i, slides in enumerate(prismatic)]


# Number of parameters of a board of known shape: its place, its turn and its size.
BOARD = 7


@lru_cache(maxsize=2)
def _similarities(params: Parameters, board: tuple[int, ...]) -> FloatArray:
    """Motions (b, 7, 4, 4) of boards of known shape about their middles: turns, shifts, and a scaling.

    board : (m,) index of the board of each marker, −1 for none.
    """
    which, M = np.array(board, dtype=np.int64), params.M[:, :3]
    boards = np.unique(which[which >= 0])
    B = np.zeros((len(boards), BOARD, 4, 4))
    for b, one in zip(B, boards, strict=True):
        center = M[which == one].mean(axis=0)
        size = float(np.linalg.norm(M[which == one] - center, axis=1).mean())
        b[:3, :3, :3], b[6, :3, :3] = cross_matrix(np.eye(3)), np.eye(3)
        b[:3, :3, 3], b[6, :3, 3] = -(b[:3, :3, :3] @ center), -center
        b[3:6, :3, 3] = size * np.eye(3)
    return B


def moved_operators(params: Parameters) -> list[FloatArray]:
    """Derivatives B Ĥ − Ĥ B (b, 4, 4) of each operator by the parameters of its joint."""
    return [B @ H_hat - H_hat @ B for B, H_hat in zip(_generators(params), params.H_hat, strict=True)]


class StatedIntrinsics(NamedTuple):
    """Intrinsics that are known but for their deviations, over pixel noise, of the entries ``UPPER``."""

    K: FloatArray  # (V, 3, 3) px
    spread: FloatArray  # (V, 5) infinite where an entry is not known


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Detections to fit and the order of the parameters: cameras, joints, lenses, curve, boards, markers.

    Residuals and derivatives are weighted, so all have the noise of a pixel of weight one. The derivative of
    the images is compact: (V, N, 2, c) for each detection by the c parameters it depends on, the last three
    the parameters of its marker. Offsets of joint readings follow the ``size`` parameters, (K, n) in units
    of ``tau``, in which their squares count like squared pixels.
    """

    detections: Detections
    q: FloatArray  # (K, n) joint values from the reference, rad or m
    q_reference: FloatArray  # (n,) the reference, rad or m
    joint: IntArray  # (n + 1,) first parameter of each joint, then of the lenses if they are estimated
    shared: int  # number of parameters before the parameters of the markers
    size: int  # number of parameters
    columns: IntArray  # (V, c - 3) parameters that all detections of a view depend on
    # (n,) noise of joint readings over pixel noise, rad/px or m/px; None where readings are exact
    tau: FloatArray | None = None
    curve_terms: int = 0  # number of terms of the curve of the joints
    by_twist: FloatArray | None = None  # (K, n, n) of ``q`` by a twist of the flange; None for joints
    stated: StatedIntrinsics | None = None  # intrinsics as priors, where there are any
    term_spread: float | None = None  # deviation of the curve's terms from zero, over pixel noise, as a prior

    @classmethod
    def of(
        cls, detections: Detections, q_reference: FloatArray, lens_terms: int = 0, curve_terms: int = 0
    ) -> "LeastSquares":
        """Problem of fitting detections about the reference joints (n,), rad or m.

        12 parameters a camera, 4 a revolute and 2 a prismatic joint, 3 a marker, ``lens_terms`` a lens,
        ``curve_terms``, and 7 a board of known shape, on whose markers their own parameters have no
        influence. The operators of poses of the flange are known.
        """
        V, known = len(detections.seen), detections.chart is not None
        of_joints = np.where(detections.prismatic, 2, 4) * (not known)
        joint = V * CAMERA + np.concatenate([[0], np.cumsum(of_joints)])
        count = lens_terms
        curved = int(joint[-1]) + V * count
        shared = curved + curve_terms + BOARD * len(detections.boards)
        view = np.arange(V)[:, None]
        parts = (
            view * CAMERA + np.arange(CAMERA),
            np.broadcast_to(np.arange(joint[0], joint[-1]), (V, joint[-1] - joint[0])),
            joint[-1] + view * count + np.arange(count),
            np.broadcast_to(np.arange(curved, shared), (V, shared - curved)),
        )
        columns = np.concatenate(parts, axis=1)
        q = detections.q - q_reference
        size = shared + 3 * detections.marker.size
        by_twist = detections.by_twist()
        return cls(detections, q, q_reference, joint, shared, size, columns, None, curve_terms, by_twist)

    def alike(self, detections: Detections) -> "LeastSquares":
        """Problem of the same parameters but for markers, of other detections, without noise of joints."""
        there = LeastSquares.of(detections, self.q_reference, self.lens_terms, self.curve_terms)
        return dataclasses.replace(there, stated=self.stated, term_spread=self.term_spread)

    def joints(self, params: Parameters) -> FloatArray:
        """Readings (K, n) from the reference, rad or m, with the offsets if joint readings have noise."""
        if self.tau is None or params.offsets is None:
            return self.q
        if self.by_twist is None:
            return self.q + params.offsets
        return np.asarray(self.q + (self.by_twist @ params.offsets[..., None])[..., 0])

    def strain(self, params: Parameters) -> FloatArray:
        """Offsets (K, n) over their noise, times the pixel noise, px; (0, n) without noise of joints."""
        if self.tau is None:
            return np.zeros((0, len(self.q_reference)))
        return np.zeros_like(self.q) if params.offsets is None else np.asarray(params.offsets / self.tau)

    def departure(self, params: Parameters) -> FloatArray:
        """Intrinsics less those stated (5 V,), then terms of the curve (T,), over their spread, px."""
        parts = [np.zeros(0)]
        if self.stated is not None:
            off = (intrinsics_of(params.P) - self.stated.K)[:, *UPPER] / self.stated.spread
            parts.append(off.ravel())
        if self.term_spread is not None and params.curve is not None:
            parts.append(params.curve.terms[:, 3] / self.term_spread)
        return np.concatenate(parts)

    def departure_derivative(self, params: Parameters) -> FloatArray:
        """Derivatives (d, shared) of ``departure`` by the shared parameters."""
        result = np.zeros((self.departure(params).size, self.shared))
        if self.stated is not None:
            by_camera = intrinsics_derivative(params.P) / self.stated.spread[..., None]
            result[: self.stated.spread.size, : params.P.size] = block_diag(*by_camera)
        if self.term_spread is not None:
            result[-self.curve_terms :, self.curved] = np.eye(self.curve_terms) / self.term_spread
        return result

    def prior_squares(self, params: Parameters) -> float:
        """Sum of the squares of ``strain`` and ``departure``, px²."""
        return float((self.strain(params) ** 2).sum() + (self.departure(params) ** 2).sum())

    def with_noise(self, tau: FloatArray | None) -> "LeastSquares":
        """Replace the noise of joints (n,) over pixel noise, rad/px or m/px."""
        return dataclasses.replace(self, tau=tau)

    @property
    def lens_terms(self) -> int:
        """Number of parameters of each lens."""
        return int(self.curved.start - self.joint[-1]) // len(self.detections.seen)

    @property
    def curved(self) -> slice:
        """Parameters of the curve of the joints."""
        end = self.shared - BOARD * len(self.detections.boards)
        return slice(end - self.curve_terms, end)

    @property
    def free(self) -> int:
        """Number of parameters that move images, those of the frame included, less what is stated of them."""
        known = 0 if self.stated is None else int(np.isfinite(self.stated.spread).sum())
        known += 0 if self.term_spread is None else self.curve_terms
        return self.size - 3 * int(np.count_nonzero(self.detections.on_board)) - known

    @property
    def by_pose(self) -> bool:
        """Whether joint offsets are eliminated pose by pose, as they outnumber coordinates of markers."""
        return self.tau is not None and self.size - self.shared < self.q.size

    def rows(self, at: IntArray | slice) -> "LeastSquares":
        """Select observations (N,); the parameters stay."""
        return dataclasses.replace(self, detections=self.detections.rows(at))

    def of_markers(self, keep: BoolArray) -> "LeastSquares":
        """Select markers (m,)."""
        return self.alike(self.detections.of_markers(keep)).with_noise(self.tau)

    def pixels(self, params: Parameters) -> tuple[FloatArray, FloatArray]:
        """Predicted pixels (V, N, 2) of every observation and their depths (V, N)."""
        detections = self.detections
        points = params.moved(self.joints(params), detections.pose_of, detections.marker_of)
        m = image_points(params.P, points)
        pixels = m[..., :2] / m[..., 2:]
        return pixels if params.lens is None else distort(params.lens[:, None], pixels), m[..., 2]

    def residual(self, params: Parameters) -> FloatArray:
        """Predicted minus seen pixels (V, N, 2), weighted, zero if not seen."""
        detections = self.detections
        residual = np.where(detections.seen[..., None], self.pixels(params)[0] - detections.pixels, 0.0)
        return np.asarray(residual * detections.weight[..., None])

    def derivative(self, params: Parameters) -> FloatArray:
        """Compact derivative (V, N, 2, c) of the weighted images, columns as in ``columns``.

        With Y_i the point behind joint i, D_i the derivative by it and B a generator, a joint contributes
        D_i (B Y_i − E_i B Y_{i+1}), where D_i E_i is D_{i+1}.
        """
        detections, q = self.detections, self.joints(params)
        images = params.images(q, detections.pose_of, detections.marker_of)
        _, Y, by_camera, D, by_lens, _ = images
        blocks = [by_camera]
        for i, B in enumerate(_generators(params)):
            turn = B.transpose(2, 1, 0).reshape(4, -1)
            near, far = (D[k] @ (Y[k] @ turn).reshape(len(Y[k]), 4, len(B)) for k in (i, i + 1))
            blocks.append(near - far)
        if by_lens is not None:
            blocks.append(by_lens[..., : self.lens_terms])
        if self.curve_terms:
            blocks.append(params.by_curve(images, q[detections.pose_of]))
        B = _similarities(params, detections.board_key)
        for b, board in zip(B, detections.boards, strict=True):
            velocity = (params.M @ b.transpose(2, 1, 0).reshape(4, -1)).reshape(-1, 4, BOARD)
            velocity[detections.board != board] = 0.0
            blocks.append(D[-1] @ velocity[detections.marker_of])
        own = D[-1][..., :3]
        if detections.board is not None:
            own = own * ~detections.on_board[detections.marker_of, None, None]
        blocks.append(own)
        return np.concatenate(blocks, axis=3) * detections.weight[..., None, None]

    def joint_derivative(self, params: Parameters) -> FloatArray:
        """Derivative (V, N, 2, n) of the weighted images by the joint values, or by twists of the flange."""
        images = params.images(self.joints(params), self.detections.pose_of, self.detections.marker_of)
        by_joint = images.by_joint(params.H_hat) * self.detections.weight[..., None, None]
        if self.by_twist is None:
            return by_joint
        return np.asarray(by_joint @ self.by_twist[self.detections.pose_of])

    def retract(self, params: Parameters, x: FloatArray) -> Parameters:
        """Parameters after a step x (size or more,); screws move rigidly and keep their constraints."""
        x, further = x[: self.size], x[self.size :]
        H_hat = params.H_hat if params.known_arm else self._moved_screws(params, x)
        M = params.M.copy()
        M[:, :3] += x[self.shared :].reshape(-1, 3)
        if self.detections.board is not None:
            B = _similarities(params, self.detections.board_key)
            motions = expm((x[self.curved.stop : self.shared].reshape(-1, BOARD, 1, 1) * B).sum(axis=1))
            for motion, board in zip(motions, self.detections.boards, strict=True):
                on = self.detections.board == board
                M[on] = params.M[on] @ motion.T
        lens = params.lens
        if lens is not None:
            lens = lens.copy()
            terms = list(TERMS[: self.lens_terms])
            lens[:, terms] += x[self.joint[-1] : self.curved.start].reshape(len(lens), -1)
        curve = params.curve
        if curve is not None:
            step = np.pad(x[self.curved, None], ((0, 0), (3, 0)))
            curve = curve._replace(terms=curve.terms + step)
        offsets = params.offsets
        if self.tau is not None and further.size:
            offsets = (0.0 if offsets is None else offsets) + self.tau * further.reshape(self.q.shape)
        P = params.P + x[: params.P.size].reshape(-1, 3, 4)
        moved = dataclasses.replace(params, P=P, H_hat=H_hat, M=M, lens=lens, offsets=offsets, curve=curve)
        return dataclasses.replace(moved, lens_terms=self.lens_terms)

    def _moved_screws(self, params: Parameters, x: FloatArray) -> FloatArray:
        """Operators (n, 4, 4) after a step, moved rigidly."""
        steps = np.split(x[self.joint[0] : self.joint[-1]], self.joint[1:-1] - self.joint[0])
        twists = [np.tensordot(step, B, axes=1) for step, B in zip(steps, _generators(params), strict=True)]
        motion = expm(np.array(twists))
        moved = motion @ params.H_hat @ np.linalg.inv(motion)
        # Restore speed and zero pitch, which the step leaves to round-off.
        H_hat = np.zeros_like(moved)
        for i, slides in enumerate(params.prismatic):
            v = moved[i, :3, 3]
            if slides:
                H_hat[i, :3, 3] = v * np.linalg.norm(params.H_hat[i, :3, 3]) / np.linalg.norm(v)
            else:
                w = _axis_of(0.5 * (moved[i] - moved[i].T))
                w /= np.linalg.norm(w)
                H_hat[i, :3, :3] = cross_matrix(w)
                H_hat[i, :3, 3] = v - w * (w @ v)
        return H_hat

    def gauge(self, params: Parameters) -> FloatArray:
        """Unit directions (size, g) of the parameters that change no image.

        Six rigid motions of the frame, its scale unless a prismatic joint sets it, and the cameras' scales.
        Known operators set the frame.
        """
        frame, V = self._of_frame(params), len(params.P)
        g = frame.shape[1]
        result = np.hstack([frame, np.zeros((self.size, V))])
        for v in range(V):
            result[v * CAMERA : (v + 1) * CAMERA, g + v] = params.P[v].ravel()
        return np.asarray(result / np.linalg.norm(result, axis=0))

    def _of_frame(self, params: Parameters) -> FloatArray:
        """Directions (size, g) of a rigid motion and scaling of the frame, none where operators set it."""
        if params.known_arm:
            return np.zeros((self.size, 0))
        motions = np.zeros((6 if params.prismatic.any() else 7, 4, 4))
        motions[:3, :3, :3] = cross_matrix(np.eye(3))
        motions[3:6, :3, 3] = np.eye(3)
        motions[6:, :3, :3] = np.eye(3)
        g = len(motions)
        result = np.zeros((self.size, g))
        result[: params.P.size] = -(params.P @ motions[:, None]).reshape(g, -1).T
        for i, (H_hat, reach) in enumerate(zip(params.H_hat, moved_operators(params), strict=True)):
            wanted = (motions @ H_hat - H_hat @ motions).reshape(-1, 16).T
            coefficients = np.linalg.lstsq(reach.reshape(-1, 16).T, wanted, rcond=None)[0]
            result[self.joint[i] : self.joint[i + 1]] = coefficients
        for b, B in enumerate(_similarities(params, self.detections.board_key)):
            at = slice(self.curved.stop + BOARD * b, self.curved.stop + BOARD * (b + 1))
            result[at] = np.linalg.lstsq(B.reshape(BOARD, 16).T, motions.reshape(g, 16).T, rcond=None)[0]
        moved = (params.M @ motions.swapaxes(1, 2))[..., :3] * ~self.detections.on_board[:, None]
        result[self.shared :] = moved.reshape(g, -1).T
        return result

    def markers_by_boards(self, params: Parameters) -> FloatArray:
        """Derivatives (m, 3, 7 b) of markers by the parameters of their boards of known shape."""
        B = _similarities(params, self.detections.board_key)
        result = np.zeros((len(params.M), 3, BOARD * len(B)))
        for b, (motion, board) in enumerate(zip(B, self.detections.boards, strict=True)):
            on = self.detections.board == board
            moved = (motion @ params.M[on].T)[:, :3].transpose(2, 1, 0)
            result[on, :, BOARD * b : BOARD * (b + 1)] = moved
        return result

    def at_poses(self, values: FloatArray) -> FloatArray:
        """Sums (K, …) of values (N, …) over the observations of each pose."""
        return per_block(self.detections.pose_of, values, len(self.q))

    def dense(self, J: FloatArray, mask: BoolArray) -> FloatArray:
        """Dense derivative (2 V N, size), zero outside a mask (V, N), for uses that need more than JᵀJ."""
        result = np.zeros((*J.shape[:3], self.size))
        J = J * mask[..., None, None]
        for v, columns in enumerate(self.columns):
            result[v][..., columns] = J[v, ..., :-3]
        own = self.shared + 3 * self.detections.marker_of[None, :, None, None] + np.arange(3)
        np.put_along_axis(result, own, J[..., -3:], axis=3)
        return result.reshape(-1, self.size)

    def predicted(self, params: Parameters, errors: Errors) -> tuple[FloatArray, FloatArray]:
        """Changes of the images by ``errors``: common ones (V, N, 2, r), and a marker's own (V, N, 2, 3)."""
        J, marker_of = self.derivative(params), self.detections.marker_of
        common = J[..., -3:] @ errors.marker[marker_of]
        for v, columns in enumerate(self.columns):
            common[v] += J[v, ..., :-3] @ errors.shared[columns]
        return common, J[..., -3:] @ errors.own[marker_of]

    def whitened(self, params: Parameters, rows: FloatArray, mask: BoolArray) -> FloatArray:
        """Whiten rows (2 V N, c) of coordinates in a mask (V, N) by S^-½, S = I + G τ² Gᵀ of each pose."""
        return rows if self.tau is None else JointErrors(self, params, mask, self.tau).whitened(rows)


class JointErrors:
    """First-order images under errors of joint readings, (K, n) in units (n,), rad or m.

    At each pose √w G = U s Vᵀ, with weights w (V, N) and derivatives G (V, N, 2, n); errors of unit variance
    give the images the covariance I + G Gᵀ.
    """

    def __init__(
        self, problem: LeastSquares, params: Parameters, weight: FloatArray | BoolArray, unit: FloatArray
    ):
        (K, n), self.pose_of = problem.q.shape, problem.detections.pose_of
        root = np.sqrt(weight)[..., None, None]
        self.G = problem.joint_derivative(params) * unit
        weighted = root * self.G
        self.V = np.linalg.eigh(problem.at_poses((np.swapaxes(weighted, 2, 3) @ weighted).sum(axis=0)))[1]
        along = weighted @ self.V[self.pose_of]
        self.square: FloatArray = problem.at_poses((along**2).sum(axis=(0, 2)))  # (K, n): s²
        rows = root * along / np.sqrt(np.maximum(self.square, 1e-300))[self.pose_of][:, None]
        columns = np.broadcast_to(n * self.pose_of[:, None, None] + np.arange(n), rows.shape)
        starts = np.arange(0, rows.size + 1, n)
        self._U = csr_array((rows.ravel(), columns.ravel(), starts), shape=(rows.size // n, K * n))

    def parts(self, rows: FloatArray) -> FloatArray:
        """Coefficients (K n, …), Uᵀ √w times rows (2 V N, …)."""
        return np.asarray(self._U.T @ rows)

    def whitened(self, rows: FloatArray) -> FloatArray:
        """Whiten rows (2 V N, c) by (I + G Gᵀ)^-½, for weights of zero and one, in coordinates that count."""
        share = 1.0 - 1.0 / np.sqrt(1.0 + self.square.reshape(-1, 1))
        return np.asarray(rows - self._U @ (share * self.parts(rows)))

    def coloured(self, rows: FloatArray) -> FloatArray:
        """Give back to whitened rows (2 V N, c) the covariance I + G Gᵀ."""
        share = np.sqrt(1.0 + self.square.reshape(-1, 1)) - 1.0
        return np.asarray(rows + self._U @ (share * self.parts(rows)))

    def undoing(self, change: FloatArray) -> FloatArray:
        """Errors (K, n) of unit variance that best undo a change (V, N, 2) of the images."""
        parts = self.parts(change.ravel()).reshape(self.square.shape)
        return -np.asarray((self.V @ (np.sqrt(self.square) / (1.0 + self.square) * parts)[..., None])[..., 0])

    def change(self, errors: FloatArray) -> FloatArray:
        """Change (V, N, 2) of the images by errors (K, n)."""
        return np.asarray((self.G @ errors[self.pose_of][..., None])[..., 0])


# Maximum ratio of the second-order to the first-order step: as by Transtrum and Sethna.
_BEND = 0.75
# Share of the step that probes the second derivative: as by Transtrum and Sethna.
_PROBE = 0.1
# Minimum Levenberg–Marquardt damping, in units of the scaled normal matrix.
_MIN_DAMPING = 1e-15
# Damping above which no step lowers the cost any more.
_MAX_DAMPING = 1e8
# Change of the images, as a share of the residual, that ends a search.
_SETTLED = 1e-7
# Change of the images, as a share of the residual, that ends a first search, with fixed cameras.
_ROUGHLY = 1e-2
# Decrease of the squared residuals, as a share, that gains nothing: a thousandth of a deviation among 1,000.
_NO_GAIN = 1e-8
# Number of such steps in a row that end a search: along a valley that the data leave flat they never end.
_FLAT_STEPS = 3
# Residual below which that rule sees round-off, px: pixels have some 1e-13 of their size.
_MIN_RESIDUAL = 1e-5
# Width of the Cauchy loss in robust standard deviations: 95 % efficient on normal residuals.
_CAUCHY = 2.385
# Observations whose derivatives are computed together, in some 50 MB.
_AT_ONCE = 2**13
# Maximum number of observations whose derivatives stay in memory, in some 80 MB.
_MAX_KEPT = 2**16
# Rounds of reweighting in a fit of joint offsets.
_OFFSET_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class _Fit:
    """Parameters and their residuals."""

    params: Parameters
    residual: FloatArray  # (V, N, 2) predicted minus seen, px, zero if not seen
    cost: float  # weighted sum of squares, px²


class _Family(NamedTuple):
    """Parameters in blocks, of which an observation depends on one: markers, or joint offsets at a pose."""

    of: IntArray  # (N,) block of an observation
    J: FloatArray  # (V, N, 2, d) weighted derivatives by it
    blocks: slice  # from the first to the last block, b in all
    sums: csr_array  # (b, N) adds up the observations of each block

    @classmethod
    def by(cls, of: IntArray, J: FloatArray) -> "_Family":
        """Group derivatives by block."""
        first, N = int(of.min()), len(of)
        sums = csr_array((np.ones(N), (of - first, np.arange(N))))
        return cls(of, J, slice(first, first + sums.shape[0]), sums)

    def added(self, values: FloatArray) -> FloatArray:
        """Sums (b, …) of values (N, …) over the observations of each block."""
        flat = self.sums @ values.reshape(len(values), -1)
        return np.asarray(flat.reshape(self.sums.shape[0], *values.shape[1:]))

    def across(self, others: FloatArray) -> FloatArray:
        """Products (b, d, c) of its derivatives with others (V, N, 2, c), summed over each block."""
        return self.added(_products(self.J, others))

    def gradient(self, change: FloatArray) -> FloatArray:
        """Products (b, d) of its derivatives with a weighted change (V, N, 2) of the images."""
        return self.across(change[..., None])[..., 0]


def _products(J: FloatArray, others: FloatArray) -> FloatArray:
    """Products (N, d, c) of derivatives (v, N, 2, d) with others (v, N, 2, c) of the same observations."""
    N = J.shape[1]
    a, b = (part.swapaxes(0, 1).reshape(N, -1, part.shape[-1]) for part in (J, others))
    return np.asarray(a.swapaxes(1, 2) @ b)


class _Part(NamedTuple):
    """Derivatives of some observations, times the roots of their weights."""

    at: slice  # rows of the observations
    shared: FloatArray  # (V, N, 2, c - 3) by the parameters common to all observations of a view
    gone: _Family  # eliminated
    kept: _Family | None  # the other family


class _Expansion:
    """First-order images about some parameters, with weights (V, N), by the parameters from a first one on.

    In units in which the diagonal of the normal matrix is at most one. Eliminating one of both families of
    blocks leaves a system in the other one and the shared parameters. Multipliers add a penalty on the gauge.
    """

    def __init__(
        self,
        problem: LeastSquares,
        params: Parameters,
        residual: FloatArray,
        weight: FloatArray,
        min_scale: FloatArray,
    ) -> None:
        self.problem, self.params, self.residual = problem, params, residual
        self.root, self.first = np.sqrt(weight), problem.size - len(min_scale)
        m, offsets = len(params.M), 0 if problem.tau is None else problem.q.size
        self.by_pose = problem.by_pose
        self.strain, self.departure = problem.strain(params), problem.departure(params)
        self.stated = problem.departure_derivative(params)
        self.known: list[_Part] = []
        s, size = problem.shared, 3 * m if self.by_pose else offsets
        blocks, width = problem.q.shape if self.by_pose else (m, 3)
        gauge = problem.gauge(params) if self.first == 0 else np.zeros((problem.size, 0))
        self.ties = gauge.shape[1]
        A, C = np.zeros((s + size, s + size)), np.zeros((blocks, width, s + size + self.ties))
        A[:s, :s] = self.stated.T @ self.stated
        D = np.zeros((blocks, width, width))
        for part in self._parts():
            self._add(part, A, C, D)
        if offsets:  # the prior by the joint readings
            own = D if self.by_pose else A[s:, s:]
            own += np.eye(own.shape[-1])
        self._scaled(A, C, D, min_scale, gauge)

    def _parts(self) -> Iterator[_Part]:
        """Derivatives of all observations, part by part; kept if they are few."""
        N = self.problem.detections.marker_of.size
        if self.known:
            yield from self.known
            return
        for first in range(0, N, _AT_ONCE):
            part = self._part(slice(first, first + _AT_ONCE))
            if N <= _MAX_KEPT:
                self.known.append(part)
            yield part

    def _part(self, at: slice) -> _Part:
        some = self.problem.rows(at)
        detections, root = some.detections, self.root[:, at, None, None]
        J = some.derivative(self.params) * root
        families = [_Family.by(detections.marker_of, J[..., -3:])]
        if some.tau is not None:
            G = some.joint_derivative(self.params) * (some.tau * root)
            families.insert(int(not self.by_pose), _Family.by(detections.pose_of, G))
        return _Part(at, J[..., :-3], families[0], families[1] if len(families) > 1 else None)

    def _add(self, part: _Part, A: FloatArray, C: FloatArray, D: FloatArray) -> None:
        """Add products of derivatives to the kept, crossed and eliminated blocks A, C, D."""
        s, other = self.problem.shared, part.kept
        D[part.gone.blocks] += part.gone.across(part.gone.J)
        if other is not None:
            width = other.J.shape[-1]
            at = s + width * np.arange(other.blocks.stop)[:, None] + np.arange(width)
            own = at[other.blocks]
        for v, columns in enumerate(self.problem.columns):
            J = part.shared[v].reshape(-1, len(columns))
            A[np.ix_(columns, columns)] += J.T @ J
            of_view = part.shared[[v]]
            C[part.gone.blocks, :, columns] += part.gone._replace(J=part.gone.J[[v]]).across(of_view)
            if other is not None:
                crossed = other._replace(J=other.J[[v]]).across(of_view).reshape(-1, len(columns))
                A[own.reshape(-1, 1), columns] += crossed
                A[columns[:, None], own.ravel()] += crossed.T
        if other is not None:
            A[own[:, :, None], own[:, None]] += other.across(other.J)
            rows = part.gone.of[:, None, None], np.arange(C.shape[1])[:, None], at[other.of][:, None]
            C[rows] += _products(part.gone.J, other.J)

    def _scaled(
        self, A: FloatArray, C: FloatArray, D: FloatArray, min_scale: FloatArray, gauge: FloatArray
    ) -> None:
        """Scale the parameters, by units no smaller than before, and tie the gauge (size, g)."""
        s, first = self.problem.shared, self.first
        of_gone = np.diagonal(D, axis1=1, axis2=2).ravel()
        markers = np.diagonal(A)[s:] if self.by_pose else of_gone
        diagonal = np.concatenate([np.diagonal(A)[first:s], markers])
        self.scale = np.maximum(min_scale, np.sqrt(np.maximum(diagonal, 1e-300)))
        shared, marker = self.scale[: s - first], self.scale[s - first :]
        kept = np.concatenate([shared, marker if self.by_pose else np.ones(len(A) - s)])
        gone = (np.ones(of_gone.size) if self.by_pose else marker).reshape(D.shape[:2])
        self.units = kept, gone
        self.A = A[first:, first:] / np.outer(kept, kept)
        # Work in place: with many markers this is most of the memory.
        self.C = C[:, :, first:]
        self.C[:, :, : len(kept)] /= kept
        self.C /= gone[:, :, None]
        self.D = D / (gone[:, :, None] * gone[:, None, :])
        # The prior of the offsets regularizes them; damping regularizes the other parameters.
        self.damped = np.arange(len(kept)) < (len(kept) if self.by_pose else s - first)
        if self.ties:
            G, ties = np.linalg.qr(self.scale[:, None] * gauge)[0], np.zeros((len(kept), self.ties))
            if self.by_pose:
                ties[:] = G
            else:
                ties[:s], self.C[:, :, len(kept) :] = G[:s], G[s:].reshape(*gone.shape, -1)
            self.A = np.block([[self.A, ties], [ties.T, -np.eye(self.ties)]])

    def step(self, damping: float) -> FloatArray | None:
        """Damped step (size or more,) with geodesic acceleration; None if the second order dominates."""
        descent, count = self.solved(damping), len(self.scale)
        if descent is None:
            return None
        velocity = descent(self.residual, self.strain, self.departure)
        if not np.isfinite(velocity).all():
            return None
        probe = self.problem.residual(self.problem.retract(self.params, _PROBE * self._whole(velocity)))
        bend = (2.0 / _PROBE) * ((probe - self.residual) / _PROBE - self.change(self._whole(velocity)))
        if not np.isfinite(bend).all():
            return None
        acceleration = descent(bend, np.zeros_like(self.strain), np.zeros_like(self.departure))
        if not np.linalg.norm(acceleration[:count]) <= _BEND * np.linalg.norm(velocity[:count]):
            return None
        return self._whole(velocity + 0.5 * acceleration)

    def solved(self, damping: float) -> Callable[[FloatArray, FloatArray, FloatArray], FloatArray] | None:
        """Solver that maps a change (V, N, 2) of images, strains (K, n) and departures (d,) to a step.

        The step undoes them, in units. None if the normal matrix is singular.
        """
        A, D = self.A.copy(), self.D + (0.0 if self.by_pose else damping) * np.eye(self.D.shape[1])
        A[np.arange(len(self.damped)), np.arange(len(self.damped))] += damping * self.damped
        try:
            root = np.linalg.cholesky(D)
            crossed = np.linalg.solve(root, self.C)
            flat = crossed.reshape(-1, len(A))
            factor = lu_factor(A - flat.T @ flat, check_finite=False)
        except np.linalg.LinAlgError:
            return None

        def descent(change: FloatArray, strain: FloatArray, departure: FloatArray) -> FloatArray:
            """Step of parameters in units, then of offsets in units of tau."""
            kept, gone = self._gradient(change, strain, departure)
            left = np.linalg.solve(root, gone[..., None])
            x = -lu_solve(factor, kept - flat.T @ left.ravel(), check_finite=False)
            y = -np.linalg.solve(root.swapaxes(1, 2), left + (crossed @ x)[..., None])[..., 0]
            return self._in_order(x, np.asarray(y, float))

        return descent

    def _gradient(
        self, change: FloatArray, strain: FloatArray, departure: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Gradients, in units, by the kept (k,) and the eliminated parameters (b, d)."""
        (kept, gone), problem, first = self.units, self.problem, self.first
        by_kept, by_gone = np.zeros(first + len(self.A)), np.zeros(gone.shape)
        width = 3 if self.by_pose else len(problem.q_reference)
        by_kept[: problem.shared] = departure @ self.stated
        others = by_kept[problem.shared : first + len(kept)].reshape(-1, width)
        for part in self._parts():
            weighed = self.root[:, part.at, None] * change[:, part.at]
            for v, columns in enumerate(problem.columns):
                by_kept[columns] += weighed[v].ravel() @ part.shared[v].reshape(-1, len(columns))
            by_gone[part.gone.blocks] += part.gone.gradient(weighed)
            if part.kept is not None:
                others[part.kept.blocks] += part.kept.gradient(weighed)
        if self.by_pose:
            by_gone += strain
        elif strain.size:
            others += strain
        by_kept = by_kept[first:]
        by_kept[: len(kept)] /= kept
        return by_kept, by_gone / gone

    def _in_order(self, kept: FloatArray, gone: FloatArray) -> FloatArray:
        """Order kept (k,) and eliminated parameters (b, d) as shared ones, markers, then offsets."""
        s = self.problem.shared - self.first
        others = kept[s : len(kept) - self.ties]
        families = [others, gone.ravel()] if self.by_pose else [gone.ravel(), others]
        return np.concatenate([kept[:s], *families])

    def _whole(self, step: FloatArray) -> FloatArray:
        """Undo the units of a step: all parameters, (size,), and offsets in units of tau."""
        count = len(self.scale)
        return np.concatenate([np.zeros(self.first), step[:count] / self.scale, step[count:]])

    def change(self, x: FloatArray) -> FloatArray:
        """First-order change (V, N, 2) of the weighted images by a step (size or more,)."""
        problem, result = self.problem, np.zeros_like(self.residual)
        shared, marker, offsets = np.split(x, [problem.shared, problem.size])
        families = [marker.reshape(-1, 3), offsets.reshape(problem.q.shape) if offsets.size else None]
        gone, kept = families[::-1] if self.by_pose else families
        for part in self._parts():
            for v, columns in enumerate(problem.columns):
                result[v, part.at] = part.shared[v] @ shared[columns]
            for family, values in ((part.gone, gone), (part.kept, kept)):
                if family is not None and values is not None:
                    result[:, part.at] += (family.J @ values[family.of][..., None])[..., 0]
        return result / np.maximum(self.root, 1e-150)[..., None]


def minimize(
    problem: LeastSquares,
    params: Parameters,
    rows: BoolArray,
    *,
    robust: bool,
    cameras: bool = True,
    max_steps: int = 200,
    stalled: Callable[[FloatArray], bool] = lambda residual: False,
) -> _Fit:
    """Minimize the squared residuals of some detections (V, N) from initial parameters.

    rows : (V, N) detections that count.
    robust : minimize a Cauchy loss instead, its width from the residuals of each step.
    cameras : adjust all parameters; False fixes the cameras and stops early.
    stalled : called with the residuals after each step, ends the search when true.
    """
    residual = problem.residual(params)
    weight = _weights(residual, rows, robust)
    scale = np.zeros(problem.size - (0 if cameras else params.P.size))
    min_change = (_SETTLED if cameras else _ROUGHLY) ** 2
    damping = 1e-3
    settled = False
    fresh = True
    flat = 0
    for _ in range(max_steps):
        if fresh:
            here = _Expansion(problem, params, residual, weight, scale)
            scale, cost = here.scale, _cost(weight, residual, problem.prior_squares(params))
            fresh = False
        x = here.step(damping)
        if x is not None:
            candidate = problem.retract(params, x)
            new_residual = problem.residual(candidate)
            new_cost = _cost(weight, new_residual, problem.prior_squares(candidate))
            fresh = bool(np.isfinite(new_cost)) and new_cost <= cost
            nearer = float(np.square(here.stated @ x[: problem.shared]).sum())
            moved = _cost(weight, here.change(x), nearer)
            settled = moved <= min_change * max(cost, _MIN_RESIDUAL**2 * float(weight.sum()))
            if fresh and not robust:
                flat = flat + 1 if cost - new_cost <= _NO_GAIN * cost else 0
                settled |= flat == _FLAT_STEPS
        if fresh:
            del here  # the next one takes as much memory again
            params, residual, weight = candidate, new_residual, _weights(new_residual, rows, robust)
            damping = max(0.1 * damping, _MIN_DAMPING)
            if stalled(residual):
                break
        else:
            damping *= 10.0
        if settled or damping > _MAX_DAMPING:
            break
    return _Fit(params, residual, _cost(weight, residual, problem.prior_squares(params)))


def fit_offsets(problem: LeastSquares, params: Parameters) -> Parameters:
    """Replace the joint offsets of each pose by the offsets of minimum Cauchy loss.

    Poses that do not count are fitted alike: their residuals then decide whether they should.
    """
    if problem.tau is None:
        return params
    for _ in range(_OFFSET_ROUNDS):
        residual = problem.residual(params)
        weight = _weights(residual, problem.detections.seen, robust=True)
        errors = JointErrors(problem, params, weight, problem.tau)
        offsets = problem.tau * errors.undoing(residual - errors.change(problem.strain(params)))
        params = dataclasses.replace(params, offsets=offsets)
    return params


def _weights(residual: FloatArray, rows: BoolArray, robust: bool) -> FloatArray:
    """Weights (V, N) of residuals (V, N, 2): one for some detections, or the weights of their Cauchy loss."""
    if not robust:
        return rows.astype(np.float64)
    distance = np.linalg.norm(residual, axis=2)
    width = _CAUCHY * max(float(np.median(distance[rows])) / RAYLEIGH, 1e-9)
    return np.where(rows, cauchy_weights((distance / width) ** 2), 0.0)


def _cost(weight: FloatArray, residual: FloatArray, of_priors: float) -> float:
    """Weighted sum of squares of residuals (V, N, 2), plus that of priors, px²."""
    return float((weight[..., None] * residual**2).sum()) + of_priors
