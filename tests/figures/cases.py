"""Runs for the tests of figures and report: the shipped tasks, calibrated by a known projective frame."""

import dataclasses
from functools import lru_cache

import numpy as np
from projservo_cli.stages.noisy import noisy_runs

from projservo_cli.calibration.prediction import prediction_derivative
from projservo_cli.config import load_config
from projservo_cli.records import LAWS, METRIC_LAWS, Calibration, following_mode, name_of
from projservo_cli.report.material import Material
from projservo_cli.stages import calibrate, plan, servo, studies
from projservo_cli.stages import scenario as truth
from projservo_cli.stages.plan import Pace
from projservo_cli.stages.scenario import servo_noise
from projservo_cli.task.margins import within
from tests.conftest import ROOT
from tests.fake_records import fake

SHORT = 4
GAINS = (0.5, 0.1)
PERIODS_S = (0.08, 0.04)
DRAWS = 4
# Laws whose runs that follow the plan are shown beside those that plan anew.
FOLLOWING = ("exact", "stacked")


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
        within(true.robot.lower, true.robot.upper),
        pace=Pace(duration=2.0),
    )
    bench = studies.bench_of(config, model, planned)
    noise = servo_noise(config, len(true.face))
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
    limits = servo.limits_of(config)
    for law in FOLLOWING:
        traces[name_of(law, following_mode(law))] = servo.drive(
            law, model, bench.plant, true, reach, bench.gains, limits, noise, bench.sense, None, planned
        )
    extra = studies.run_studies(bench) if whole else studies.run_studies(bench, GAINS, PERIODS_S)
    numbers = tuple(true.number[i] for i in true.face)
    observation = calibrate.simulate(config, true)
    calibration = known(config, true, model, observation.q)
    material = Material(
        calibration, observation, model, true.robot, bench.plant, planned, numbers, traces, extra
    )
    noisy = noisy_runs(bench, config, calibration, planned, material.compared(), 0.5, DRAWS)
    material = dataclasses.replace(material, noisy=noisy, noise_px=0.5)
    return config, bench, material


def known(config, true, model, q):
    """The record of a model known in the frame of ``projective_twin``, as if it had been fitted freely."""
    M = np.linalg.solve(studies.H_PE, true.M.T).T
    J = prediction_derivative(model, M, q)
    s, Vt = np.linalg.svd(J.reshape(-1, J.shape[-1]), full_matrices=False)[1:]
    factor = (Vt / s[:, None])[s > 1e-8 * s[0]]
    none = np.zeros((0, 3), dtype=np.int64)
    sigma = config.noise.calibration_px or 0.5
    return fake(
        Calibration,
        sizes={"joint": len(q[0])},
        joint_types=config.robot.joint_types,
        sigma_px=sigma,
        chi2_per_dof=1.0,
        **{name: getattr(model, name) for name in ("P", "H_hat_0", "q_reference", "a_inf")},
        marker=np.array(true.number),
        M=M,
        covariance=sigma**2 * factor.T @ factor,
        excitation=np.ptp(q, axis=0),
        weak=np.arange(len(q[0])) == 1,
        outlier=none,
        suspect=none[:, :2],
        swapped=none,
    )


def geometric(start, factor, count):
    """Geometric sequence."""
    return start * factor ** np.arange(count)
