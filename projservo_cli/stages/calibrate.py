"""Stage calibrate: trial motions or a recorded table in, projective kinematics out."""

from functools import partial
from pathlib import Path

import numpy as np

from projservo_cli.calibration import (
    REACH_M,
    REACH_RAD,
    Nominal,
    Region,
    Solution,
    Suggestion,
    calibrate,
    cross_validate,
    suggest,
)
from projservo_cli.config import Config
from projservo_cli.files import write_whole
from projservo_cli.records import Calibration, CrossValidation, FloatArray, InputError, Observation
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.scenario import CALIBRATION_NOISE, SUGGESTIONS, TRIAL_POSES, generator
from projservo_cli.stages.world import (
    Truth,
    image_size_of,
    is_ideal,
    joints_of,
    limit_passed,
    reference_of,
    truth_of,
)
from projservo_cli.tables import read_table, to_csv

# Random poses where not given; how far trials are spread, rad, so that no reading repeats its error:
# a tick of a coarse encoder, 4,096 a turn. Draws of one pose, of which each reaches less far, and the share
# of markers that both cameras must see.
_RANDOM_POSES, _TICKS = 12, 4096
_DRAWS, _SHRINKING, _LEAST_SEEN = 100, 0.98, 0.75


def trial_motions(config: Config) -> FloatArray:
    """Joint readings (k, n) of the reference and of all trials, rad or m.

    Every joint alone; then, where joints may be read or images taken with faults, all joints at once, and
    the trials are spread by fractions of an encoder's tick.
    """
    settings = config.calibration
    vector = reference_of(config)
    if vector is None:
        raise InputError("trial motions need a reference: set calibration.reference or task.start")
    joints = joints_of(config)
    reference = np.array(vector.values(joints.types))
    amplitude = np.array(
        [settings.amplitude_m if kind == "P" else np.radians(settings.amplitude_deg) for kind in joints.types]
    )
    rows = [reference]
    for i, farthest in enumerate(amplitude):
        for offset in np.linspace(-farthest, farthest, settings.frames_per_joint):
            q = reference.copy()
            q[i] += offset
            if wrong := limit_passed(q, joints.lower, joints.upper):
                raise InputError(
                    f"calibration: in a trial {wrong}: choose another calibration.reference or a smaller "
                    "amplitude"
                )
            rows.append(q)
    ideal, rng = is_ideal(config), generator(_seed(config), TRIAL_POSES)
    count = settings.random_poses
    if count is None:
        count = 0 if ideal or settings.method == "closed_form" else _RANDOM_POSES
    rows += [_random_pose(config, reference, amplitude, rng) for _ in range(count)]
    q = np.array(rows)
    if ideal or settings.method == "closed_form":  # which takes joints that are told to stand still to do so
        return q
    turn = 2.0 * np.pi / (config.disturbance.encoder_ticks or _TICKS)
    tick = np.where([kind == "P" for kind in joints.types], REACH_M / REACH_RAD, 1.0) * turn
    return np.clip(q + tick * rng.uniform(-1.0, 1.0, q.shape), joints.lower, joints.upper)


def _random_pose(
    config: Config, reference: FloatArray, amplitude: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Joints (n,) within the amplitudes and the limits, which show the markers of a simulated robot."""
    joints, truth = joints_of(config), truth_of(config) if config.plant.use is None else None
    for draw in range(_DRAWS):
        q = reference + amplitude * _SHRINKING**draw * rng.uniform(-1.0, 1.0, len(reference))
        if limit_passed(q, joints.lower, joints.upper):
            continue
        if truth is None:
            return q
        images = images_at(truth, q, np.zeros((2, len(truth.M), 2)))
        if np.isfinite(images).all(axis=(0, 2)).mean() >= _LEAST_SEEN:
            return q
    return reference


def _seed(config: Config) -> int:
    """Seed of the trial motions and of all that is random in their evaluation."""
    return config.seed if config.calibration.seed is None else config.calibration.seed


def trial_noise(config: Config, poses: int, markers: int) -> FloatArray:
    """Pixel noise (poses, 2, markers, 2) of the trial motions, px."""
    drawn = generator(_seed(config), CALIBRATION_NOISE).standard_normal((poses, 2, markers, 2))
    return config.noise.calibration_px * drawn


def simulate(config: Config, truth: Truth, q: FloatArray | None = None) -> Observation:
    """Noisy images of all markers at poses (k, n), by default the trial motions; unseen outside an image."""
    q = trial_motions(config) if q is None else q
    noise = trial_noise(config, len(q), len(truth.number))
    images = np.stack([images_at(truth, *pair) for pair in zip(q, noise, strict=True)])
    return Observation(np.arange(len(q)), np.array(truth.number), q, images)


def images_at(truth: Truth, q: FloatArray, noise: FloatArray) -> FloatArray:
    """Pixels (2, m, 2) of all markers at the joints q (n,), rad or m, with noise; NaN outside an image."""
    images = truth.images(q, truth.M) + noise
    inside = np.all((images >= -0.5) & (images <= truth.image_size - 0.5), axis=-1)
    images[~inside] = np.nan
    return images


def run(
    config: Config, *, progress: Progress = silent
) -> tuple[Observation, Calibration, CrossValidation | None]:
    """Calibrate from simulated trial motions, or from the recorded table of the configuration.

    Returns what was seen, the calibration, and its held-out errors if the configuration asks for them.
    """
    from projservo_cli.config.robot import read_nominal

    settings, seed = config.calibration, _seed(config)
    init = Nominal(**read_nominal(settings.init)) if settings.init is not None else None
    if config.data is not None:
        observation = read_table(config.data.table, config.joint_types, config.data.joint_unit)
        sigma_px = config.data.noise_px
    else:
        observation = simulate(config, truth_of(config))
        sigma_px = config.noise.calibration_px or None
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
        source="recorded" if config.recorded else "simulated",
        image_size=image_size_of(config),
        seed=seed,
        lens=settings.lens,
        init=init,
        fitted=hold_out if settings.cross_validate is not None else None,
        tell=progress,
    )
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
    pixels, size = observation.images, image_size_of(config)
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
