"""Begin of a task: measured, partitioned, and a half turn in the sense that is better when rehearsed."""

import math

import numpy as np

from projservo_cli.control import make_law
from projservo_cli.control.law import ERRORS, Gains, State, make_split, measure, new_state, reset
from projservo_cli.geometry.algebra import as_array
from projservo_cli.geometry.jit import inline
from projservo_cli.geometry.kinematics import backward
from projservo_cli.geometry.mechanisms import OWN, Span, make_span
from projservo_cli.laws import CODES
from projservo_cli.loop.compiled_loop import Course, run_compiled
from projservo_cli.loop.verdicts import CONVERGED, Limits, new_log
from projservo_cli.records import FloatArray, JointLimits, Model
from projservo_cli.simulation.analytic_plant import Plant
from projservo_cli.task.body_pose import NO_BODY
from projservo_cli.task.face import FOUND, MIDPOINT, NOT_MEASURED, NOT_UNIQUE, Task, center_of, require_found
from projservo_cli.task.partition import NO_PARTS, Parts, partition

# Closer than this to half a turn, rad, calibration noise alone decides the sign of the angle.
_HALF_TURN_BAND = math.radians(2.0)
_REHEARSAL_STEPS = 300
_REHEARSAL_PX = 1.0
_REHEARSAL_STEP = math.radians(5.0)
_REHEARSAL = Gains(
    gain_t=0.1,
    gain_r=0.1,
    gain_p=0.1,
    gain_s=0.1,
    ratio_rp=1.0,
    gain=0.1,
    period=1.0,
    visibility_fraction=0.9,
)
_DIRECT_TWO = CODES["direct_two"]


class Rehearsal:
    """Both senses of a half turn, tried on a robot that is as the model says, without noise.

    Either sense reaches the goal, but they take the joints elsewhere. Both are rehearsed at a tenth of the
    error and at most 5° a step; the sense that arrives without passing a joint limit is taken, between equals
    the one that arrives in fewer steps.

    model : calibrated; q_start : (n,) first joints, rad or m; m : markers of the face; bounds : of
        the joints; span : of an arm of n ≠ 6 joints.
    """

    def __init__(
        self, model: Model, q_start: FloatArray, m: int, bounds: JointLimits, span: Span = OWN
    ) -> None:
        self.model, self.q_start, self.bounds, n = model, q_start, bounds, len(q_start)
        V = len(model.P)
        self.noise = np.zeros((_REHEARSAL_STEPS + 1, V, m, 2))
        self.state = new_state(n, m, span=span, views=V)
        self.log = new_log(n, m, _REHEARSAL_STEPS, len(ERRORS), views=V)

    def better(self, task: Task, state: State) -> tuple[int, Parts, bool]:
        """A partitioned task in the better sense: its verdict, its parts, and whether it arrives."""
        model = self.model
        # Cameras have no sign; the plant distinguishes front and back by positive depths.
        depth = model.P[:, 2] @ np.array(center_of(state.A, MIDPOINT))
        seen = model._replace(P=model.P * np.sign(depth)[:, None, None])
        M = np.ascontiguousarray(state.A @ as_array(backward(model, self.q_start)).T)
        plant = Plant(
            model=seen,
            M=M,
            order=task.order,
            center=task.center,
            O=task.O,
            visible=task.visible,
            image_size=np.full((len(task.O), 2), np.inf),
            limits=self.bounds,
            opaque=False,
            min_views=task.min_views,
        )
        # The face alone is shown, by points if a pair of views shows it.
        body = NO_BODY if len(task.pair) else task.body._replace(weight=np.ones_like(task.body.weight))
        law = make_law(_DIRECT_TWO, seen, task._replace(body=body), _REHEARSAL)
        step = np.full(len(self.q_start), _REHEARSAL_STEP)
        q_hat_p = state.q_hat[2].copy()

        def simulated(sense: float, max_steps: int) -> tuple[bool, bool, int]:
            """Whether a sense fails to arrive, whether it passes a joint limit, and in how many steps."""
            reset(self.state)
            self.state.driven[1] = sense * q_hat_p
            limits = Limits(
                speed=step,
                image_error_px=_REHEARSAL_PX,
                diverged_factor=math.inf,
                stall_periods=20,
                max_steps=max_steps,
                stop_at_joint_limit=False,
                stop_at_border=False,
            )
            course = Course(plant, limits, self.q_start)
            verdict, steps = run_compiled(law, course, self.noise, self.state, self.log)
            return verdict != CONVERGED, bool(self.log.events[1] >= 0.0), steps

        first = simulated(1.0, _REHEARSAL_STEPS)
        # If the first sense does well, the other one is better only if it arrives before.
        other = simulated(-1.0, _REHEARSAL_STEPS if any(first[:2]) else max(0, first[2] - 1))
        state.driven[1] = (-1.0 if other < first else 1.0) * q_hat_p
        parts = partition(task, make_split(state))
        return FOUND if parts.found else NOT_UNIQUE, parts, not (first[0] and other[0])


def begin(
    model: Model, task: Task, s: FloatArray, q_start: FloatArray, bounds: JointLimits | None
) -> tuple[State, Parts, bool]:
    """Measure and partition the task at its start.

    model : calibrated; task : in its frame.
    s : (V, b, 2) straight pixels at the start; q_start : (n,) joints there, rad or m.
    bounds : limits of the joints, if a half turn is to be made in the sense
        that is better when rehearsed.
    Returns the state with the face and the joint motions; the parts; False if neither sense of a half turn
    arrived. Raises WorkFailed if the face is not seen, or a motion not unique.
    """
    m, span, arrives = len(task.A_star), make_span(model, task.A_star), True
    state = new_state(len(q_start), m, s.shape[1], span, len(s))
    status, parts = first_parts(model, task, s, q_start, state)
    if status == FOUND and bounds is not None and is_half_turn(parts.theta_p):
        status, parts, arrives = Rehearsal(model, q_start, m, bounds, span).better(task, state)
    require_found(status, 0)
    return state, parts, arrives


@inline
def first_parts(
    model: Model, task: Task, s: FloatArray, q_start: FloatArray, state: State
) -> tuple[int, Parts]:
    """Measure and partition the task in the sense of the angles; return the verdict and the parts."""
    if not measure(model, task, s, q_start, state):
        return NOT_MEASURED, NO_PARTS
    parts = partition(task, make_split(state))
    return FOUND if parts.found else NOT_UNIQUE, parts


@inline
def is_half_turn(theta_p: float) -> bool:
    """Whether the rotation within the plane is so near to half a turn that its sense must be chosen."""
    return math.pi - abs(theta_p) < _HALF_TURN_BAND
