"""Runs with image noise drawn anew in each: how the modes of the control take it."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.records import BODY_LAWS, REPLAN, Calibration, Plan, Trace, law_and_mode
from projservo_cli.stages.scenario import SERVO_NOISE, generator, sight_of
from projservo_cli.stages.servo import drive
from projservo_cli.stages.studies import Bench

if TYPE_CHECKING:
    from projservo_cli.config import Config

DRAWS = 20
# Noise per coordinate where none is configured, px.
NOISE_PX = 0.5
# Periods after the plan has arrived that are looked at: at a gain of 0.1 a step, six times 1/e.
PERIODS_AFTER = 60


def noisy_runs(
    bench: Bench,
    config: "Config",
    calibration: Calibration,
    plan: Plan,
    names: Sequence[str],
    sigma: float,
    draws: int = DRAWS,
) -> Mapping[str, list[Trace]]:
    """Runs by name, all as long, one a draw but for those that end early; every name meets the same noise.

    Start and goal are shown without noise, so that all that differs is the noise of the loop.

    Parameters
    ----------
    names : of runs, at least one of which follows the plan.
    sigma : standard deviation of the noise, px per coordinate.

    Raises
    ------
    WorkFailed
        If a law cannot be run.
    """
    period = bench.gains.period
    steps = round((plan.duration or 0.0) / period) + PERIODS_AFTER
    limits = bench.limits._replace(image_px=0.0, noise_px=0.0, max_steps=steps, diverged_factor=np.inf)
    m, body = len(bench.truth.face), sight_of(config, calibration, bench.truth, bench.reach)
    found: dict[str, list[Trace]] = {name: [] for name in names}
    for draw in range(draws):
        rng = generator(config, SERVO_NOISE, draw)
        noise = sigma * rng.standard_normal((steps + 1, 2, m + (0 if body is None else len(body.pins)), 2))
        for name in names:
            law, mode = law_and_mode(name)
            sight = body if law in BODY_LAWS else None
            trace = drive(
                law,
                bench.models["calibrated"],
                bench.plant,
                bench.truth,
                bench.reach,
                bench.gains,
                limits,
                noise if sight is not None else np.ascontiguousarray(noise[:, :, :m]),
                bench.sense,
                sight,
                None if mode == REPLAN else plan,
            )
            if trace.steps == steps:
                found[name].append(trace)
    return found
