"""Whether 95 % regions of the metric hold the truth: ``python -m tests.studies.metric_coverage [ARM …]``.

Each draw is a calibration of a simulated arm at 0.5 px from its own trial motions, and a length between
the two markers farthest apart, known to 0.2 %. Prints for each arm the share of regions that hold the truth:
of the intrinsics and the pose of each camera, in the own frames and in those of the true model, of each axis,
and of tool positions within the data's range.
"""

import argparse

import numpy as np
from scipy.stats import chi2

import projservo_cli as projservo
from projservo_cli.config.settings_and_rules import truth_of
from projservo_cli.metric.frame import Metric
from projservo_cli.metric.nominal_comparison import in_model_frames
from projservo_cli.records import WorkFailed, changed
from tests.known import configured

ARMS = ("paper", "ur5", "seven", "hobby")
DRAWS = 1000
NOISE_PX = 0.5
LENGTH_STD = 0.002  # of the length
SEED = 330_000  # of draw 0
POSES = 10  # of the tool
RANK = 1e-9  # of the largest eigenvalue, below which a direction is fixed
FIXED = 1e-18  # of the largest eigenvalue, in rad², m² or px², of what a frame fixes


def true_metric(truth, calibration, length):
    """The metric of the true robot, in the same frames; its length sets no scale."""
    order = [truth.number.index(number) for number in calibration.marker.tolist()]
    model = truth.model
    exact = changed(
        calibration,
        P=model.P,
        H_hat_0=model.H_hat_0,
        q_reference=model.q_reference,
        M=truth.M[order],
        lens=None if calibration.lens is None else truth.lens,
    )
    size = 24 + 16 * len(model.q_reference) + (0 if calibration.lens is None else 4) + 4 * len(order)
    return Metric.of(exact, np.zeros((size, 1)), length_m=length[0], between=length[1])


def longest(truth, calibration):
    """Distance of the two markers farthest apart, m, and their numbers."""
    numbers = calibration.marker.tolist()
    M = truth.M[[truth.number.index(number) for number in numbers], :3]
    apart = np.linalg.norm(M[:, None] - M, axis=-1)
    a, b = np.unravel_index(apart.argmax(), apart.shape)
    return float(apart[a, b]), (numbers[a], numbers[b])


def held(error, covariance):
    """Whether each error (k, d) is in the 95 % region of its covariance (k, d, d); NaN if that is empty.

    A region has no more directions than its covariance: a unit vector has two, a line four.
    """
    result = np.full(len(error), np.nan)
    for k, (e, C) in enumerate(zip(error, covariance, strict=True)):
        values, vectors = np.linalg.eigh(C)
        known = (values > RANK * values[-1]) & (values[-1] > FIXED)
        if known.any():
            square = ((vectors.T @ e)[known] ** 2 / values[known]).sum()
            result[k] = square <= chi2.ppf(0.95, known.sum())
    return result


def flat(K):
    """The five entries (2, 5) of intrinsics (2, 3, 3)."""
    return K[:, (0, 0, 0, 1, 1), (0, 1, 2, 1, 2)]


def off(T, T0):
    """Errors (k, 6) of poses (k, 4, 4): small rotation, and shift."""
    R = np.swapaxes(T[:, :3, :3] @ T0[:, :3, :3].swapaxes(1, 2), 0, 2)
    half = np.stack([R[1, 2] - R[2, 1], R[2, 0] - R[0, 2], R[0, 1] - R[1, 0]], axis=1)
    return np.concatenate([0.5 * half, (T - T0)[:, :3, 3]], axis=1)


def draw(config, seed):
    """Whether the regions of one draw hold the truth, by name; None if the calibration fails."""
    rng = np.random.default_rng(seed)
    truth = truth_of(config)
    try:
        c = projservo.calibrate(projservo.simulate(config, seed=seed, noise_px=NOISE_PX))
    except WorkFailed:
        return None
    length, between = longest(truth, c)
    std = LENGTH_STD * length
    m = c.metric(length + std * rng.standard_normal(), between, length_std_m=std)
    exact = true_metric(truth, c, (length, between))
    q = rng.uniform(*m.range.T, size=(POSES, len(c.joint_types)))
    there = in_model_frames(m, exact.axes, exact.body.tool)
    position = (m.pose(q) - exact.pose(q))[:, :3, 3]
    return {
        "K": held(flat(m.K) - flat(exact.K), m.covariance("K")),
        "poses": held(off(m.poses, exact.poses), m.covariance("poses")),
        "in model": held(off(there.poses, exact.poses), there.covariance("poses")),
        "axes": held(m.axes - exact.axes, m.covariance("axes")),
        "markers": held(m.markers - exact.markers, m.covariance("markers")),
        "positions": held(position, m.pose_covariance(q)[:, 3:, 3:]),
    }


def study(arm, draws):
    """Print the coverage of an arm."""
    config = configured(arm)
    found = [draw(config, SEED + k) for k in range(draws)]
    done = [one for one in found if one is not None]
    print(f"{arm}: {len(done)} of {draws} draws calibrate")
    for name in done[0]:
        each = 100.0 * np.nanmean([one[name] for one in done], axis=0)
        print(f"  {name:10} {np.nanmean(each):5.1f} %, each {np.round(each, 1).tolist()}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("arms", nargs="*", default=ARMS)
    parser.add_argument("--draws", type=int, default=DRAWS)
    given = parser.parse_args()
    for arm in given.arms:
        study(arm, given.draws)


if __name__ == "__main__":
    main()
