"""Weights of cameras: a noise of each, by the residuals of a fit to all of them."""

import dataclasses

import numpy as np

from projservo_cli.calibration.detections import RAYLEIGH
from projservo_cli.calibration.initial.epipolar import Epipolar, ImageGeometry
from projservo_cli.calibration.lens_estimation import undistorted
from projservo_cli.calibration.robust_fit import Solution, fit_inliers
from projservo_cli.records import WorkFailed

# Rounds of reweighting by the noise of each view.
_NOISE_ROUNDS = 6
# Relative change of the noise of each view that ends these rounds.
_SETTLED = 0.01


def with_own_noise(solution: Solution, epipolar: ImageGeometry) -> tuple[Solution, ImageGeometry]:
    """Weigh each view by its own noise until it settles; also the epipolar geometry of the quietest pair.

    In units of the root mean square noise of this pair. Two views share one noise, which their epipolar
    geometry shows.
    """
    if len(solution.used) <= 2:
        return solution, epipolar
    first_pair = solution.problem.detections.pair
    for _ in range(_NOISE_ROUNDS):
        detections = solution.problem.detections
        noise = np.array([_noise(solution, v) for v in range(len(solution.used))])
        first, second = np.sort(np.argsort(noise / detections.weight.max(axis=1))[:2]).tolist()
        noise /= np.sqrt(np.mean(noise[[first, second]] ** 2))
        if np.abs(np.log(noise)).max() <= _SETTLED:
            break
        weight = detections.weight / noise[:, None]
        weighed = dataclasses.replace(detections, weight=weight, pair=(first, second))
        problem = dataclasses.replace(solution.problem, detections=weighed)
        found = fit_inliers(problem, solution.params, solution.typical_px / RAYLEIGH, epipolar.noise_px)
        if found is None:
            break
        solution = found
    seen = undistorted(solution.problem.detections, solution.params.lens)
    try:
        return solution, Epipolar.of(seen, np.random.default_rng(0))
    except WorkFailed:  # without a baseline: the first pair has one
        detections = dataclasses.replace(solution.problem.detections, pair=first_pair)
        problem = dataclasses.replace(solution.problem, detections=detections)
        seen = dataclasses.replace(seen, pair=first_pair)
        return dataclasses.replace(solution, problem=problem), Epipolar.of(seen, np.random.default_rng(0))


def _noise(solution: Solution, v: int) -> float:
    """Robust noise of a view per coordinate, weighted, px: of all that was seen, so that none is cut off."""
    distance = np.linalg.norm(solution.residual[v, solution.problem.detections.seen[v]], axis=1)
    return max(float(np.median(distance)) / RAYLEIGH, 1e-9)
