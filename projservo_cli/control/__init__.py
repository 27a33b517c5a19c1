"""Control laws: one file a law, one contract, one if-chain."""

from projservo_cli.control.blockwise import blockwise
from projservo_cli.control.direct_three import direct_three
from projservo_cli.control.direct_two import direct_two
from projservo_cli.control.euclidean_points import euclidean_points
from projservo_cli.control.exact import exact
from projservo_cli.control.following import aim, go_on
from projservo_cli.control.law import LOST, Gains, State
from projservo_cli.control.stacked import stacked
from projservo_cli.geometry.jit import internal
from projservo_cli.geometry.lens import bends, straight
from projservo_cli.records import LAWS, FloatArray, Model
from projservo_cli.task.face import Task
from projservo_cli.task.trajectory import following

CODES = {law: code for code, law in enumerate(LAWS)}


@internal
def command(
    code: int, model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State
) -> int:
    """Run the law of a code on images as projective cameras would have seen them.

    The only place that tells the laws apart.

    Parameters
    ----------
    s : (2, b, 2) pixels as the cameras report them, NaN where unseen.

    Returns
    -------
    Status of the law; ``LOST`` for a state made for another number of markers.
    """
    seen = s
    if bends(model.lens):
        if state.straight.shape[1] != s.shape[1]:
            return LOST
        straight(model.lens, s, state.straight)
        seen = state.straight
    if following(task.reference):
        aim(task.reference, gains, state)
    if code == 0:
        status = direct_three(model, task, gains, seen, q, state)
    elif code == 1:
        status = direct_two(model, task, gains, seen, q, state)
    elif code == 2:
        status = stacked(model, task, gains, seen, q, state)
    elif code == 3:
        status = blockwise(model, task, gains, seen, q, state)
    elif code == 4:
        status = euclidean_points(model, task, gains, seen, q, state)
    else:
        status = exact(model, task, gains, seen, q, state)
    if following(task.reference):
        go_on(task.reference, gains, status, code == 5, state)
    return status
