"""A real arm with errors put into its readings, for the tests in small and by hand in full.

Arm 2 of a Motoman MA1400 before two fixed cameras: K. Stepanova et al., "Automatic self-contained
calibration of an industrial dual-arm robot with cameras using self-contact, planar constraints, and
self-observation", RCIM 73, 2022. ``python -m tests.acceptance.motoman`` prints every case, some minutes.
"""

import dataclasses
import time

import numpy as np

from projservo_cli.calibration import calibrate, residual_statistics
from projservo_cli.records import WorkFailed
from projservo_cli.tables import read_table
from tests.calibration.damage import exchanged, listed, misread, shifted
from tests.conftest import SHARED

SIZE = (6000, 4000)
# What the best fit leaves, px.
SIGMA = 0.52


def tables(folder=SHARED):
    """Training and test poses."""
    return tuple(read_table(folder / "motoman" / f"arm2_{part}.csv") for part in ("train", "test"))


def fit(observation, seed=0, lens=True):
    return calibrate(observation, "RRRRRR", source="recorded", image_size=SIZE, seed=seed, lens=lens)


def some(observation, rows):
    """Observation of some of the poses."""
    values = {name: getattr(observation, name)[rows] for name in ("pose", "q", "images")}
    return dataclasses.replace(observation, **values)


def few(train, seed=0):
    """Thirty random poses."""
    return some(train, np.sort(np.random.default_rng(seed).choice(len(train.q), 30, replace=False)))


def _show(name, observation, test, wrong=frozenset(), which=0, **options):
    begin = time.process_time()
    try:
        calibration = fit(observation, **options)
    except WorkFailed as error:
        print(f"{name:28} refused: {error}", flush=True)
        return
    value = residual_statistics(calibration, test)
    found = listed(calibration)[which]
    print(
        f"{name:28} rms {value['rms_px']:.4f}, median {value['median_px']:.4f}, "
        f"p95 {value['p95_px']:.4f} px, "
        f"{len(wrong & found)} of {len(wrong)} culprits and {len(found - wrong)} others listed, "
        f"{time.process_time() - begin:.1f} s",
        flush=True,
    )


def main():
    train, test = tables()
    _show("without lens", train, test, lens=False)
    for seed in range(10):
        _show(f"seed {seed}", train, test, seed=seed)
    for seed in range(3):
        for share in (0.05, 0.15):
            _show(f"{share:.0%} shifted, draw {seed}", *_cased(shifted(train, share, SIGMA, seed), test))
        _show(f"exchanged, draw {seed}", *_cased(exchanged(train, seed), test), which=1)
        _show(f"misread, draw {seed}", *_cased(misread(train, seed), test), which=2)
    for seed in range(10):
        for lens in (False, True):
            _show(f"30 poses, draw {seed}, {'lens' if lens else 'none'}", few(train, seed), test, lens=lens)


def _cased(case, test):
    observation, wrong = case
    return observation, test, wrong


if __name__ == "__main__":
    main()
