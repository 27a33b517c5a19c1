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
from tests.conftest import SHARED

SIZE = (6000, 4000)
# Five standard deviations of what the best fit leaves, px.
FIVE_SIGMA = 5.0 * 0.52


def tables(folder=SHARED):
    """Training and test poses."""
    return tuple(read_table(folder / "motoman" / f"arm2_{part}.csv") for part in ("train", "test"))


def fit(observation, seed=0, lens=True):
    return calibrate(observation, "RRRRRR", source="recorded", image_size=SIZE, seed=seed, lens=lens)


def some(observation, rows):
    """Observation of some of the poses."""
    values = {name: getattr(observation, name)[rows] for name in ("pose", "q", "images")}
    return dataclasses.replace(observation, **values)


def shifted(train, share, seed=0):
    """A share of the readings shifted by up to ±50 px, and which of them by more than 5σ."""
    rng = np.random.default_rng(seed)
    images, wrong = train.images.copy(), set()
    seen = np.argwhere(np.isfinite(images[..., 0]))
    for k, v, j in seen[rng.choice(len(seen), int(share * len(seen)), replace=False)]:
        shift = rng.uniform(-50.0, 50.0, 2)
        images[k, v, j] += shift
        if np.abs(shift).max() > FIVE_SIGMA:
            wrong.add((int(train.pose[k]), int(train.marker[j]), int(v)))
    return dataclasses.replace(train, images=images), wrong


def exchanged(train, seed=0):
    """Two marker numbers exchanged in a fifth of the poses, and which."""
    rng = np.random.default_rng(seed)
    images, wrong = train.images.copy(), set()
    for k in rng.choice(len(train.q), len(train.q) // 5, replace=False):
        visible = np.flatnonzero(np.isfinite(images[k]).all(axis=(0, 2)))
        a, b = sorted(rng.choice(visible, 2, replace=False))
        images[k][:, [a, b]] = images[k][:, [b, a]]
        wrong.add((int(train.pose[k]), int(train.marker[a]), int(train.marker[b])))
    return dataclasses.replace(train, images=images), wrong


def misread(train, seed=0):
    """A twentieth of the joint readings off by 0.3 rad, and which."""
    rng = np.random.default_rng(seed)
    q, wrong = train.q.copy(), set()
    for k, i in np.argwhere(rng.random(q.shape) < 0.05):
        q[k, i] += rng.choice([-0.3, 0.3])
        wrong.add((int(train.pose[k]), int(i) + 1))
    return dataclasses.replace(train, q=q), wrong


def few(train, seed=0):
    """Thirty random poses."""
    return some(train, np.sort(np.random.default_rng(seed).choice(len(train.q), 30, replace=False)))


def listed(calibration):
    """What a calibration found: readings left out by view, exchanged numbers, joint readings in doubt."""
    readings = {
        (p, m, v) for p, m, view in calibration.outlier.tolist() for v in ((view,) if view < 2 else (0, 1))
    }
    return readings, *(
        {tuple(row) for row in rows.tolist()} for rows in (calibration.swapped, calibration.suspect)
    )


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
            _show(f"{share:.0%} shifted, draw {seed}", *_cased(shifted(train, share, seed), test))
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
