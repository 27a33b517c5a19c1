"""The sense in which the rotations of a task are planned, without the rest of the plan."""

from typing import TYPE_CHECKING, NamedTuple

from projservo_cli.records import Calibration, FloatArray, signed
from projservo_cli.stages import plan
from projservo_cli.stages.beginning import partitioned_at_start
from projservo_cli.stages.constrained import CONSTRAINED
from projservo_cli.stages.motion import joints_of
from projservo_cli.stages.sight import Sight
from projservo_cli.stages.truth import Reach, center_index

if TYPE_CHECKING:
    from projservo_cli.config import Config


class Sense(NamedTuple):
    """All of a plan that a law needs that plans anew in each step: which way to turn."""

    motions: FloatArray

    def rotation_sense(self) -> FloatArray:
        """Joint motions (2, n) of the rotations r and p in the sense they are planned."""
        return self.motions


def rotation_sense(
    config: "Config", calibration: Calibration, reach: Reach, sight: Sight | None
) -> FloatArray:
    """Joint motions (2, n) of the rotations r and p in the sense that the plan takes them.

    The same as that of the whole plan, which only the profile constrained needs for it.

    Raises
    ------
    WorkFailed
        If the task cannot be partitioned.
    """
    profile = config.trajectory.profile
    if profile == CONSTRAINED:
        return plan.run(config, calibration).rotation_sense()
    joints = joints_of(config, calibration.joint_types)
    state, _, parts, _ = partitioned_at_start(
        calibration.model(),
        reach.q_start,
        reach.s_start,
        reach.s_star,
        center_index(config),
        profile,
        (joints.lower, joints.upper),
        sight,
    )
    return signed(parts.theta_r, parts.theta_p, state.q_hat[1:3])
