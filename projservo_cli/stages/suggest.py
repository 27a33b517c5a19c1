"""Further poses to record for a calibration: where they may lie, and the list of them."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.calibration.suggestions import Region, Suggestion, suggest
from projservo_cli.files import replacing
from projservo_cli.records import Calibration, FloatArray, Observation
from projservo_cli.stages.calibrate import image_size_of
from projservo_cli.stages.scenario import SUGGESTIONS, generator
from projservo_cli.stages.world import robot_of

if TYPE_CHECKING:
    from projservo_cli.config import Config

# The range of the recorded readings is widened at each end by this share of itself; for a robot
# whose limits are known, the candidates' by more.
WIDER, FARTHER = 0.15, 1.0


def run(
    config: "Config", observation: Observation, calibration: Calibration, count: int
) -> tuple[Suggestion, ...]:
    """Poses that reduce the variance of predictions most, within the joint limits where they are known.

    Predictions are judged over the range of the recorded readings, a little widened. Candidates lie in
    the same range, or for a simulated robot in one three times as wide.

    Parameters
    ----------
    config : robot and rig as far as they are known.
    observation, calibration : of the run.
    count : poses to suggest.

    Raises
    ------
    InputError
        If the method of the calibration has no covariance.
    WorkFailed
        If no pose shows the markers to both views.
    """
    image = _image(config, observation)
    targets = _region(config, observation.q, WIDER, image)
    candidates = targets if config.recorded else _region(config, observation.q, FARTHER, image)
    return suggest(calibration, observation, candidates, targets, count, generator(config.seed, SUGGESTIONS))


def _image(config: "Config", observation: Observation) -> FloatArray:
    """Corners (2, 2, 2) of both images, px; where their size is not known, of where markers were seen."""
    size = image_size_of(config)
    if size is not None:
        return np.array([[[-0.5, -0.5], np.array(size) - 0.5]] * 2)
    pixels = observation.images
    return np.stack([np.nanmin(pixels, axis=(0, 2)), np.nanmax(pixels, axis=(0, 2))], axis=1)


def _region(config: "Config", q: FloatArray, share: float, image: FloatArray) -> Region:
    """The range of readings (K, n), widened at each end by a share of it as far as the limits allow."""
    span = np.ptp(q, axis=0)
    low, high = q.min(axis=0) - share * span, q.max(axis=0) + share * span
    if config.robot is not None:
        robot = robot_of(config.robot)
        # A recorded robot may have been where its configured limits do not reach.
        low = np.maximum(low, np.minimum(robot.lower, q.min(axis=0)))
        high = np.minimum(high, np.maximum(robot.upper, q.max(axis=0)))
    return Region(low, high, image)


def write(found: Sequence[Suggestion], path: Path, prismatic: Sequence[bool], joint_unit: str | None) -> None:
    """Write suggestions as a list of motions, a row each: q1 … qN, from_pose, delta_q1 … delta_qN.

    Parameters
    ----------
    found : the suggestions.
    path : CSV to write; it appears whole or not at all.
    prismatic : (n,) which joints are prismatic.
    joint_unit : unit of the revolute joints, ``deg``, else rad.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    scale = np.where(np.array(prismatic) | (joint_unit != "deg"), 1.0, np.degrees(1.0))
    joints = [f"q{i}" for i in range(1, len(scale) + 1)]
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*joints, "from_pose", *(f"delta_{name}" for name in joints)])
        for one in found:
            q, delta = (map(repr, (scale * values).tolist()) for values in (one.q, one.delta))
            writer.writerow([*q, one.from_pose, *delta])
