"""Bundle adjustment: cameras, screws and markers whose predicted images are nearest to those seen.

A scene lives in a frame that is metric up to a similarity (``a_inf`` is (0, 0, 0, 1), operators are
twists), so that all operators are conjugate to rigid motions by one common matrix by construction.
Both cameras are general 3×4 matrices. The frame is a means of writing the constraint down and has no
claim to truth: how it sits in the world is left to the images as far as they determine it.

Levenberg–Marquardt with geodesic acceleration and a gauge penalty: M. Transtrum, J. Sethna,
"Improvements to the Levenberg–Marquardt algorithm", arXiv:1201.5885.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, expm

from projservo_cli.calibration.prediction import (
    CAMERA,
    LENS,
    displacements,
    image_points,
    moved_points,
    projection_derivative,
)
from projservo_cli.calibration.readings import Readings
from projservo_cli.geometry.lens import FIRST, bent
from projservo_cli.records import BoolArray, FloatArray, IntArray


def cross_matrix(w: FloatArray) -> FloatArray:
    """Matrices (…, 3, 3) of the cross products with w (…, 3)."""
    S = np.zeros((*w.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return S - np.swapaxes(S, -1, -2)


def _axis_of(H_hat: FloatArray) -> FloatArray:
    """Axes (…, 3) of the rotation parts of twists (…, 4, 4)."""
    return np.stack([H_hat[..., 2, 1], H_hat[..., 0, 2], H_hat[..., 1, 0]], axis=-1)


@dataclass(frozen=True, eq=False)
class Scene:
    """What the adjustment varies."""

    P: FloatArray  # (2, 3, 4) cameras to pixels
    H_hat: FloatArray  # (n, 4, 4) twists at the reference: unit rotations without pitch, or translations
    M: FloatArray  # (m, 4) markers at the reference, last coordinate one
    lens: FloatArray | None = None  # (2, 5) lenses, of which k1 and k2 vary; None where none is sought

    def generators(self, prismatic: BoolArray) -> list[FloatArray]:
        """Rigid motions (b, 4, 4) that move each joint's screw: four for an axis, two for a direction.

        An axis turns about its point nearest to the markers and shifts across itself; a direction turns.
        """
        center = self.M[:, :3].mean(axis=0)
        size = float(np.linalg.norm(self.M[:, :3] - center, axis=1).mean()) or 1.0
        H_hat = self.H_hat
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


@dataclass(frozen=True, eq=False)
class Problem:
    """Images to explain, and where each parameter stands: both cameras, joints, markers, then both lenses.

    The derivative of the images is compact: (2, N, 2, c) for each reading by the c parameters it depends on.
    """

    readings: Readings  # what was seen
    q: FloatArray  # (K, n) joint values from the reference, rad or m
    q_reference: FloatArray  # (n,) the reference, rad or m
    joint: IntArray  # (n + 1,) first parameter of each joint, then of the markers
    lens: int  # first parameter of the lenses; ``size`` where none is sought
    size: int  # number of parameters
    groups: tuple[slice, ...]  # rows of each marker, as slices of the lists of ``Readings``
    columns: IntArray  # (2, m, c) parameters that the images of a marker in a view depend on

    def pixels(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Predicted pixels (2, N, 2) of every sighting and their depths (2, N)."""
        m = image_points(scene.P, self.carried(scene)[1][0])
        pixels = m[..., :2] / m[..., 2:]
        return pixels if scene.lens is None else bent(scene.lens[:, None], pixels), m[..., 2]

    def residual(self, scene: Scene) -> FloatArray:
        """Predicted minus seen pixels (2, N, 2), zero where not seen."""
        result: FloatArray = np.where(
            self.readings.seen[..., None], self.pixels(scene)[0] - self.readings.pixels, 0.0
        )
        return result

    def carried(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Displacements (n, N, 4, 4) at each sighting, and its point behind each joint (n + 1, N, 4)."""
        readings = self.readings
        E = displacements(scene.H_hat, readings.prismatic, self.q)[:, readings.pose_of]
        return E, moved_points(E, scene.M[readings.marker_of][:, None])[:, :, 0]

    def derivative(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Pixels (2, N, 2) and their compact derivative (2, N, 2, c), [RH00] eq. (7) carried through eq. (6).

        With Y_i the point behind joint i, D_i the image derivative carried to it and B a generator, a joint
        contributes D_i (B Y_i − E_i B Y_{i+1}). Columns are those of ``Problem.columns``.
        """
        E, Y = self.carried(scene)
        pixels, G, by_lens = projection_derivative(scene.P, scene.lens, Y[0])
        blocks = [(G[..., None] * Y[0][:, None, None, :]).reshape(*G.shape[:3], CAMERA)]
        D = G @ scene.P[:, None]
        for i, B in enumerate(scene.generators(self.readings.prismatic)):
            before = D @ np.einsum("bij,Nj->Nib", B, Y[i])
            D = D @ E[i]
            blocks.append(before - D @ np.einsum("bij,Nj->Nib", B, Y[i + 1]))
        blocks.append(D[..., :3])
        if by_lens is not None:
            blocks.append(by_lens)
        return pixels, np.concatenate(blocks, axis=3)

    def joint_derivative(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Pixels (2, N, 2) and their derivative (2, N, 2, n) by the joint values, [RH00] eqs. (7), (19)."""
        E, Y = self.carried(scene)
        pixels, G, _ = projection_derivative(scene.P, scene.lens, Y[0])
        D = G @ scene.P[:, None]
        J = np.empty((*pixels.shape, len(E)))
        for i in range(len(E)):
            J[..., i] = np.einsum("vNrc,Nc->vNr", D, Y[i] @ scene.H_hat[i].T)
            D = D @ E[i]
        return pixels, J

    def retract(self, scene: Scene, x: FloatArray) -> Scene:
        """Scene after a step x (size,); screws move as rigid bodies and keep their constraints."""
        prismatic = self.readings.prismatic
        steps = np.split(x[self.joint[0] : self.joint[-1]], self.joint[1:-1] - self.joint[0])
        twists = [
            np.tensordot(step, B, axes=1) for step, B in zip(steps, scene.generators(prismatic), strict=True)
        ]
        motion = expm(np.array(twists))
        moved = motion @ scene.H_hat @ np.linalg.inv(motion)
        # Without the round-off of the step: speed and vanishing pitch restored.
        H_hat = np.zeros_like(moved)
        for i, slides in enumerate(prismatic):
            v = moved[i, :3, 3]
            if slides:
                H_hat[i, :3, 3] = v * np.linalg.norm(scene.H_hat[i, :3, 3]) / np.linalg.norm(v)
            else:
                w = _axis_of(0.5 * (moved[i] - moved[i].T))
                w /= np.linalg.norm(w)
                H_hat[i, :3, :3] = cross_matrix(w)
                H_hat[i, :3, 3] = v - w * (w @ v)
        M = scene.M.copy()
        M[:, :3] += x[self.joint[-1] : self.lens].reshape(-1, 3)
        lens = scene.lens
        if lens is not None:
            lens = lens.copy()
            lens[:, FIRST:] += x[self.lens :].reshape(2, LENS)
        return Scene(scene.P + x[: 2 * CAMERA].reshape(2, 3, 4), H_hat, M, lens)

    def gauge(self, scene: Scene) -> FloatArray:
        """Directions (size, g) of the parameters that change no image, of unit norm each.

        Six rigid motions of the frame, its scale unless a prismatic joint sets it, and the cameras' scales.
        """
        prismatic = self.readings.prismatic
        motions = np.zeros((6 if prismatic.any() else 7, 4, 4))
        motions[:3, :3, :3] = cross_matrix(np.eye(3))
        motions[3:6, :3, 3] = np.eye(3)
        motions[6:, :3, :3] = np.eye(3)
        bases = scene.generators(prismatic)
        result = np.zeros((self.size, len(motions) + 2))
        for k, Z in enumerate(motions):
            result[: 2 * CAMERA, k] = -(scene.P @ Z).ravel()
            for i, B in enumerate(bases):
                wanted = (Z @ scene.H_hat[i] - scene.H_hat[i] @ Z).ravel()
                reach = (B @ scene.H_hat[i] - scene.H_hat[i] @ B).reshape(len(B), 16).T
                result[self.joint[i] : self.joint[i + 1], k] = np.linalg.lstsq(reach, wanted, rcond=None)[0]
            result[self.joint[-1] : self.lens, k] = (scene.M @ Z.T)[:, :3].ravel()
        for v in (0, 1):
            result[v * CAMERA : (v + 1) * CAMERA, len(motions) + v] = scene.P[v].ravel()
        directions: FloatArray = result / np.linalg.norm(result, axis=0)
        return directions

    def scaled_normal(
        self, scene: Scene, J: FloatArray, weight: FloatArray, first: int, least: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Normal matrix from a first parameter on, its diagonal at most one and the gauge tied; its units."""
        A = self.normal(J, weight)[first:, first:]
        scale = np.maximum(least, np.sqrt(np.maximum(np.diagonal(A), 1e-300)))
        A = A / np.outer(scale, scale)
        if first == 0:
            G = np.linalg.qr(scale[:, None] * self.gauge(scene))[0]
            A += G @ G.T
        return A, scale

    def normal(self, J: FloatArray, weight: FloatArray) -> FloatArray:
        """Normal matrix Jᵀ W J (size, size) from the compact derivative, one marker and view at a time."""
        A = np.zeros((self.size, self.size))
        for v, j, rows in self._blocks():
            block = J[v, rows].reshape(-1, J.shape[-1])
            columns = self.columns[v, j]
            A[np.ix_(columns, columns)] += (block.T * np.repeat(weight[v, rows], 2)) @ block
        return A

    def gradient(self, J: FloatArray, weighted: FloatArray) -> FloatArray:
        """Jᵀ times weighted residuals (2, N, 2): (size,)."""
        g = np.zeros(self.size)
        for v, j, rows in self._blocks():
            g[self.columns[v, j]] += weighted[v, rows].ravel() @ J[v, rows].reshape(-1, J.shape[-1])
        return g

    def change(self, J: FloatArray, x: FloatArray) -> FloatArray:
        """J times a step: first-order change (2, N, 2) of the images."""
        result = np.empty(J.shape[:3])
        for v, j, rows in self._blocks():
            result[v, rows] = J[v, rows] @ x[self.columns[v, j]]
        return result

    def dense(self, J: FloatArray, mask: BoolArray) -> FloatArray:
        """The whole derivative (4 N, size), zero outside a mask (2, N), for what needs more than JᵀJ."""
        result = np.zeros((*J.shape[:3], self.size))
        for v, j, rows in self._blocks():
            block = J[v, rows] * mask[v, rows, None, None]
            result[v, rows, :, self.columns[v, j]] = np.moveaxis(block, 2, 0)
        return result.reshape(-1, self.size)

    def _blocks(self) -> list[tuple[int, int, slice]]:
        """View, marker and rows of each part of the derivative whose columns are the same."""
        return [(v, j, rows) for v in (0, 1) for j, rows in enumerate(self.groups)]


def prepare(readings: Readings, q_reference: FloatArray, lens: bool = False) -> Problem:
    """Problem of explaining readings about the reference joints (n,), rad or m.

    12 parameters a camera, 4 a revolute and 2 a prismatic joint, 3 a marker, 2 a lens.
    """
    joint = 2 * CAMERA + np.concatenate([[0], np.cumsum(np.where(readings.prismatic, 2, 4))])
    m = readings.marker.size
    edges = np.searchsorted(readings.marker_of, np.arange(m + 1))
    groups = tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(edges))
    first = int(joint[-1]) + 3 * m
    count = LENS if lens else 0
    columns = np.empty((2, m, CAMERA + joint[-1] - joint[0] + 3 + count), dtype=np.int64)
    for v, j in np.ndindex(2, m):
        camera, own_lens = v * CAMERA + np.arange(CAMERA), first + v * count + np.arange(count)
        joints, marker = np.arange(joint[0], joint[-1]), joint[-1] + 3 * j + np.arange(3)
        columns[v, j] = np.r_[camera, joints, marker, own_lens]
    q = readings.q - q_reference
    return Problem(readings, q, q_reference, joint, first, first + 2 * count, groups, columns)


# Largest ratio of second-order to first-order step, and the probe of the second derivative, as by the source.
_BEND, _PROBE = 0.75, 0.1
LEAST_DAMPING = 1e-15
_MOST_DAMPING = 1e8
# A step that moves the predicted images by less than this fraction of the residual is the last.
SETTLED = 1e-7
# Residuals below this, px, are round-off for the purpose of that rule: pixels have some 1e-13 of it.
_LEAST_RESIDUAL = 1e-5

Weighting = Callable[[FloatArray], FloatArray]
Stalled = Callable[[FloatArray], bool]


@dataclass(frozen=True, eq=False)
class _Fit:
    """A scene, and how well it explains the images."""

    scene: Scene  # the model
    residual: FloatArray  # (2, N, 2) predicted minus seen, px, zero where not seen
    cost: float  # weighted sum of squares, px²


class _Expansion(NamedTuple):
    """A scene, residuals (2, N, 2), weights (2, N), derivative, and the normal matrix in units of a scale."""

    scene: Scene
    residual: FloatArray
    weight: FloatArray
    J: FloatArray
    A: FloatArray
    scale: FloatArray


def minimize(
    problem: Problem,
    scene: Scene,
    weighting: Weighting,
    *,
    cameras: bool = True,
    most: int = 200,
    settled_at: float = SETTLED,
    stalled: Stalled = lambda residual: False,
) -> _Fit:
    """Weighted least squares from a scene over all parameters, or with the cameras held.

    Weights (2, N) come from residuals (2, N, 2) anew after each accepted step, and ``stalled``, told the
    same, may end the search; a step that moves the images by less than a share of the residual is the last.
    """
    first = 0 if cameras else 2 * CAMERA
    residual = problem.residual(scene)
    weight = weighting(residual)
    scale = np.zeros(problem.size - first)
    damping = 1e-3
    settled = False
    fresh = True
    for _ in range(most):
        if fresh:
            J = problem.derivative(scene)[1]
            A, scale = problem.scaled_normal(scene, J, weight, first, scale)
            here = _Expansion(scene, residual, weight, J, A, scale)
            cost = _cost(weight, residual)
            fresh = False
        x = _step(problem, here, damping)
        if x is not None:
            candidate = problem.retract(scene, x)
            new_residual = problem.residual(candidate)
            new_cost = _cost(weight, new_residual)
            fresh = bool(np.isfinite(new_cost)) and new_cost <= cost
            moved = _cost(weight, problem.change(J, x))
            settled = moved <= settled_at**2 * max(cost, _LEAST_RESIDUAL**2 * float(weight.sum()))
        if fresh:
            scene, residual, weight = candidate, new_residual, weighting(new_residual)
            damping = max(0.1 * damping, LEAST_DAMPING)
            if stalled(residual):
                break
        else:
            damping *= 10.0
        if settled or damping > _MOST_DAMPING:
            break
    return _Fit(scene, residual, _cost(weight, residual))


def _cost(weight: FloatArray, residual: FloatArray) -> float:
    """Weighted sum of squares of residuals (2, N, 2), px²."""
    return float((weight[..., None] * residual**2).sum())


def _step(problem: Problem, here: _Expansion, damping: float) -> FloatArray | None:
    """Damped step with geodesic acceleration, or None where the second order outweighs the first."""
    try:
        factor = cho_factor(here.A + damping * np.eye(len(here.A)))
    except np.linalg.LinAlgError:
        return None
    held = np.zeros(problem.size - len(here.scale))

    def descent(change: FloatArray) -> FloatArray:
        """Step in units of the scale that undoes a change (2, N, 2) of the images."""
        g = problem.gradient(here.J, here.weight[..., None] * change)[len(held) :] / here.scale
        return np.asarray(-cho_solve(factor, g))

    def whole(step: FloatArray) -> FloatArray:
        """Step of all parameters, (size,)."""
        return np.concatenate([held, step / here.scale])

    velocity = descent(here.residual)
    probe = problem.residual(problem.retract(here.scene, _PROBE * whole(velocity)))
    bend = (2.0 / _PROBE) * ((probe - here.residual) / _PROBE - problem.change(here.J, whole(velocity)))
    if not np.isfinite(bend).all():
        return None
    acceleration = descent(bend)
    if np.linalg.norm(acceleration) > _BEND * np.linalg.norm(velocity):
        return None
    return whole(velocity + 0.5 * acceleration)
