"""What the image-based laws share: velocities of the face in one view."""

from projservo_cli.control.law import State
from projservo_cli.geometry.algebra import apply, mat, put_vec, vec
from projservo_cli.geometry.jit import internal
from projservo_cli.geometry.kernels import least_squares
from projservo_cli.geometry.kinematics import image_velocity
from projservo_cli.geometry.lens import straighten
from projservo_cli.geometry.mechanisms import joint_motion
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task
from projservo_cli.task.trajectory import following


@internal
def put_view(model: Model, task: Task, s: FloatArray, state: State, view: int, first: int) -> None:
    """Interaction matrix and image error of one view, [RH00] eq. (7), into rows from ``first`` on."""
    work = state.work
    operators = work.columns
    for i in range(operators.shape[0]):
        operator = mat(operators[i])
        for k in range(state.A.shape[0]):
            put_vec(state.A_t[k], apply(operator, vec(state.A[k])))
            _, _, u_dot, v_dot = image_velocity(model.P[view], state.A[k], state.A_t[k])
            work.B[i, first + 2 * k] = u_dot
            work.B[i, first + 2 * k + 1] = v_dot
    for k in range(state.A.shape[0]):
        if following(task.reference):
            u, v = float(state.s_aim[view, k, 0]), float(state.s_aim[view, k, 1])
        else:
            target = task.s_star[view, k]
            u, v = straighten(model.lens[view], float(target[0]), float(target[1]))
        work.rhs[first + 2 * k] = s[view, k, 0] - u
        work.rhs[first + 2 * k + 1] = s[view, k, 1] - v


@internal
def pseudo_inverse(state: State, rows: int, q_hat: FloatArray) -> bool:
    """Joint motion q̂ (n,) of least squares, and of least norm, of the matrix in the workspace.

    The matrix has a column for each of ``Work.columns``: a pseudo-inverse of the
    product of an image Jacobian of full column rank and of coordinates of full row rank is the product of
    both pseudo-inverses.
    """
    work = state.work
    if work.columns.shape[0] == q_hat.shape[0]:
        return least_squares(work.B, rows, q_hat.shape[0], q_hat, work.pivot, work.z, work.rhs)
    if not least_squares(work.B, rows, work.xi.shape[0], work.xi, work.pivot, work.z, work.rhs):
        return False
    return joint_motion(work, work.xi, q_hat)
