"""Runs for the tests of figures and report: the shipped tasks, calibrated by a known projective frame."""

from functools import lru_cache

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.figures.material import Material
from projservo_cli.records import LAWS, METRIC_LAWS
from projservo_cli.stages import plan, servo, studies, truth
from tests.conftest import ROOT

SHORT = 4
GAINS = (0.5, 0.1)
PERIODS_S = (0.08, 0.04)


def config_of(name, *overrides):
    """A shipped configuration."""
    return load_config(ROOT / "configs" / f"{name}.yaml", overrides)


@lru_cache
def case(name="paper", steps=SHORT, whole=False):
    """Configuration, bench and material of a task whose runs end after a few steps.

    The model is the true one in a projective frame, so everything is known and nothing is fitted.
    ``whole`` sweeps all gains and periods.
    """
    config = config_of(name, f"stop.max_steps={steps}")
    true = truth.truth_of(config)
    model = studies.projective_twin(true.model)
    reach = truth.reach_of(config, true)
    planned = plan.plan_task(
        model,
        reach.q_start,
        reach.s_start,
        reach.s_star,
        true.center,
        "linear",
        config.trajectory.delta,
        21,
        (true.robot.lower, true.robot.upper),
    )
    bench = studies.bench_of(config, model, planned)
    noise = servo.servo_noise(config, len(true.face))
    traces = {
        law: servo.drive(
            law,
            true.model if law in METRIC_LAWS else model,
            bench.plant,
            true,
            reach,
            bench.gains,
            servo.limits_of(config),
            noise,
            bench.sense,
        )
        for law in LAWS
    }
    extra = studies.run_studies(bench) if whole else studies.run_studies(bench, GAINS, PERIODS_S)
    numbers = tuple(true.number[i] for i in true.face)
    material = Material(model, true.robot, bench.plant, planned, numbers, traces, extra)
    return config, bench, material


def geometric(start, factor, count):
    """Geometric sequence."""
    return start * factor ** np.arange(count)
