"""The sense in which the rotations of a task are planned, without the rest of the plan."""

from typing import TYPE_CHECKING, NamedTuple

from projservo_cli.records import Calibration, FloatArray, signed
from projservo_cli.stages import plan
from projservo_cli.stages.beginning import joint_motions, partitioned_at_start
from projservo_cli.stages.constrained import CONSTRAINED
from projservo_cli.stages.motion import joints_of
from projservo_cli.stages.sight import Sight
from projservo_cli.stages.truth import Reach, center_index
from projservo_cli.task.face import Task

if TYPE_CHECKING:
    from projservo_cli.config import Config


class Sense(NamedTuple):
    """All of a plan that a law needs that plans anew in each step: which way to turn.

    Attributes
    ----------
    motions : (2, n) joint motions of the rotations r and p in the sense they are planned.
    task : measured as the plan is; None where the whole plan was made.
    """

    motions: FloatArray
    task: Task | None

    def rotation_sense(self) -> FloatArray:
        """Joint motions (2, n) of the rotations r and p in the sense they are planned."""
        return self.motions


def rotation_sense(config: "Config", calibration: Calibration, reach: Reach, sight: Sight | None) -> Sense:
    """The sense that the plan of a task takes; only the profile constrained needs the whole plan for it.

    Raises
    ------
    WorkFailed
        If the task cannot be partitioned.
    """
    profile = config.trajectory.profile
    if profile == CONSTRAINED:
        return Sense(plan.run(config, calibration).rotation_sense(), None)
    joints = joints_of(config, calibration.joint_types)
    state, task, parts, _ = partitioned_at_start(
        calibration.model(),
        reach.q_start,
        reach.s_start,
        reach.s_star,
        center_index(config),
        profile,
        (joints.lower, joints.upper),
        sight,
    )
    return Sense(signed(parts.theta_r, parts.theta_p, joint_motions(state)[1:3]), task)
