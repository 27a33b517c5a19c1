"""Bundle adjustment: cameras, screws and markers whose predicted images are nearest to those seen.

A scene lives in a frame that is metric up to a similarity (``a_inf`` is (0, 0, 0, 1), operators are
twists, markers end in one), so that all operators are conjugate to rigid motions by one common matrix by
construction. Both cameras are general 3×4 matrices. The frame is a means of writing the constraint down and
has no claim to truth: how it sits in the world is left to the images as far as they determine it.

Where joint readings err, the true joints of each pose are unknowns too, held to the readings by their noise.
Markers are eliminated from each step one by one, or these offsets pose by pose where they are more (Schur
complement), so that the cost is linear in the markers: W. A. Fuller, "Measurement error models", Wiley 1987,
section 3.2; B. Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6.

Levenberg–Marquardt with geodesic acceleration and a gauge penalty: M. Transtrum, J. Sethna,
"Improvements to the Levenberg–Marquardt algorithm", arXiv:1201.5885.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm, lu_factor, lu_solve
from scipy.sparse import csr_array

from projservo_cli.calibration.prediction import CAMERA, LENS, Scene, image_points
from projservo_cli.calibration.readings import RAYLEIGH, Readings, per_block
from projservo_cli.geometry.lens import FIRST, bent
from projservo_cli.records import BoolArray, Errors, FloatArray, IntArray


def cross_matrix(w: FloatArray) -> FloatArray:
    """Matrices (…, 3, 3) of the cross products with w (…, 3)."""
    return np.cross(w[..., None, :], np.eye(3)).swapaxes(-1, -2)


def _axis_of(H_hat: FloatArray) -> FloatArray:
    """Axes (…, 3) of the rotation parts of twists (…, 4, 4)."""
    return np.stack([H_hat[..., 2, 1], H_hat[..., 0, 2], H_hat[..., 1, 0]], axis=-1)


def _generators(scene: Scene) -> list[FloatArray]:
    """Rigid motions (b, 4, 4) that move each joint's screw: two turns and two shifts, a slide two turns."""
    H_hat, prismatic = scene.H_hat, scene.prismatic
    center = scene.M[:, :3].mean(axis=0)
    size = float(np.linalg.norm(scene.M[:, :3] - center, axis=1).mean()) or 1.0
    w = np.where(prismatic[:, None], H_hat[:, :3, 3], _axis_of(H_hat))
    w = w / np.linalg.norm(w, axis=1, keepdims=True)
    # Two unit vectors across w: from the coordinate axis farthest from it, so that neither is short.
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


def moved_operators(scene: Scene) -> list[FloatArray]:
    """Derivatives B Ĥ − Ĥ B (b, 4, 4) of each operator by the parameters of its joint."""
    return [B @ H_hat - H_hat @ B for B, H_hat in zip(_generators(scene), scene.H_hat, strict=True)]


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Images to explain, and where each parameter stands: both cameras, joints, both lenses, then markers.

    Residuals and derivatives are weighed, so that all have the noise of a pixel of weight one. The derivative
    of the images is compact: (2, N, 2, c) for each reading by the c parameters it depends on, the last three
    those of its marker.
    Offsets of joint readings come after the ``size`` parameters, (K, n) in units of ``tau``, in which their
    squares weigh as those of pixels.
    """

    readings: Readings  # what was seen
    q: FloatArray  # (K, n) joint values from the reference, rad or m
    q_reference: FloatArray  # (n,) the reference, rad or m
    joint: IntArray  # (n + 1,) first parameter of each joint, then of the lenses where these are sought
    shared: int  # number of parameters before those of the markers
    size: int  # number of parameters
    columns: IntArray  # (2, c - 3) parameters that all readings of a view depend on
    # (n,) noise of joint readings over that of pixels, rad/px or m/px; None where readings are exact
    tau: FloatArray | None = None

    @classmethod
    def of(cls, readings: Readings, q_reference: FloatArray, lens: bool = False) -> "LeastSquares":
        """Problem of explaining readings about the reference joints (n,), rad or m.

        12 parameters a camera, 4 a revolute and 2 a prismatic joint, 3 a marker, 2 a lens.
        """
        joint = 2 * CAMERA + np.concatenate([[0], np.cumsum(np.where(readings.prismatic, 2, 4))])
        count = LENS if lens else 0
        shared = int(joint[-1]) + 2 * count
        view = np.arange(2)[:, None]
        parts = (
            view * CAMERA + np.arange(CAMERA),
            np.broadcast_to(np.arange(joint[0], joint[-1]), (2, joint[-1] - joint[0])),
            joint[-1] + view * count + np.arange(count),
        )
        columns = np.concatenate(parts, axis=1)
        q = readings.q - q_reference
        return cls(readings, q, q_reference, joint, shared, shared + 3 * readings.marker.size, columns)

    def joints(self, scene: Scene) -> FloatArray:
        """Joint values (K, n) from the reference, rad or m; where they have noise with a scene's offsets."""
        return self.q if self.tau is None or scene.offsets is None else self.q + scene.offsets

    def strain(self, scene: Scene) -> FloatArray:
        """Offsets (K, n) of a scene in units of their noise, times that of pixels: px; none without noise."""
        if self.tau is None:
            return np.zeros((0, len(self.q_reference)))
        return np.zeros_like(self.q) if scene.offsets is None else np.asarray(scene.offsets / self.tau)

    def with_noise(self, tau: FloatArray | None) -> "LeastSquares":
        """The same problem with other noise of joints (n,) over that of pixels, rad/px or m/px."""
        return dataclasses.replace(self, tau=tau)

    @property
    def by_pose(self) -> bool:
        """Whether offsets of joints are eliminated pose by pose, being more than coordinates of markers."""
        return self.tau is not None and self.size - self.shared < self.q.size

    def rows(self, at: IntArray | slice) -> "LeastSquares":
        """The same problem with some of the sightings (N,); parameters stay."""
        return dataclasses.replace(self, readings=self.readings.rows(at))

    def of_markers(self, keep: BoolArray) -> "LeastSquares":
        """The same problem with some of the markers (m,) alone."""
        smaller = LeastSquares.of(
            self.readings.of_markers(keep), self.q_reference, self.shared > self.joint[-1]
        )
        return smaller.with_noise(self.tau)

    def pixels(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Predicted pixels (2, N, 2) of every sighting and their depths (2, N)."""
        readings = self.readings
        points = scene.moved(self.joints(scene), readings.pose_of, readings.marker_of)
        m = image_points(scene.P, points)
        pixels = m[..., :2] / m[..., 2:]
        return pixels if scene.lens is None else bent(scene.lens[:, None], pixels), m[..., 2]

    def residual(self, scene: Scene) -> FloatArray:
        """Predicted minus seen pixels (2, N, 2), weighed, zero where not seen."""
        readings = self.readings
        residual = np.where(readings.seen[..., None], self.pixels(scene)[0] - readings.pixels, 0.0)
        return np.asarray(residual * readings.weight[..., None])

    def derivative(self, scene: Scene) -> FloatArray:
        """Compact derivative (2, N, 2, c) of the weighed images, columns as in ``columns``.

        With Y_i the point behind joint i, D_i the derivative by it and B a generator, a joint contributes
        D_i (B Y_i − E_i B Y_{i+1}), where D_i E_i is D_{i+1}.
        """
        readings, q = self.readings, self.joints(scene)
        _, Y, by_camera, D, by_lens = scene.images(q, readings.pose_of, readings.marker_of)
        blocks = [by_camera]
        for i, B in enumerate(_generators(scene)):
            turn = B.transpose(2, 1, 0).reshape(4, -1)
            near, far = (D[k] @ (Y[k] @ turn).reshape(-1, 4, len(B)) for k in (i, i + 1))
            blocks.append(near - far)
        if by_lens is not None:
            blocks.append(by_lens)
        blocks.append(D[-1][..., :3])
        return np.concatenate(blocks, axis=3) * readings.weight[..., None, None]

    def joint_derivative(self, scene: Scene) -> FloatArray:
        """Derivative (2, N, 2, n) of the weighed images by the joint values."""
        images = scene.images(self.joints(scene), self.readings.pose_of, self.readings.marker_of)
        return images.by_joint(scene.H_hat) * self.readings.weight[..., None, None]

    def retract(self, scene: Scene, x: FloatArray) -> Scene:
        """Scene after a step x (size or more,); screws move as rigid bodies and keep their constraints."""
        x, further = x[: self.size], x[self.size :]
        steps = np.split(x[self.joint[0] : self.joint[-1]], self.joint[1:-1] - self.joint[0])
        twists = [np.tensordot(step, B, axes=1) for step, B in zip(steps, _generators(scene), strict=True)]
        motion = expm(np.array(twists))
        moved = motion @ scene.H_hat @ np.linalg.inv(motion)
        # Without the round-off of the step: speed and vanishing pitch restored.
        H_hat = np.zeros_like(moved)
        for i, slides in enumerate(scene.prismatic):
            v = moved[i, :3, 3]
            if slides:
                H_hat[i, :3, 3] = v * np.linalg.norm(scene.H_hat[i, :3, 3]) / np.linalg.norm(v)
            else:
                w = _axis_of(0.5 * (moved[i] - moved[i].T))
                w /= np.linalg.norm(w)
                H_hat[i, :3, :3] = cross_matrix(w)
                H_hat[i, :3, 3] = v - w * (w @ v)
        M = scene.M.copy()
        M[:, :3] += x[self.shared :].reshape(-1, 3)
        lens = scene.lens
        if lens is not None:
            lens = lens.copy()
            lens[:, FIRST:] += x[self.joint[-1] : self.shared].reshape(2, LENS)
        offsets = scene.offsets
        if self.tau is not None and further.size:
            offsets = (0.0 if offsets is None else offsets) + self.tau * further.reshape(self.q.shape)
        P = scene.P + x[: 2 * CAMERA].reshape(2, 3, 4)
        return Scene(P, H_hat, scene.prismatic, M, lens, offsets)

    def gauge(self, scene: Scene) -> FloatArray:
        """Directions (size, g) of the parameters that change no image, of unit norm each.

        Six rigid motions of the frame, its scale unless a prismatic joint sets it, and the cameras' scales.
        """
        motions = np.zeros((6 if scene.prismatic.any() else 7, 4, 4))
        motions[:3, :3, :3] = cross_matrix(np.eye(3))
        motions[3:6, :3, 3] = np.eye(3)
        motions[6:, :3, :3] = np.eye(3)
        result = np.zeros((self.size, len(motions) + 2))
        result[: 2 * CAMERA, :-2] = -(scene.P @ motions[:, None]).reshape(len(motions), -1).T
        for i, (H_hat, reach) in enumerate(zip(scene.H_hat, moved_operators(scene), strict=True)):
            wanted = (motions @ H_hat - H_hat @ motions).reshape(-1, 16).T
            found = np.linalg.lstsq(reach.reshape(-1, 16).T, wanted, rcond=None)[0]
            result[self.joint[i] : self.joint[i + 1], :-2] = found
        moved = (scene.M @ motions.swapaxes(1, 2))[..., :3]
        result[self.shared :, :-2] = moved.reshape(len(motions), -1).T
        for v in (0, 1):
            result[v * CAMERA : (v + 1) * CAMERA, v - 2] = scene.P[v].ravel()
        return np.asarray(result / np.linalg.norm(result, axis=0))

    def at_poses(self, values: FloatArray) -> FloatArray:
        """Sums (K, …) over the sightings of each pose of values (N, …)."""
        return per_block(self.readings.pose_of, values, len(self.q))

    def dense(self, J: FloatArray, mask: BoolArray) -> FloatArray:
        """The whole derivative (4 N, size), zero outside a mask (2, N), for what needs more than JᵀJ."""
        result = np.zeros((*J.shape[:3], self.size))
        J = J * mask[..., None, None]
        for v in (0, 1):
            result[v][..., self.columns[v]] = J[v, ..., :-3]
        own = self.shared + 3 * self.readings.marker_of[None, :, None, None] + np.arange(3)
        np.put_along_axis(result, own, J[..., -3:], axis=3)
        return result.reshape(-1, self.size)

    def predicted(self, scene: Scene, errors: Errors) -> tuple[FloatArray, FloatArray]:
        """Change of the images by ``errors``: (2, N, 2, r) all feel, (2, N, 2, 3) are a marker's own."""
        J, marker_of = self.derivative(scene), self.readings.marker_of
        common = J[..., -3:] @ errors.marker[marker_of]
        for v in (0, 1):
            common[v] += J[v, ..., :-3] @ errors.shared[self.columns[v]]
        return common, J[..., -3:] @ errors.own[marker_of]

    def whitened(self, scene: Scene, rows: FloatArray, mask: BoolArray) -> FloatArray:
        """S^-½ times rows (4 N, c) of coordinates in a mask (2, N), S = I + G τ² Gᵀ of each pose."""
        return rows if self.tau is None else JointErrors(self, scene, mask, self.tau).whitened(rows)


class JointErrors:
    """First order of the images about a scene by errors of joint readings, (K, n) in units (n,), rad or m.

    Of each pose √w G = U s Vᵀ, with weights w (2, N) and derivatives G (2, N, 2, n); the covariance of the
    images by errors of unit variance is I + G Gᵀ.
    """

    def __init__(self, problem: LeastSquares, scene: Scene, weight: FloatArray | BoolArray, unit: FloatArray):
        (K, n), self.pose_of = problem.q.shape, problem.readings.pose_of
        root = np.sqrt(weight)[..., None, None]
        self.G = problem.joint_derivative(scene) * unit
        weighted = root * self.G
        self.V = np.linalg.eigh(problem.at_poses((np.swapaxes(weighted, 2, 3) @ weighted).sum(axis=0)))[1]
        along = weighted @ self.V[self.pose_of]
        self.square: FloatArray = problem.at_poses((along**2).sum(axis=(0, 2)))  # (K, n): s²
        rows = root * along / np.sqrt(np.maximum(self.square, 1e-300))[self.pose_of][:, None]
        columns = np.broadcast_to(n * self.pose_of[:, None, None] + np.arange(n), rows.shape)
        starts = np.arange(0, rows.size + 1, n)
        self._U = csr_array((rows.ravel(), columns.ravel(), starts), shape=(rows.size // n, K * n))

    def parts(self, rows: FloatArray) -> FloatArray:
        """Uᵀ √w rows (4 N, …): (K n, …)."""
        return np.asarray(self._U.T @ rows)

    def whitened(self, rows: FloatArray) -> FloatArray:
        """(I + G Gᵀ)^-½ rows (4 N, c), for weights of zero and one, in coordinates that count."""
        share = 1.0 - 1.0 / np.sqrt(1.0 + self.square.reshape(-1, 1))
        return np.asarray(rows - self._U @ (share * self.parts(rows)))

    def undoing(self, change: FloatArray) -> FloatArray:
        """The errors (K, n) of unit variance that best undo a change (2, N, 2) of the images."""
        parts = self.parts(change.ravel()).reshape(self.square.shape)
        return -np.asarray((self.V @ (np.sqrt(self.square) / (1.0 + self.square) * parts)[..., None])[..., 0])

    def change(self, errors: FloatArray) -> FloatArray:
        """Change (2, N, 2) of the images by errors (K, n)."""
        return np.asarray((self.G @ errors[self.pose_of][..., None])[..., 0])


# Largest ratio of second-order to first-order step, and the probe of the second derivative, as by the source.
_BEND, _PROBE = 0.75, 0.1
_LEAST_DAMPING, _MOST_DAMPING = 1e-15, 1e8
# A step that moves the predicted images by less than this fraction of the residual is the last: of a whole
# search, and of one with the cameras held, which only begins one.
_SETTLED, _ROUGHLY = 1e-7, 1e-2
# Residuals below this, px, are round-off for the purpose of that rule: pixels have some 1e-13 of it.
_LEAST_RESIDUAL = 1e-5

# Width of the Cauchy loss in robust standard deviations: 95 % efficient on normal residuals.
_CAUCHY = 2.385


@dataclass(frozen=True, eq=False)
class _Fit:
    """A scene, and how well it explains the images."""

    scene: Scene  # the model
    residual: FloatArray  # (2, N, 2) predicted minus seen, px, zero where not seen
    cost: float  # weighted sum of squares, px²


class _Family(NamedTuple):
    """Parameters of which a sighting depends on one block alone: markers, or offsets of joints at a pose."""

    of: IntArray  # (N,) block of a sighting
    J: FloatArray  # (2, N, 2, d) derivatives by it, weighed
    blocks: slice  # from the first to the last of these, b in all
    sums: csr_array  # (b, N) adds up the sightings of each block

    @classmethod
    def by(cls, of: IntArray, J: FloatArray) -> "_Family":
        """Of derivatives by blocks."""
        first, N = int(of.min()), len(of)
        sums = csr_array((np.ones(N), (of - first, np.arange(N))))
        return cls(of, J, slice(first, first + sums.shape[0]), sums)

    def added(self, values: FloatArray) -> FloatArray:
        """Sums (b, …) over the sightings of each block of values (N, …)."""
        flat = self.sums @ values.reshape(len(values), -1)
        return np.asarray(flat.reshape(self.sums.shape[0], *values.shape[1:]))

    def across(self, others: FloatArray) -> FloatArray:
        """Products (b, d, c) of its derivatives with others (2, N, 2, c) over all sightings of each block."""
        return self.added(_products(self.J, others))

    def gradient(self, change: FloatArray) -> FloatArray:
        """Products (b, d) of its derivatives with a weighed change (2, N, 2) of the images."""
        return self.across(change[..., None])[..., 0]


def _products(J: FloatArray, others: FloatArray) -> FloatArray:
    """Products (N, d, c) of derivatives (v, N, 2, d) with others (v, N, 2, c) of the same sightings."""
    N = J.shape[1]
    a, b = (part.swapaxes(0, 1).reshape(N, -1, part.shape[-1]) for part in (J, others))
    return np.asarray(a.swapaxes(1, 2) @ b)


class _Part(NamedTuple):
    """Derivatives of some sightings, weighed by the roots of their weights."""

    at: slice  # of the sightings
    shared: FloatArray  # (2, N, 2, c - 3) by what all sightings of a view depend on
    gone: _Family  # eliminated
    kept: _Family | None  # the other family


# Sightings that are derived at once, in some 50 MB, and of which the derivatives are kept: some 80 MB.
_AT_ONCE, _MOST_KEPT = 2**13, 2**16


class _Expansion:
    """First order of the images about a scene, with weights (2, N), by the parameters from a first one on.

    In units in which the diagonal of the normal matrix is at most one. One of both families of blocks is
    eliminated, so that what is solved has the size of the other one and of what all sightings share. The
    gauge is tied by a penalty, as multipliers beside them.
    """

    def __init__(
        self, problem: LeastSquares, scene: Scene, residual: FloatArray, weight: FloatArray, least: FloatArray
    ) -> None:
        self.problem, self.scene, self.residual = problem, scene, residual
        self.root, self.first = np.sqrt(weight), problem.size - len(least)
        m, offsets = len(scene.M), 0 if problem.tau is None else problem.q.size
        self.by_pose = problem.by_pose
        self.strain = problem.strain(scene)
        self.known: list[_Part] = []
        s, size = problem.shared, 3 * m if self.by_pose else offsets
        blocks, width = problem.q.shape if self.by_pose else (m, 3)
        gauge = problem.gauge(scene) if self.first == 0 else np.zeros((problem.size, 0))
        self.ties = gauge.shape[1]
        A, C = np.zeros((s + size, s + size)), np.zeros((blocks, width, s + size + self.ties))
        D = np.zeros((blocks, width, width))
        for part in self._parts():
            self._add(part, A, C, D)
        if offsets:  # what readings say of them
            own = D if self.by_pose else A[s:, s:]
            own += np.eye(own.shape[-1])
        self._scaled(A, C, D, least, gauge)

    def _parts(self) -> Iterator[_Part]:
        """Derivatives of all sightings, part by part; kept where they are few."""
        N = self.problem.readings.marker_of.size
        if self.known:
            yield from self.known
            return
        for first in range(0, N, _AT_ONCE):
            part = self._part(slice(first, first + _AT_ONCE))
            if N <= _MOST_KEPT:
                self.known.append(part)
            yield part

    def _part(self, at: slice) -> _Part:
        some = self.problem.rows(at)
        readings, root = some.readings, self.root[:, at, None, None]
        J = some.derivative(self.scene) * root
        families = [_Family.by(readings.marker_of, J[..., -3:])]
        if some.tau is not None:
            G = some.joint_derivative(self.scene) * (some.tau * root)
            families.insert(int(not self.by_pose), _Family.by(readings.pose_of, G))
        return _Part(at, J[..., :-3], families[0], families[1] if len(families) > 1 else None)

    def _add(self, part: _Part, A: FloatArray, C: FloatArray, D: FloatArray) -> None:
        """Add the products of the derivatives of some sightings to what is kept, crossed and eliminated."""
        s, other = self.problem.shared, part.kept
        D[part.gone.blocks] += part.gone.across(part.gone.J)
        if other is not None:
            width = other.J.shape[-1]
            at = s + width * np.arange(other.blocks.stop)[:, None] + np.arange(width)
            own = at[other.blocks]
        for v, columns in enumerate(self.problem.columns):
            J = part.shared[v].reshape(-1, len(columns))
            A[np.ix_(columns, columns)] += J.T @ J
            one = part.shared[[v]]
            C[part.gone.blocks, :, columns] += part.gone._replace(J=part.gone.J[[v]]).across(one)
            if other is not None:
                crossed = other._replace(J=other.J[[v]]).across(one).reshape(-1, len(columns))
                A[own.reshape(-1, 1), columns] += crossed
                A[columns[:, None], own.ravel()] += crossed.T
        if other is not None:
            A[own[:, :, None], own[:, None]] += other.across(other.J)
            rows = part.gone.of[:, None, None], np.arange(C.shape[1])[:, None], at[other.of][:, None]
            C[rows] += _products(part.gone.J, other.J)

    def _scaled(
        self, A: FloatArray, C: FloatArray, D: FloatArray, least: FloatArray, gauge: FloatArray
    ) -> None:
        """Take units of the parameters, no smaller than before, and tie the gauge (size, g)."""
        s, first = self.problem.shared, self.first
        of_gone = np.diagonal(D, axis1=1, axis2=2).ravel()
        markers = np.diagonal(A)[s:] if self.by_pose else of_gone
        diagonal = np.concatenate([np.diagonal(A)[first:s], markers])
        self.scale = np.maximum(least, np.sqrt(np.maximum(diagonal, 1e-300)))
        shared, marker = self.scale[: s - first], self.scale[s - first :]
        kept = np.concatenate([shared, marker if self.by_pose else np.ones(len(A) - s)])
        gone = (np.ones(of_gone.size) if self.by_pose else marker).reshape(D.shape[:2])
        self.units = kept, gone
        self.A = A[first:, first:] / np.outer(kept, kept)
        # In place: this is most of what is held where markers are many.
        self.C = C[:, :, first:]
        self.C[:, :, : len(kept)] /= kept
        self.C /= gone[:, :, None]
        self.D = D / (gone[:, :, None] * gone[:, None, :])
        # Offsets are held by their own noise, all else is damped.
        self.damped = np.arange(len(kept)) < (len(kept) if self.by_pose else s - first)
        if self.ties:
            G, held = np.linalg.qr(self.scale[:, None] * gauge)[0], np.zeros((len(kept), self.ties))
            if self.by_pose:
                held[:] = G
            else:
                held[:s], self.C[:, :, len(kept) :] = G[:s], G[s:].reshape(*gone.shape, -1)
            self.A = np.block([[self.A, held], [held.T, -np.eye(self.ties)]])

    def step(self, damping: float) -> FloatArray | None:
        """Damped step (size or more,) with geodesic acceleration; None where second outweighs first order."""
        descent, count = self.solved(damping), len(self.scale)
        if descent is None:
            return None
        velocity = descent(self.residual, self.strain)
        if not np.isfinite(velocity).all():
            return None
        probe = self.problem.residual(self.problem.retract(self.scene, _PROBE * self._whole(velocity)))
        bend = (2.0 / _PROBE) * ((probe - self.residual) / _PROBE - self.change(self._whole(velocity)))
        if not np.isfinite(bend).all():
            return None
        acceleration = descent(bend, np.zeros_like(self.strain))
        if not np.linalg.norm(acceleration[:count]) <= _BEND * np.linalg.norm(velocity[:count]):
            return None
        return self._whole(velocity + 0.5 * acceleration)

    def solved(self, damping: float) -> Callable[[FloatArray, FloatArray], FloatArray] | None:
        """What undoes a change (2, N, 2) of images and strains (K, n), in units; None where nothing does."""
        A, D = self.A.copy(), self.D + (0.0 if self.by_pose else damping) * np.eye(self.D.shape[1])
        A[np.arange(len(self.damped)), np.arange(len(self.damped))] += damping * self.damped
        try:
            root = np.linalg.cholesky(D)
            crossed = np.linalg.solve(root, self.C)
            flat = crossed.reshape(-1, len(A))
            factor = lu_factor(A - flat.T @ flat, check_finite=False)
        except np.linalg.LinAlgError:
            return None

        def descent(change: FloatArray, strain: FloatArray) -> FloatArray:
            """Step of parameters in units, then of offsets in those of tau."""
            kept, gone = self._gradient(change, strain)
            left = np.linalg.solve(root, gone[..., None])
            x = -lu_solve(factor, kept - flat.T @ left.ravel(), check_finite=False)
            y = -np.linalg.solve(root.swapaxes(1, 2), left + (crossed @ x)[..., None])[..., 0]
            return self._in_order(x, np.asarray(y, float))

        return descent

    def _gradient(self, change: FloatArray, strain: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradients, in units, of what is kept (k,) and eliminated (b, d), by a change and by strains."""
        (kept, gone), problem, first = self.units, self.problem, self.first
        by_kept, by_gone = np.zeros(first + len(self.A)), np.zeros(gone.shape)
        width = 3 if self.by_pose else len(problem.q_reference)
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
        """Shared parameters, markers, then offsets, of what is kept (k,) and eliminated (b, d)."""
        s = self.problem.shared - self.first
        others = kept[s : len(kept) - self.ties]
        families = [others, gone.ravel()] if self.by_pose else [gone.ravel(), others]
        return np.concatenate([kept[:s], *families])

    def _whole(self, step: FloatArray) -> FloatArray:
        """Step of all parameters, (size,), and of offsets in units of tau, from one in units."""
        count = len(self.scale)
        return np.concatenate([np.zeros(self.first), step[:count] / self.scale, step[count:]])

    def change(self, x: FloatArray) -> FloatArray:
        """First-order change (2, N, 2) of the weighed images by a step (size or more,)."""
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
    scene: Scene,
    rows: BoolArray,
    *,
    robust: bool,
    cameras: bool = True,
    most: int = 200,
    stalled: Callable[[FloatArray], bool] = lambda residual: False,
) -> _Fit:
    """Least squares of some readings (2, N) from a scene, over all parameters or roughly with cameras held.

    Under a Cauchy loss if ``robust``, its width from the residuals of each step. ``stalled``, told these, may
    end the search; a step that moves the images by less than a share of the residual is the last.
    """
    residual = problem.residual(scene)
    weight = _weights(residual, rows, robust)
    scale = np.zeros(problem.size - (0 if cameras else 2 * CAMERA))
    least_change = (_SETTLED if cameras else _ROUGHLY) ** 2
    damping = 1e-3
    settled = False
    fresh = True
    for _ in range(most):
        if fresh:
            here = _Expansion(problem, scene, residual, weight, scale)
            scale, cost = here.scale, _cost(weight, residual, problem.strain(scene))
            fresh = False
        x = here.step(damping)
        if x is not None:
            candidate = problem.retract(scene, x)
            new_residual = problem.residual(candidate)
            new_cost = _cost(weight, new_residual, problem.strain(candidate))
            fresh = bool(np.isfinite(new_cost)) and new_cost <= cost
            moved = _cost(weight, here.change(x), np.zeros(0))
            settled = moved <= least_change * max(cost, _LEAST_RESIDUAL**2 * float(weight.sum()))
        if fresh:
            del here  # before the next takes as much again
            scene, residual, weight = candidate, new_residual, _weights(new_residual, rows, robust)
            damping = max(0.1 * damping, _LEAST_DAMPING)
            if stalled(residual):
                break
        else:
            damping *= 10.0
        if settled or damping > _MOST_DAMPING:
            break
    return _Fit(scene, residual, _cost(weight, residual, problem.strain(scene)))


_SETTLING = 8


def settled(problem: LeastSquares, scene: Scene) -> Scene:
    """The scene with the offsets of each pose that explain its images best, under a Cauchy loss.

    Of poses that count and of those that do not, alike: whether they should is asked of what that leaves.
    """
    if problem.tau is None:
        return scene
    for _ in range(_SETTLING):
        residual = problem.residual(scene)
        weight = _weights(residual, problem.readings.seen, robust=True)
        errors = JointErrors(problem, scene, weight, problem.tau)
        offsets = problem.tau * errors.undoing(residual - errors.change(problem.strain(scene)))
        scene = dataclasses.replace(scene, offsets=offsets)
    return scene


def _weights(residual: FloatArray, rows: BoolArray, robust: bool) -> FloatArray:
    """Weights (2, N) of residuals (2, N, 2): one for some readings, or those of their Cauchy loss."""
    if not robust:
        return rows.astype(np.float64)
    distance = np.linalg.norm(residual, axis=2)
    width = _CAUCHY * max(float(np.median(distance[rows])) / RAYLEIGH, 1e-9)
    return np.where(rows, 1.0 / (1.0 + (distance / width) ** 2), 0.0)


def _cost(weight: FloatArray, residual: FloatArray, strain: FloatArray) -> float:
    """Weighted sum of squares of residuals (2, N, 2), and that of strains (K, n) if any, px²."""
    return float((weight[..., None] * residual**2).sum()) + float((strain**2).sum())
