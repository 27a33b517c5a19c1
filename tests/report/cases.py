"""Runs for the tests of figures and report: the shipped tasks, calibrated by a known projective frame."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from projservo_cli.calibration.prediction import Parameters
from projservo_cli.config.inputs import report_inputs
from projservo_cli.laws import LAW_SPECS, run_name
from projservo_cli.records import Calibration
from projservo_cli.report.figure_inputs import ReportData
from projservo_cli.report.figures import FIGURES
from projservo_cli.robots.frame_recorder import FrameRecorder
from projservo_cli.stages import report as stage
from projservo_cli.stages.carried_goals import in_metres
from tests.configured import record, truth_of
from tests.fake_records import fake, seen_by
from tests.known import configured, driven, known_scenario, planned
from tests.scene import FACE_LAWS

SHORT = 4
GAINS = (0.5, 0.1)
PERIODS_S = (0.08, 0.04)
# Laws whose runs that follow the plan are shown beside those that plan anew.
FOLLOWING = ("exact", "stacked")
SPECS = {spec.name: spec for spec in FIGURES}


@lru_cache
def case(name="paper", steps=SHORT, whole=False):
    """Configuration, extra runs and material of a task whose runs end after a few steps.

    The model is the true one in a projective frame, so everything is known and nothing is fitted.
    ``whole`` sweeps all gains and periods.
    """
    config = configured(name, f"stop.max_steps={steps}")
    scenario = known_scenario(config)
    true = scenario.simulated.truth
    model = stage.projective_twin(true.model)
    plan = planned(scenario, model, samples=21, duration=3.0)
    sense = plan.rotation_sense()
    traces = {
        law: driven(scenario, sense, law, true.model if LAW_SPECS[law].metric else model) for law in FACE_LAWS
    }
    traces["direct_three"] = filmed(traces["direct_three"], *true.image_size[0].astype(int))
    for law in FOLLOWING:
        followed = run_name(law, LAW_SPECS[law].modes[1])
        traces[followed] = driven(scenario, plan, followed, model)
    clean = replace(
        known_scenario(config.idealized), termination=scenario.termination._replace(stop_at_joint_limit=False)
    )
    models = {"true": true.model, "twin": model, "calibrated": model}
    bench = stage.Comparison(clean, models, plan)
    extra = stage.run_studies(bench) if whole else stage.run_studies(bench, GAINS, PERIODS_S)
    observation = record.simulate(config, true)
    calibration = known(config, true, model, observation.q)
    numbers = tuple(true.number[i] for i in true.face)
    metric, why = in_metres(calibration, report_inputs(config).lengths)
    assert not why
    plant = scenario.plant_of("exact")
    return (
        config,
        bench,
        ReportData(
            calibration,
            observation,
            model,
            true.robot,
            plant,
            plan,
            numbers,
            traces,
            extra,
            trajectory=scenario.world.inputs.trajectory,
            metric=metric,
        ),
    )


@lru_cache
def seen(names):
    """The material of a task seen by cameras of other names: the left and the right one in turn."""
    config, _, material = case()
    chosen = [v % 2 for v in range(len(names))]

    def of(model):
        return model._replace(P=model.P[chosen], lens=model.lens[chosen])

    def traced(runs):
        return {key: seen_by(trace, names) for key, trace in runs.items()}

    plant, studied, model = material.plant, material.studies, of(material.calibrated)
    plant = plant._replace(
        model=of(plant.model),
        **{field: getattr(plant, field)[chosen] for field in ("O", "visible", "image_size")},
    )
    calibration = known(config, truth_of(config), model, material.observation.q)
    calibration = replace(calibration, view=names)
    metric, no_metric = in_metres(calibration, report_inputs(config).lengths)
    return replace(
        material,
        calibration=calibration,
        observation=seen_by(material.observation, names),
        calibrated=model,
        plant=plant,
        plan=seen_by(material.plan, names),
        traces=traced(material.traces),
        studies=replace(
            studied, **{of: traced(getattr(studied, of)) for of in ("sweep", "own", "rate", "further")}
        ),
        metric=metric,
        no_metric=no_metric,
    )


def filmed(trace, width, height):
    """A run of which there are frames: black, with a bright square where a marker is."""
    film = FrameRecorder()
    for k, s in enumerate(trace.s):
        frames = np.zeros((2, height, width), dtype=np.uint8)
        for view, marker in np.ndindex(s.shape[:2]):
            u, v = s[view, marker].round().astype(int)
            frames[view, max(0, v - 8) : v + 9, max(0, u - 8) : u + 9] = 200
        film.show(k, s, frames)
    return replace(trace, frames=film.recorded())


def known(config, true, model, q):
    """The record of a model known in the frame of ``projective_twin``, as if it had been fitted freely."""
    M = np.linalg.solve(stage.H_PE, true.M.T).T
    scene = Parameters(model.P, model.H_hat_0, model.prismatic, M)
    J, own = scene.derivative(q - model.q_reference)
    own = np.einsum("kvmia,mn->kvmina", own, np.eye(len(M))).reshape(*own.shape[:-1], -1)
    J, first = np.concatenate([J, own], axis=-1), J.shape[-1]
    s, Vt = np.linalg.svd(J.reshape(-1, J.shape[-1]), full_matrices=False)[1:]
    factor = (Vt / s[:, None])[s > 1e-8 * s[0]].T
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
        sqrt_cov_shared=sigma * factor[:first],
        sqrt_cov_marker=sigma * factor[first:].reshape(len(M), 4, -1),
        sqrt_cov_own=np.zeros((len(M), 4, 3)),
        excitation=np.ptp(q, axis=0),
        lowest=q.min(axis=0),
        poorly_observable=np.arange(len(q[0])) == 1,
        outlier=none,
        suspect=none[:, :2],
        id_switches=none,
    )
