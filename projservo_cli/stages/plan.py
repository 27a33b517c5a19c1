"""Stage plan: the task's partition, where the face stays visible, and a motion that keeps it so."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from projservo_cli.control.law import State
from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, Subject, from_text, usable
from projservo_cli.geometry.algebra import as_array, vec
from projservo_cli.geometry.displacements import composed_angle
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators, project
from projservo_cli.geometry.lens import undistort
from projservo_cli.geometry.null_space import COORDINATES, RANK_TOLERANCE
from projservo_cli.image_size import image_sizes
from projservo_cli.loop.task_start import begin
from projservo_cli.messages import failed, lines, sentence_and_remedy, setup_of, text
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.monitoring.arrival_accuracy import RigidFit, metric_points, rigid_fit
from projservo_cli.monitoring.fault_at_rest import fault_at_rest
from projservo_cli.planning.incidence_goals import goals_meeting
from projservo_cli.planning.joint_constraints import constraints_of
from projservo_cli.planning.joints_from_images import NEAR_PX, joints_showing
from projservo_cli.planning.motion_margins import Demands, Motion, Reaching, best_views
from projservo_cli.records import (
    NO_SPREAD,
    Calibration,
    FaceVisibility,
    FloatArray,
    GoalOfIncidences,
    InputError,
    JointLimits,
    Model,
    Observation,
    Plan,
    PlannedMotion,
    TaskPartition,
    WorkFailed,
    in_sense,
)
from projservo_cli.robots.session import Session
from projservo_cli.settings.task import Trajectory
from projservo_cli.stages.carried_goals import carried_by
from projservo_cli.stages.plan_motion import (
    Found,
    JointSearch,
    body_at_start,
    by_profile,
    coupled,
    joint_path,
    kept_out,
    search_of,
    why_closed,
)
from projservo_cli.stages.plan_summary import findings_on, relaxed, search_summary, verdict_of
from projservo_cli.stages.scenario import Scenario, scenario_of
from projservo_cli.stages.stage_inputs import PlanInputs
from projservo_cli.task.face import Task, center_of, face_plane
from projservo_cli.task.incidence_contradictions import contradicting_incidences
from projservo_cli.task.incidences import errors_px, free_motions
from projservo_cli.task.partition import Parts
from projservo_cli.task.target import TaskImages
from projservo_cli.task.visibility import (
    arc_minimum,
    margin_coefficients,
    visibility_angles,
    visibility_translation,
)


def _partitioned(
    model: Model, images: TaskImages, trajectory: Trajectory, limits: JointLimits
) -> tuple[State, Task, Parts, bool]:
    """Measure and partition the task at its start; half turns are rehearsed within joint limits.

    Returns the state with face and joint motions, the task in the frame of the model, translation and
    rotations, a half turn in the sense that was rehearsed, and whether it arrived.
    """
    task, seen = images.task(model), undistort(model.lens, images.s_start)
    bounds = limits if trajectory.rehearses else None
    state, parts, arrives = begin(model, task, seen, images.q_start, bounds)
    return state, task, parts, arrives


def _joint_motions(state: State) -> FloatArray:
    """Joint motions t, r, p (3, n) of a partitioned task; zero if the joints are singular."""
    work = state.work
    if len(work.span.H_hat) == 0:
        return state.q_hat[:3].copy()
    J = work.span.dual @ work.H_hat.reshape(-1, 16).T
    q_hat, _, rank, _ = np.linalg.lstsq(J, state.q_hat[:3].T, rcond=RANK_TOLERANCE)
    return np.asarray(q_hat.T if rank == min(J.shape) else np.zeros_like(q_hat.T))


# Residual by noise and calibration of images that the joints can reach, px rms per marker and view.
_LEFT_PX = 3.0
_STAGES = 20  # instants of the plan at which the joints are sought
# Distance of a marker of the face from its plane, over its size, that noise of the calibration may show.
_UNEVEN = 0.05


def _require_in_span(model: Model, A: FloatArray, q_start: FloatArray, images: FloatArray) -> None:
    """Refuse a task whose goal leaves more than ``_LEFT_PX`` wherever the joints bring the face.

    The joints that bring the face A (m, 4) nearest to its planned images (s, V, m, 2), in px, are carried
    along the plan from those at the start (n,); SciPy's least squares do for twenty images.
    """
    M = A @ np.linalg.inv(forward_kinematics(model, q_start)).T
    q = q_start

    def miss(q: FloatArray, wanted: FloatArray) -> FloatArray:
        return (project(model.P, M @ forward_kinematics(model, q).T, model.lens) - wanted).ravel()

    for k in np.unique(np.linspace(0, len(images) - 1, _STAGES).astype(int)):
        q = least_squares(miss, q, args=(images[k],), method="lm", xtol=1e-12).x
    left = float(np.sqrt(np.mean(np.sum(miss(q, images[-1]).reshape(-1, 2) ** 2, axis=1))))
    if not left <= _LEFT_PX:
        joints = (Finding("joints", amount=float(len(q)), unit="1"),)
        off = Finding("beyond_joints", REFUSES, amount=left, limit=_LEFT_PX, unit="px", others=joints)
        raise failed([off])


def run(
    inputs: PlanInputs,
    calibration: Calibration,
    before: Plan | None = None,
    session: Session | None = None,
) -> Plan:
    """Partition the task and plan its motion, from the calibration and the images alone.

    before : plan to the same goal from elsewhere, whose location of an object holds; None to locate it again.
    session : connection to the robot that observes; None to open one.
    Raises InputError if the task is missing; WorkFailed if it cannot be partitioned.
    """
    known = set(calibration.marker.tolist())
    missing = [number for number in inputs.markers.face if number not in known]
    if missing:
        raise WorkFailed(
            f"markers.face names marker {missing[0]}, which the calibration has not seen: "
            f"choose among {', '.join(map(str, sorted(known)))}"
        )
    scenario = scenario_of(inputs, calibration)
    if not scenario.untested:
        _require_taught_since(scenario, calibration)
    carried = carried_by(scenario, inputs.carriers, before, session)
    scenario = scenario.carried(carried)
    plan = _to_any_goal(scenario) if inputs.incidences else _plan_in(scenario)
    face = metric_points(scenario.world.model, calibration.M[calibration.indices_of(inputs.markers.face)])
    further = (
        *calibration.open_order,
        *_borders(inputs, calibration.view),
        *(() if face is None else _uneven(face)),
    )
    reason = "; ".join((plan.reason, *lines(further, setup_of(calibration))))
    return replace(plan, reason=reason, findings=plan.findings + further, carried=carried)


def _plan_in(scenario: Scenario) -> Plan:
    """Plan the task of a scenario as its trajectory is configured; raises as ``plan_task``."""
    asked = scenario.world.inputs.trajectory
    search = search_of(scenario) if asked.needs_covariance else None
    return plan_task(scenario.world.model, scenario.ends, asked, scenario.demands, search)


# Goals to which a motion is planned until one is feasible.
_GOALS = 6


def _to_any_goal(scenario: Scenario) -> Plan:
    """Plan to the first goal of all incidences that a feasible motion reaches, otherwise to the best one.

    Raises WorkFailed if no joints meet all incidences, with those that fail, or no motion leads to a goal.
    """
    model, ends = scenario.world.model, scenario.ends
    H_taught, shows = ends.displacements_taught(model), np.isfinite(ends.s_star[..., 0])
    scenes = ends.scenes(H_taught)
    asked, sigma_px = ends.goal.incidences, scenario.goal_error_px
    apart = tuple(contradicting_incidences(model, ends.body, H_taught[0], scenes, asked, shows, sigma_px))
    if not usable(apart):
        raise failed([one for one in apart if one.severity == REFUSES])
    state, task, _, _ = _partitioned(model, ends, scenario.world.inputs.trajectory, scenario.demands.limits)
    names = tuple(one.name for one in asked)
    body = body_at_start(model, task, ends, state.A)
    c = constraints_of(model, body, task, ends.q_start, scenario.demands)
    seed = scenario.world.inputs.trajectory.search.seed
    goals, nearest = goals_meeting(c, task.incidences, ends.q_start, scenario.goal_joints, seed, _LEFT_PX)
    if not len(goals):
        (left,) = errors_px(task.incidences, forward_kinematics(model, nearest)[None])
        each = sorted(zip(left.tolist(), names, strict=True), reverse=True)
        missed = [
            Finding("incidence", subject=Subject(name=name), amount=px, limit=_LEFT_PX, unit="px")
            for px, name in each
            if px > min(_LEFT_PX, 0.5 * each[0][0])
        ]
        raise failed([*apart, Finding("unmet_incidences", REFUSES, others=tuple(missed))])
    plans, failures = [], []
    for q in goals[:_GOALS]:
        H = forward_kinematics(model, q)
        s_goal = project(model.P, task.body.M @ H.T, model.lens)
        chosen = replace(scenario, s_chosen=s_goal, goal_joints=q[None])
        try:
            plan = _plan_in(chosen)
        except WorkFailed as error:
            failures.append(error)
            continue
        free = len(free_motions(task.incidences, H, joint_operators(model, q)))
        plans.append(
            replace(plan, open_goal=GoalOfIncidences(incidences=names, free_dof=free, s_goal=s_goal))
        )
        if plan.feasible:
            break
    if not plans:
        raise failures[0]
    best = plans[-1] if plans[-1].feasible else plans[0]
    reason = "; ".join((best.reason, *lines(apart, _setup(ends))))
    return replace(best, reason=reason, findings=best.findings + apart)


def _borders(inputs: PlanInputs, view: Sequence[str]) -> Iterator[Finding]:
    """Tell which borders images of an unknown size are taken to have."""
    if inputs.image_size is None:
        sizes = zip(image_sizes(inputs.seen_px, view).tolist(), view, strict=True)
        each = (Finding("size", subject=Subject(views=(name,)), amount=w, limit=h) for (w, h), name in sizes)
        yield Finding("unknown_image_size", LIMITS, others=tuple(each))


def _uneven(face: FloatArray) -> Iterator[Finding]:
    """Report the distance of markers (m, 3) of a face from the plane that motions assume."""
    size = np.linalg.svd(face - face.mean(axis=0))[1]
    if (share := float(size[2] / size[0])) > _UNEVEN:
        yield Finding("uneven_face", LIMITS, amount=share, limit=_UNEVEN)


def _require_taught_since(scenario: Scenario, calibration: Calibration) -> None:
    """Refuse goal images that the calibration contradicts or no pose of the arm shows, with a WorkFailed.

    Images without joint readings are tested where the arm shows them best.
    """
    task = scenario.world.inputs.task
    images = task.goal.images if task is not None else None
    if images is None or (whole := scenario.goal_pixels) is None:
        return
    view, face = calibration.view, scenario.world.inputs.markers.face
    pixels, size = images.pixels(face, view), image_sizes(scenario.world.inputs.image_size, view)
    numbers, seen = np.array([*pixels]), np.swapaxes(np.array([*pixels.values()]), 0, 1)
    if images.joints is not None:
        q = images.joints.values(calibration.joint_types)
        if fault := fault_at_rest(calibration, Observation.of_one(numbers, q, seen, view), size):
            raise failed([fault], setup_of(calibration), "; teach it again", stage=CHANGED)
        _require_rigid(rigid_fit(calibration, q, *whole), setup_of(calibration), "teach it again")
        return
    stated = images.sigma_px(scenario.world.numbers[: scenario.world.m], scenario.world.inputs.markers.face)
    sigma = scenario.world.noise_px if stated is None else stated
    known, near_px = np.isin(numbers, calibration.marker), max(NEAR_PX, 2.0 * sigma)
    seen_markers = numbers[known].tolist(), seen[:, known]
    q, median = joints_showing(calibration, *seen_markers, scenario.exact.q_start, near_px)
    enough, fit = len(q) >= COORDINATES, rigid_fit(calibration, q, *whole)
    if enough and median > near_px:
        raise failed([Finding("goal_out_of_reach", REFUSES, amount=fit.moved_px, limit=near_px, unit="px")])
    advice = (
        "take the images again, or give their deviations (sigma_left_px and sigma_right_px of "
        "task.goal.images)"
    )
    _require_rigid(fit, setup_of(calibration), advice)
    alone = fit.off_px * (np.isfinite(whole[0][..., 0]) & ~fit.seen)
    v, k = np.unravel_index(int(np.argmax(alone)), alone.shape)
    if alone[v, k] > near_px:
        of = Subject(views=(calibration.view[v],), markers=(int(calibration.marker[k]),))
        raise failed([Finding("goal_marker_off", REFUSES, of, alone[v, k], limit=near_px, unit="px")])
    whole_tool = Observation.of_one(numbers, q, seen, view)
    if enough and (fault := fault_at_rest(calibration, whole_tool, size, sigma_px=sigma)):
        raise failed([fault], setup_of(calibration), f"; {advice}", stage=CHANGED)
    if not enough and not fit.reached:
        units = ["m" if kind == "P" else "rad" for kind in calibration.joint_types]
        there = [Finding("joint_reading", amount=x, unit=unit) for x, unit in zip(q, units, strict=True)]
        turn = Finding("turn", amount=fit.turn, unit="rad")
        others = (turn, *there)
        raise failed([Finding("goal_unreached", REFUSES, amount=fit.moved_px, unit="px", others=others)])


CHANGED = "the goal was taught after a change since the calibration"


def _require_rigid(fit: RigidFit, setup: Setup, advice: str) -> None:
    """Refuse goal images whose residual at the nearest pose of the tool exceeds chance."""
    if not fit.agrees:
        of = Subject(views=(setup.view[fit.view],))
        shift = tuple(Finding("shift", amount=x, unit="px") for x in fit.shift) * (len(setup.view) > 1)
        off = Finding("goal_not_rigid", REFUSES, of, fit.rms_px, limit=fit.limit_px, unit="px", others=shift)
        raise failed([off], setup, f"; {advice}")


def plan_task(
    model: Model,
    images: TaskImages,
    trajectory: Trajectory,
    demands: Demands,
    search: JointSearch | None = None,
) -> Plan:
    """Plan from the images of the face at the start and at the goal, [RH00] section 4.

    trajectory : the requested motion.
    demands : constraints of the motion; profiles of the paper are only measured against them.
    search : inputs of a search through joint space, for the profiles ``joint_space`` and ``auto``.
    Raises WorkFailed if a marker cannot be triangulated, a motion is not unique or the joints would be too
    fast; InputError for the profile ``joint_space`` if a joint has no speed limit.
    """
    if trajectory.profile != "auto":
        return _planned(model, images, trajectory, demands, search)[0]
    before: list[tuple[str, Finding]] = []
    shut = why_closed(model, demands, search)
    for profile in ("linear", "constrained", "joint_space"):
        asked = trajectory.model_copy(update={"profile": profile})
        last = profile == "joint_space" or (profile == "constrained" and shut is not None)
        try:
            plan, fails = _planned(model, images, asked, demands, search)
        except WorkFailed as error:
            if last:
                raise
            before.append((profile, from_text(str(error), NOTE)))
            continue
        if fails is None or last:
            if shut is not None and fails is not None and profile != "joint_space":
                before.append(("joint_space", shut))
            rejected = tuple(
                Finding("rejected_profile", NOTE, Subject(name=name), others=(why,)) for name, why in before
            )
            words = lines(rejected, _setup(images))
            return replace(plan, rejected_profiles=words, findings=plan.findings + rejected)
        before.append((profile, fails))
    raise AssertionError(before)


def _setup(images: TaskImages) -> Setup:
    """Return the arm and the cameras of a task."""
    return Setup(view=images.view, joints=len(images.q_start))


def _found(
    reaching: Reaching,
    task: Task,
    trajectory: Trajectory,
    search: JointSearch | None,
    pure: tuple[float, float],
) -> Found:
    """The motion of one profile; ``pure`` shares of translation and rotation at most before the other."""
    profile = trajectory.profile
    if profile == "joint_space":
        shut = why_closed(reaching.model, reaching.demands, search)
        if search is None or shut is not None:
            raise InputError(f"the profile joint_space: {'' if shut is None else sentence_and_remedy(shut)}")
        return joint_path(reaching, task, trajectory, search)
    if profile == "constrained":
        found = coupled(reaching, trajectory)
    else:
        found = by_profile(profile, reaching, trajectory, pure)
    if trajectory.keep_out and usable(found.findings):
        found = kept_out(found, task, trajectory, NO_SPREAD if search is None else search.spread)
    return found


def _minimum_of(motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Smallest value (4,) of each constraint in its own unit, and the shares (4, 3) where it is."""
    along = motion.along
    best = best_views(motion.reaching.demands, along.visibility, along.distance)
    constraints = [best[0].min(axis=1), best[1].min(axis=1), along.limit, along.condition]
    worst = [0 if np.isnan(column).all() else int(np.nanargmin(column)) for column in constraints]
    return np.array([column[i] for column, i in zip(constraints, worst, strict=True)]), motion.mu[worst]


def _motion_of(found: Found) -> PlannedMotion:
    """Samples of a motion that was found."""
    along, time = found.motion.along, found.time
    min_margin, min_margin_mu = _minimum_of(found.judged)
    return PlannedMotion(
        path_parameter=np.linspace(0.0, 1.0, len(time)),
        time=time,
        duration=float(time[-1]) if math.isfinite(time[-1]) else None,
        mu=found.motion.mu,
        H_d=along.H_d,
        s=along.s,
        margin=along.visibility,
        border_distance=along.distance,
        q=along.q,
        joint_margin=along.limit,
        reciprocal_condition=along.condition,
        min_margin=min_margin,
        min_margin_mu=min_margin_mu,
    )


def _partition_of(
    state: State, task: Task, parts: Parts, images: TaskImages, reaching: Reaching
) -> TaskPartition:
    """Translation and rotations of a task, by the operators and amplitudes of its motion."""
    face, (tau, theta_r, theta_p) = images.by_points(), (float(x) for x in reaching.amplitudes)
    center = center_of(task.A_star, images.center)
    return TaskPartition(
        s_start=face.s_start,
        s_star=face.s_star,
        A=state.A,
        A_star=task.A_star,
        A_t=state.A_t,
        A_r=state.A_r,
        a=reaching.a,
        a_star=np.array(face_plane(task.A_star, task.order, center)),
        a_t=np.array(parts.a_t),
        A_c=np.array(parts.A_c),
        A_c_star=np.array(center),
        q_start=images.q_start,
        q_hat=_joint_motions(state),
        H_hat=reaching.H_hat,
        tau=tau,
        theta_r=theta_r,
        theta_p=theta_p,
        theta_s=composed_angle(theta_r, theta_p)[0],
    )


def _planned(
    model: Model,
    images: TaskImages,
    trajectory: Trajectory,
    demands: Demands,
    search: JointSearch | None,
) -> tuple[Plan, Finding | None]:
    """Return the plan of one profile, and the first constraint that fails; None if all hold."""
    state, task, parts, arrives = _partitioned(model, images, trajectory, demands.limits)
    H_hat = np.array([as_array(H) for H in (parts.H_t, parts.H_r, parts.H_p)])
    a, amplitudes = np.array(parts.a), np.array([parts.tau, parts.theta_r, parts.theta_p])
    tau_0, theta_0 = _changes(a, H_hat, task)
    tau_limit = min((trajectory.visibility_fraction * t for t in tau_0 if t > 0.0), default=math.inf)
    body = body_at_start(model, task, images, state.A)
    reaching = Reaching(
        model=model,
        demands=demands,
        H_hat=H_hat,
        amplitudes=amplitudes,
        A=state.A,
        a=a,
        O=task.O,
        visible=task.visible,
        q_start=images.q_start,
        body=body,
    )
    theta_limit = trajectory.visibility_fraction * _first_change(theta_0, parts.theta_r)
    pure_t, pure_r = (
        limit / abs(whole) if whole else 1.0
        for limit, whole in ((tau_limit, parts.tau), (theta_limit, parts.theta_r))
    )
    found = _found(reaching, task, trajectory, search, (pure_t, pure_r))
    motion, along, time, path = found.motion, found.motion.along, found.time, found.path
    if len(images.q_start) < COORDINATES and path is None:
        _require_in_span(model, state.A, images.q_start, along.s)
    sense, sense_margin = _senses(parts, task)
    constraint, nearest = verdict_of(found.judged)
    about = found.findings if path is None else (findings_on(path, images.view),)
    if path is None and not arrives:
        about += (Finding("half_turn", LIMITS),)
    ends = () if path is None or path.timing is None else tuple(relaxed(path, along.q, images.view))
    plan = Plan(
        profile=trajectory.profile,
        feasible=usable(about),
        reason=text(about, _setup(images)),
        findings=about + ends,
        relaxed_constraints=lines(ends, _setup(images)),
        view=images.view,
        constraint=constraint,
        motion=_motion_of(found),
        partition=_partition_of(state, task, parts, images, motion.reaching),
        visibility=FaceVisibility(
            optical_center=task.O,
            tau_0=tau_0,
            theta_0=theta_0,
            sense=sense,
            sense_margin=sense_margin,
            tau_limit=tau_limit,
        ),
        search=None if path is None else search_summary(path, along.q, time, trajectory.search.seed),
    )
    holds = usable([nearest]) or (path is not None and plan.feasible)
    return plan, found.entered or (None if holds else nearest)


def _changes(a: FloatArray, H_hat: FloatArray, task: Task) -> tuple[FloatArray, FloatArray]:
    """τ_0 (V,) and θ_0± (V, 2) of the cameras; NaN if a motion never changes visibility."""
    tau_0 = [visibility_translation(a, H_hat[0], O) for O in task.O]
    theta_0 = [visibility_angles(a, H_hat[1], O) for O in task.O]
    return (
        np.array([math.nan if t is None else t for t in tau_0]),
        np.array([(math.nan, math.nan) if t is None else t for t in theta_0]),
    )


def _first_change(theta_0: FloatArray, theta_r: float) -> float:
    """Least turn, rad, in the sense of θ_r to an angle of θ_0 (V, 2); infinite if none changes visibility."""
    turns = np.remainder(math.copysign(1.0, theta_r) * theta_0, 2.0 * math.pi)
    return float(np.nanmin(turns, initial=math.inf))


def _senses(parts: Parts, task: Task) -> tuple[FloatArray, FloatArray]:
    """Return both senses of the rotation onto the plane, and each camera's minimum margin along them."""
    other = parts.theta_r - math.copysign(2.0 * math.pi, parts.theta_r)
    senses = np.array(sorted((parts.theta_r, other), key=abs))
    margins = np.zeros((2, len(task.O)))
    for view, O in enumerate(task.O):
        c = np.array(margin_coefficients(parts.a, parts.H_r, vec(O)))
        c_0, c_s, c_c = (c * (task.visible[view] / abs(c[0] + c[2]))).tolist()
        margins[:, view] = [arc_minimum(c_0, c_s, c_c, sense) for sense in senses.tolist()]
    return senses, margins


def rotation_sense(scenario: Scenario) -> FloatArray:
    """Joint motions (2, n) of both rotations in the sense of a plan whose profile rehearses half turns."""
    asked, joints = scenario.world.inputs.trajectory, scenario.world.joints
    state, _, parts, _ = _partitioned(scenario.world.model, scenario.ends, asked, joints.limits)
    return in_sense(parts.theta_r, parts.theta_p, _joint_motions(state)[1:3])
