"""Closed-loop runs that are not in the run file, for the comparisons of figures and claims."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.control.law import Gains
from projservo_cli.geometry.algebra import as_array, mat
from projservo_cli.geometry.displacements import (
    composed_angle,
    composed_operator,
    exp_rotation,
    screws,
    twist_exponential,
)
from projservo_cli.laws import TRACK, run_name
from projservo_cli.planning.margins import limits_alone
from projservo_cli.records import Calibration, FloatArray, Model, Plan, Trace, WorkFailed
from projservo_cli.report.report_data import DIRECT, Composition, Studies
from projservo_cli.simulation.workspace import Truth
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.plan import plan_task
from projservo_cli.stages.scenario import RunScenario, run_scenario
from projservo_cli.stages.servo import drive
from projservo_cli.stages.stage_inputs import ServoInputs
from projservo_cli.task.body import make_body
from projservo_cli.task.target import is_stereo

_GAINS = (0.5, 0.3, 0.1, 0.05, 0.02)
_PERIODS_S = (0.16, 0.08, 0.04, 0.02, 0.01)
STEP_LIMIT_DEG = 5.0
_LAMBDAS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
# Share of the translation that a step takes where its gain is as high as can be.
_FAST_PER_STEP = 0.9
# Instants of a planned rotation, and steps of a law towards it.
_INSTANTS, _STEPS = 4001, 400

# An arbitrary frame of condition number 2.4 in which no coordinate is metric.
H_PE = np.array([[1.1, 0.2, -0.1, 0.3], [-0.2, 0.9, 0.2, -0.1], [0.1, -0.1, 1.2, 0.2], [0.2, -0.1, 0.3, 1.0]])


@dataclass(frozen=True, eq=False)
class Comparison:
    """Common setting of all extra runs: the task without noise, with the configured gains."""

    scenario: RunScenario  # without noise and disturbances, and without an end at a border or a joint limit
    # by operators, ``true`` (metric), ``twin`` (the same in a projective frame) and ``calibrated``
    models: dict[str, Model]
    plan: Plan  # that was made; half turns are driven in its sense

    @property
    def truth(self) -> Truth:
        """Robot, rig and markers as they are."""
        assert self.scenario.truth is not None
        return self.scenario.truth

    def run(self, law: str, operators: str, gains: Gains, *, limited: bool) -> Trace:
        """Drive a direct law without limit, or with 5° a step and that of prismatic joints as configured."""
        seen = self.scenario_by(operators)
        limits = seen.termination
        speed = np.full(len(seen.ends.q_start), math.inf)
        if limited:
            prismatic = self.truth.robot.prismatic
            speed = np.where(prismatic, limits.speed, math.radians(STEP_LIMIT_DEG) / gains.period)
        scenario = replace(seen, gains=gains, termination=limits._replace(speed=speed))
        return drive(scenario, self.plan.rotation_sense(), law, self.models[operators]).trace()

    def followed(self) -> Trace | None:
        """Drive directTHREE along the plan, with the configured limits; None where it cannot be followed."""
        if not self.plan.feasible or self.plan.duration is None or np.isnan(self.plan.mu).any():
            return None
        law = run_name(DIRECT[0], TRACK)
        return drive(self.scenario, self.plan, law, self.models["calibrated"]).trace()

    def scenario_by(self, operators: str) -> RunScenario:
        """Return the setting with the body, where the face is measured with one, in the frame of a model."""
        exact = self.scenario.exact
        if operators == "calibrated" or not len(exact.body.M):
            return self.scenario
        M = self.truth.of(self.scenario.numbers)
        if operators == "twin":
            M = M @ np.linalg.inv(H_PE).T
        return replace(self.scenario, exact=exact._replace(body=make_body(self.models[operators], M)))


def projective_twin(model: Model) -> Model:
    """The same robot and rig in the projective frame ``H_PE``, [RH00] eqs. (1), (2)."""
    inverse = np.linalg.inv(H_PE)
    return Model(
        np.ascontiguousarray(model.P @ H_PE),
        np.ascontiguousarray(inverse @ model.H_hat_0 @ H_PE),
        model.prismatic,
        model.q_reference,
        model.a_inf @ H_PE,
        model.lens,
        curve=model.curve,
        on_tool=model.on_tool,
    )


def comparison_of(inputs: ServoInputs, calibration: Calibration, plan: Plan) -> Comparison:
    """Set up the extra runs; images are without noise, but for a goal that is known by them alone.

    inputs : of laws by themselves on the ideal plant, which measure the face point by point, but with the
        body where there are not two views: nothing keeps them out of regions. The goal is the taught pose.
    """
    inputs = replace(inputs, plan=replace(inputs.plan, incidences=(), carrier=None))
    if not is_stereo(calibration.view):
        inputs = replace(inputs, plan=replace(inputs.plan, features="body"))
    scenario = run_scenario(inputs, calibration)
    limits = scenario.termination._replace(stop_at_joint_limit=False, stop_at_border=False)
    scenario = replace(scenario, termination=limits)
    assert scenario.truth is not None
    metric = scenario.truth.model
    models = {"true": metric, "twin": projective_twin(metric), "calibrated": calibration.model()}
    return Comparison(scenario, models, plan)


def _with_gain(gains: Gains, gain_per_step: float) -> Gains:
    """Gains of the direct laws such that each step takes one share of all errors."""
    gain = gain_per_step / gains.period
    return gains._replace(gain_t=gain, gain_r=gain, gain_p=gain, gain_s=gain, ratio_rp=1.0)


def run_studies(
    bench: Comparison,
    gains: Sequence[float] = _GAINS,
    periods: Sequence[float] = _PERIODS_S,
    progress: Progress = silent,
) -> Studies:
    """Make all extra runs, over gains per step, and over periods, s, at the configured gains.

    Periods with a gain of 1 a step or more, which no loop survives, are left out.
    """
    own, limits = bench.scenario.gains, (False, True)
    maximum = max(own.gain_t, own.gain_r, own.gain_p, own.gain_s)
    periods = [period for period in periods if maximum * period < 1.0]
    both = ("true", "calibrated")
    cases: list[tuple[Any, Gains, str, bool]] = [
        *((case, _with_gain(own, case[3]), *case[1:3]) for case in product(DIRECT, both, limits, gains)),
        *((case, own, *case[1:]) for case in product(DIRECT, bench.models, limits)),
        *((case, own._replace(period=case[1]), "true", False) for case in product(DIRECT, periods)),
    ]
    made: dict[Any, Trace] = {}
    for done, (case, chosen, operators, limited) in enumerate(cases):
        progress("studies", done, len(cases))
        made[case] = bench.run(case[0], operators, chosen, limited=limited)
    fast = own._replace(gain_t=_FAST_PER_STEP / own.period)
    further = {"fast": bench.run(DIRECT[0], "true", fast, limited=False), "tracked": bench.followed()}
    progress("studies", len(cases), len(cases))
    sweep, by_model, rate = ({c: trace for c, trace in made.items() if len(c) == n} for n in (4, 3, 2))
    return Studies(
        gains=tuple(gains),
        periods=tuple(periods),
        gains_of_laws=own,
        step_limit_deg=STEP_LIMIT_DEG,
        sweep=sweep,
        own=by_model,
        rate=rate,
        further={name: trace for name, trace in further.items() if trace is not None},
    )


def metric_plan(bench: Comparison) -> Plan:
    """The task partitioned with the true metric model, so that its operators are in metres."""
    asked, robot = bench.scenario.inputs.trajectory, bench.truth.robot
    trajectory = asked.model_copy(update={"profile": "linear", "n_samples": 2, "duration_s": None})
    shown, limits = bench.scenario_by("true").ends, limits_alone(robot.limits, len(bench.scenario.view))
    return plan_task(bench.models["true"], shown, trajectory, limits)


def composition_error(plan: Plan, lambdas: Sequence[float] = _LAMBDAS) -> FloatArray:
    """Difference of both sides of [RH00] eq. (22) for a metric plan in shares λ of τ and θ_s.

    Returns the distance (k,) of the centre under exp(λτ Ĥ_t) exp(λθ_s Ĥ_s) and exp(λτ Ĥ_t + λθ_s Ĥ_s), m.
    Raises WorkFailed if the task has no rotation.
    """
    theta_s, a, b, c = composed_angle(plan.theta_r, plan.theta_p)
    turns, H_s = composed_operator(mat(plan.H_hat[1]), mat(plan.H_hat[2]), a, b, c)
    if not turns:
        raise WorkFailed("two rotations by 0° compose to the identity, which has no axis")
    H_hat_s = as_array(H_s)
    distance = []
    for share in lambdas:
        shift = np.eye(4) + share * plan.tau * plan.H_hat[0]
        product = shift @ exp_rotation(H_hat_s, share * theta_s)
        summed = share * (plan.tau * plan.H_hat[0] + theta_s * H_hat_s)
        difference = product - as_array(twist_exponential(mat(summed)))
        distance.append(float(np.linalg.norm(difference @ plan.A_c)))
    return np.array(distance)


def orientation_bias(plan: Plan, gains: Gains) -> FloatArray:
    """Farthest that each of ``DIRECT`` turns the face off its planned rotation, rad, [RH00] eq. (21).

    Each step turns the face as the law wants to, exactly, and partitions what is left anew: no joint steps
    are involved. The planned rotation of directTHREE is exp(μ θ_r Ĥ_r) exp(μ θ_p Ĥ_p) of eq. (17), that of
    directTWO exp(μ θ_s Ĥ_s), for μ from 0 to 1. From a metric plan.
    """
    r, p = screws(plan.H_hat)[1:, :3]
    mu = np.linspace(0.0, 1.0, _INSTANTS)[:, None]
    two_turns = Rotation.from_rotvec(mu * plan.theta_r * r) * Rotation.from_rotvec(mu * plan.theta_p * p)
    goal, whole = two_turns[-1], two_turns[-1].as_rotvec()
    axis = whole / max(float(np.linalg.norm(whole)), 1e-300)
    off = np.zeros(2)
    for law in range(2):
        R, theta_p = Rotation.identity(), plan.theta_p
        for _ in range(_STEPS):
            left = goal * R.inv()
            normal, c = R.apply(p), np.cross(R.apply(p), goal.apply(p))
            sine = float(np.linalg.norm(c))
            onto = math.atan2(sine, float(R.apply(p) @ goal.apply(p))) * c / sine if sine > 0.0 else c
            within = float((Rotation.from_rotvec(-onto) * left).as_rotvec() @ normal)
            theta_p = within - 2.0 * math.pi * round((within - theta_p) / (2.0 * math.pi))  # in its sense
            three = gains.gain_r * onto + gains.gain_p * theta_p * normal
            two = gains.gain_s * left.as_rotvec()
            R = Rotation.from_rotvec(gains.period * (three, two)[law]) * R
            # Sine of half the turn about other axes.
            half = float(np.linalg.norm(np.cross(axis, R.as_quat()[:3])))
            from_plan = (two_turns.inv() * R).magnitude().min(), 2.0 * math.asin(min(1.0, half))
            off[law] = max(off[law], from_plan[law])
    return off


def composition_of(plan: Plan, gains: Gains) -> Composition:
    """How the parts of a metric plan go together; raises WorkFailed if the task has no rotation."""
    distance = composition_error(plan)
    r, p = screws(plan.H_hat)[1:, :3]
    axis = (Rotation.from_rotvec(plan.theta_r * r) * Rotation.from_rotvec(plan.theta_p * p)).as_rotvec()
    way = screws(plan.H_hat)[0, 3:]
    cosine = abs(float(way @ axis)) / max(float(np.linalg.norm(way) * np.linalg.norm(axis)), 1e-300)
    return Composition(
        np.array(_LAMBDAS), distance, math.acos(min(1.0, cosine)), orientation_bias(plan, gains)
    )
