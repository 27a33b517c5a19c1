"""Levenberg–Marquardt with geodesic acceleration and a gauge penalty, for the scene of ``adjustment``."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.adjustment import CAMERA, Layout, Scene
from projservo_cli.calibration.readings import Readings
from projservo_cli.records import BoolArray, FloatArray

# Largest ratio of second-order to first-order step, and the probe of the second derivative: values
# of M. Transtrum, J. Sethna, "Improvements to the Levenberg–Marquardt algorithm", arXiv:1201.5885.
BEND = 0.75
PROBE = 0.1
LEAST_DAMPING, MOST_DAMPING = 1e-15, 1e8
# A step that moves the predicted images by less than this fraction of the residual is the last.
SETTLED = 1e-7
# Residuals below this, px, are round-off for the purpose of that rule: pixels have some 1e-13 of it.
LEAST_RESIDUAL = 1e-5

Weighting = Callable[[FloatArray], FloatArray]
Stalled = Callable[[FloatArray], bool]


@dataclass(frozen=True, eq=False)
class Fit:
    """A scene, how well it explains the images, and how the search ended.

    Attributes
    ----------
    scene : the model.
    residual : (2, N, 2) predicted minus seen, px, zero where not seen.
    weight : (2, N) weights the fit ended with.
    cost : weighted sum of squares, px².
    steps : accepted and rejected steps.
    settled : whether the last step was too small to matter.
    """

    scene: Scene
    residual: FloatArray
    weight: FloatArray
    cost: float
    steps: int
    settled: bool


@dataclass(frozen=True, eq=False)
class Problem:
    """Images to explain: the readings, joint values (K, n) from the reference (n,), layout."""

    readings: Readings
    q: FloatArray
    q_reference: FloatArray
    place: Layout

    def residual(self, scene: Scene) -> FloatArray:
        """Predicted minus seen pixels (2, N, 2), zero where not seen."""
        pixels, _ = adjustment.predict_pixels(scene, self.readings, self.q)
        result: FloatArray = np.where(self.readings.seen[..., None], pixels - self.readings.pixels, 0.0)
        return result

    def normal(self, J: FloatArray, weight: FloatArray) -> FloatArray:
        """Normal matrix Jᵀ W J (size, size) from the compact derivative, one marker and view at a time."""
        A = np.zeros((self.place.size, self.place.size))
        for v in (0, 1):
            for j, rows in enumerate(self.place.groups):
                block = J[v, rows].reshape(-1, J.shape[-1])
                columns = self.place.columns[v, j]
                A[np.ix_(columns, columns)] += (block.T * np.repeat(weight[v, rows], 2)) @ block
        return A

    def gradient(self, J: FloatArray, weighted: FloatArray) -> FloatArray:
        """Jᵀ times weighted residuals (2, N, 2): (size,)."""
        g = np.zeros(self.place.size)
        for v in (0, 1):
            for j, rows in enumerate(self.place.groups):
                block = J[v, rows].reshape(-1, J.shape[-1])
                g[self.place.columns[v, j]] += weighted[v, rows].ravel() @ block
        return g

    def change(self, J: FloatArray, x: FloatArray) -> FloatArray:
        """J times a step: first-order change (2, N, 2) of the images."""
        result = np.empty(J.shape[:3])
        for v in (0, 1):
            for j, rows in enumerate(self.place.groups):
                result[v, rows] = J[v, rows] @ x[self.place.columns[v, j]]
        return result

    def dense(self, J: FloatArray, weight: FloatArray) -> FloatArray:
        """The whole derivative (4 N, size) in units of noise, for what needs more than JᵀJ."""
        result = np.zeros((*J.shape[:3], self.place.size))
        for v in (0, 1):
            for j, rows in enumerate(self.place.groups):
                result[v, rows, :, self.place.columns[v, j]] = np.moveaxis(
                    J[v, rows] * np.sqrt(weight[v, rows])[:, None, None], 2, 0
                )
        return result.reshape(-1, self.place.size)


def prepare(readings: Readings, q_reference: FloatArray, lens: bool = False) -> Problem:
    """Problem of explaining the readings about the reference joints (n,), rad or m."""
    return Problem(readings, readings.q - q_reference, q_reference, adjustment.layout(readings, lens))


def fixed(weight: FloatArray) -> Weighting:
    """Weights that do not depend on the residuals."""
    return lambda _: weight


def minimize(
    problem: Problem,
    scene: Scene,
    weighting: Weighting,
    *,
    cameras: bool = True,
    most: int = 200,
    settled_at: float = SETTLED,
    stalled: Stalled = lambda residual: False,
) -> Fit:
    """Weighted least squares over all parameters, or with the cameras held.

    Parameters
    ----------
    problem : what to explain.
    scene : start.
    weighting : weights (2, N) from residuals (2, N, 2), recomputed after each accepted step.
    cameras : whether the cameras are free.
    most : steps after which to give up.
    settled_at : a step that moves the images by less than this fraction of the residual is the last.
    stalled : told the residuals (2, N, 2) after each accepted step; true ends the search.
    """
    place, readings = problem.place, problem.readings
    free = np.arange(place.size) >= (0 if cameras else 2 * CAMERA)
    residual = problem.residual(scene)
    weight = weighting(residual)
    damping, scale = 1e-3, np.zeros(int(free.sum()))
    settled = False
    fresh = True
    steps = 0
    while steps < most and not settled and damping <= MOST_DAMPING:
        steps += 1
        if fresh:
            _, J = adjustment.derivative(scene, readings, problem.q)
            A, g, scale, G = scaled_normal(problem, scene, J, weight, residual, free, scale)
            cost = float((weight[..., None] * residual**2).sum())
        x = _step(problem, scene, J, weight, residual, (A, g, scale, G), damping, free)
        candidate = adjustment.retract(scene, readings, place, x) if x is not None else scene
        new_residual = problem.residual(candidate) if x is not None else residual
        new_cost = float((weight[..., None] * new_residual**2).sum())
        fresh = x is not None and np.isfinite(new_cost) and new_cost <= cost
        if x is not None:
            moved = float((weight[..., None] * problem.change(J, x) ** 2).sum())
            settled = moved <= settled_at**2 * max(cost, LEAST_RESIDUAL**2 * float(weight.sum()))
        if fresh:
            scene, residual, weight = candidate, new_residual, weighting(new_residual)
            damping = max(0.1 * damping, LEAST_DAMPING)
            if stalled(residual):
                break
        else:
            damping *= 10.0
    cost = float((weight[..., None] * residual**2).sum())
    return Fit(scene, residual, weight, cost, steps, settled)


def scaled_normal(
    problem: Problem,
    scene: Scene,
    J: FloatArray,
    weight: FloatArray,
    residual: FloatArray,
    free: BoolArray,
    scale: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Normal matrix and gradient in units in which its diagonal is at most one, with the gauge tied."""
    A = problem.normal(J, weight)[np.ix_(free, free)]
    g = problem.gradient(J, weight[..., None] * residual)[free]
    scale = np.maximum(scale, np.sqrt(np.maximum(np.diagonal(A), 1e-300)))
    A = A / np.outer(scale, scale)
    G = np.zeros((len(scale), 0))
    if free.all():
        G = np.linalg.qr(scale[:, None] * adjustment.gauge(scene, problem.readings, problem.place))[0]
    return A + G @ G.T, g / scale, scale, G


def _step(
    problem: Problem,
    scene: Scene,
    J: FloatArray,
    weight: FloatArray,
    residual: FloatArray,
    system: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    damping: float,
    free: BoolArray,
) -> FloatArray | None:
    """Damped step with geodesic acceleration, or None where the second order outweighs the first."""
    A, g, scale, _ = system
    try:
        factor = cho_factor(A + damping * np.eye(len(g)))
    except np.linalg.LinAlgError:
        return None
    velocity = np.zeros(free.size)
    velocity[free] = -cho_solve(factor, g) / scale
    probe = problem.residual(adjustment.retract(scene, problem.readings, problem.place, PROBE * velocity))
    bend = (2.0 / PROBE) * ((probe - residual) / PROBE - problem.change(J, velocity))
    if not np.isfinite(bend).all():
        return None
    acceleration = np.zeros(free.size)
    curve = problem.gradient(J, weight[..., None] * bend)[free] / scale
    acceleration[free] = -cho_solve(factor, curve) / scale
    first = float(np.linalg.norm(velocity[free] * scale))
    second = float(np.linalg.norm(acceleration[free] * scale))
    if second > BEND * first:
        return None
    result: FloatArray = velocity + 0.5 * acceleration
    return result
