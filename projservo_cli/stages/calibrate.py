"""Stage calibrate: trial motions or a recorded table in, projective kinematics out."""

import csv
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.calibration import (
    Nominal,
    Region,
    Solution,
    Suggestion,
    calibrate,
    cross_validate,
    suggest,
)
from projservo_cli.files import replacing
from projservo_cli.records import Calibration, CrossValidation, FloatArray, InputError, Observation
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.scenario import CALIBRATION_NOISE, SUGGESTIONS, calibration_seed, generator
from projservo_cli.stages.world import (
    Truth,
    image_size_of,
    joints_of,
    outside,
    reference_of,
    robot_of,
    truth_of,
)

if TYPE_CHECKING:
    from projservo_cli.config import Config


def trial_motions(config: "Config") -> FloatArray:
    """Joint readings (k, n) of the reference and of every single-joint trial, rad or m.

    Raises InputError if a trial would pass a joint limit, or no reference is set.
    """
    settings = config.calibration
    vector = reference_of(config)
    if vector is None:
        raise InputError("trial motions need a reference: set calibration.reference or task.start")
    joints = joints_of(config)
    reference = np.array(vector.values(joints.types))
    rows = [reference]
    for i, kind in enumerate(joints.types):
        amplitude = settings.amplitude_m if kind == "P" else np.radians(settings.amplitude_deg)
        for offset in np.linspace(-amplitude, amplitude, settings.frames_per_joint):
            q = reference.copy()
            q[i] += offset
            if wrong := outside(q, joints.lower, joints.upper):
                raise InputError(
                    f"calibration: in a trial {wrong}: choose another calibration.reference or a smaller "
                    "amplitude"
                )
            rows.append(q)
    return np.array(rows)


def simulate(config: "Config", truth: Truth) -> Observation:
    """Noisy images of all markers along the trial motions; markers outside an image are unseen."""
    q = trial_motions(config)
    rng = generator(calibration_seed(config), CALIBRATION_NOISE)
    noise = config.noise.calibration_px * rng.standard_normal((len(q), 2, len(truth.number), 2))
    images = np.stack([images_at(truth, *pair) for pair in zip(q, noise, strict=True)])
    return Observation(np.arange(len(q)), np.array(truth.number), q, images)


def images_at(truth: Truth, q: FloatArray, noise: FloatArray) -> FloatArray:
    """Pixels (2, m, 2) of all markers at the joints q (n,), rad or m, with noise; NaN outside an image."""
    images = truth.images(q, truth.M) + noise
    inside = np.all((images >= -0.5) & (images <= truth.image_size - 0.5), axis=-1)
    images[~inside] = np.nan
    return images


def run(
    config: "Config", *, progress: Progress = silent
) -> tuple[Observation, Calibration, CrossValidation | None]:
    """Calibrate from simulated trial motions, or from the recorded table of the configuration.

    Returns what was seen, the calibration, and its held-out errors if the configuration asks for them. Raises
    InputError if the table or the configuration cannot be used; WorkFailed if the data do not support a
    calibration.
    """
    from projservo_cli.config.robot import read_nominal

    settings = config.calibration
    init = Nominal(**read_nominal(settings.init)) if settings.init is not None else None
    observation, types, sigma_px = _observed(config)
    held_out: list[CrossValidation] = []

    def hold_out(solution: Solution, noise_px: float) -> None:
        """Cross-validate the solution while it is at hand."""
        folds = settings.cross_validate
        assert folds is not None
        tell = partial(progress, "cross-validation")
        held_out.append(cross_validate(solution, noise_px, folds, calibration_seed(config), tell))

    calibration = calibrate(
        observation,
        types,
        method=settings.method,
        sigma_px=sigma_px,
        source="recorded" if config.recorded else "simulated",
        image_size=image_size_of(config),
        seed=calibration_seed(config),
        lens=settings.lens,
        init=init,
        fitted=hold_out if settings.cross_validate is not None else None,
        tell=progress,
    )
    return observation, calibration, held_out[0] if held_out else None


def _observed(config: "Config") -> tuple[Observation, str, float | None]:
    """What is to be explained, the types of the joints, and the noise if it is known, px."""
    from projservo_cli.tables import read_table

    if config.data is not None:
        observation = read_table(config.data.table, config.joint_types, config.data.joint_unit)
        types = config.joint_types or "R" * observation.q.shape[1]
        return observation, types, config.data.noise_px
    observation = simulate(config, truth_of(config))
    assert config.robot is not None
    return observation, config.robot.joint_types, config.noise.calibration_px or None


# The range of the recorded readings is widened at each end by this share of itself; for a robot
# whose limits are known, the candidates' by more.
WIDER, FARTHER = 0.15, 1.0


def suggested(
    config: "Config", observation: Observation, calibration: Calibration, count: int
) -> tuple[Suggestion, ...]:
    """Poses that reduce the variance of predictions most, within the joint limits where they are known.

    Predictions are judged over the range of the recorded readings, a little widened. Candidates lie in
    the same range, or for a simulated robot in one three times as wide.

    Raises InputError if the method of the calibration has no covariance; WorkFailed if no pose shows the
    markers to both views.
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


def write_suggestions(
    found: Sequence[Suggestion], path: Path, prismatic: Sequence[bool], joint_unit: str | None
) -> None:
    """Write suggestions as a list of motions, a row each: q1 … qN, from_pose, delta_q1 … delta_qN.

    prismatic : (n,) which joints are prismatic.
    joint_unit : unit of the revolute joints, ``deg``, else rad.
    Raises InputError if it cannot be written.
    """
    scale = np.where(np.array(prismatic) | (joint_unit != "deg"), 1.0, np.degrees(1.0))
    joints = [f"q{i}" for i in range(1, len(scale) + 1)]
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*joints, "from_pose", *(f"delta_{name}" for name in joints)])
        for one in found:
            q, delta = (map(repr, (scale * values).tolist()) for values in (one.q, one.delta))
            writer.writerow([*q, one.from_pose, *delta])
