"""Steps of a law in recorded states, compiled as one: what is timed as the cost of a step."""

from projservo_cli.control import command
from projservo_cli.control.law import Gains, State
from projservo_cli.geometry.jit import njit
from projservo_cli.loop.step import limit_speed
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task


@njit
def many_steps(
    code: int,
    model: Model,
    task: Task,
    gains: Gains,
    S: FloatArray,
    Q: FloatArray,
    state: State,
    speed: FloatArray,
) -> float:
    """Measure, partition, command and limit, once in each recorded state."""
    total = 0.0
    for k in range(S.shape[0]):
        command(code, model, task, gains, S[k], Q[k], state)
        total += limit_speed(state.q_dot, speed)
    return total
