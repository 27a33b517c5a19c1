"""Intrinsics of known cameras as priors of a fit, unless the images contradict them.

Cameras of a fit are those of a metric frame up to its scale, so their intrinsics need no further unknowns.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.bundle_adjustment import StatedIntrinsics
from projservo_cli.calibration.known_shape import chance
from projservo_cli.calibration.prediction import CAMERA
from projservo_cli.calibration.robust_fit import Expected, Solution, fit_inliers
from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.geometry.invariant_forms import UPPER, intrinsics_derivative, intrinsics_of
from projservo_cli.records import BoolArray, FloatArray

# Probability that chance contradicts stated intrinsics as much.
_BY_CHANCE = 1e-4
# Names of the entries ``UPPER``.
_ENTRIES = "focal length", "skew", "centre", "focal length", "centre"


class KnownCameras(NamedTuple):
    """Cameras as stated."""

    K: FloatArray  # (V, 3, 3) px
    lens: FloatArray  # (V, 5) lenses
    deviation: FloatArray  # (V, 5) standard deviations of the entries ``UPPER`` of K, px


def with_known_intrinsics(
    free: Solution, cameras: KnownCameras, expected: Expected
) -> tuple[Solution, list[Finding]]:
    """Fit with the intrinsics that the images do not contradict; findings on the others."""
    which = np.ones(len(cameras.K), dtype=np.bool_)
    if (solution := _agreeing(free, cameras, which, expected)) is None:  # which of them it is
        which = np.array([_agreeing(free, cameras, one, expected) is not None for one in np.diag(which)])
        solution = _agreeing(free, cameras, which, expected) if which.any() else None
    unused = ~which | (solution is None)
    return solution or free, list(_contradicted(free, cameras, unused, expected))


def _agreeing(free: Solution, cameras: KnownCameras, which: BoolArray, expected: Expected) -> Solution | None:
    """Fit with the intrinsics of some views (V,); None if it fails, or the images contradict them."""
    noise_px = max(expected.sigma_px if expected.known else free.sigma_px, 1e-9)
    spread = np.where(which[:, None], cameras.deviation / noise_px, np.inf)
    problem = dataclasses.replace(free.problem, stated=StatedIntrinsics(cameras.K, spread))
    found = fit_inliers(problem, free.params, free.sigma_px, min_px=expected.min_px)
    if found is None or chance(found, free) < _BY_CHANCE:
        return None
    return dataclasses.replace(found, joint_noise=free.joint_noise)


def _contradicted(
    free: Solution, cameras: KnownCameras, which: BoolArray, expected: Expected
) -> Iterator[Finding]:
    """Yield a finding for each of some views (V,), by the entry farthest off within both deviations."""
    K, stated = intrinsics_of(free.params.P)[:, *UPPER], cameras.K[:, *UPPER]
    shared = free.errors().shared if which.any() else np.zeros((0, 0))
    for v in np.flatnonzero(which):
        by_camera = shared[v * CAMERA : (v + 1) * CAMERA]
        rows = intrinsics_derivative(free.params.P[v]) @ by_camera
        by_images = expected.noise_px(free) * np.linalg.norm(rows, axis=1)
        i = int(np.argmax(np.abs(K[v] - stated[v]) / np.hypot(by_images, cameras.deviation[v])))
        subject = Subject(views=(free.problem.detections.view[int(v)],), name=_ENTRIES[i])
        about = float(K[v, i]), float(by_images[i]), float(stated[v, i])
        yield Finding("other_intrinsics", LIMITS, subject, *about, "px")
