"""Contract of every control law.

A compiled law is ``law(code, model, task, gains, s, q, state) -> status``; one function may serve several
codes. Its inputs are the model, the task, the undistorted pixels ``s`` of the face and then of further
markers of its body, and the joint readings ``q``, never the truth. It writes joint velocities to
``state.q_dot`` (rad/s or m/s) and control errors to ``state.errors``.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import (
    Mat4,
    Vec4,
    apply,
    axpy,
    dot,
    inner,
    inverse,
    mat,
    mat_into,
    mul,
    sub,
    unit,
    vec,
    vec_into,
)
from projservo_cli.geometry.displacements import composed_angle, composed_operator
from projservo_cli.geometry.jit import inline, internal, merged, njit, separate
from projservo_cli.geometry.kinematics import image_velocity, operators_at, row
from projservo_cli.geometry.lens import undistort_pixel
from projservo_cli.geometry.mechanisms import (
    OWN,
    Span,
    Work,
    joint_motion,
    rotation_mechanism,
    rows_of,
    workspace,
)
from projservo_cli.geometry.null_space import COORDINATES, least_squares
from projservo_cli.geometry.stereo import triangulate
from projservo_cli.records import VIEWS, FloatArray, IntArray, JointLimits, Model, position_limits
from projservo_cli.task.body_pose import ALL_VIEWS, GOAL_VIEWS, carry, fit_body
from projservo_cli.task.face import Task, center_of
from projservo_cli.task.incidences import image_error, rank_of
from projservo_cli.task.partition import NO_PARTS, Parts, Split, partition
from projservo_cli.task.trajectory import following
from projservo_cli.task.visibility import limited_translation

# Maximum number of parts of a step.
MAX_PARTS = 128
# No limits, for any number of joints of a configuration.
UNLIMITED = position_limits(np.full(64, -np.inf), np.full(64, np.inf))
# Status of a law: a command.
OK = 0
# Status of a law: the face is not measured.
LOST = 1
# Status of a law: the joint motion is not unique.
SINGULAR = 2
# Indices of the control errors, named in ``ERRORS``.
TAU, TAU_AFFINE, THETA_R, THETA_P, THETA_S = range(5)
ERRORS = ("tau", "tau_affine", "theta_r", "theta_p", "theta_s")


class Gains(NamedTuple):
    """Gains and limits of the laws.

    Attributes
    ----------
    gain_t, gain_r, gain_p : of ``direct_three``, 1/s.
    gain_s : rotation of ``direct_two``, 1/s.
    ratio_rp : λ_r/λ_p of ``direct_two``.
    gain : of the classical laws, 1/s.
    period : control period, s.
    visibility_fraction : fraction of τ_0 that one pure translation may use.
    limits : of the joints, (n,) each: ``lower`` and ``upper``, rad or m, at which a path ends, ``speed``,
        per s, and ``acceleration``, per s²; infinite for none.
    substeps : whether a step is sent in the parts it was solved in.
    scale : factor of every command, which the loop applies.
    """

    gain_t: float
    gain_r: float
    gain_p: float
    gain_s: float
    ratio_rp: float
    gain: float
    period: float
    visibility_fraction: float
    limits: JointLimits = UNLIMITED
    substeps: bool = False
    scale: float = 1.0


class Law(NamedTuple):
    """A built-in law with its inputs."""

    code: int  # code of the law
    address: int  # address of its compiled function, in this process
    model: Model  # calibrated or metric
    task: Task  # task in the frame of the model
    gains: Gains


class StepParts(NamedTuple):
    """The last step of a law, as it is to be sent."""

    path: FloatArray  # (129, n) joints at the ends of the parts of a step, the current ones first
    # (1,) share of the amplitude left by the joint-speed limit, −1 if the law leaves the limit to the loop
    share: FloatArray
    parts: IntArray  # (1,) number of parts of the step in ``path``; 0 if the joints move linearly to the end
    blocked: IntArray  # (1,) joint at whose limit the step ends, −1 for none


class AlongPlan(NamedTuple):
    """Progress of a law along a plan, and the plan there."""

    clock: FloatArray  # (1,) completed periods of the plan, if there is one
    A_ref: FloatArray  # (m, 4) points of the face by the plan
    s_ref: FloatArray  # (V, m, 2) target pixels of the image-based law by the plan
    q_ahead: FloatArray  # (n,) joint motion of the plan in the next period; zero without a plan


class State(NamedTuple):
    """Workspace and results of a law."""

    work: Work  # arrays of the kernels, the current operators among them
    A: FloatArray  # (m, 4) current points
    pose: FloatArray  # (4, 4) measured displacement of the body from the reference
    A_t: FloatArray  # (m, 4) target without translation
    A_r: FloatArray  # (m, 4) target without translation and rotation r
    q_hat: FloatArray  # (4, n) joint motions t, r, p, s; (4, 6) coordinates in the span of an arm of n ≠ 6
    q_dot: FloatArray  # (n,) joint velocity commanded, rad/s or m/s
    xi_dot: FloatArray  # (6,) the same in the coordinates of ``q_hat``; ``q_dot`` itself for six joints
    errors: FloatArray  # (5,) τ in the unit-norm scale of (8), τ in the scale of a_inf, θ_r, θ_p, θ_s in rad
    driven: FloatArray  # (2, n) joint motions of the last rotations r and p in their sense
    limited: FloatArray  # (1,) number of steps in which visibility limited the translation
    # (3,) sums of squared residuals of the predicted and of the fitted body, px², and the number of markers
    # used, once a view; NaN if the face is measured point by point
    fit: FloatArray
    # (1,) image error of the face at the measured pose of the body, or of the incidences, px rms per marker
    # and view, even if the face is not seen; NaN if it is measured point by point
    face_px: FloatArray
    normal: FloatArray  # (6, 7) workspace of the fit of the body
    step: StepParts
    straight: FloatArray  # (V, b, 2) undistorted pixels if there is a lens
    plan: AlongPlan


def new_state(n: int, m: int, observed: int = 0, span: Span = OWN, views: int = len(VIEWS)) -> State:
    """Initial state for n joints and m face markers in a number of views.

    observed : number of markers in images, m or more; span : of an arm of n ≠ 6 joints.
    """
    q_dot = np.zeros(n)
    own = len(span.H_hat) == 0
    k = n if own else COORDINATES
    return State(
        work=workspace(n, rows_of(views, m), span),
        A=np.zeros((m, 4)),
        pose=np.eye(4),
        A_t=np.zeros((m, 4)),
        A_r=np.zeros((m, 4)),
        q_hat=np.zeros((4, k)),
        q_dot=q_dot,
        xi_dot=q_dot if own else np.zeros(k),
        errors=np.full(len(ERRORS), np.nan),
        driven=np.zeros((2, k)),
        limited=np.zeros(1),
        fit=np.full(3, np.nan),
        face_px=np.full(1, np.nan),
        normal=np.zeros((COORDINATES, COORDINATES + 1)),
        step=StepParts(
            path=np.zeros((MAX_PARTS + 1, n)),
            share=np.full(1, -1.0),
            parts=np.zeros(1, dtype=np.int64),
            blocked=np.full(1, -1, dtype=np.int64),
        ),
        straight=np.zeros((views, max(m, observed), 2)),
        plan=AlongPlan(
            clock=np.zeros(1),
            A_ref=np.zeros((m, 4)),
            s_ref=np.zeros((views, m, 2)),
            q_ahead=np.zeros(n),
        ),
    )


def example() -> tuple[int, Model, Task, Gains, FloatArray, FloatArray, State]:
    """Arguments of a law of the types that all runs have; their values mean nothing."""
    q, matrices, order = np.zeros(4), np.zeros((4, 4, 4)), np.zeros(4, np.int64)
    model = Model(
        np.zeros((2, 3, 4)), matrices, np.zeros(4, np.bool_), q_reference=q, a_inf=q, lens=np.zeros((2, 5))
    )
    task = Task(
        s_star=np.zeros((2, 4, 2)),
        A_star=matrices[0],
        order=order,
        center=0,
        pair=order,
        F=np.zeros((3, 3)),
        O=np.zeros((2, 4)),
        visible=q,
        min_views=2,
    )
    gains = Gains(*(1.0,) * 8, limits=JointLimits(q, q, q, q))
    return 0, model, task, gains, task.s_star, q, new_state(4, 4)


@njit
def reset(state: State) -> None:
    """Reset a state to the initial one, for another run."""
    state.driven[:] = 0.0
    state.q_dot[:] = 0.0
    state.plan.q_ahead[:] = 0.0
    state.errors[:] = math.nan
    state.fit[:] = math.nan
    state.face_px[0] = math.nan
    state.limited[0] = 0.0
    state.step.share[0] = -1.0
    state.step.parts[0] = 0
    state.step.blocked[0] = -1
    state.plan.clock[0] = 0.0


@inline
def make_split(state: State) -> Split:
    """The arrays of a state in which the task is partitioned."""
    return Split(
        work=state.work, A=state.A, A_t=state.A_t, A_r=state.A_r, q_hat=state.q_hat, driven=state.driven
    )


@separate
@njit
def measure(model: Model, task: Task, s: FloatArray, q: FloatArray, state: State) -> bool:
    """Measure the face, with the body or point by point, and move the operators to the current joints.

    Returns False if too little is seen; point by point every marker of the face must have a finite point.
    Source: [RH00] eq. (19) for the operators.
    """
    H = operators_at(model, q, state.work.H_hat)
    if task.body.M.shape[0] > 0:
        return _measure_body(model, task, s, H, state)
    if task.pair.shape[0] == 0:
        return False
    for k in range(state.A.shape[0]):
        for i in range(2):
            view = task.pair[i]
            if not (math.isfinite(s[view, k, 0]) and math.isfinite(s[view, k, 1])):
                return False
        finite, M = triangulate(model.P, task.pair, task.F, model.a_inf, s, k)
        if not finite:
            return False
        vec_into(state.A[k], M)
    return True


@merged
def _measure_body(model: Model, task: Task, s: FloatArray, H: Mat4, state: State) -> bool:
    """Measure the face by all markers of the body, predicted at the displacement H of the joints.

    At the goal the errors of the calibration cancel if the fit has the same views as the fit of the goal
    image; it uses others only if these do not determine the body.
    """
    state.face_px[0] = math.nan
    fit = fit_body(model.P, task.body, s, H, GOAL_VIEWS, state.normal)
    if not fit.found:
        fit = fit_body(model.P, task.body, s, H, ALL_VIEWS, state.normal)
    state.fit[0] = fit.before
    state.fit[1] = fit.after
    state.fit[2] = fit.views
    if not fit.found:
        return False
    carry(task.body, fit.H, state.A)
    mat_into(state.pose, fit.H)
    if rank_of(task.incidences) > 0:
        state.face_px[0] = image_error(task.incidences, fit.H, inverse(fit.H))
    else:
        state.face_px[0] = _predicted_error(model.P, state.A, task.A_star)
    return True


@internal
def _predicted_error(P: FloatArray, A: FloatArray, A_star: FloatArray) -> float:
    """Image error between points A and A_star (m, 4), px rms per point and view, [RH00] eq. (1)."""
    total = 0.0
    for view in range(P.shape[0]):
        for k in range(A.shape[0]):
            M, M_star = vec(A[k]), vec(A_star[k])
            depth, depth_star = row(P[view], 2, M), row(P[view], 2, M_star)
            if depth == 0.0 or depth_star == 0.0:
                return math.nan
            for i in range(2):
                d = row(P[view], i, M) / depth - row(P[view], i, M_star) / depth_star
                total += d * d
    return math.sqrt(total / (P.shape[0] * A.shape[0]))


@merged
def _current_target(task: Task, state: State) -> Task:
    """Task with the current pose of the plan as its target; the task itself without a plan."""
    if not following(task.reference):
        return task
    return Task(task.s_star, state.plan.A_ref, *task[2:])


@merged
def partitioned(model: Model, task: Task, s: FloatArray, q: FloatArray, state: State) -> tuple[int, Parts]:
    """Measure the face and partition the remaining task, or that to the current pose of the plan.

    Writes the errors to the state. Returns the status and the parts.
    """
    state.q_dot[:] = 0.0
    state.errors[:] = math.nan
    if not measure(model, task, s, q, state):
        return LOST, NO_PARTS
    current = _current_target(task, state)
    parts = partition(current, make_split(state))
    if not parts.found:
        return SINGULAR, parts
    offset = sub(center_of(current.A_star, task.center), parts.A_c)
    theta_s, _, _, _ = composed_angle(parts.theta_r, parts.theta_p)
    state.errors[TAU] = parts.tau
    state.errors[TAU_AFFINE] = math.sqrt(dot(offset, offset))
    state.errors[THETA_R] = parts.theta_r
    state.errors[THETA_P] = parts.theta_p
    state.errors[THETA_S] = theta_s
    return OK, parts


@merged
def joint_velocity_into(state: State) -> bool:
    """Convert the velocity ``xi_dot`` to joint velocities ``q_dot``; False if the joints cannot make it."""
    if state.work.span.H_hat.shape[0] == 0:
        return True
    return joint_motion(state.work, state.xi_dot, state.q_dot)


@internal
def translation_rate(task: Task, gains: Gains, parts: Parts, state: State) -> float:
    """Rate λ_t τ of the translation, with its step within δ τ_0 of all cameras."""
    wanted = gains.gain_t * parts.tau * gains.period
    allowed = limited_translation(parts.a, parts.H_t, wanted, gains.visibility_fraction, task)
    if allowed < wanted:
        state.limited[0] += 1.0
    return allowed / gains.period


@merged
def _axis_direction(H_s: Mat4, a_inf: FloatArray, A_c: Vec4) -> Vec4:
    """Point at infinity on the axis of a rotation about the centre, of unit norm.

    (I + Ĥ²) X is the foot of X on the axis; the four coordinate vectors X less the centre give multiples of
    one direction, of which the longest has the highest accuracy.
    """
    H_s2 = mul(H_s, H_s)
    weights = vec(a_inf)
    best = (0.0, 0.0, 0.0, 0.0)
    largest = -1.0
    for k in range(4):
        X = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0, 1.0 if k == 3 else 0.0)
        foot = apply(H_s2, X)
        D = axpy(-weights[k], A_c, (foot[0] + X[0], foot[1] + X[1], foot[2] + X[2], foot[3] + X[3]))
        if dot(D, D) > largest:
            largest = dot(D, D)
            best = D
    return unit(best)


@separate
@internal
def single_rotation(
    model: Model, parts: Parts, ratio: float, state: State
) -> tuple[bool, float, float, Mat4]:
    """Both rotations of a partition as one about the centre, [RH00] eqs. (23)–(25) as corrected.

    The joint motion q̂_s with Σ q̂_si Ĥ_i = Ĥ_s is given by eq. (9) about the axis of Ĥ_s, at unit rate.
    For λ_r/λ_p = ρ ≠ 1 the rotations composed in (24) are θ_r and θ_p weighted by ρ/max(1, ρ) and
    1/max(1, ρ): each then decays at its own rate, and the axis of the single rotation changes.

    ratio : ρ; state : gets the joint motion in its row s.
    Returns found: False if the joint motion is not unique; theta_s: angle, rad, 0 if no rotation remains;
    sense: factor that scales row s to the sense of Ĥ_s; H_s: operator Ĥ_s.
    """
    largest = max(1.0, ratio)
    theta_s, a, b, c = composed_angle(ratio / largest * parts.theta_r, parts.theta_p / largest)
    turns, H_s = composed_operator(parts.H_r, parts.H_p, a, b, c)
    if not turns:
        return True, 0.0, 0.0, H_s
    axis = _axis_direction(H_s, model.a_inf, parts.A_c)
    unique, H = rotation_mechanism(state.work, unit(parts.A_c), axis, state.q_hat[3])
    size = inner(H, H)
    if not unique or size == 0.0:
        return False, theta_s, 0.0, H_s
    return True, theta_s, inner(H, H_s) / size, H_s


@internal
def view_into(model: Model, task: Task, s: FloatArray, state: State, view: int, first: int) -> int:
    """Write the interaction matrix and image error of one view, [RH00] eq. (7), to rows from ``first`` on.

    Rows of a marker that it does not show, now or at the goal, are zero. Returns how many it shows.
    """
    n_views = 0
    system, operators = state.work.system, state.work.columns
    for i in range(operators.shape[0]):
        operator = mat(operators[i])
        for k in range(state.A.shape[0]):
            A = vec(state.A[k])
            _, _, u_dot, v_dot = image_velocity(model.P[view], A, apply(operator, A))
            system.B[i, first + 2 * k] = u_dot
            system.B[i, first + 2 * k + 1] = v_dot
    for k in range(state.A.shape[0]):
        if following(task.reference):
            u, v = float(state.plan.s_ref[view, k, 0]), float(state.plan.s_ref[view, k, 1])
        else:
            target = task.s_star[view, k]
            u, v = undistort_pixel(model.lens[view], float(target[0]), float(target[1]))
        e_u, e_v = s[view, k, 0] - u, s[view, k, 1] - v
        if math.isfinite(e_u + e_v):
            n_views += 1
        else:
            e_u = e_v = 0.0
            for i in range(operators.shape[0]):
                system.B[i, first + 2 * k] = system.B[i, first + 2 * k + 1] = 0.0
        system.rhs[first + 2 * k] = e_u
        system.rhs[first + 2 * k + 1] = e_v
    return n_views


@internal
def pseudo_inverse(state: State, rows: int, q_hat: FloatArray) -> bool:
    """Joint motion q̂ (n,) of least squares and minimum norm, by the matrix in the workspace.

    The matrix has a column for each of ``Work.columns``. The pseudo-inverse of the product of an image
    Jacobian of full column rank and coordinates of full row rank is the product of both pseudo-inverses.
    """
    work = state.work
    if work.columns.shape[0] == q_hat.shape[0]:
        return least_squares(work.system, rows, q_hat)
    if not least_squares(work.system, rows, work.xi):
        return False
    return joint_motion(work, work.xi, q_hat)


@merged
def limit_speed(q_dot: FloatArray, speed: FloatArray) -> float:
    """Scale joint velocities (n,) uniformly to the joint-speed limit, and return the factor."""
    share = speed_share(q_dot, speed, 1.0)
    for i in range(q_dot.shape[0]):
        q_dot[i] *= share
    return share


@merged
def speed_share(q_step: FloatArray, speed: FloatArray, period: float) -> float:
    """Share of the amplitude at which the first-order joint step is within the joint-speed limit."""
    share = 1.0
    for i in range(q_step.shape[0]):
        size = abs(q_step[i])
        if size * share > speed[i] * period:
            share = speed[i] * period / size
    return share
