"""Control laws: the laws of the paper, one without drift, and classical ones, behind one function.

Run files and tables know a law by its name, compiled code by its code in ``laws``.
"""

from projservo_cli.control.classical import classical
from projservo_cli.control.direct import direct, exact
from projservo_cli.control.incidence_law import incidences
from projservo_cli.control.law import LOST, OK, Gains, Law, State, example, limit_speed
from projservo_cli.geometry.jit import ByAddress, internal, merged
from projservo_cli.geometry.lens import distorts, undistort_into
from projservo_cli.laws import LAW_SPECS, Family
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task
from projservo_cli.task.trajectory import Reference, following, near_joint_path, on_joint_path, reference_into

# Share of the image-based command of a period that corrects a joint-space path.
_CORRECTED = 0.2
_BY_ADDRESS = ByAddress(example)
_call_law = _BY_ADDRESS.caller()


def make_law(code: int, model: Model, task: Task, gains: Gains) -> Law:
    """A built-in law with its inputs, compiled or loaded."""
    return Law(code, address_of(code), model, task, gains)


def address_of(code: int) -> int:
    """Address in this process of the compiled function of a law."""
    return _BY_ADDRESS.address(FUNCTIONS[code])


@merged
def command(law: Law, s: FloatArray, q: FloatArray, state: State) -> int:
    """Run a law on images as the cameras report them, along a plan if it follows one.

    s : (V, b, 2) pixels, NaN if unseen.
    Returns the status of the law; ``LOST`` for a state made for another number of markers.
    """
    return _call_law(law.address, (law.code, law.model, law.task, law.gains, s, q, state))


# One after the other, as the cache finds no function again that another function made.
@internal
def _direct_period(
    code: int, model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State
) -> int:
    """Run a direct law of the paper for a period."""
    ready, straight = _prepared(model, task, gains, s, state)
    if not ready:
        return LOST
    return _finished(task, gains, q, direct(code, model, task, gains, straight, q, state), False, state)


@internal
def _classical_period(
    code: int, model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State
) -> int:
    """Run a classical law for a period."""
    ready, straight = _prepared(model, task, gains, s, state)
    if not ready:
        return LOST
    return _finished(task, gains, q, classical(code, model, task, gains, straight, q, state), False, state)


@internal
def _exact_period(
    _code: int, model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State
) -> int:
    """Run the law without drift for a period."""
    ready, straight = _prepared(model, task, gains, s, state)
    if not ready:
        return LOST
    return _finished(task, gains, q, exact(model, task, gains, straight, q, state), True, state)


@internal
def _incidences_period(
    _code: int, model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State
) -> int:
    """Run the law of a list of incidences for a period."""
    ready, straight = _prepared(model, task, gains, s, state)
    if not ready:
        return LOST
    return _finished(task, gains, q, incidences(model, task, gains, straight, q, state), False, state)


# Functions of the families of laws. Each measures and commands once for all its codes.
_PERIODS = {
    Family.DIRECT: _direct_period,
    Family.CLASSICAL: _classical_period,
    Family.EXACT: _exact_period,
    Family.INCIDENCES: _incidences_period,
}
# Functions of the laws in the order of their codes.
FUNCTIONS = tuple(_PERIODS[spec.family] for spec in LAW_SPECS.values())


@merged
def _prepared(model: Model, task: Task, gains: Gains, s: FloatArray, state: State) -> tuple[bool, FloatArray]:
    """Undistort the images and look up the plan; whether the state is for as many markers, and the images."""
    straight = s
    if distorts(model.lens):
        if state.straight.shape[1] != s.shape[1]:
            return False, s
        undistort_into(model.lens, s, state.straight)
        straight = state.straight
    if following(task.reference):
        lead = 1.0 / (gains.gain * gains.period)
        reference_into(
            model,
            task.reference,
            float(state.plan.clock[0]),
            lead,
            state.plan.A_ref,
            state.plan.s_ref,
            state.plan.q_ahead,
        )
    return True, straight


@merged
def _finished(task: Task, gains: Gains, q: FloatArray, status: int, limited: bool, state: State) -> int:
    """Advance along the plan by the command of the law, if there is one; the status.

    limited : whether the law applies the joint-speed limit.
    """
    if following(task.reference):
        if status != LOST and on_joint_path(task.reference, float(state.plan.clock[0])):
            _keep_near(task.reference, gains, q, status == OK, state)
            status, limited = OK, False
        _go_on(task.reference, gains, status, limited, state)
    return status


@merged
def _keep_near(reference: Reference, gains: Gains, q: FloatArray, unique: bool, state: State) -> None:
    """Keep the joints near a joint-space path and within their limits.

    Images correct by a share of the law's command, which amplifies noise near a singularity.

    unique : whether the law found a joint motion; otherwise the joints follow the path alone.
    """
    for i in range(q.shape[0]):
        step = state.plan.q_ahead[i]
        if unique:
            step += _CORRECTED * (gains.period * state.q_dot[i] - step)
        q_next = near_joint_path(reference, float(state.plan.clock[0]) + 1.0, i, q[i] + step)
        q_next = min(max(q_next, gains.limits.lower[i]), gains.limits.upper[i])
        state.q_dot[i] = (q_next - q[i]) / gains.period
    state.step.parts[0], state.step.blocked[0] = 0, -1


@merged
def _go_on(reference: Reference, gains: Gains, status: int, limited: bool, state: State) -> None:
    """Advance the plan by the share of a period that the joint-speed limit leaves of the step.

    limited : whether the law applied the limit; otherwise this function does.
    """
    if status != OK:
        return
    if not limited:
        state.step.share[0] = limit_speed(state.q_dot, gains.limits.speed)
    state.plan.clock[0] += reference.rate * state.step.share[0]
