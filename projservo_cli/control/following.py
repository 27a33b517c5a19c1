"""How a law follows a plan: it aims where the plan is now and is led on to where it will be."""

from projservo_cli.control.law import OK, Gains, State
from projservo_cli.geometry.algebra import apply, put_vec, vec
from projservo_cli.geometry.jit import merged
from projservo_cli.records import FloatArray
from projservo_cli.task.trajectory import Reference, between, place, planned


@merged
def aim(reference: Reference, gains: Gains, state: State) -> None:
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
def speed_share(q_step: FloatArray, speed: FloatArray, period: float) -> float:
    """Share of the amplitude at which the first-order joint step keeps the joint-speed limit."""
    share = 1.0
    for i in range(q_step.shape[0]):
        size = abs(q_step[i])
        if size * share > speed[i] * period:
            share = speed[i] * period / size
    return share


@merged
def go_on(reference: Reference, gains: Gains, status: int, limited: bool, state: State) -> None:
    """Advance the plan by as much of a period as the joint-speed limit leaves of the step.

    Parameters
    ----------
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
