"""Independent streams of random numbers, each a child of a seed."""

import numpy as np

CALIBRATION_NOISE, TARGET_NOISE, SERVO_NOISE, SUGGESTIONS, PIN_TARGET_NOISE, PIN_NOISE = range(6)
TRIAL_POSES, TAUGHT_NOISE, START_FRAMES, GOAL_FRAMES, POSE_NOISE = range(6, 11)
OBJECT_TAUGHT, OBJECT_NOW = range(11, 13)


def generator(seed: int, *stream: int) -> np.random.Generator:
    """Random numbers of a stream of a seed, or of a part of one, such as a frame of a view."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=stream))
