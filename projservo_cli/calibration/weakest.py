"""The direction that the data determine worst, in words."""

import numpy as np
from scipy.linalg import rq

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.optimization import Problem
from projservo_cli.calibration.prediction import prediction_derivative
from projservo_cli.calibration.quality import REACH_M, REACH_RAD
from projservo_cli.records import PRISMATIC, REVOLUTE, FloatArray, Model

# Rows of the rotation of a camera in words.
SIGHTS = ("the horizontal of the left image", "the vertical of the left image", "the left line of sight")
TURN, SHIFT, SPEED = "turn", "shift", "speed"
SCALE = 6  # of the motions of the frame in ``adjustment.gauge``


def worst_determined(
    problem: Problem, scene: Scene, factor: FloatArray, spread: FloatArray, sigma: float
) -> str:
    """The direction of the parameters that carries most of the variance of predictions, by its joint.

    Of all parameters at once the direction is the first right singular vector of the predictions'
    derivative by independent errors of unit variance. It is told by the joint that it changes most
    (seen in the images with that joint at its reach), the frame held by the markers. Lengths are in
    shares of the distance from the left camera, which no scale changes.

    Parameters
    ----------
    problem, scene : the fit.
    factor : (size, r) factor of the covariance of the adjusted parameters at a noise of one pixel.
    spread : (rows, r) derivative of predicted coordinates by the same errors.
    sigma : noise, px.
    """
    _, s, Vt = np.linalg.svd(np.asarray(np.linalg.qr(spread, mode="r")))
    direction, speed = _held_by_markers(problem, scene, sigma * (factor @ Vt[0]))
    effects = _effects(problem, scene, direction, speed)
    i, part = max(effects, key=lambda key: effects[key][0])
    vector = effects[i, part][1]
    sight, distance = _left_camera(scene)
    along = SIGHTS[int(np.argmax(np.abs(sight @ vector)))] if part != SPEED else ""
    size = float(np.linalg.norm(vector))
    how = {
        TURN: f"its tilt about {along}, known to ±{np.degrees(size):.2g}°",
        SHIFT: f"its place along {along}, known to ±{100.0 * size / distance:.2g} % of the camera's distance",
        SPEED: f"its travel against the size of all the rest, known to ±{100.0 * size:.2g} %",
    }
    what = "direction" if problem.readings.prismatic[i] else "axis"
    share = 100.0 * float(s[0] ** 2 / (s**2).sum())
    return f"joint {i + 1}'s {what}: {how[part]}; {share:.0f} % of the variance of predictions"


def _held_by_markers(problem: Problem, scene: Scene, direction: FloatArray) -> tuple[FloatArray, float]:
    """A direction (size,) in the frame in which the markers move least, and what prismatic speeds change by.

    Where a prismatic joint sets the scale, the markers set it here, and the joints' speeds take the
    change instead, as a share.
    """
    place = problem.place
    gauge = adjustment.gauge(scene, problem.readings, place, scaled=True)
    markers = slice(int(place.joint[-1]), place.lens)
    held = np.linalg.lstsq(gauge[markers], direction[markers], rcond=None)[0]
    # The scale moves every marker by itself times the change; gauge directions are of unit norm.
    norm = np.linalg.norm(scene.M[:, :3]) / np.linalg.norm(gauge[markers, SCALE])
    return direction - gauge @ held, -float(held[SCALE] / norm)


def _effects(
    problem: Problem, scene: Scene, direction: FloatArray, speed: float
) -> dict[tuple[int, str], tuple[float, FloatArray]]:
    """What the parts of each joint's screw along a direction (size,) do to images, and which they are.

    Returns
    -------
    By joint and part: root mean square of the image change with the joint at its reach, px, and the
    rotation vector, rad, the translation, in units of the scene, or the share of the speed.
    """
    prismatic, place = problem.readings.prismatic, problem.place
    n = len(prismatic)
    types = np.where(prismatic, PRISMATIC, REVOLUTE).astype(np.int64)
    model = Model(scene.P, scene.H_hat, types, np.zeros(n), np.array([0.0, 0.0, 0.0, 1.0]))
    found = {}
    for i, B in enumerate(adjustment.generators(scene, prismatic)):
        q = np.zeros((2, n))
        q[:, i] = np.array([1.0, -1.0]) * (REACH_M if prismatic[i] else REACH_RAD)
        first, H_hat = 2 * adjustment.CAMERA + 16 * i, scene.H_hat[i]
        J = prediction_derivative(model, scene.M, q)[..., first : first + 16]
        step = direction[place.joint[i] : place.joint[i + 1]]
        turn = np.tensordot(step[:2], B[:2], axes=1)
        turned = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
        parts = {TURN: (turn @ H_hat - H_hat @ turn, turned)}
        if prismatic[i]:
            parts[SPEED] = speed * H_hat, np.array([speed])
        else:
            shift = np.tensordot(step[2:], B[2:], axes=1)
            parts[SHIFT] = shift @ H_hat - H_hat @ shift, shift[:3, 3]
        for part, (change, vector) in parts.items():
            found[i, part] = float(np.sqrt(((J @ change.ravel()) ** 2).mean())), vector
    return found


def _left_camera(scene: Scene) -> tuple[FloatArray, float]:
    """Rotation (3, 3) of the left camera, rows right, down and ahead, and its distance from the markers."""
    K, R = rq(scene.P[0, :, :3])
    center = -np.linalg.solve(scene.P[0, :, :3], scene.P[0, :, 3])
    distance = float(np.linalg.norm(scene.M[:, :3].mean(axis=0) - center))
    return np.asarray(R * np.sign(np.diagonal(K))[:, None]), distance
