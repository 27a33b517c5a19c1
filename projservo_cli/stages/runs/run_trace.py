"""The record of a run: its numbers and series, how far it ended from its goal, and why."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from projservo_cli.control.law import TAU_AFFINE, THETA_S
from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, Subject
from projservo_cli.geometry.algebra import as_array
from projservo_cli.geometry.kinematics import forward, image_jacobian, joint_operators
from projservo_cli.geometry.lens import undistort
from projservo_cli.geometry.null_space import COORDINATES
from projservo_cli.laws import REGULATE
from projservo_cli.loop.verdicts import (
    PLATEAU_FALL,
    Log,
    plateau_stretch,
    tolerance,
)
from projservo_cli.messages import text
from projservo_cli.messages.verdict_causes import VERDICTS, arrived
from projservo_cli.monitoring.arrival_accuracy import Posture, rigid_fit
from projservo_cli.monitoring.innovation_tests import WINDOW
from projservo_cli.records import (
    BoolArray,
    FloatArray,
    GoalHistory,
    ImagesUsed,
    IncidenceHistory,
    Plan,
    PlanFollowing,
    RunErrors,
    RunHistory,
    RunMetrics,
    Trace,
    TrueMotion,
    flat_fields,
)
from projservo_cli.simulation.analytic_plant import rig_distance
from projservo_cli.simulation.robot_with_faults import obstruction_of
from projservo_cli.stages.carried_goals import markers_now
from projservo_cli.stages.runs.followed_goal import history_of
from projservo_cli.stages.runs.law_run import LawRun
from projservo_cli.task.body_pose import SETTLED, fit_body
from projservo_cli.task.face import Task
from projservo_cli.task.incidence_errors import IncidenceErrors, TaughtAndNow, incidence_errors
from projservo_cli.task.incidences import (
    errors_px,
    free_motions,
    images_of,
    points_of,
)
from projservo_cli.task.objects.object_bundle_adjustment import NO_POINTS, ObjectView
from projservo_cli.task.target import TaskImages

# Maximum residual of a body that agrees with its calibration, over the noise, px.
_AGREES, _LEAST_NOISE_PX = 4.0, 0.01
_EXACT_PX = 1e-3  # deviation of images that are predicted, or without noise
# Image error of a face of three markers as it is seen, over that which counts as converged: by noise once in
# ten thousand.
_BY_NOISE = 2.0
# Noise of markers at the end, over the noise of the run, that is reported.
_VAGUE = 3.0
# Joints that moved by less in the steps in which an error must fall hardly did, rad or m.
_HARDLY = 0.01


def trace_of(run: LawRun) -> Trace:
    """Record of a run that was driven."""
    scenario, log, steps = run.scenario, run.log, run.steps
    rows = steps + 1
    # A law that follows a plan measures the distance to the plan, not to the goal.
    remaining = _left(log, steps) if run.course.mode == REGULATE else (None, None)
    joint, driven = int(log.events[2]), run.driven
    dark = _blind_view(log.s[:rows], scenario.world.view, WINDOW) if driven and arrived(run.verdict) else ()
    lost = [run.unseen] if run.unseen else dark
    untested = () if driven is None else scenario.untested
    found = (*_reason(run, joint, remaining), *run.replannings)
    tool_poses = None if driven is None or not driven.truths else _whole(driven.truths, rows)
    poses = scenario.world.poses(run.plant, run.true_ends, log.H[:rows], tool_poses, scenario.joints_at_goal)
    values = run.summary._asdict() | {"center_deviation_mm": run.deviation_mm()} | poses.numbers
    return Trace(
        view=scenario.world.view,
        law=run.law,
        verdict=run.verdict,
        reason=text(found, run.setup),
        findings=found,
        steps=steps,
        period=scenario.gains.period,
        images_used=ImagesUsed(
            features="points" if np.isnan(log.fit[:rows, 2]).all() else "body",
            untested=text((*untested, *lost), run.setup),
        ),
        overruns=None if driven is None else driven.steered.overruns,
        following=PlanFollowing(
            mode=run.course.mode,
            planned_s=run.course.planned_s,
            replan_attempts=len(run.replannings),
            unplanned=run.course.unplanned,
        ),
        errors=RunErrors(
            remaining_translation=remaining[0],
            remaining_rotation_deg=remaining[1],
            **_known_of(RunErrors, values),
            **_stated_mm(run),
        ),
        metrics=_metrics_of(run, values),
        history=_history_of(run),
        truth=TrueMotion(
            self_occluded=log.hidden[:rows] > 0.5,
            pose=poses.pose,
            goal_pose=poses.goal_pose,
            center=poses.center,
        ),
        of_incidences=_incidences(run),
        of_goal=_of_goal(run),
        frames=None if driven is None else driven.film.recorded(),
    )


def _known_of(part: type, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the values that a part of a trace has; None for NaN."""
    names = [field.name for field in flat_fields(part) if field.name in values]
    return {name: None if math.isnan(values[name]) else values[name] for name in names}


def _metrics_of(run: LawRun, values: Mapping[str, float]) -> RunMetrics:
    """Numbers of a run by which laws are compared."""
    stretch = plateau_stretch(run.log.judged[: run.steps + 1], run.scenario.termination.stall_periods)
    numbers = _known_of(RunMetrics, values)
    if numbers["success"] is not None:
        numbers["success"] = numbers["success"] == 1.0
    return RunMetrics(
        self_occluded_steps=run.self_occluded_steps,
        longest_stall_steps=0 if stretch is None else stretch[1] - stretch[0],
        limit_joint=int(run.log.events[2]),
        **numbers,
    )


def _history_of(run: LawRun) -> RunHistory:
    """Arrays of a run over time."""
    log, steps, rows, driven = run.log, run.steps, run.steps + 1, run.driven
    before, after, views = log.fit[:rows].T
    errors, read = log.errors[:rows], log.read[:rows]
    if driven is not None:  # the log has the predicted rest of the robot instead of readings
        read = _whole(driven.readings, rows)
    s_star = run.s_star
    return RunHistory(
        q=log.q[:rows],
        q_read=None if np.array_equal(read, log.q[:rows]) else read,
        s=np.ascontiguousarray(log.s[:rows, :, : s_star.shape[1]]),
        s_star=s_star,
        image_error=log.error[:rows],
        convergence_error=run.own_unit * log.judged[:rows],
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
        force=None if driven is None or not driven.forces else _whole(driven.forces, rows),
        latency=None if driven is None else _whole(driven.delays, rows),
    )


def _whole(values: Sequence[FloatArray] | Sequence[float], rows: int) -> FloatArray:
    """Return the values at each time of a run, (rows, ...); NaN after its end."""
    missing = np.full_like(values[0], np.nan)
    return np.array([*values, *[missing] * (rows - len(values))])


def _credible(run: LawRun) -> bool:
    """Whether images agree with the calibration at the end of a run, so that errors can be stated by both."""
    scenario, ended = run.scenario, VERDICTS[run.verdict]
    refuted = ended.refutes and (run.why is None or run.why.code != "pressed")
    untested = run.driven is not None and scenario.untested
    noise = [_LEAST_NOISE_PX, scenario.world.noise_px, scenario.world.calibration.sigma_px]
    _, after, views = run.log.fit[run.steps]
    left = _rms(after[None], 2.0 * views[None] - COORDINATES)[0]
    return not (refuted or ended.retried or untested or left > _AGREES * max(noise))


def _stated_mm(run: LawRun) -> dict[str, Any]:
    """State the final distance of the face from the goal, rms mm: by images, and with undetectable errors.

    Nothing if no length on the face is known, images disagree with the calibration, or the goal was pushed.
    """
    scenario, calibration, m = run.scenario, run.scenario.world.calibration, run.scenario.world.m
    pushed = run.goal is not None and run.goal.pushed
    if scenario.exact.goal.incidences or pushed or not _credible(run):  # a pose of incidences is one of many
        return {}
    numbers, q = scenario.numbers_of(run.law), run.log.read[run.steps]
    M = calibration.M[calibration.indices_of(numbers)]
    s, s_star = run.log.s[run.steps], run.images_at_end.s_star
    posture = Posture(scenario.world.model, q, M[:m], scenario.world.inputs.lengths)
    whole = np.isfinite(s[:, :m]).all(axis=(1, 2))
    if not posture.known or whole.sum() < scenario.world.min_views:
        return {}
    used: BoolArray = np.isfinite(s + s_star)[..., 0]
    off = np.where(used[..., None], s - s_star, 0.0).ravel()
    # Measure by all markers that the law uses, and by the face itself.
    measured = (used, used & (np.arange(len(numbers)) < m))
    parts, found = [max(float(np.linalg.norm(posture.carry(M, by) @ off)) for by in measured)], {}
    if run.driven is not None and run.driven.monitor is not None:
        every = np.zeros((len(scenario.world.view), len(calibration.marker)), dtype=np.bool_)
        every[:, calibration.indices_of(numbers)] = used
        found["undetected_position_error_mm"] = run.driven.monitor.undetected_mm(q, every, posture)
    if run.goal is not None:
        carried = run.goal.carried
        parts.append(0.0 if carried is None else carried.position_mm)
    elif isinstance(run.plan, Plan) and run.plan.carried:
        parts += [one.goal_deviation_mm or 0.0 for one in run.plan.carried]
    elif (goal := scenario.goal_pixels) is not None:
        parts.append(rigid_fit(calibration, q, *goal).off_mm(posture, calibration.M))
    return found | {"estimated_position_error_mm": float(np.linalg.norm([*parts, *found.values()]))}


def _of_goal(run: LawRun) -> GoalHistory | None:
    """Return the history of a goal that moved; None of one that stayed."""
    if run.goal is None or not run.goal.periods:
        return None
    return history_of(run.goal, run.scenario.true_ends.goal, run.steps + 1)


def _left(log: Log, steps: int) -> tuple[float | None, float | None]:
    """Share of the translation and rotation, deg, that were left; None if the law measures neither."""
    first, last = (float(log.errors[k, TAU_AFFINE]) for k in (0, steps))
    turn = float(log.errors[steps, THETA_S])
    share = last / first if first > 0.0 and math.isfinite(last) else None
    return share, math.degrees(turn) if math.isfinite(turn) else None


def _rms(squares: FloatArray, count: FloatArray) -> FloatArray:
    """Root of the mean of sums of squares; NaN if the count is not positive."""
    mean = np.full(squares.shape, math.nan)
    np.divide(squares, count, out=mean, where=count > 0.0)
    return np.asarray(np.sqrt(mean))


def _incidences(run: LawRun) -> IncidenceHistory | None:
    """Incidences, their errors at each time and the freedoms that they leave; None for a whole pose."""
    scenario, images = run.scenario, run.scenario.ends
    if not images.goal.incidences:
        return None
    task, model = images.task(scenario.world.model), scenario.world.model
    seen, normal = undistort(model.lens, run.log.s), np.zeros((COORDINATES, COORDINATES + 1))
    H = np.full((run.steps + 1, 4, 4), math.nan)  # measured, as far as images show it
    for k in range(len(H)):
        fit = fit_body(model.P, task.body, seen[k], forward(model, run.log.read[k]), SETTLED, normal)
        if fit.settled:
            H[k] = as_array(fit.H)
    taught = images.displacements_taught(model)
    there = H[-1] if _credible(run) else np.full_like(H[-1], np.nan)
    left = _incidence_errors(run, images, there, taught)
    tools = [points_of(task.body.M, one.tool) for one in images.goal.incidences]
    return IncidenceHistory(
        feature_s=images_of(model, tools, H),
        feature_s_star=images_of(model, images.scenes(taught), np.eye(4)[None])[0],
        incidence_mm=np.hypot(left.mm, left.deviation_mm),
        incidence_deg=np.hypot(left.deg, left.deviation_deg),
        incidence_deviation_mm=left.deviation_mm,
        incidence_deviation_deg=left.deviation_deg,
        incidences=tuple(one.name for one in images.goal.incidences),
        incidence_px=errors_px(task.incidences, H),
        free_dof=run.plan.free_dof if isinstance(run.plan, Plan) else None,
        **_free(run, task, H[-1]),
    )


def _free(run: LawRun, task: Task, H: FloatArray) -> dict[str, Any]:
    """Joint motions that incidences leave free at the end, if the body is displaced by H (4, 4)."""
    model, q = run.scenario.world.model, run.log.read[run.steps]
    if not np.isfinite(H).all():
        return {}
    H_hat = joint_operators(model, q)
    free = free_motions(task.incidences, H, H_hat)
    by_joints = image_jacobian(model.P, task.body.M[: run.scenario.world.m] @ H.T, H_hat)
    return {"free_motion": free, "free_s": np.einsum("vmdj,fj->fvmd", by_joints, free)}


def _incidence_errors(run: LawRun, images: TaskImages, H: FloatArray, taught: FloatArray) -> IncidenceErrors:
    """State errors of incidences (g,) at the end, if the body is displaced by H (4, 4).

    taught : (g, 4, 4) displacements of the body where each was taught.
    """
    scenario, world, plan = run.scenario, run.scenario.world, run.plan
    objects = plan.carried if isinstance(plan, Plan) else ()
    s, on_face = np.full_like(images.s_star, np.nan), run.log.s[run.steps]
    s[:, : on_face.shape[1]] = on_face  # a law that measures points has the face alone
    now = ObjectView(s, np.full(s.shape[:2], max(world.noise_px, _EXACT_PX)))
    found, markers = np.full((4, len(taught)), np.nan), world.calibration.indices_of(world.numbers)
    for carrier in images.goal.carriers:
        own = [k for k, one in enumerate(images.goal.incidences) if one.carrier == carrier]
        place, sigma, more = images.goal.place(carrier), scenario.goal_sigma_px, (0.0, 0.0)
        if carrier and objects:  # its images are predicted: their deviation is stated besides
            of, sigma = objects[carrier - 1], 0.0
            more = of.goal_deviation_mm or 0.0, of.goal_deviation_deg or 0.0
        goal, asked = (
            ObjectView(place.s, np.full(s.shape[:2], max(sigma, _EXACT_PX))),
            [images.goal.incidences[k] for k in own],
        )
        on_face = all(one.visible_by(range(len(markers))) for one in asked)
        points = NO_POINTS if on_face else markers_now(world.calibration, objects[carrier - 1])
        ends = TaughtAndNow(goal, now, taught[own[0]], H, *more, points)
        found[:, own] = incidence_errors(world.calibration, markers, asked, ends, world.inputs.lengths)
    return IncidenceErrors(*found)


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
    of = Subject(name=name, joints=(joint + 1,) if joint >= 0 else ())
    own = Finding(verdict.replace(" ", "_"), REFUSES, of, error, unit=unit)
    at_step = replace(own, amount=float(steps), unit="1")
    if verdict == "followed" and run.goal is not None:
        errors, stated = run.goal.over_window
        yield replace(own, severity=NOTE, amount=errors, limit=stated)
        yield from (*_unkept(run, at_step), *_covered(run))
        return
    if verdict == "converged":
        yield replace(own, severity=NOTE, limit=within)
        yield from (*_noisy_markers(run), *_apart(run), *_unkept(run, at_step))
        return
    if verdict == "no progress":
        yield replace(own, others=(run.why or _stalled_by(run),))
    elif verdict == "markers lost":
        unseen = Finding("marker_unseen", amount=limits.max_lost_periods, unit="1")
        yield replace(at_step, others=(run.why or unseen,))
    elif verdict == "diverged":
        yield _grown(run, own, at_step)
    elif verdict == "joint limit":
        unit = "m" if run.scenario.world.model.prismatic[joint] else "rad"
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
    yield from _covered(run)
    yield from _blind_view(log.s[: steps + 1], run.scenario.world.view, limits.stall_periods)
    if run.driven is not None:
        yield from obstruction_of(run.driven.robot.robot)


def _covered(run: LawRun) -> Iterator[Finding]:
    """Tell which views of a followed object were left out, as they contradicted the others.

    Views that the goal leaves are none of these: its object leaves them, too.
    """
    covered = None if run.goal is None else run.goal.covered
    left = () if run.why is None else run.why.subject.views
    if covered is not None and not {*covered.subject.views} <= {*left}:
        yield covered


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


def _noisy_markers(run: LawRun) -> Iterator[Finding]:
    """Tell that markers are seen there with more noise than elsewhere."""
    if run.noise_ratio > _VAGUE:
        yield Finding("vague_markers", LIMITS, amount=run.noise_ratio, limit=_VAGUE)


def _apart(run: LawRun) -> Iterator[Finding]:
    """Report a visible face that errs by more than noise, although the whole body does not."""
    displaced = run.scenario.world.inputs.displaced  # its goal was never seen
    if run.scenario.exact.goal.incidences or displaced:  # the face may be anywhere that they leave open
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
    for name, steps in zip(run.scenario.world.view, hidden, strict=True):
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
