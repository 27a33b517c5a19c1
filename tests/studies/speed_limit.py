"""Highest share of the joint-speed limit that each law commands, over all shipped configurations.

    python -m tests.studies.speed_limit [--steps 400] [--periods 0.04 0.1]

Every law runs in each of its modes in the compiled loop, with the true model and no calibration, on plans of
two profiles. A share is that of the joint that comes nearest to its limit in a step, Δq over the period.
"""

import argparse
from collections import defaultdict

from tests.conftest import SHIPPED
from tests.known import configured
from tests.loop.speeds import highest_shares

PROFILES = ("linear", "joint_space")


def main():
    """Make the runs and print a table."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.speed_limit")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--periods", type=float, nargs="+", default=[0.04, 0.1])
    given = parser.parse_args()
    found = defaultdict(list)
    for path in SHIPPED:
        for period in given.periods:
            config = configured(path.stem, f"control.period_s={period}")
            for (name, _), share in highest_shares(config, PROFILES, given.steps).items():
                found[name].append((share, path.stem, period))
    print("| run | runs | highest share of the limit | configuration | period, s |\n|---|---|---|---|---|")
    for name, shares in found.items():
        share, where, period = max(shares)
        print(f"| {name} | {len(shares)} | {share:.9f} | {where} | {period:g} |")


if __name__ == "__main__":
    main()
