"""Trial motions: where they lead, and what an ideal simulated robot shows there."""

import numpy as np

from projservo_cli.calibration import REACH_M, REACH_RAD
from projservo_cli.config import Config
from projservo_cli.records import FloatArray, InputError, Observation
from projservo_cli.stages.scenario import CALIBRATION_NOISE, TRIAL_POSES, generator
from projservo_cli.stages.world import Truth, is_ideal, joints_of, limit_passed, reference_of, truth_of

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
    ideal, rng = is_ideal(config), generator(seed_of_trials(config), TRIAL_POSES)
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


def seed_of_trials(config: Config) -> int:
    """Seed of the trial motions and of all that is random in their evaluation."""
    return config.seed if config.calibration.seed is None else config.calibration.seed


def trial_noise(config: Config, poses: int, markers: int) -> FloatArray:
    """Pixel noise (poses, 2, markers, 2) of the trial motions, px."""
    drawn = generator(seed_of_trials(config), CALIBRATION_NOISE).standard_normal((poses, 2, markers, 2))
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
