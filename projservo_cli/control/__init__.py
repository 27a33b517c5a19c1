"""Control laws: one file a law, one contract, one if-chain.

Run files and tables know a law by its name, compiled code by its place in ``records.LAWS``. A law is added
there, by its file, and by its lines here.
"""

from projservo_cli.control import blockwise, direct_three, direct_two, euclidean_points, exact, stacked
from projservo_cli.control.law import LOST, Gains, State, aim, go_on
from projservo_cli.geometry.jit import internal
from projservo_cli.geometry.lens import bends, straight
from projservo_cli.records import LAWS, FloatArray, Model
from projservo_cli.task.face import Task
from projservo_cli.task.trajectory import following

CODES = {law: code for code, law in enumerate(LAWS)}
_DIRECT_THREE, _DIRECT_TWO, _STACKED, _BLOCKWISE, _EUCLIDEAN_POINTS, _EXACT = CODES.values()


@internal
def command(
    code: int, model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State
) -> int:
    """Run the law of a code on images as projective cameras would have seen them.

    The only place that tells the laws apart.

    s : (2, b, 2) pixels as the cameras report them, NaN where unseen.
    Returns status of the law; ``LOST`` for a state made for another number of markers.
    """
    seen = s
    if bends(model.lens):
        if state.straight.shape[1] != s.shape[1]:
            return LOST
        straight(model.lens, s, state.straight)
        seen = state.straight
    if following(task.reference):
        aim(task.reference, gains, state)
    if code == _DIRECT_THREE:
        status = direct_three.direct_three(model, task, gains, seen, q, state)
    elif code == _DIRECT_TWO:
        status = direct_two.direct_two(model, task, gains, seen, q, state)
    elif code == _STACKED:
        status = stacked.stacked(model, task, gains, seen, q, state)
    elif code == _BLOCKWISE:
        status = blockwise.blockwise(model, task, gains, seen, q, state)
    elif code == _EUCLIDEAN_POINTS:
        status = euclidean_points.euclidean_points(model, task, gains, seen, q, state)
    else:
        status = exact.exact(model, task, gains, seen, q, state)
    if following(task.reference):
        go_on(task.reference, gains, status, code == _EXACT, state)
    return status
