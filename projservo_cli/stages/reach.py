"""Start and goal of the task: as they truly are in a simulation, else as the calibration predicts them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.calibration import predict
from projservo_cli.records import Calibration, FloatArray, InputError, IntArray, WorkFailed
from projservo_cli.stages.motion import joints_of
from projservo_cli.stages.sight import Sight, by_points, sight_of
from projservo_cli.stages.truth import Reach, face_numbers, goal_joints, reach_of, truth_of
from projservo_cli.task.body import body_of

if TYPE_CHECKING:
    from projservo_cli.config import Config


def reach_for(config: "Config", calibration: Calibration) -> Reach:
    """Start, goal and their images, of the simulated robot or of the one in ``plant.use``.

    Raises
    ------
    InputError
        If the configuration lacks a part of it, naming the key to set.
    WorkFailed
        If the goal cannot be reached or seen.
    """
    if config.plant.use is None:
        return reach_of(config, truth_of(config))
    return _predicted(config, calibration)


def observed(config: "Config", calibration: Calibration) -> list[int]:
    """Numbers of the markers that a robot in ``plant.use`` observes, in its order."""
    known = config.markers.known if config.markers is not None else None
    numbers = list(known) if known is not None else calibration.marker.tolist()
    for number in face_numbers(config):
        if number not in numbers:
            raise InputError(f"markers.face: marker {number} is not among those observed, {numbers}")
    return numbers


def watched(config: "Config", calibration: Calibration) -> list[int]:
    """Numbers of the observed markers that the calibration knows, the face first, then the pins."""
    face, known = face_numbers(config), calibration.marker.tolist()
    pins = [number for number in observed(config, calibration) if number in known and number not in face]
    return [*face, *pins]


def sight_for(config: "Config", calibration: Calibration, reach: Reach) -> Sight | None:
    """The body to measure with, of the simulated robot or of the one in ``plant.use``."""
    if config.plant.use is None:
        return sight_of(config, calibration, truth_of(config), reach)
    if by_points(config, calibration):
        return None
    M = calibration.M[_indices(calibration, watched(config, calibration))]
    return Sight(
        body_of(calibration.model(), M),
        M[reach.s_star.shape[1] :],
        np.concatenate([reach.s_start, reach.pins_start], axis=1),
        np.concatenate([reach.s_star, reach.pins_star], axis=1),
    )


def _indices(calibration: Calibration, numbers: Sequence[int]) -> IntArray:
    known = calibration.marker.tolist()
    return np.array([known.index(number) for number in numbers])


def face_of(config: "Config", calibration: Calibration) -> IntArray:
    """Indices of the face markers among those of the calibration."""
    return _indices(calibration, face_numbers(config))


def _predicted(config: "Config", calibration: Calibration) -> Reach:
    """Start and goal of a robot whose truth nobody knows."""
    if config.task is None:
        raise InputError("this stage needs a task: set task.start and task.goal")
    joints = joints_of(config, calibration.joint_types)
    start, goal = config.task.start, config.task.goal
    for vector, key in ((start, "task.start"), (goal.joints, "task.goal.joints")):
        if vector is not None and len(vector.joints) != len(joints.types):
            raise InputError(f"{key}: {len(vector.joints)} values for {len(joints.types)} joints")
    q_from = np.array(start.values(joints.types))
    q_start = q_from
    if config.task.start_offset is not None:
        q_start = q_from + np.array(config.task.start_offset.values(joints.types))
    joints.require_inside(q_start, "task.start")
    s_start, pins_start = _images(config, calibration, q_start, "task.start")
    if goal.images is not None:
        s_star = np.array([goal.images.left, goal.images.right])
        return Reach(q_start, None, s_start, s_star, pins_start, np.full(pins_start.shape, np.nan))
    if goal.joints is not None:
        q_goal = np.array(goal.joints.values(joints.types))
    elif config.robot is None:
        raise InputError("task.goal.turn_deg needs the model of the robot: give joints or images instead")
    else:
        q_goal = goal_joints(config.task, joints.types, truth_of(config), q_from)
    joints.require_inside(q_goal, "task.goal")
    s_star, pins_star = _images(config, calibration, q_goal, "task.goal")
    return Reach(q_start, None, s_start, s_star, pins_start, pins_star)


def _images(
    config: "Config", calibration: Calibration, q: FloatArray, where: str
) -> tuple[FloatArray, FloatArray]:
    """Predicted pixels (2, k, 2) of the face and (2, p, 2) of the pins at the joints q (n,)."""
    s = predict(calibration, q[None])[0][:, _indices(calibration, watched(config, calibration))]
    k = len(face_numbers(config))
    if np.isnan(s[:, :k]).any():
        raise WorkFailed(f"{where}: by the calibration, the face is not in front of both cameras there")
    return np.ascontiguousarray(s[:, :k]), s[:, k:]
