"""Stage calibrate: trial motions or a recorded table in, projective kinematics out."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from projservo_cli.calibration import (
    Nominal,
    Solution,
    calibrate,
    cross_validate,
)
from projservo_cli.config import Config
from projservo_cli.files import write_whole
from projservo_cli.guidance.spread import Region, Suggestion, suggest
from projservo_cli.records import Calibration, CrossValidation, FloatArray, Observation
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.record import observed, seed_of_trials
from projservo_cli.stages.scenario import SUGGESTIONS, generator
from projservo_cli.stages.world import joints_of
from projservo_cli.tables import read_table, to_csv


def run(
    config: Config, *, progress: Progress = silent
) -> tuple[Observation, Calibration, CrossValidation | None]:
    """Calibrate from simulated trial motions, or from the recorded table of the configuration.

    Returns what was seen, the calibration, and its held-out errors if the configuration asks for them.
    """
    from projservo_cli.config.robot import read_nominal

    settings, seed = config.calibration, seed_of_trials(config)
    ideal = config.is_ideal and not config.recorded
    init = Nominal(**read_nominal(settings.init)) if settings.init is not None else None
    noise_deg = 0.0 if ideal and settings.joint_noise_deg is None else settings.joint_noise_deg
    if config.data is not None:
        observation = read_table(config.data.table, config.joint_types, config.data.joint_unit)
        sigma_px = config.data.noise_px
    else:
        observation, sigma_px = observed(config, progress=progress)
    held_out: list[CrossValidation] = []

    def hold_out(solution: Solution, noise_px: float) -> None:
        """Cross-validate the solution while it is at hand."""
        assert settings.cross_validate is not None
        tell = partial(progress, "cross-validation")
        held_out.append(cross_validate(solution, noise_px, settings.cross_validate, seed, tell))

    calibration = calibrate(
        observation,
        config.joint_types or "R" * observation.q.shape[1],
        method=settings.method,
        sigma_px=sigma_px,
        # Where joints or images have faults, χ² of pixel noise alone decides no more than in a recording.
        source="simulated" if ideal else "recorded",
        image_size=config.image_size_px,
        seed=seed,
        lens=settings.lens,
        init=init,
        joint_noise=None if noise_deg is None else float(np.radians(noise_deg)),
        fitted=hold_out if settings.cross_validate is not None else None,
        tell=progress,
    )
    calibration = replace(calibration, source="recorded" if config.recorded else "simulated")
    return observation, calibration, held_out[0] if held_out else None


# The range of the recorded readings is widened at each end by this share of itself; for a robot
# whose limits are known, the candidates' by more.
WIDER, FARTHER = 0.15, 1.0


def suggest_motions(
    config: Config, observation: Observation, calibration: Calibration, count: int, path: Path
) -> tuple[Suggestion, ...]:
    """Write poses that reduce the variance of predictions most, within the joint limits where they are known.

    Predictions are judged over the range of the recorded readings, a little widened. Candidates lie in
    the same range, or for a simulated robot in one three times as wide. ``path`` becomes a list of motions, a
    row each: q1 … qN, from_pose, delta_q1 … delta_qN, revolute joints in the unit of the recorded table.
    """
    observation = observation.at_rest
    pixels, size = observation.images, config.image_size_px
    image = np.stack([np.nanmin(pixels, axis=(0, 2)), np.nanmax(pixels, axis=(0, 2))], axis=1)  # corners, px
    if size is not None:
        image = np.array([[[-0.5, -0.5], np.array(size) - 0.5]] * 2)
    targets = _region(config, observation.q, WIDER, image)
    candidates = targets if config.recorded else _region(config, observation.q, FARTHER, image)
    rng = generator(config.seed, SUGGESTIONS)
    found = suggest(calibration, observation, candidates, targets, count, rng)
    turn = np.degrees(1.0) if config.data is not None and config.data.joint_unit == "deg" else 1.0
    scale = np.array([turn if kind == "R" else 1.0 for kind in calibration.joint_types])
    joints = [f"q{i}" for i in range(1, len(scale) + 1)]
    q, delta = (scale * [getattr(one, name) for one in found] for name in ("q", "delta"))
    columns = dict(zip(joints, q.T, strict=True)) | {"from_pose": np.array([one.from_pose for one in found])}
    columns |= {f"delta_{name}": values for name, values in zip(joints, delta.T, strict=True)}
    write_whole(path, to_csv(columns))
    return found


def _region(config: Config, q: FloatArray, share: float, image: FloatArray) -> Region:
    """The range of readings (K, n), widened at each end by a share of it as far as the limits allow."""
    span = np.ptp(q, axis=0)
    low, high = q.min(axis=0) - share * span, q.max(axis=0) + share * span
    joints = joints_of(config, "R" * q.shape[1])
    # A recorded robot may have been where its configured limits do not reach.
    low = np.maximum(low, np.minimum(joints.lower, q.min(axis=0)))
    high = np.minimum(high, np.maximum(joints.upper, q.max(axis=0)))
    return Region(low, high, image)
