"""Errors as labs make them, put into the readings of an observation, and what a calibration lists."""

import dataclasses

import numpy as np


def shifted(observation, share, sigma, seed=0):
    """A share of the readings shifted by up to ±50 px, and which of them by more than 5σ; σ in px."""
    rng = np.random.default_rng(seed)
    images, wrong = observation.images.copy(), set()
    seen = np.argwhere(np.isfinite(images[..., 0]))
    for k, v, j in seen[rng.choice(len(seen), int(share * len(seen)), replace=False)]:
        shift = rng.uniform(-50.0, 50.0, 2)
        images[k, v, j] += shift
        if np.abs(shift).max() > 5.0 * sigma:
            wrong.add((int(observation.pose[k]), int(observation.marker[j]), int(v)))
    return dataclasses.replace(observation, images=images), wrong


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


def misread(train, share=0.05, seed=0):
    """A share of the joint readings off by 0.3 rad, and which."""
    rng = np.random.default_rng(seed)
    q, wrong = train.q.copy(), set()
    for k, i in np.argwhere(rng.random(q.shape) < share):
        q[k, i] += rng.choice([-0.3, 0.3])
        wrong.add((int(train.pose[k]), int(i) + 1))
    return dataclasses.replace(train, q=q), wrong


def listed(calibration):
    """What a calibration found: readings left out by view, exchanged numbers, joint readings in doubt."""
    readings = {
        (p, m, v) for p, m, view in calibration.outlier.tolist() for v in ((view,) if view < 2 else (0, 1))
    }
    return readings, *(
        {tuple(row) for row in rows.tolist()} for rows in (calibration.id_switches, calibration.suspect)
    )
