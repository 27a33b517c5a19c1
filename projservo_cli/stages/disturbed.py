"""The noise and the disturbances of a configuration as the simulated robot suffers them."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.plants.plant import NEVER, Disturbance
from projservo_cli.records import FloatArray
from projservo_cli.stages.truth import PIN_NOISE, SERVO_NOISE, stream_of

if TYPE_CHECKING:
    from projservo_cli.config import Config


def disturbance_of(config: "Config", n: int) -> Disturbance:
    """What befalls the joints and the images of a robot of n joints."""
    given = config.disturbance
    bump, frozen = given.bump, given.frozen_joint
    step = np.zeros(n)
    if bump is not None:
        step[bump.joint - 1] = math.radians(bump.by_deg) if bump.by_deg is not None else bump.by_m
    return Disturbance(
        given.delay_periods,
        -1 if bump is None else bump.at_step,
        step,
        bump is None or bump.read,
        -1 if frozen is None else frozen.joint - 1,
        0 if frozen is None else frozen.from_step,
        _end(frozen.from_step, frozen.steps) if frozen is not None else NEVER,
    )


def _end(first: int, count: int | None) -> int:
    """First instant after so many from the first; None for ever."""
    return NEVER if count is None else first + count


def lose_markers(config: "Config", noise: FloatArray, numbers: Sequence[int]) -> None:
    """Make the noise of lost markers NaN, in place, by which they are unseen.

    Parameters
    ----------
    noise : (k, 2, m, 2) at every instant, px.
    numbers : (m,) of the markers.
    """
    lost = config.disturbance.lost_markers
    if lost is None:
        return
    those = [i for i, number in enumerate(numbers) if lost.markers is None or number in lost.markers]
    noise[lost.from_step : _end(lost.from_step, lost.steps), :, those] = np.nan


def servo_noise(config: "Config", m: int, pins: int = 0) -> FloatArray:
    """Pixel noise of m face markers and of pins at every instant, the same for every law, px."""
    return noise_of(config.seed, config.noise.servo_px, config.stop.max_steps + 1, m, pins)


def noise_of(seed: int, sigma: float, instants: int, m: int, pins: int) -> FloatArray:
    """Pixel noise (instants, 2, m + pins, 2) of a seed, px; fewer instants are the first of more."""
    noise = np.zeros((instants, 2, m + pins, 2))
    if sigma > 0.0:
        for these, count, stream in ((slice(m), m, SERVO_NOISE), (slice(m, None), pins, PIN_NOISE)):
            if count > 0:
                drawn = stream_of(seed, stream).standard_normal((instants, 2, count, 2))
                np.multiply(sigma, drawn, out=noise[:, :, these])
    return noise
