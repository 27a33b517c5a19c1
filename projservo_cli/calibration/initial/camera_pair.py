"""Choice of the pair of cameras with which a fit of several cameras begins."""

import dataclasses
from itertools import combinations

import numpy as np

from projservo_cli.calibration.detections import Detections
from projservo_cli.calibration.initial.epipolar import Epipolar
from projservo_cli.records import WorkFailed


def with_best_pair(detections: Detections) -> Detections:
    """Choose the pair of views that determines most; two views are the pair, one is alone.

    By parallax over noise, times the root of the number of markers that both see at poses where they share
    two or more: cameras far around see a tool from other sides.

    Raises WorkFailed if no pair has an epipolar geometry.
    """
    V = len(detections.view)
    if V <= 2:
        return detections
    found, failure = list[tuple[float, tuple[int, int]]](), None
    for pair in combinations(range(V), 2):
        some = detections.of_views([*pair])
        try:
            epipolar = Epipolar.of(some, np.random.default_rng(0))
        except WorkFailed as error:
            failure = error
            continue
        shared = np.bincount(some.pose_of[some.both])
        strength = float(np.sqrt(shared[shared > 1].sum())) * epipolar.parallax_px / epipolar.noise_px
        found.append((strength, pair))
    if not found and failure is not None:
        raise failure
    return dataclasses.replace(detections, pair=max(found)[1])
