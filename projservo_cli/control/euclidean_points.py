"""Classical stereo law: triangulated Euclidean points, with a metric model."""

from projservo_cli.control.law import LOST, OK, SINGULAR, Gains, State, measure, pseudo_inverse
from projservo_cli.geometry.algebra import apply, mat, vec
from projservo_cli.geometry.jit import merged
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task

CODE = 4


@merged
def euclidean_points(
    model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State
) -> int:
    """Joint velocity −λ J⁺ (X − X*) for points X in metres; the model must be metric.

    Source: "a Jacobian for 3D Euclidean points (like (6) but in Euclidean space)", [RH00] section 6.
    """
    if not measure(model, task, s, q, state):
        return LOST
    n = q.shape[0]
    m = state.A.shape[0]
    system, operators = state.work.system, state.work.columns
    for i in range(operators.shape[0]):
        operator = mat(operators[i])
        for k in range(m):
            velocity = apply(operator, vec(state.A[k]))
            system.B[i, 3 * k] = velocity[0]
            system.B[i, 3 * k + 1] = velocity[1]
            system.B[i, 3 * k + 2] = velocity[2]
    for k in range(m):
        for j in range(3):
            system.rhs[3 * k + j] = state.A[k, j] - task.A_star[k, j]
    if not pseudo_inverse(state, 3 * m, state.q_dot):
        return SINGULAR
    for i in range(n):
        state.q_dot[i] *= -gains.gain
    return OK
