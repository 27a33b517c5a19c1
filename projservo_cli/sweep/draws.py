"""What is random in a sweep: every draw has a stream and a number of its own."""

import math
from typing import Any

import numpy as np

from projservo_cli.config.sweep import Distribution

# Streams of the sweep's seed.
RUNS, CALIBRATIONS, TASKS, VALUES, CALIBRATION_VALUES = range(5)


def seed_of(seed: int, stream: int, number: int) -> int:
    """Seed of one of many draws."""
    return int(np.random.SeedSequence(seed, spawn_key=(stream, number)).generate_state(1, np.uint64)[0] >> 1)


def sample(distribution: Distribution, rng: np.random.Generator) -> Any:
    """One value; always as many random numbers, whatever the distribution."""
    uniform, normal = rng.random(), rng.standard_normal()
    if distribution.uniform is not None:
        least, most = distribution.uniform
        return least + (most - least) * uniform
    if distribution.log_uniform is not None:
        least, most = distribution.log_uniform
        return math.exp(math.log(least) + (math.log(most) - math.log(least)) * uniform)
    if distribution.normal is not None:
        mean, deviation = distribution.normal
        return mean + deviation * normal
    assert distribution.choice is not None
    return distribution.choice[int(uniform * len(distribution.choice))]
