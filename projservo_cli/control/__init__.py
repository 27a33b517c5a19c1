"""Control laws: one file a law, one contract, one if-chain.

Run files and tables know a law by its name, compiled code by the code in its file. A law is added by its
file, its lines here, and its name among ``records.LAWS``, whose order means nothing to compiled code.
"""

from projservo_cli.control import blockwise, direct_three, direct_two, euclidean_points, exact, stacked
from projservo_cli.control.law import LOST, OK, Gains, Law, State, speed_share
from projservo_cli.geometry.algebra import apply, put_vec, vec
from projservo_cli.geometry.jit import internal, merged
from projservo_cli.geometry.lens import bends, straight
from projservo_cli.records import LAWS, FloatArray
from projservo_cli.task.trajectory import Reference, between, following, place, planned

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
def command(law: Law, s: FloatArray, q: FloatArray, state: State) -> int:
    """Run a law on images as projective cameras would have seen them.

    The only place that tells the laws apart.

    s : (2, b, 2) pixels as the cameras report them, NaN where unseen.
    Returns status of the law; ``LOST`` for a state made for another number of markers.
    """
    code, model, task, gains = law
    seen = s
    if bends(model.lens):
        if state.straight.shape[1] != s.shape[1]:
            return LOST
        straight(model.lens, s, state.straight)
        seen = state.straight
    if following(task.reference):
        _aim(task.reference, gains, state)
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
        _go_on(task.reference, gains, status, code == _EXACT, state)
    return status


@merged
def _aim(reference: Reference, gains: Gains, state: State) -> None:
    """Write where the face should be now, where its images should go, and how the joints lead there.

    For the image-based law, whose command is −λ J⁺ (s − s_aim), the planned velocity ṡ is fed forward by
    aiming ahead: s_aim = s + ṡ/λ.
    """
    i, x = place(reference, float(state.clock[0]))
    j, y = place(reference, float(state.clock[0]) + 1.0)
    lead = 1.0 / (gains.gain * gains.period)
    H = planned(reference, float(state.clock[0]))
    for k in range(state.A_aim.shape[0]):
        for c in range(4):
            state.A_aim[k, c] = between(reference.A[:, k, c], i, x)
        put_vec(state.A_aim[k], apply(H, vec(state.A_aim[k])))
        for view in range(2):
            for c in range(2):
                here = between(reference.s[:, view, k, c], i, x)
                ahead = between(reference.s_ahead[:, view, k, c], i, x)
                state.s_aim[view, k, c] = here + lead * ahead
    for l in range(state.q_ahead.shape[0]):
        state.q_ahead[l] = between(reference.q[:, l], j, y) - between(reference.q[:, l], i, x)


@merged
def _go_on(reference: Reference, gains: Gains, status: int, limited: bool, state: State) -> None:
    """Advance the plan by as much of a period as the joint-speed limit leaves of the step.

    limited : whether the law kept the limit itself; it is else applied here.
    """
    if status != OK:
        return
    if not limited:
        share = speed_share(state.q_dot, gains.speed, 1.0)
        for i in range(state.q_dot.shape[0]):
            state.q_dot[i] *= share
        state.share[0] = share
    state.clock[0] += reference.rate * state.share[0]
