"""A way through joint space for whoever calls from Python: what ``projservo_cli.guide`` does."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from projservo_cli.config import load_config
from projservo_cli.config.task import TaskSettings
from projservo_cli.records import FloatArray, InputError, Plan, WorkFailed
from projservo_cli.stages import plan as planning
from projservo_cli.stages.world import joints_of
from projservo_cli.store import Run


def guide(
    run: Run, q_start: ArrayLike, goal: ArrayLike, limits: ArrayLike | None, speed: ArrayLike | None
) -> Plan:
    """Plan of the profile ``joint`` from joints to images, by the calibration of a run alone."""
    config, calibration = load_config(run.path, text=run.configuration), run.calibration
    n, m = len(calibration.q_reference), len(config.face_numbers)
    joints = joints_of(config, calibration.joint_types, calibration)
    if limits is not None:
        lower, upper = _array("limits", limits, (n, 2)).T.copy()
        joints = joints._replace(lower=lower, upper=upper)
    if speed is not None:
        joints = joints._replace(speed=_array("speed", speed, (n,)))
    left, right = _array("goal", goal, (2, m, 2)).tolist()
    task: dict[str, Any] = {
        "start": {"joints": _array("q_start", q_start, (n,)).tolist(), "unit": "rad"},
        "goal": {"images": {"left": left, "right": right}},
    }
    trajectory = config.trajectory.model_copy(update={"profile": "joint"})
    asked = {"task": TaskSettings.model_validate(task), "trajectory": trajectory}
    plan = planning.run(config.model_copy(update=asked), calibration, joints)
    if not plan.feasible:
        raise WorkFailed(plan.reason)
    return plan


def _array(name: str, value: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{name} of shape {array.shape}: expected finite numbers of shape {shape}")
    return array
