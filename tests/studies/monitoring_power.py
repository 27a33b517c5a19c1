"""What the best test of images could see of a fault, by the errors that a calibration allows.

    python -m tests.studies.monitoring_power [--runs 40]

Rigs and tasks are of ``tests.studies.monitoring``; nothing is driven. Images along the way from start
to goal differ by μ under a fault. The test that knows μ has the power Φ(λ − z) at a false alarm in a hundred
runs, with λ² = μᵀ S⁻¹ μ and S the covariance of errors of the calibration, of joints and of corners: Neyman
and Pearson's lemma; no test sees more. A likelihood ratio that must find six parameters, in one of forty
directions and ten looks, sees less. Errors of corners are new in each view. Those of joints are so or the
same all along: backlash lies between both.
"""

import argparse

import numpy as np
from scipy.stats import chi2, ncx2, norm

from projservo_cli.monitoring.frame_pairs import FramePair
from projservo_cli.monitoring.innovation_tests import ErrorModel, is_same_view
from tests.monitoring.stand_in import ARMS, seen, tool_pose
from tests.studies.monitoring import CAMERA, SEED, calibrated, fault_of, rigs, tasks

FALSE_ALARM, SAMPLES = 0.01, 60  # chance in a run; looks on the way
FREE, TESTS = 6, 400  # parameters of a likelihood ratio; directions times looks that share the chance
# Levels of ``fault_of``, and the rigs that they are asked of.
CORNERS, SLACK = ("subpix", "jpeg"), 0.3
CASES = {
    "refocused by 1 %, corners without deviations": (
        [("refocus", view, by) for view in (0, 1) for by in (0.99, 1.01)],
        lambda rig: rig.corners in CORNERS,
    ),
    **{
        f"both cameras moved by {px:g} px, five joints, backlash": (
            [level for level in CAMERA if level[1] == (0, 1) and level[-1] == px],
            lambda rig: rig.arm == "five" and rig.backlash_deg == SLACK,
        )
        for px in (3.0, 8.0)
    },
    "left camera shifted by 2 px": (
        [("shift", (0,), axis, sign, 2.0) for axis in (0, 1) for sign in (-1, 1)],
        lambda rig: True,
    ),
}


def looks_of(rig, start, goal, fault):
    """The first look of each view on the way, without errors, and μ (2, m, 2) px of each by a fault."""
    found, before, still = [], None, np.zeros(2)
    for q in np.radians(np.linspace(start, goal, SAMPLES)):
        T = tool_pose(ARMS[rig.arm], q)
        shown = [seen(T, view) for view in (0, 1)]
        pixels = np.stack([one.pixels.reshape(-1, 2) for one in shown])
        if before is not None and is_same_view(before, pixels):
            continue
        before = pixels
        images = np.where(np.repeat([one.shown for one in shown], 4, axis=1)[..., None], pixels, np.nan)
        there = np.stack([seen(T, view, (fault,)).pixels.reshape(-1, 2) for view in (0, 1)])
        both = np.stack([q, q])
        look = FramePair(still, both, 0.0 * both, still, images, np.zeros(images.shape[:2]), 0.0 * q)
        found.append((look, there - pixels))
    return found


def noncentrality(calibration, looks, lasting):
    """λ of looks; joint errors are the same in all of them, or new in each."""
    errors = ErrorModel(calibration, calibration.sigma_px)
    n, e = len(errors.sigma_q), errors.e
    A, b, square = np.eye(e + n), np.zeros(e + n), 0.0
    for look, mu in looks:
        look = look._replace(noise=errors.noise(look.seen, None))
        residual = errors.residual(look)
        J_q = residual.F[:, :n] * (calibration.sigma_q or 0.0)
        R = np.diag(np.repeat(residual.noise.ravel(), 2) ** 2)
        if not lasting:
            R += J_q @ J_q.T
        B = np.concatenate([residual.B, J_q * lasting], axis=1)
        mu = np.where(look.seen[..., None], mu, 0.0).ravel()
        solved = np.linalg.solve(R, np.column_stack([B, mu]))
        A, b, square = A + B.T @ solved[:, :-1], b + B.T @ solved[:, -1], square + mu @ solved[:, -1]
    return float(np.sqrt(max(square - b @ np.linalg.solve(A, b), 0.0)))


def main():
    """Print λ and power for each case, before motion and over the whole way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=40, help="of each case")
    given, z = parser.parse_args(), norm.isf(FALSE_ALARM)
    most = chi2.isf(FALSE_ALARM / TESTS, FREE)
    for case, (levels, concerned) in CASES.items():
        known = [rig for rig in rigs(["finder", *CORNERS, "none"]) if concerned(rig) and rig.latency_s == 0.0]
        found = []
        for k in range(given.runs):
            rig, rng = known[k % len(known)], np.random.default_rng([SEED, k])
            calibration = calibrated(rig)
            if isinstance(calibration, str):
                continue
            start, goal = next(tasks(rig, rng))
            T = tool_pose(ARMS[rig.arm], np.radians(start))
            fault, _ = fault_of(levels[k % len(levels)], T, len(start), rng)
            looks = looks_of(rig, start, goal, fault)
            some = (looks[:1], True), (looks, True), (looks, False)
            found.append([noncentrality(calibration, *one) for one in some])
        print(f"{case}: {len(found)} runs")
        for name, values in zip(
            ("before motion", "whole way, joint errors last", "whole way, joint errors new in each view"),
            np.transpose(found),
            strict=True,
        ):
            least, low, median = np.quantile(values, (0.0, 0.05, 0.5))
            best, searched = norm.cdf(values - z), ncx2.sf(most, FREE, values**2)
            print(
                f"    {name}: λ least {least:.1f}, 5 % {low:.1f}, median {median:.1f}; seen by the best "
                f"test {100.0 * best.mean():.1f} %, by a likelihood ratio {100.0 * searched.mean():.1f} %"
            )


if __name__ == "__main__":
    main()
