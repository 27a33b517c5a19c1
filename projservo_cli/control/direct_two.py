"""Direct control of translation and one rotation: the paper's directTWO."""

from projservo_cli.control.law import OK, SINGULAR, Gains, State, follow, partitioned, translation_rate
from projservo_cli.geometry.algebra import Mat4, Vec4, apply, axpy, dot, inner, mul, unit, vec
from projservo_cli.geometry.displacement import composed_angle, composed_operator
from projservo_cli.geometry.jit import internal, merged
from projservo_cli.geometry.mechanisms import Work, rotation_mechanism
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task
from projservo_cli.task.partition import Parts

CODE = 1


@merged
def _axis_direction(H_s: Mat4, a_inf: FloatArray, A_c: Vec4) -> Vec4:
    """Point at infinity on the axis of a rotation about the centre, of unit norm.

    (I + Ĥ²) X is the foot of X on the axis; the four coordinate vectors X less the centre give
    multiples of one direction, of which the longest is taken.
    """
    H_s2 = mul(H_s, H_s)
    weights = vec(a_inf)
    best = (0.0, 0.0, 0.0, 0.0)
    most = -1.0
    for k in range(4):
        X = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0, 1.0 if k == 3 else 0.0)
        foot = apply(H_s2, X)
        D = axpy(-weights[k], A_c, (foot[0] + X[0], foot[1] + X[1], foot[2] + X[2], foot[3] + X[3]))
        if dot(D, D) > most:
            most = dot(D, D)
            best = D
    return unit(best)


@merged
def rotation_about_center(
    work: Work, H_s: Mat4, a_inf: FloatArray, A_c: Vec4, q_hat: FloatArray
) -> tuple[bool, float]:
    """Joint motion q̂_s with Σ q̂_si Ĥ_i = Ĥ_s, [RH00] eq. (23), by the axis of Ĥ_s in eq. (9).

    Returns the factor that scales the unit-rate motion in ``q_hat`` to the sense of Ĥ_s.
    """
    found, H = rotation_mechanism(work, unit(A_c), _axis_direction(H_s, a_inf, A_c), q_hat)
    size = inner(H, H)
    if not found or size == 0.0:
        return False, 0.0
    return True, inner(H, H_s) / size


@internal
def single_rotation(
    model: Model, parts: Parts, ratio: float, state: State
) -> tuple[bool, float, float, Mat4]:
    """Both rotations of a partition as one about the centre, [RH00] eqs. (23)–(25) as corrected.

    For λ_r/λ_p = ρ ≠ 1 the rotations composed in (24) are θ_r and θ_p weighted by ρ/max(1, ρ) and
    1/max(1, ρ): each then decays at its own rate, and the axis of the single rotation changes.

    ratio : ρ; state : the joint motion is written to its row s.
    Returns found: False where the joint motion is not unique; theta_s: angle, rad; 0 where no rotation is
    left; sense: factor that scales row s to the sense of Ĥ_s; H_s: operator Ĥ_s.
    """
    most = max(1.0, ratio)
    theta_s, a, b, c = composed_angle(ratio / most * parts.theta_r, parts.theta_p / most)
    turns, H_s = composed_operator(parts.H_r, parts.H_p, a, b, c)
    if not turns:
        return True, 0.0, 0.0, H_s
    found, sense = rotation_about_center(state.work, H_s, model.a_inf, parts.A_c, state.q_hat[3])
    return found, theta_s, sense, H_s


@merged
def direct_two(model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State) -> int:
    """Joint velocity λ_t τ q̂_t + λ_s θ_s q̂_s, [RH00] eqs. (23)–(25) as corrected."""
    status, parts = partitioned(model, task, s, q, state)
    if status != OK:
        return status
    found, theta_s, sense, _ = single_rotation(model, parts, gains.ratio_rp, state)
    if not found:
        return SINGULAR
    rate = gains.gain_s * theta_s * sense
    t = translation_rate(task, gains, parts, state)
    for i in range(state.xi_dot.shape[0]):
        state.xi_dot[i] = t * state.q_hat[0, i] + rate * state.q_hat[3, i]
    if not follow(state):
        return SINGULAR
    for i in range(q.shape[0]):
        state.q_dot[i] += state.q_ahead[i] / gains.period
    return OK
