"""Vectorised forward model and its derivative: the twin of the kernels for all poses at once.

A scene lives in a frame that is metric up to a similarity (``a_inf`` is (0, 0, 0, 1), operators are
twists), so that all operators are conjugate to rigid motions by one common matrix by construction.
Both cameras are general 3×4 matrices. The frame is a means of writing the constraint down and has no
claim to truth: how it sits in the world is left to the images as far as they determine it.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from projservo_cli.calibration.readings import Readings
from projservo_cli.calibration.rotations import cross
from projservo_cli.geometry.lens import FIRST, bent, bent_derivative
from projservo_cli.records import BoolArray, FloatArray, IntArray

CAMERA = 12
LENS = 2


@dataclass(frozen=True, eq=False)
class Scene:
    """What the adjustment varies.

    Attributes
    ----------
    P : (2, 3, 4) cameras to pixels.
    H_hat : (n, 4, 4) twists at the reference: unit rotations without pitch, or translations.
    M : (m, 4) markers at the reference, last coordinate one.
    lens : (2, 5) lenses, of which k1 and k2 vary; None where none is sought.
    """

    P: FloatArray
    H_hat: FloatArray
    M: FloatArray
    lens: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Layout:
    """Where each parameter stands: both cameras, then joints, then markers, then both lenses.

    Attributes
    ----------
    joint : (n + 1,) first parameter of each joint, then of the markers.
    lens : first parameter of the lenses; ``size`` where none is sought.
    size : number of parameters.
    groups : rows of each marker, as slices of the lists of ``Readings``.
    columns : (2, m, c) parameters that the images of a marker in a view depend on.
    """

    joint: IntArray
    lens: int
    size: int
    groups: tuple[slice, ...]
    columns: IntArray


def layout(readings: Readings, lens: bool = False) -> Layout:
    """Parameters of a problem: 12 a camera, 4 a revolute and 2 a prismatic joint, 3 a marker, 2 a lens."""
    joint = 2 * CAMERA + np.concatenate([[0], np.cumsum(np.where(readings.prismatic, 2, 4))])
    m = readings.marker.size
    edges = np.searchsorted(readings.marker_of, np.arange(m + 1))
    groups = tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(edges))
    joints = np.arange(joint[0], joint[-1])
    first = int(joint[-1]) + 3 * m
    count = LENS if lens else 0
    columns = np.array(
        [
            [
                np.r_[
                    v * CAMERA + np.arange(CAMERA),
                    joints,
                    joint[-1] + 3 * j + np.arange(3),
                    first + v * count + np.arange(count),
                ]
                for j in range(m)
            ]
            for v in (0, 1)
        ]
    )
    return Layout(joint, first, first + 2 * count, groups, columns)


def displacements(H_hat: FloatArray, prismatic: BoolArray, q: FloatArray) -> FloatArray:
    """Displacements exp(q Ĥ) of every joint at every pose, [RH00] eqs. (4), (5): (n, K, 4, 4).

    Parameters
    ----------
    H_hat : (n, 4, 4) operators.
    prismatic : (n,) whether eq. (5) holds.
    q : (K, n) joint values from the reference, rad or m.
    """
    squared = H_hat @ H_hat
    sine = np.where(prismatic, q, np.sin(q)).T[..., None, None]
    versine = np.where(prismatic, 0.0, 2.0 * np.sin(0.5 * q) ** 2).T[..., None, None]
    result: FloatArray = np.eye(4) + sine * H_hat[:, None] + versine * squared[:, None]
    return result


def pixels_of(m: FloatArray) -> FloatArray:
    """Perspective projection (..., 2) px of image points (..., 3), [RH00] eq. (7)."""
    result: FloatArray = m[..., :2] / m[..., 2:]
    return result


def moved_points(E: FloatArray, M: FloatArray, readings: Readings) -> FloatArray:
    """Point of each sighting after the last joints alone, (n + 1, N, 4), [RH00] eq. (6) from its right end.

    Entry n holds the markers at the reference, entry 0 the markers moved by all joints.

    Parameters
    ----------
    E : (n, K, 4, 4) displacements.
    M : (m, 4) markers at the reference.
    readings : which marker at which pose.
    """
    n = E.shape[0]
    Y = np.empty((n + 1, readings.pose_of.size, 4))
    Y[n] = M[readings.marker_of]
    for i in range(n - 1, -1, -1):
        Y[i] = (E[i][readings.pose_of] @ Y[i + 1][..., None])[..., 0]
    return Y


def predict_pixels(scene: Scene, readings: Readings, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (2, N, 2) of every sighting and their depths (2, N).

    Parameters
    ----------
    scene : the model.
    readings : which marker at which pose.
    q : (K, n) joint values from the reference, rad or m.
    """
    Y = moved_points(displacements(scene.H_hat, readings.prismatic, q), scene.M, readings)
    m = Y[0] @ np.swapaxes(scene.P, 1, 2)
    pixels = pixels_of(m)
    return pixels if scene.lens is None else bent(scene.lens[:, None], pixels), m[..., 2]


def generators(scene: Scene, prismatic: BoolArray) -> list[FloatArray]:
    """Rigid motions (b, 4, 4) that move each joint's screw: four for an axis, two for a direction.

    An axis turns about its point nearest to the markers and shifts across itself; a direction turns.
    """
    center = scene.M[:, :3].mean(axis=0)
    size = float(np.linalg.norm(scene.M[:, :3] - center, axis=1).mean()) or 1.0
    H_hat = scene.H_hat
    turning = np.stack([H_hat[:, 2, 1], H_hat[:, 0, 2], H_hat[:, 1, 0]], axis=1)
    w = np.where(prismatic[:, None], H_hat[:, :3, 3], turning)
    w = w / np.linalg.norm(w, axis=1, keepdims=True)
    # Two unit vectors across w: from the coordinate axis farthest from it, so that neither is short.
    across = np.empty((len(w), 2, 3))
    W = cross(w)
    across[:, 0] = W[np.arange(len(w)), :, np.argmin(np.abs(w), axis=1)]
    across[:, 0] /= np.linalg.norm(across[:, 0], axis=1, keepdims=True)
    across[:, 1] = (W @ across[:, 0, :, None])[..., 0]
    velocity = H_hat[:, :3] @ np.append(center, 1.0)
    near = center + (W @ velocity[..., None])[..., 0]
    B = np.zeros((len(w), 4, 4, 4))
    B[:, :2, :3, :3] = cross(across)
    B[:, :2, :3, 3] = -(B[:, :2, :3, :3] @ near[:, None, :, None])[..., 0]
    B[:, 2:, :3, 3] = across * size
    B[prismatic, :2, :3, 3] = 0.0
    return [B[i, : 2 if slides else 4] for i, slides in enumerate(prismatic)]


def derivative(scene: Scene, readings: Readings, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (2, N, 2) and their derivative (2, N, 2, c) by the parameters each depends on.

    The c columns are those of ``Layout.columns``: the view's camera, all joints, the own marker, the
    view's lens. The rest of the Jacobian is zero and never formed. With Y_i the point behind joint i,
    D_i the image derivative carried to it and B a generator, a joint contributes D_i (B Y_i − E_i B Y_{i+1}).

    Parameters are those of ``predict_pixels``.
    """
    E = displacements(scene.H_hat, readings.prismatic, q)
    Y = moved_points(E, scene.M, readings)
    pixels, G, lens = projection_derivative(scene, Y[0])
    blocks = [(G[..., None] * Y[0][:, None, None, :]).reshape(*G.shape[:3], CAMERA)]
    D = G @ scene.P[:, None]
    for i, B in enumerate(generators(scene, readings.prismatic)):
        before = D @ np.einsum("bij,Nj->Nib", B, Y[i])
        D = D @ E[i][readings.pose_of]
        blocks.append(before - D @ np.einsum("bij,Nj->Nib", B, Y[i + 1]))
    blocks += [D[..., :3], *lens]
    return pixels, np.concatenate(blocks, axis=3)


def projection_derivative(
    scene: Scene, points: FloatArray
) -> tuple[FloatArray, FloatArray, tuple[FloatArray, ...]]:
    """Pixels (2, N, 2) of points, their derivative (2, N, 2, 3) by the image points, and that by the lens.

    [RH00] eq. (7), second row corrected: rows (1, 0, −u)/m3 and (0, 1, −v)/m3; then the lens, if there
    is one, whose derivative is (2, N, 2, 2) by k1 and k2.

    Parameters
    ----------
    scene : cameras and lenses.
    points : (N, 4) points.
    """
    m = points @ np.swapaxes(scene.P, 1, 2)
    pixels = pixels_of(m)
    G = np.zeros((*m.shape[:2], 2, 3))
    G[..., 0, 0] = G[..., 1, 1] = 1.0 / m[..., 2]
    G[..., 2] = -pixels / m[..., 2:]
    if scene.lens is None:
        return pixels, G, ()
    lens = scene.lens[:, None]
    by_pixel, by_lens = bent_derivative(lens, pixels)
    return bent(lens, pixels), by_pixel @ G, (by_lens,)


def joint_derivative(scene: Scene, readings: Readings, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (2, N, 2) and their derivative (2, N, 2, n) by the joint values, [RH00] eqs. (7), (19).

    Parameters are those of ``predict_pixels``.
    """
    E = displacements(scene.H_hat, readings.prismatic, q)
    Y = moved_points(E, scene.M, readings)
    pixels, G, _ = projection_derivative(scene, Y[0])
    D = G @ scene.P[:, None]
    J = np.empty((*pixels.shape, len(E)))
    for i in range(len(E)):
        J[..., i] = np.einsum("vNrc,Nc->vNr", D, Y[i] @ scene.H_hat[i].T)
        D = D @ E[i][readings.pose_of]
    return pixels, J


def retract(scene: Scene, readings: Readings, place: Layout, x: FloatArray) -> Scene:
    """Scene after a step of all parameters; screws move as rigid bodies and keep their constraints.

    Parameters
    ----------
    scene : where the step starts.
    readings : types of the joints.
    place : where the parameters stand in ``x``.
    x : (size,) step.
    """
    H_hat = scene.H_hat.copy()
    for i, B in enumerate(generators(scene, readings.prismatic)):
        twist = np.tensordot(x[place.joint[i] : place.joint[i + 1]], B, axes=1)
        motion = expm(twist)
        H_hat[i] = motion @ H_hat[i] @ np.linalg.inv(motion)
        H_hat[i] = _clean(H_hat[i], scene.H_hat[i], bool(readings.prismatic[i]))
    M = scene.M.copy()
    M[:, :3] += x[place.joint[-1] : place.lens].reshape(-1, 3)
    lens = scene.lens
    if lens is not None:
        lens = lens.copy()
        lens[:, FIRST:] += x[place.lens :].reshape(2, LENS)
    return Scene(scene.P + x[: 2 * CAMERA].reshape(2, 3, 4), H_hat, M, lens)


def _clean(H_hat: FloatArray, before: FloatArray, slides: bool) -> FloatArray:
    """The twist without the round-off of the last step: speed and vanishing pitch restored."""
    result = np.zeros((4, 4))
    if slides:
        speed = np.linalg.norm(before[:3, 3]) / np.linalg.norm(H_hat[:3, 3])
        result[:3, 3] = H_hat[:3, 3] * speed
        return result
    w = 0.5 * np.array([H_hat[2, 1] - H_hat[1, 2], H_hat[0, 2] - H_hat[2, 0], H_hat[1, 0] - H_hat[0, 1]])
    w /= np.linalg.norm(w)
    result[:3, :3] = cross(w)
    result[:3, 3] = H_hat[:3, 3] - w * (w @ H_hat[:3, 3])
    return result


def gauge(scene: Scene, readings: Readings, place: Layout, *, scaled: bool = False) -> FloatArray:
    """Directions (size, g) of the parameters that change no image, of unit norm each.

    Six rigid motions of the frame, its scale unless a prismatic joint sets it, and the scales of both
    cameras.

    Parameters are those of ``retract``; ``scaled`` takes in the scale, though it changes prismatic speeds.
    """
    motions = np.zeros((7, 4, 4))
    for k, e in enumerate(np.eye(3)):
        motions[k, :3, :3] = cross(e)
        motions[3 + k, :3, 3] = e
    motions[6, :3, :3] = np.eye(3)
    if readings.prismatic.any() and not scaled:
        motions = motions[:6]
    bases = generators(scene, readings.prismatic)
    result = np.zeros((place.size, len(motions) + 2))
    for k, Z in enumerate(motions):
        result[: 2 * CAMERA, k] = -(scene.P @ Z).ravel()
        for i, B in enumerate(bases):
            wanted = (Z @ scene.H_hat[i] - scene.H_hat[i] @ Z).ravel()
            reach = (B @ scene.H_hat[i] - scene.H_hat[i] @ B).reshape(len(B), 16).T
            result[place.joint[i] : place.joint[i + 1], k] = np.linalg.lstsq(reach, wanted, rcond=None)[0]
        result[place.joint[-1] : place.lens, k] = (scene.M @ Z.T)[:, :3].ravel()
    for v in (0, 1):
        result[v * CAMERA : (v + 1) * CAMERA, len(motions) + v] = scene.P[v].ravel()
    directions: FloatArray = result / np.linalg.norm(result, axis=0)
    return directions
