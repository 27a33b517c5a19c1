"""Independent streams of random numbers, each a child of a seed."""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

from projservo_cli.records import FloatArray

CALIBRATION_NOISE, TARGET_NOISE, SERVO_NOISE, SUGGESTIONS, PIN_TARGET_NOISE, PIN_NOISE = range(6)
TRIAL_POSES, TAUGHT_NOISE, START_FRAMES, GOAL_FRAMES, POSE_NOISE = range(6, 11)
OBJECT_TAUGHT, OBJECT_NOW = range(11, 13)


def generator(seed: int, *stream: int) -> np.random.Generator:
    """Random numbers of a stream of a seed, or of a part of one, such as a frame of a view."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=stream))


class NoiseShape(NamedTuple):
    """Distribution of the noise of pixels, of unit deviation but for outliers."""

    tail_dof: float = math.inf  # degrees of freedom of Student's t, above 2; infinite for a normal one
    outlier_share: float = 0.0  # share of outliers among the markers of an image
    outlier_factor: float = 1.0  # deviation of outliers, over the deviation of the others

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        """Noise (..., m, 2), of which fewer rows are the first of more.

        Tails follow t at the quantiles of the normal numbers, and outliers are of another stream, so
        that studies of several distributions share their draws.
        """
        noise = rng.standard_normal(shape)
        if math.isfinite(self.tail_dof):
            tail = stdtrit(self.tail_dof, ndtr(-np.abs(noise))) * math.sqrt(1.0 - 2.0 / self.tail_dof)
            noise = np.copysign(tail, noise)
        if self.outlier_share > 0.0:
            noise[rng.spawn(1)[0].random(shape[:-1]) < self.outlier_share] *= self.outlier_factor
        return noise


NORMAL = NoiseShape()
