"""Laws as the Python loop takes them: built in, or of somebody else."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from projservo_cli import plugins
from projservo_cli.control import CODES
from projservo_cli.control.law import ERRORS, LOST, OK, Gains
from projservo_cli.geometry.span import in_span
from projservo_cli.loop.python import BuiltInLaw, LoopLaw
from projservo_cli.modes import REPLAN, law_and_mode
from projservo_cli.plugins import what_failed
from projservo_cli.records import METRIC_LAWS, Calibration, FloatArray, InputError, IntArray, Plan, WorkFailed
from projservo_cli.results import ImageModel, image_model
from projservo_cli.stages.following import followed
from projservo_cli.stages.reach import face_of
from projservo_cli.stages.sight import Sight, measured_task
from projservo_cli.stages.truth import Reach, center_index, truth_of

if TYPE_CHECKING:
    from projservo_cli.config import Config


@dataclass(frozen=True, eq=False)
class LawSetup:
    """What a law of somebody else is made with.

    Attributes
    ----------
    calibration : with ``predict(q)`` and ``jacobian(q)``.
    face : (k,) indices of the face markers among those of the calibration.
    s_start, s_star : (2, k, 2) pixels of the face at the start and at the goal.
    plan : the planned motion.
    gains : configured gains, limits and period.
    period : control period, s.
    """

    calibration: ImageModel
    face: IntArray
    s_start: FloatArray
    s_star: FloatArray
    plan: Plan
    gains: Gains
    period: float


class ForeignLaw:
    """A law ``law(s, q) -> q_dot`` whose answers are checked; None holds the robot for a period.

    Parameters
    ----------
    law : pixels (2, k, 2) of the face and joint readings (n,) to joint velocities (n,), rad/s or m/s.
    name : of it, for messages.
    """

    def __init__(self, law: Callable[[FloatArray, FloatArray], Any], name: str) -> None:
        self.law, self.name = law, name
        self.errors = np.full(len(ERRORS), np.nan)

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity of one instant; the law is asked where the whole face was seen."""
        if np.isnan(s).any():
            return LOST, np.zeros_like(q)
        try:
            answer = self.law(s.copy(), q.copy())
            if answer is None:
                return LOST, np.zeros_like(q)
            q_dot = np.array(answer, dtype=np.float64)
        except Exception as error:
            raise WorkFailed(f"{self.name}: failed: {what_failed(error)}") from error
        if q_dot.shape != q.shape or not np.isfinite(q_dot).all():
            raise WorkFailed(
                f"{self.name}: gave {answer!r:.80}: expected {len(q)} finite joint velocities, or None"
            )
        return OK, q_dot


def law_for(
    config: "Config",
    calibration: Calibration,
    plan: Plan,
    name: str,
    reach: Reach,
    gains: Gains,
    sight: Sight | None = None,
) -> LoopLaw:
    """The law of the run of a name, ready for the Python loop; with a sight it measures with the body.

    Raises
    ------
    InputError
        If there is no such law, it needs a model of the robot that the configuration lacks, or the plan to
        follow has no time.
    WorkFailed
        If it cannot be made, or the joints cannot follow the plan.
    """
    law, mode = law_and_mode(name)
    if law not in CODES:
        face = face_of(config, calibration)
        model = image_model(calibration)
        setup = LawSetup(model, face, reach.s_start, reach.s_star, plan, gains, gains.period)
        return ForeignLaw(plugins.make("law", law, ("__call__",), (setup,), {}), f"law {law}")
    if law in METRIC_LAWS and None in (config.robot, config.rig):
        raise InputError(
            f"{law} is given the metric model of robot and rig: set robot and rig, or leave it out of "
            "control.laws"
        )
    believed = truth_of(config).model if law in METRIC_LAWS else calibration.model()
    task = measured_task(believed, reach.q_start, reach.s_start, reach.s_star, center_index(config), sight)
    if mode != REPLAN:
        task = followed(believed, task, plan, gains.period, config.plant.speed_scale)
    built_in = BuiltInLaw(CODES[law], believed, task, gains)
    span, sense = built_in.state.work.span, plan.rotation_sense()
    built_in.state.memory.rotation[:] = in_span(span, believed, reach.q_start, sense)
    return built_in
