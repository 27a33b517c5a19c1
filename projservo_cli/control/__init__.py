"""Control laws: one file a law, one contract, one if-chain.

Run files and tables know a law by its name, compiled code by the code in its file. A law is added by its
file, its lines here, and its name among ``records.LAWS``, whose order means nothing to compiled code.
"""

from projservo_cli.control import blockwise, direct_three, direct_two, euclidean_points, exact, stacked
from projservo_cli.control.law import LOST, Gains, State, aim, go_on
from projservo_cli.geometry.jit import internal
from projservo_cli.geometry.lens import bends, straight
from projservo_cli.records import LAWS, FloatArray, Model
from projservo_cli.task.face import Task
from projservo_cli.task.trajectory import following

_DIRECT_THREE, _DIRECT_TWO, _STACKED = direct_three.CODE, direct_two.CODE, stacked.CODE
_BLOCKWISE, _EUCLIDEAN_POINTS, _EXACT = blockwise.CODE, euclidean_points.CODE, exact.CODE
CODES = {
    "direct_three": _DIRECT_THREE,
    "direct_two": _DIRECT_TWO,
    "stacked": _STACKED,
    "blockwise": _BLOCKWISE,
    "euclidean_points": _EUCLIDEAN_POINTS,
    "exact": _EXACT,
}
if set(CODES) != set(LAWS) or len(set(CODES.values())) < len(CODES):
    raise ValueError(f"each of {', '.join(LAWS)} needs a code of its own: {CODES}")


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
