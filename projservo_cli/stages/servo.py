"""Stage servo: one control law in closed loop with a robot, from the start of the task to its verdict."""

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from projservo_cli import plugins
from projservo_cli.control.law import ERRORS, LOST, MAX_PARTS, OK, TAU_AFFINE, THETA_S, Gains
from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, Subject
from projservo_cli.geometry.algebra import as_array, mat
from projservo_cli.geometry.kernels import COORDINATES
from projservo_cli.geometry.kinematics import forward
from projservo_cli.geometry.lens import undistort
from projservo_cli.geometry.mechanisms import in_span
from projservo_cli.laws import CODES, INCIDENCES, REGULATE, law_and_mode
from projservo_cli.loop.compiled import Course, run_compiled
from projservo_cli.loop.python import BuiltInLaw, LoopLaw, run_in_python
from projservo_cli.loop.replanning import ExecutionMonitor
from projservo_cli.loop.run_metrics import Ended, Summary, angle_between, path_deviation, summarize
from projservo_cli.loop.stall_monitor import StallMonitor
from projservo_cli.loop.verdicts import (
    CONVERGED,
    FAULT_DETECTED,
    OBJECT_MOVED,
    PLATEAU_FALL,
    VERDICT_NAMES,
    Log,
    new_log,
    plateau_stretch,
    tolerance,
)
from projservo_cli.monitoring.accuracy import Posture, metres_a_unit, rigid_fit
from projservo_cli.monitoring.innovation_tests import WINDOW
from projservo_cli.plugins import what_failed
from projservo_cli.records import (
    MM,
    TOOL,
    WORLD,
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    Model,
    Plan,
    Trace,
    WorkFailed,
)
from projservo_cli.results import ImageModel
from projservo_cli.robots.client import DrivenRobot
from projservo_cli.robots.session import Session
from projservo_cli.robots.standstill import STILL
from projservo_cli.simulation.analytic_plant import AnalyticPlant, Ends, Plant, rig_distance
from projservo_cli.simulation.faults import obstruction_of
from projservo_cli.simulation.workspace import Truth
from projservo_cli.stages import external_robot
from projservo_cli.stages.motions import PathReplanner, search_of, why_closed
from projservo_cli.stages.scenario import RunScenario, run_scenario
from projservo_cli.stages.stage_inputs import ServoInputs
from projservo_cli.task.body import SETTLED, fit_body, make_body
from projservo_cli.task.face import Task, center_of
from projservo_cli.task.incidences import (
    errors_px,
    images_of,
    incidences_of,
    metric_errors,
    nearest_goal,
    whole_pose,
)
from projservo_cli.task.target import TaskImages, followed
from projservo_cli.words import failed, order_advice, text
from projservo_cli.words.reasons import VERDICTS, arrived
from projservo_cli.words.table import Setup
from projservo_cli.words.values import all_of

_RETREAT = 10  # periods by which an arm goes back where the object of its goal moves
_NOT_DRIVEN: Any = None  # in place of what a run leaves


def _point_velocities(M: FloatArray, motions: FloatArray) -> FloatArray:
    """Return the velocities (3 m, 6) of metric points (m, 4) by motions (6, 4, 4), to measure these by."""
    return np.asarray(np.einsum("kab,mb->mak", motions, M)[:, :3].reshape(-1, COORDINATES))


def _stands_at(driven: DrivenRobot, q: FloatArray) -> bool:
    """Whether a robot stands at joints (n,), as near as it is held."""
    away = np.abs(driven.steered.observe().q - q)
    return bool((away <= np.maximum(driven.robot.bounds.sag, STILL)).all())


@dataclass(eq=False)
class LawRun:
    """A run of a law: made, driven to its verdict, and summed up."""

    scenario: RunScenario
    plan: Plan | FloatArray  # of the task, or the joint motions (2, n) of its rotations where that is enough
    law: str
    mode: str = REGULATE  # law, mode: of the run
    planned_s: float | None = None  # when the plan that it follows arrives, s
    unplanned: str = ""  # why it goes without the plan that it was to follow
    believed: Model | None = None  # robot and rig as the law has them; None for the default of its kind
    factory: Callable[[Any], Any] | None = None  # makes the law of its setup; None for that of its name
    robot: Any = None  # an object of the contract; None for that of the configuration
    blind: bool = False  # whether a robot may move although cameras show no marker of the calibration
    session: Session | None = None  # whose robot is driven; None for a connection of its own
    # As it ended.
    verdict: str = ""
    why: Finding | None = None  # what held, disturbed or failed it, where something did
    steps: int = 0  # commands sent
    log: Log = _NOT_DRIVEN  # the recorded run, once it was driven
    limited: float = 0.0  # how often visibility limited the translation
    plant: Plant = _NOT_DRIVEN  # that was driven; of an external robot the calibrated model
    replannings: tuple[Finding, ...] = ()
    driven: DrivenRobot | None = None  # client of a robot of the contract
    unseen: Finding | None = None  # cameras that showed nothing before the run, though they were compared
    noise_ratio: float = 1.0  # of what pixels stated at the end to the noise of the run; at least 1
    own_tolerance: float | None = None  # of an error that a law of somebody's states

    @property
    def own_unit(self) -> float:
        """Factor of errors that decide convergence, in px, to what they are told in."""
        own = self.own_tolerance
        return 1.0 if own is None else own / self.scenario.termination.image_error_px

    @property
    def setup(self) -> Setup:
        """Return the arm and the cameras for words."""
        mount = TOOL if self.scenario.model.on_tool else WORLD
        return Setup(mount, self.scenario.view, len(self.scenario.joints.units))

    @property
    def judged(self) -> tuple[str, str]:
        """Name and unit of the error that decides convergence, as words have them."""
        if self.own_tolerance is not None:
            return "error of the law", ""
        if self.scenario.exact.incidences and not math.isnan(float(self.log.fit[self.steps, 2])):
            return "error of the incidences", "px"
        return "image error", "px"

    @property
    def replans(self) -> bool:
        """Whether the law goes its own way instead of following the plan."""
        return self.mode == REGULATE or bool(self.unplanned)

    @property
    def is_guided(self) -> bool:
        """Whether the run follows a plan which gives way to another one where it fails."""
        scenario = self.scenario
        searched = scenario.inputs.trajectory.profile in ("joint_space", "auto")
        if self.replans or self.law not in CODES or not searched:
            return False
        return not why_closed(scenario.model, scenario.demands, search_of(scenario))

    def simulated(self) -> tuple[Plant, FloatArray, FloatArray]:
        """The simulated robot as the law sees it, its first joints (n,), and the noise of its images."""
        scenario = self.scenario
        noise = scenario.noise_of(self.law, scenario.inputs.seed, scenario.termination.max_steps + 1)
        return scenario.plant_of(self.law), scenario.ends.q_start, noise

    def compiled(self) -> None:
        """Drive a built-in law on the simulated robot in the compiled loop."""
        scenario, controller = self.scenario, self._built_in()
        limits, observed = scenario.termination, len(scenario.numbers_of(self.law))
        self.plant, q_start, noise = self.simulated()
        parts = MAX_PARTS if scenario.gains.substeps else 0
        V = len(scenario.view)
        self.log = new_log(len(q_start), observed, limits.max_steps, len(ERRORS), parts, V)
        course = Course(self.plant, limits, q_start.copy())
        code, self.steps = run_compiled(controller.law, course, noise, controller.state, self.log)
        self.verdict, self.limited = VERDICT_NAMES[code], float(controller.state.limited[0])

    def by_contract(self) -> None:
        """Drive a robot of the contract from the start of the task, where a simulated one stands.

        That of ``plant.use`` is driven there, unless it starts where it stands. Before its first motion, its
        images must agree with the calibration where it stands. The robot is stopped and closed on every way
        out, in a shared session at its end.
        """
        scenario, contract = self.scenario, self.scenario.servo.contract
        assert contract is not None
        own = scenario.truth is None
        if own and (scenario.calibration is None or not scenario.calibration.usable):
            raise WorkFailed("the calibration is not usable, and no robot is driven with it: calibrate again")
        if own and scenario.calibration is not None and (order := order_advice(scenario.calibration)):
            raise InputError(
                f"{order}, or set data.joint_order=stated if it is known; no robot is driven before"
            )
        controller = self.controller()
        shared, plan = self.session, self.plan if isinstance(self.plan, Plan) else None
        # The matrices of a frame are small: a second thread costs more than it gives.
        with threadpool_limits(limits=1), nullcontext(shared) if shared else Session() as session:
            driven = external_robot.connected_robot(scenario, self.law, session, self.robot, plan)
            driven.stops = shared is None
            if own:
                driven.robot.require_identity(contract.identity)
                wrong = driven.fits()
                refutes = not driven.object_moved
                if wrong:
                    raise self._stopped("the robot did not move, since at the start", wrong, refutes=refutes)
                assert contract.settle_s is not None
                start, settle_s = scenario.ends.q_start, contract.settle_s
                unseen = self._require_images(driven, "the robot did not move, since where it stands", 1)
                stands = scenario.starts_here and _stands_at(driven, start)
                path = external_robot.path_to(driven.steered, start, settle_s, "servo")
                for _ in () if stands else path:
                    if wrong := driven.agrees():
                        refutes = not driven.object_moved
                        raise self._stopped("stopped on the path to the start, since", wrong, refutes=refutes)
                if wrong := driven.at_rest(held=True):
                    raise self._stopped("stopped at the start, since", wrong, refutes=True)
                at_start = self._require_images(driven, "stopped at the start of the task, since", 2)
                self.unseen = at_start or unseen
            driven.begin()
            driven.retreats = _RETREAT
            self.in_python(controller, driven, StallMonitor(driven, scenario.termination))

    def _stopped(self, what: str, fault: Finding, *, refutes: bool) -> WorkFailed:
        """Return the failure of a robot that a fault stopped before the run."""
        return failed([fault], self.setup, begin=f"{what} ", refutes=refutes)

    def _require_images(self, driven: DrivenRobot, what: str, seeing: int) -> Finding | None:
        """Refuse to move a robot of which fewer than so many cameras show markers, unless that was asked for.

        Of fewer cameras, all must.
        """
        unseen = driven.unseen(seeing, held=seeing > 1)
        if unseen and not self.blind:
            found = [unseen, *driven.robot.remarks()]
            mend = (
                f": uncover {all_of(driven.robot.view)} and look at the light, or move the arm by hand to "
                "where they see the tags; --blind (blind=True) drives it without images"
            )
            raise failed(found, self.setup, mend, begin=f"{what} ")
        return unseen

    def in_python(
        self, law: LoopLaw, plant: AnalyticPlant | DrivenRobot, stall: StallMonitor | None = None
    ) -> None:
        """Drive a law on a plant, every command scaled; a run that is guided is watched."""
        scenario, execution = self.scenario, None
        if self.is_guided and isinstance(law, BuiltInLaw):
            assert isinstance(self.plan, Plan)
            follow, searches = partial(self._task, law.law.model), scenario.servo.max_replan_attempts
            replanner = PathReplanner(scenario, self.plan)
            blind, limits = self.blind or scenario.truth is not None, scenario.termination
            execution = ExecutionMonitor(law, follow, replanner, searches, limits, stall, blind=blind)
        code, self.steps, self.log = run_in_python(
            law,
            plant,
            scenario.ends.by_points().s_star,
            scenario.gains.period,
            scenario.termination,
            scenario.servo.speed_scale,
            stall=stall,
            execution=execution,
        )
        self.noise_ratio = plant.noise_ratio
        if isinstance(law, PluginLaw) and law.states_error:
            self.own_tolerance = law.tolerance
        if isinstance(plant, DrivenRobot):
            self.driven = plant
            if code == CONVERGED and plant.at_rest():
                code = FAULT_DETECTED
            if code == FAULT_DETECTED and plant.object_moved:
                code = OBJECT_MOVED
            # It moves from sample to sample, in any mode.
            path = np.stack([self.log.q, np.roll(self.log.q, -1, axis=0)], axis=1)
            self.log = self.log._replace(path=path, parts=np.ones_like(self.log.parts))
        self.verdict, self.plant = VERDICT_NAMES[code], plant.plant
        self.limited = float(law.state.limited[0]) if isinstance(law, BuiltInLaw) else 0.0
        self.why = plant.disturbance or (None if stall is None else stall.reason)
        self.replannings = () if execution is None else tuple(execution.attempts)

    def _task(self, model: Model, plan: Plan) -> Task:
        """The task as a built-in law with a model is given it, with the plan that it follows."""
        scenario = self.scenario
        task, scale = scenario.images_for(self.law).task(model), scenario.servo.speed_scale
        return followed(model, task, plan, scenario.gains.period, scale)

    def _images(self) -> TaskImages:
        """Start and goal as the law measures them, with the whole pose for a law of incidences without any.

        Raises InputError for such a law without a body.
        """
        images = self.scenario.images_for(self.law)
        if self.law != INCIDENCES or images.incidences:
            return images
        if not len(images.body.M):
            raise InputError(
                f"{self.law} measures with the body: leave control.features: points out, and calibrate well"
            )
        return images._replace(incidences=whole_pose(images.body.M[: self.scenario.m]))

    def _built_in(self) -> BuiltInLaw:
        """The built-in law with the model that it is given, and the sense of its rotations."""
        scenario, plan = self.scenario, self.plan
        model = self.believed or scenario.believed_by(self.law)
        if self.replans:
            task = self._images().task(model)
        else:
            assert isinstance(plan, Plan)
            task = self._task(model, plan)
        found = BuiltInLaw(CODES[self.law], model, task, scenario.gains)
        sense = plan.rotation_sense() if isinstance(plan, Plan) else plan
        found.state.driven[:] = in_span(found.state.work.span, model, scenario.ends.q_start, sense)
        return found

    def controller(self) -> LoopLaw:
        """The law, ready for the Python loop.

        Raises InputError if there is no such law, it needs a model of the robot that the configuration lacks,
        or the plan to follow has no time; WorkFailed if it cannot be made, or the joints cannot follow the
        plan.
        """
        if self.law in CODES:
            return self._built_in()
        scenario, gains, ends = self.scenario, self.scenario.gains, self.scenario.ends.by_points()
        assert scenario.calibration is not None
        assert isinstance(self.plan, Plan)
        face = np.array(scenario.calibration.indices_of(scenario.numbers[: scenario.m]))
        model, shown = ImageModel.of(scenario.calibration), (ends.s_start, ends.s_star)
        # A copy: no law may write to the arrays of another.
        setup = copy.deepcopy(LawSetup(model, face, *shown, self.plan, gains, gains.period))
        factory = self.factory or plugins.find("law", self.law)
        law = plugins.called("law", self.law, factory, (setup,), {})
        return PluginLaw(law, f"law {self.law}", scenario.least_views, scenario.termination.image_error_px)

    @cached_property
    def summary(self) -> Summary:
        """Numbers of the run; NaN if they need an unknown truth."""
        ended = Ended(VERDICT_NAMES.index(self.verdict), self.steps, self.limited)
        found = summarize(self.plant, self.log, ended, self.scenario.gains.period, self.true_ends)
        return found if self.scenario.truth is not None else found._replace(success=math.nan)

    @property
    def self_occluded_steps(self) -> tuple[int, ...]:
        """Number of times (V,) at which each camera is behind the face."""
        return tuple(np.count_nonzero(self.log.hidden[: self.steps + 1], axis=0).tolist())

    def deviation_mm(self) -> float:
        """Largest distance of the true centre from its line, between the samples too, mm; NaN if unknown."""
        goal, period = self.true_ends.goal, self.scenario.gains.period
        if not np.isfinite(goal).all():
            return math.nan
        start = self.log.H[0] @ np.array(center_of(self.plant.M, self.plant.center))
        between = path_deviation(self.plant, self.log, self.steps, period, start, goal)
        return max(MM * between, self.summary.center_deviation_at_samples_mm)

    def _incidences(self) -> dict[str, Any]:
        """Names of the incidences, their errors at each time, px, and the freedoms that they leave."""
        scenario, images = self.scenario, self.scenario.ends
        if not images.incidences:
            return {}
        task, model = images.task(scenario.model), scenario.model
        seen, normal = undistort(model.lens, self.log.s), np.zeros((COORDINATES, COORDINATES + 1))
        H = np.full((self.steps + 1, 4, 4), math.nan)  # measured, as far as images show it
        for k in range(len(H)):
            fit = fit_body(model.P, task.body, seen[k], forward(model, self.log.read[k]), SETTLED, normal)
            if fit.settled:
                H[k] = as_array(fit.H)
        taught = images.displacement_taught(model)
        mm, deg = metric_errors(model, images.incidences, task.body.M, (H[-1], taught))
        flats = [[one.tool for one in images.incidences], [one.scene for one in images.incidences]]
        metre = metres_a_unit(model, task.body.M[: scenario.m], scenario.inputs.lengths)
        return {
            "feature_s": images_of(model, task.body.M, flats[0], H),
            "feature_s_star": images_of(model, task.body.M, flats[1], taught[None])[0],
            "incidence_mm": MM * mm * metre,
            "incidence_deg": deg,
            "incidences": tuple(one.name for one in images.incidences),
            "incidence_px": errors_px(task.incidences, H),
            "free_dof": self.plan.free_dof if isinstance(self.plan, Plan) else None,
        }

    @cached_property
    def true_ends(self) -> Ends:
        """True poses of the tool, with the nearest goal to where it ended where incidences leave it open."""
        scenario, ends = self.scenario, self.scenario.true_ends
        if not scenario.exact.incidences or scenario.truth is None or not np.isfinite(ends.goal_pose).all():
            return ends
        model, on_tool = scenario.truth.model, self.plant.model.on_tool
        H_taught = ends.goal_pose @ np.linalg.inv(ends.base_tool)
        body = make_body(model, scenario.truth.of(scenario.numbers))
        rows = incidences_of(
            model, body, np.linalg.inv(H_taught) if on_tool else H_taught, scenario.exact.incidences
        )
        H = nearest_goal(rows, body, self.log.H[self.steps], _point_velocities)
        pose = (np.linalg.inv(H) if on_tool else H) @ ends.base_tool
        return Ends(ends.base_tool, pose, H @ np.array(center_of(self.plant.M, self.plant.center)))

    def trace(self) -> Trace:
        """Record of the run."""
        scenario, log, steps = self.scenario, self.log, self.steps
        rows = steps + 1
        before, after, views = log.fit[:rows].T
        errors, H, read = log.errors[:rows], log.H[:rows], log.read[:rows]
        # A law that follows a plan measures the distance to the plan, not to the goal.
        remaining = _left(log, steps) if self.mode == REGULATE else (None, None)
        joint = int(log.events[2])
        stretch = plateau_stretch(log.judged[:rows], scenario.termination.stall_periods)
        s_star = scenario.ends.by_points().s_star
        simulated = scenario.truth is not None
        center = np.asarray(H @ np.array(center_of(self.plant.M, self.plant.center)))[:, :3]
        driven = self.driven
        dark = _blind_view(log.s[:rows], scenario.view, WINDOW) if driven and arrived(self.verdict) else ()
        lost = [self.unseen] if self.unseen else dark
        untested = () if driven is None else scenario.untested
        found = (*_reason(self, joint, remaining), *self.replannings)
        if driven is not None:  # the log has the predicted rest of the robot instead of readings
            read = _whole(driven.readings, rows)
        values = self.summary._asdict() | {"center_deviation_mm": self.deviation_mm()}
        moved = np.linalg.inv(H) if self.plant.model.on_tool else H
        pose, goal_pose = moved @ self.true_ends.base_tool, self.true_ends.goal_pose
        if driven is not None and driven.truths and not simulated:
            pose, goal_pose = _reported_poses(scenario, _whole(driven.truths, rows))
            values["position_error_mm"] = MM * float(np.linalg.norm(goal_pose[:3, 3] - pose[-1, :3, 3]))
            values["rotation_error_deg"] = math.degrees(angle_between(mat(pose[-1]), mat(goal_pose)))
        numbers: dict[str, Any] = {n: None if math.isnan(values[n]) else values[n] for n in _SUMMARY_FIELDS}
        if simulated:
            numbers["success"] = values["success"] == 1.0
        return Trace(
            **numbers,
            view=scenario.view,
            self_occluded_steps=self.self_occluded_steps,
            law=self.law,
            mode=self.mode,
            planned_s=self.planned_s,
            verdict=self.verdict,
            reason=text(found, self.setup),
            findings=found,
            replan_attempts=len(self.replannings),
            steps=steps,
            period=scenario.gains.period,
            features="points" if np.isnan(views).all() else "body",
            remaining_translation=remaining[0],
            remaining_rotation_deg=remaining[1],
            longest_stall_steps=0 if stretch is None else stretch[1] - stretch[0],
            limit_joint=joint,
            q=log.q[:rows],
            q_read=None if np.array_equal(read, log.q[:rows]) else read,
            s=np.ascontiguousarray(log.s[:rows, :, : s_star.shape[1]]),
            s_star=s_star,
            image_error=log.error[:rows],
            convergence_error=self.own_unit * log.judged[:rows],
            tau=errors[:, 0],
            tau_affine=errors[:, 1],
            theta_r=errors[:, 2],
            theta_p=errors[:, 3],
            theta_s=errors[:, 4],
            prediction_px=_rms(before, 2.0 * views),
            fit_px=_rms(after, 2.0 * views - COORDINATES),
            views_used=views,
            q_dot=log.q_dot[:steps],
            speed_factor=log.factor[:steps],
            self_occluded=log.hidden[:rows] > 0.5,
            pose=pose,
            goal_pose=goal_pose,
            center=center if simulated else np.full_like(center, np.nan),
            unplanned=self.unplanned,
            **self._incidences(),
            **_stated_mm(self, views),
            untested=text((*untested, *lost), self.setup),
            overruns=None if driven is None else driven.steered.overruns,
            force=None if driven is None or not driven.forces else _whole(driven.forces, rows),
            latency=None if driven is None else _whole(driven.delays, rows),
            **({} if driven is None else driven.film.fields()),
        )


# Numbers of a trace that are those of the summary of its run, and one more.
_SUMMARY_FIELDS = [
    field.name for field in fields(Trace) if field.name in {*Summary._fields, "center_deviation_mm"}
]


def _whole(values: Sequence[FloatArray] | Sequence[float], rows: int) -> FloatArray:
    """Return the values at each time of a run, (rows, ...); NaN after its end."""
    missing = np.full_like(values[0], np.nan)
    return np.array([*values, *[missing] * (rows - len(values))])


def _reported_poses(scenario: RunScenario, truths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return poses (k, 4, 4) of the tool as a robot reports them, and at the goal (4, 4), m; NaN if unknown.

    truths : the poses, or joints (k, n), from which a configured arm gives them.
    """
    arm, goal = scenario.inputs.arm, np.full((4, 4), np.nan)
    if arm is not None and len(scenario.joints_at_goal):
        goal = arm.pose(scenario.joints_at_goal[0])
    if truths.ndim == 3:
        return truths, goal
    return np.array([goal * np.nan if arm is None else arm.pose(q) for q in truths]), goal


# Maximum residual of a body that agrees with its calibration, over the noise, px.
_AGREES, _LEAST_NOISE_PX = 4.0, 0.01
# Image error of a face of three markers as it is seen, over that which counts as converged: by noise once in
# ten thousand.
_BY_NOISE = 2.0
# Noise of markers at the end, over that of the run, that is told.
_VAGUE = 3.0
# Joints that moved by less in the steps in which an error must fall hardly did, rad or m.
_HARDLY = 0.01
# A plan is of a task where its start, rad or m, and its goal images, px, are the same but for rounding and
# another calibration of the same rig.
_SAME_START, _SAME_GOAL_PX = 1e-6, 10.0


def _stated_mm(run: LawRun, views: FloatArray) -> dict[str, Any]:
    """State how far the face ended from the goal, rms mm: by images, and by what no test tells from none.

    Nothing if no length on the face is known, or images disagree with the calibration.
    """
    scenario, calibration, m = run.scenario, run.scenario.calibration, run.scenario.m
    if scenario.exact.incidences:  # from one goal of many
        return {}
    noise = [_LEAST_NOISE_PX, scenario.noise_px, 0.0 if calibration is None else calibration.sigma_px]
    left = _rms(run.log.fit[run.steps, 1:2], 2.0 * views[-1:] - COORDINATES)[0]
    untested = run.driven is not None and scenario.untested
    ended = VERDICTS[run.verdict]
    if ended.refutes or ended.retried or untested or left > _AGREES * max(noise):
        return {}
    numbers, q, known = scenario.numbers_of(run.law), run.log.read[run.steps], calibration or scenario.truth
    assert known is not None
    M = known.of(numbers) if isinstance(known, Truth) else known.M[known.indices_of(numbers)]
    s, s_star = run.log.s[run.steps], scenario.images_for(run.law).s_star
    posture = Posture(scenario.model, q, M[:m], scenario.inputs.lengths)
    whole = np.isfinite(s[:, :m]).all(axis=(1, 2))
    if not posture.known or whole.sum() < scenario.least_views:
        return {}
    used: BoolArray = np.isfinite(s + s_star)[..., 0]
    off = np.where(used[..., None], s - s_star, 0.0).ravel()
    # By all markers that the law measures with, and by the face itself.
    measured = (used, used & (np.arange(len(numbers)) < m))
    parts, found = [max(float(np.linalg.norm(posture.carry(M, by) @ off)) for by in measured)], {}
    if calibration is not None and run.driven is not None and run.driven.monitor is not None:
        every = np.zeros((len(scenario.view), len(calibration.marker)), dtype=np.bool_)
        every[:, calibration.indices_of(numbers)] = used
        found["undetected_position_error_mm"] = run.driven.monitor.undetected_mm(q, every, posture)
    if isinstance(run.plan, Plan) and run.plan.object_name is not None:
        parts.append(run.plan.goal_deviation_mm or 0.0)
    elif calibration is not None and (goal := scenario.goal_pixels) is not None:
        parts.append(rigid_fit(calibration, q, *goal).off_mm(posture, calibration.M))
    return found | {"estimated_position_error_mm": float(np.linalg.norm([*parts, *found.values()]))}


def _left(log: Log, steps: int) -> tuple[float | None, float | None]:
    """Share of the translation and rotation, deg, that were left; None where the law measures neither."""
    first, last = (float(log.errors[k, TAU_AFFINE]) for k in (0, steps))
    turn = float(log.errors[steps, THETA_S])
    share = last / first if first > 0.0 and math.isfinite(last) else None
    return share, math.degrees(turn) if math.isfinite(turn) else None


def _rms(squares: FloatArray, count: FloatArray) -> FloatArray:
    """Root of the mean of sums of squares; NaN where the count is not positive."""
    mean = np.full(squares.shape, math.nan)
    np.divide(squares, count, out=mean, where=count > 0.0)
    return np.asarray(np.sqrt(mean))


def _stalled_by(run: LawRun) -> Finding:
    """Return why the image error stopped falling: commands too slow to lower it, or a local minimum.

    Joints that move on at their limits, as a law asks of them near a singularity, are not slow.
    """
    gains, window = run.scenario.gains, run.scenario.termination.stall_periods
    minimum = Finding("local_minimum", LIMITS)
    if run.steps < window:
        return minimum
    limited = float(np.median(run.log.factor[run.steps - window : run.steps]))
    share = min(1.0, max(gains.gain, gains.gain_s) * gains.period * gains.scale * limited)
    moved = np.abs(np.diff(run.log.read[run.steps - window : run.steps + 1], axis=0)).sum(axis=0).max()
    if 1.0 - (1.0 - share) ** window > 2.0 * PLATEAU_FALL or moved > _HARDLY:
        return minimum
    return Finding("slow_commands", LIMITS, amount=share)


def _reason(run: LawRun, joint: int, remaining: tuple[float | None, float | None]) -> Iterator[Finding]:
    """Yield the reasons of the verdict."""
    log, steps, limits, verdict = run.log, run.steps, run.scenario.termination, run.verdict
    name, unit = run.judged
    error, within = (
        run.own_unit * value
        for value in (float(log.judged[steps]), tolerance(limits, float(log.fit[steps, 2]), run.noise_ratio))
    )
    own = Finding(
        verdict.replace(" ", "_"), REFUSES, Subject(name=name, joints=(joint + 1,)), error, unit=unit
    )
    at_step = replace(own, amount=float(steps), unit="1")
    if verdict == "converged":
        yield replace(own, severity=NOTE, limit=within)
        yield from (*_vague(run), *_apart(run), *_unkept(run, at_step))
        return
    if verdict == "no progress":
        yield replace(own, others=(run.why or _stalled_by(run),))
    elif verdict == "markers lost":
        unseen = Finding("marker_unseen", amount=limits.max_lost_periods, unit="1")
        yield replace(at_step, others=(run.why or unseen,))
    elif verdict == "diverged":
        yield _grown(run, own, at_step)
    elif verdict == "joint limit":
        unit = "m" if run.scenario.model.prismatic[joint] else "rad"
        yield replace(own, amount=float(log.read[steps, joint]), unit=unit)
    elif run.why is not None:
        yield run.why
    else:
        yield own if verdict == "max steps" else at_step
    if verdict in ("following error", "joint limit"):
        share, turn = remaining
        parts = [] if share is None else [Finding("share", amount=share, unit="1")]
        parts += [] if turn is None else [Finding("turn", amount=math.radians(turn), unit="rad")]
        yield replace(own, code="remaining", others=tuple(parts))
    yield from _blind_view(log.s[: steps + 1], run.scenario.view, limits.stall_periods)
    if run.driven is not None:
        yield from obstruction_of(run.driven.robot.robot)


def _grown(run: LawRun, own: Finding, at_step: Finding) -> Finding:
    """Return which of error, distance and command made a run diverge."""
    log, more = run.log, run.scenario.termination.diverged_factor
    times, first = (Finding("factor", amount=more),), run.own_unit * float(log.judged[0])
    at, begun = rig_distance(run.plant, run.plant.M @ log.H[run.steps].T), float(log.begun[0])
    if log.judged[run.steps] > more * log.begun[1]:
        return replace(own, code="error_grew", limit=first, others=times)
    if at > more * begun > 0.0:
        return replace(own, code="face_left", amount=at, limit=begun, unit="m", others=times)
    return replace(at_step, code="not_finite")


def _vague(run: LawRun) -> Iterator[Finding]:
    """Tell that markers are seen there with more noise than elsewhere."""
    if run.noise_ratio > _VAGUE:
        yield Finding("vague_markers", LIMITS, amount=run.noise_ratio, limit=_VAGUE)


def _apart(run: LawRun) -> Iterator[Finding]:
    """Tell that the face as it is seen is off by more than noise, though the whole body is not."""
    displaced = run.scenario.inputs.displaced  # to where it was never seen
    if run.scenario.exact.incidences or displaced:  # the face may be anywhere that they leave open
        return
    limits = run.scenario.termination
    by_noise = limits.image_error_px + (run.noise_ratio - 1.0) * limits.noise_px
    seen, most = float(run.log.error[run.steps]), _BY_NOISE * by_noise
    if seen > most:
        yield Finding("face_apart", LIMITS, amount=seen, limit=most, unit="px")


def _unkept(run: LawRun, at_step: Finding) -> Iterator[Finding]:
    """Tell which constraint a simulated run did not keep in truth, so that it is no success."""
    summary, hidden = run.summary, run.self_occluded_steps
    if summary.success != 0.0:
        return
    found = replace(at_step, severity=LIMITS)
    if summary.first_outside_image >= 0:
        yield replace(found, code="out_of_view", amount=float(summary.first_outside_image))
    if (step := summary.first_beyond_limit) >= 0:
        q, limits = run.log.q[step], run.plant.limits
        joint = int(np.argmax(np.maximum(limits.lower - q, q - limits.upper)))
        yield replace(found, code="joint_passed", subject=Subject(joints=(joint + 1,)), amount=float(step))
    for name, steps in zip(run.scenario.view, hidden, strict=True):
        if steps:
            yield replace(found, code="face_hidden", subject=Subject(views=(name,)), amount=float(steps))


def _blind_view(s: FloatArray, names: Sequence[str], window: int) -> Sequence[Finding]:
    """Return the camera that showed no marker in the last images (k, V, m, 2), and since when."""
    for view, name in enumerate(names):
        steps = np.flatnonzero(np.isfinite(s[:, view, :, 0]).any(axis=1))
        last = int(steps[-1]) if steps.size else -1
        if len(s) - last > window:
            return (Finding("blind_camera", LIMITS, Subject(views=(name,)), last + 1.0, unit="1"),)
    return ()


def run(inputs: ServoInputs, calibration: Calibration, plan: Plan, name: str, **brought: Any) -> Trace:
    """Drive one law in one mode from the start of the task to its verdict.

    name : of the run: that of the law, with the mode where it follows the plan, such as ``exact_track``.
    brought : by a caller: ``factory``, ``robot``, ``blind`` and ``session`` of ``LawRun``.
    Raises InputError if a part of the simulation is missing, the plan is of another task, or the plan to
    follow has no time; WorkFailed if the goal cannot be reached, or the joints cannot follow the plan and
    ``refuses`` is set.
    """
    task = inputs.plan.task
    if task is not None and task.start_joints is None and inputs.plan.q_current is None:
        # where the arm stood when it was planned
        inputs = replace(inputs, plan=replace(inputs.plan, q_current=plan.q_start))
    scenario = run_scenario(inputs, calibration)
    _require_its_task(scenario.towards(plan), plan)
    return drive(scenario, plan, name, **brought).trace()


def _require_its_task(scenario: RunScenario, plan: Plan) -> None:
    """Refuse a plan from another start, or to other goal images, with an InputError."""
    ends = scenario.ends.by_points()
    if ends.s_star.shape != plan.s_star.shape or ends.q_start.shape != plan.q_start.shape:
        what = "it has other joints or markers"
    elif (away := float(np.abs(ends.q_start - plan.q_start).max())) > _SAME_START:
        what = f"it starts {away:.3g} rad or m from task.start"
    elif (off := float(np.nanmax(np.abs(ends.s_star - plan.s_star), initial=0.0))) > _SAME_GOAL_PX:
        what = f"its goal images are {off:.3g} px from those of task.goal"
    else:
        return
    raise InputError(f"the plan is of another task than the configuration: {what}; plan this task first")


def drive(
    scenario: RunScenario, plan: Plan | FloatArray, name: str, believed: Model | None = None, **brought: Any
) -> LawRun:
    """Drive the run of a name to its verdict.

    plan : of the task; a built-in law that does not follow it needs but the joint motions (2, n) of its
        rotations, which give the sense of the turn.
    believed : robot and rig as the law has them; None for those that a law of its kind is given.
    Raises InputError, WorkFailed as of ``run``.
    """
    law, mode = law_and_mode(name)
    unplanned, planned_s = "", None
    if isinstance(plan, Plan):
        scenario = scenario.towards(plan)
    if scenario.inputs.trajectory.keep_out and not (isinstance(plan, Plan) and plan.feasible):
        raise WorkFailed("the plan is not feasible, and with trajectory.keep_out no law runs without one")
    if mode != REGULATE and isinstance(plan, Plan):
        if not np.isfinite(plan.q).all() and not scenario.servo.refuses:
            unplanned = f"no joints can follow the plan: {plan.reason}"
        elif plan.duration is not None:
            planned_s = plan.duration / scenario.servo.speed_scale
    run = LawRun(scenario, plan, law, mode, planned_s, unplanned, believed, **brought)
    if scenario.servo.contract is not None:
        run.by_contract()
    elif isinstance(plan, Plan) and (not _in_compiled_loop(scenario.servo, law) or run.is_guided):
        run.in_python(run.controller(), AnalyticPlant(*run.simulated()))
    else:
        run.compiled()
    return run


def _in_compiled_loop(inputs: ServoInputs, law: str) -> bool:
    """Whether the compiled loop runs a law; the others are run in Python and are given the whole plan."""
    return law in CODES and inputs.speed_scale == 1.0 and inputs.contract is None


def sense_is_enough(inputs: ServoInputs, name: str) -> bool:
    """Whether a run needs no more of the plan than the sense of its rotations."""
    law, mode = law_and_mode(name)
    asked = inputs.plan
    # Any other goal than a pose needs that of the plan.
    pose = law != INCIDENCES and not asked.incidences and asked.carrier is None
    return mode == REGULATE and _in_compiled_loop(inputs, law) and pose


@dataclass(frozen=True, eq=False)
class LawSetup:
    """Inputs of a plug-in law.

    Attributes
    ----------
    calibration : with ``predict(q)`` and ``jacobian(q)``.
    face : (k,) indices of the face markers among those of the calibration.
    s_start, s_star : (V, k, 2) pixels of the face at the start and at the goal.
    plan : the planned motion.
    gains : configured gains, limits and period.
    period : control period, s.
    """

    calibration: ImageModel
    face: IntArray
    s_start: FloatArray
    s_star: FloatArray
    plan: Plan
    gains: Gains
    period: float


class PluginLaw:
    """A law ``law(s, q) -> q_dot`` whose answers are checked; None holds the robot for a period.

    Parameters
    ----------
    law : pixels (V, k, 2) of the face and joint readings (n,) to joint velocities (n,), rad/s or m/s.
    name : of it, for messages.
    least_views : number of views that are to see the face.
    image_error_px : image error at which a run converges, px, unless the law states an error of its own:
        ``error(s, q)``, a number, and its ``tolerance``.
    """

    def __init__(
        self,
        law: Callable[[FloatArray, FloatArray], Any],
        name: str,
        least_views: int,
        image_error_px: float = math.inf,
    ) -> None:
        self.law, self.name, self.least_views = law, name, least_views
        self.errors = np.full(len(ERRORS), np.nan)
        self.face_px = np.full(1, math.nan)
        self._error: Any = getattr(law, "error", None)
        self.states_error, self.tolerance = callable(self._error), math.nan
        if self.states_error:
            stated = getattr(law, "tolerance", None)
            if isinstance(stated, bool) or not isinstance(stated, int | float) or not 0.0 < stated < math.inf:
                raise InputError(
                    f"{name}: has error(s, q) and tolerance {stated!r}: make it a positive number, in the "
                    "unit of the error"
                )
            self.tolerance, self._px = float(stated), image_error_px

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity of one instant; the law is asked where enough views show the face."""
        if np.isfinite(s).all(axis=(1, 2)).sum() < self.least_views:
            return LOST, np.zeros_like(q)
        try:
            answer = self.law(s.copy(), q.copy())
            if answer is None:
                return LOST, np.zeros_like(q)
            q_dot = np.array(answer, dtype=np.float64)
            if self.states_error:
                error = float(self._error(s.copy(), q.copy()))
                self.face_px[0] = error / self.tolerance * self._px
        except Exception as error:
            raise WorkFailed(f"{self.name}: failed: {what_failed(error)}") from error
        if q_dot.shape != q.shape or not np.isfinite(q_dot).all():
            raise WorkFailed(
                f"{self.name}: gave {answer!r:.80}: expected {len(q)} finite joint velocities, or None"
            )
        return OK, q_dot
