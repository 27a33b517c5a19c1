"""Stage report: figures after the paper's, and its claims against runs, of which some are made for them."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli import provenance
from projservo_cli.control.law import Gains
from projservo_cli.geometry.algebra import as_array, mat
from projservo_cli.geometry.displacements import (
    composed_angle,
    composed_operator,
    exp_rotation,
    screws,
    twist_exponential,
)
from projservo_cli.image_size import ImageSize
from projservo_cli.laws import TRACK, run_name
from projservo_cli.planning.motion_margins import limits_alone
from projservo_cli.records import VIEWS, Calibration, FloatArray, Model, Plan, Report, Trace, WorkFailed
from projservo_cli.report import style
from projservo_cli.report.animation import motion_of, write_animation, write_view
from projservo_cli.report.claims import claims_of
from projservo_cli.report.figure_inputs import (
    ANIMATION_FILE,
    CLAIMS_FILE,
    DIRECT,
    VIEW_FILE,
    Composition,
    Driven,
    Fit,
    ReportData,
    Studies,
)
from projservo_cli.report.figure_processes import Drawing, SecondProcess
from projservo_cli.report.figures import FIGURES
from projservo_cli.report.figures.path_deviation import drift_rows, study_numbers
from projservo_cli.report.figures.scene import chosen_poses, metric_rows
from projservo_cli.report.page import write_page
from projservo_cli.simulation.ground_truth import Truth, plant_of
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.carried_goals import in_metres
from projservo_cli.stages.plan import plan_task
from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.scenario import RunScenario, run_scenario
from projservo_cli.stages.servo import drive
from projservo_cli.stages.stage_inputs import ReportInputs, Scenery, ServoInputs
from projservo_cli.store.files_and_locks import replacing, require_inside, write_whole
from projservo_cli.store.observation_tables import to_csv
from projservo_cli.store.run_file import Result, Run
from projservo_cli.task.body_pose import make_body
from projservo_cli.task.face import cyclic_order
from projservo_cli.task.target import is_stereo

FOLDER = "figures"
_OF_ONE = "figures and claims are of one motion, and the task is a sequence: name a goal, --goal NAME"
_NUMBERS = "csv"  # the numbers of each figure
# Reasons why a figure of extra runs is left out.
_WHY_NONE = "the extra runs could not be made: {}"
_NOT_ASKED = f"extra runs and claims are of {' and '.join(DIRECT)}: name both in control.laws"

_GAINS = (0.5, 0.3, 0.1, 0.05, 0.02)
_PERIODS_S = (0.16, 0.08, 0.04, 0.02, 0.01)
STEP_LIMIT_DEG = 5.0
_LAMBDAS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
# Share of the translation that a step takes if its gain is as high as can be.
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
        return self.scenario.simulated.truth

    def run(self, law: str, operators: str, gains: Gains, *, limited: bool) -> Trace:
        """Drive a direct law without limit, or with 5° per step and configured limits of prismatic joints."""
        seen = self.scenario_by(operators)
        limits = seen.termination
        speed = np.full(len(seen.ends.q_start), math.inf)
        if limited:
            prismatic = self.truth.robot.prismatic
            speed = np.where(prismatic, limits.speed, math.radians(STEP_LIMIT_DEG) / gains.period)
        scenario = replace(seen, gains=gains, termination=limits._replace(speed=speed))
        return trace_of(drive(scenario, self.plan.rotation_sense(), law, self.models[operators]))

    def followed(self) -> Trace | None:
        """Drive directTHREE along the plan, with the configured limits; None if it cannot be followed."""
        if not self.plan.feasible or self.plan.duration is None or np.isnan(self.plan.mu).any():
            return None
        law = run_name(DIRECT[0], TRACK)
        return trace_of(drive(self.scenario, self.plan, law, self.models["calibrated"]))

    def scenario_by(self, operators: str) -> RunScenario:
        """Return the setting with the body, if the face is measured with one, in the frame of a model."""
        exact = self.scenario.exact
        if operators == "calibrated" or not len(exact.body.M):
            return self.scenario
        M = self.truth.of(self.scenario.world.numbers)
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
        body if there are not two views: nothing keeps them out of regions. The goal is the taught pose.
    """
    inputs = replace(inputs, plan=inputs.plan.of_taught_pose)
    if not is_stereo(calibration.view):
        inputs = replace(inputs, plan=replace(inputs.plan, features="body"))
    scenario = run_scenario(inputs, calibration)
    limits = scenario.termination._replace(stop_at_joint_limit=False, stop_at_border=False)
    scenario = replace(scenario, termination=limits)
    metric = scenario.simulated.truth.model
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
    asked, robot = bench.scenario.world.inputs.trajectory, bench.truth.robot
    trajectory = asked.model_copy(update={"profile": "linear", "n_samples": 2, "duration_s": None})
    shown, limits = bench.scenario_by("true").ends, limits_alone(robot.limits, len(bench.scenario.world.view))
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

    Each step turns the face as the law wants to, exactly, and partitions the rest again: no joint steps
    are involved. The planned rotation of directTHREE is exp(μ θ_r Ĥ_r) exp(μ θ_p Ĥ_p) of eq. (17), and of
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
            # in the sense of the planned one
            theta_p = within - 2.0 * math.pi * round((within - theta_p) / (2.0 * math.pi))
            three = gains.gain_r * onto + gains.gain_p * theta_p * normal
            two = gains.gain_s * left.as_rotvec()
            R = Rotation.from_rotvec(gains.period * (three, two)[law]) * R
            # Sine of half the turn about other axes.
            half = float(np.linalg.norm(np.cross(axis, R.as_quat()[:3])))
            nearest = int(np.argmax(np.abs(two_turns.as_quat() @ R.as_quat())))
            from_plan = (two_turns[nearest].inv() * R).magnitude(), 2.0 * math.asin(min(1.0, half))
            off[law] = max(off[law], from_plan[law])
    return off


def composition_of(plan: Plan, gains: Gains) -> Composition:
    """Composition of the parts of a metric plan; raises WorkFailed if the task has no rotation."""
    distance = composition_error(plan)
    r, p = screws(plan.H_hat)[1:, :3]
    axis = (Rotation.from_rotvec(plan.theta_r * r) * Rotation.from_rotvec(plan.theta_p * p)).as_rotvec()
    translation = screws(plan.H_hat)[0, 3:]
    cosine = abs(float(translation @ axis)) / max(
        float(np.linalg.norm(translation) * np.linalg.norm(axis)), 1e-300
    )
    return Composition(
        np.array(_LAMBDAS), distance, math.acos(min(1.0, cosine)), orientation_bias(plan, gains)
    )


def run(inputs: ReportInputs, run: Run, directory: Path, *, progress: Progress = silent) -> Report:
    """Make the extra runs, draw the figures, measure the claims and write the page.

    run : with calibration, plan and traces; if there is no task, with the calibration. Of a robot without
        a model the page has plan and runs, and the figures that need no model.
    directory : folder of the run; receives ``figures/``, ``claims.json`` and ``report.html``.
    """
    with SecondProcess(useful=bool(run.traces)) as second:
        return _run(inputs, run, directory, progress, second)


def _run(
    inputs: ReportInputs, run: Run, directory: Path, progress: Progress, second: SecondProcess
) -> Report:
    """Make a report as ``run`` does, with the help of a second process."""
    left_out: list[dict[str, str]] = []
    report_data: Fit = Fit(run.calibration, run.observation.at_rest, held_out=run.cross_validation)
    metric, no_metric = in_metres(run.calibration, inputs.lengths)
    studies, composition, claims = None, None, []
    if inputs.extra is not None:
        bench = comparison_of(inputs.extra, run.calibration, run.plan)
        of_paper = set(DIRECT) <= run.traces.keys()
        if of_paper:
            with _unless_it_fails("studies", left_out):
                studies = run_studies(bench, progress=progress)
        report_data = _report_data(inputs, run, bench, studies, left_out)
        if of_paper:
            with _unless_it_fails("equation (22)", left_out):
                composition = composition_of(metric_plan(bench), bench.scenario.gains)
            claims = [claim._asdict() for claim in claims_of(report_data, composition)]
    elif run.traces:
        *_, last = run.traces
        part = last.split("/")[0] if "/" in last else ""
        plan, lacks = (run.at_step(part).plan, _OF_ONE) if part else (run.plan, Driven.lacks)
        known = run.calibration, run.observation.at_rest, plan, run.traces, lacks
        report_data = Driven(*known, held_out=run.cross_validation)
    report_data = replace(report_data, metric=metric, no_metric=no_metric)
    figures = _draw_all(report_data, directory, inputs.files.formats, left_out, progress, second)
    report = Report(
        figures=tuple(figures),
        omitted=tuple(left_out),
        claims=tuple(claims),
        metric=() if metric is None else tuple(metric_rows(metric, chosen_poses(metric, report_data))),
        step_limit_deg=STEP_LIMIT_DEG,
        share=np.zeros(0) if composition is None else composition.share,
        composition_mm=np.zeros(0) if composition is None else 1e3 * composition.distance,
        **study_numbers(studies),
    )
    content = {"claims": report.claims, "drift": drift_rows(report), "omitted": report.omitted}
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, indent=2)
    write_whole(directory / CLAIMS_FILE, f"{text}\n")
    for name in (VIEW_FILE, ANIMATION_FILE):  # files of runs that are not in this report
        (directory / name).unlink(missing_ok=True)
    result = Result("", run.configuration, provenance.collect(seed=inputs.about.seed), {}, {"": report})
    write_page(replace(run, results={**run.results, "report": result}), inputs.about)
    return report


@contextmanager
def _unless_it_fails(what: str, left_out: list[dict[str, str]]) -> Iterator[None]:
    """Do something that a report can be without; if it fails, say why."""
    try:
        yield
    except WorkFailed as error:
        left_out.append({"what": what, "reason": " ".join(str(error).split())})


def _report_data(
    inputs: ReportInputs,
    run: Run,
    bench: Comparison,
    studies: Studies | None,
    left_out: list[dict[str, str]],
) -> ReportData:
    """All that figures may show and claims be about."""
    truth = bench.truth
    return ReportData(
        calibration=run.calibration,
        observation=run.observation.at_rest,
        calibrated=bench.models["calibrated"],
        robot=truth.robot,
        plant=bench.scenario.plant_of("direct_three"),
        plan=run.plan,
        numbers=tuple(truth.number[i] for i in truth.face),
        traces=run.traces,
        studies=studies,
        no_studies=_WHY_NONE.format(left_out[-1]["reason"]) if left_out else "" if studies else _NOT_ASKED,
        stall_periods=bench.scenario.termination.stall_periods,
        held_out=run.cross_validation,
        trajectory=inputs.trajectory,
    )


def _draw_all(
    report_data: Fit,
    directory: Path,
    formats: Sequence[str],
    left_out: list[dict[str, str]],
    progress: Progress,
    second: SecondProcess,
) -> list[str]:
    """Draw every figure that the material supports, in all formats; the others are named with the reason.

    Files that an earlier report left of them, and formats that are not asked for now, are removed. Returns
    files written, relative to the folder.
    """
    folder = directory / FOLDER
    require_inside(folder, directory)
    drawings: list[Drawing] = []
    for spec in FIGURES:
        if reason := spec.lacking(report_data):
            left_out += [] if spec.optional else [{"what": spec.name, "reason": reason}]
            _replace_figure(folder, spec.name, {})
            continue
        if partial := spec.partly(report_data):
            left_out.append({"what": f"{spec.name}, in part", "reason": partial})
        drawings.append(Drawing(spec, spec.data(report_data), tuple(formats)))
    written: list[str] = []
    without = len(FIGURES) - len(drawings)
    progress("figures", without, len(FIGURES))
    for done, (drawing, files) in enumerate(zip(drawings, second.contents(drawings), strict=True), 1):
        numbers = {name: array for name, array in drawing.data.items() if array.dtype != np.uint8}
        if tuple(drawing.data.get("view", VIEWS)) == VIEWS:  # which need no names
            numbers.pop("view", None)
        _replace_figure(folder, drawing.spec.name, {_NUMBERS: to_csv(numbers).encode(), **files})
        written += [f"{FOLDER}/{drawing.spec.name}.{kind}" for kind in files]
        progress("figures", without + done, len(FIGURES))
    return written


def _replace_figure(folder: Path, name: str, contents: Mapping[str, bytes]) -> None:
    """Write the files of a figure by their kinds, and remove files of other kinds."""
    for kind in {*style.FORMATS, _NUMBERS} - {*contents}:
        (folder / f"{name}.{kind}").unlink(missing_ok=True)
    for kind, content in contents.items():
        with replacing(folder / f"{name}.{kind}", durable=False) as path:
            path.write_bytes(content)


def view(scenery: Scenery, run: Run, progress: Progress = silent) -> Path:
    """Write the 3D view of a run into its folder; a WorkFailed says that no run has a step to show."""
    truth, traces = scenery.truth, _moved(run)
    plant = plant_of(truth, run.plan.q_start, opaque=scenery.opaque)
    joints = "simulated joints" if scenery.simulated else "joints that the robot itself reported"
    known = f"Robot, rig and face as the configuration describes them, moved by the {joints}."
    path = run.path.parent / VIEW_FILE
    progress("view", 0, 1)
    motion = motion_of(truth.robot, plant, truth.M, run.plan, traces)
    write_view(path, motion, name=scenery.name, known=known)
    progress("view", 1, 1)
    return path


def animation(size: ImageSize | None, run: Run, progress: Progress = silent) -> Path:
    """Write the film of both camera images into the folder of a run, as GIF; fails as ``view`` does.

    size : width and height, px, of both images or of one each, if known.
    """
    path, traces = run.path.parent / ANIMATION_FILE, _moved(run)
    write_animation(path, traces, cyclic_order(run.plan.A), size, progress)
    return path


def _moved(run: Run) -> dict[str, Trace]:
    moved = {name: trace for name, trace in run.traces.items() if trace.steps > 0}
    if not moved:
        raise WorkFailed("no run of a law has a step to show; make one: projservo servo")
    return moved
