"""How often features of an object's own markers are met as well as is stated, which nobody has taught.

    python -m tests.studies.object_features [--draws 200] [-o object_features.csv]

The arm, cameras and part of ``configs/object.yaml``, calibrated anew in each draw; the part is displaced by
up to 60 mm and 30 degrees. A marker of the tool goes to the middle of one of its tags, a line of the tool
along an edge of the other, by ``exact_track``. Errors are those of the truth.
"""

import json
import math
from collections import Counter

import numpy as np

from projservo_cli.records import WorkFailed
from tests.configured import calibrate, plan, servo, truth_of
from tests.known import configured
from tests.studies.carried_goals import direction
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, written

SEED, FARTHEST_M, MOST_DEG = 810_000, 0.06, 30.0
FEATURES = {
    "tip": {"on": "tool", "point": [4]},
    "axis": {"on": "tool", "line": [5, 7]},
    "spot": {"on": "part", "point": [40, 41, 42, 43]},
    "edge": {"on": "part", "line": [44, 45]},
}
COLUMNS = ("seed", "verdict", "mm", "stated_mm", "deg", "stated_deg", "reason")


def driven(seed):
    """Row of a draw."""
    rng = np.random.default_rng(SEED + seed)
    by, turn = rng.uniform(0.0, FARTHEST_M) * direction(rng), rng.uniform(0.0, MOST_DEG) * direction(rng)
    moved = {"translation_m": by.tolist(), "rotation_deg": turn.tolist()}
    config = configured(
        "object",
        f"seed={seed + 1}",
        f"objects.part.displacement={json.dumps(moved)}",
        f"features={json.dumps(FEATURES)}",
        "task.goal.on=null",
        "task.goal.incidences=[[tip, spot], [axis, edge, parallel]]",
    )
    part = config.objects.named["part"]
    X = (part.points @ part.moved.T)[:, :3]
    truth, row = truth_of(config), {"seed": seed}
    try:
        calibration = calibrate.run(config)[1]
        trace = servo.run(config, calibration, plan.run(config, calibration), "exact_track")
    except WorkFailed as error:
        return row | {"verdict": "not started", "reason": str(error)}
    H = trace.pose[-1] @ np.linalg.inv(truth.robot.base_tool)
    tip, *line = (truth.of((4, 5, 7)) @ H.T)[:, :3]
    turned = np.cross(line[1] - line[0], X[5] - X[4])
    sine = np.linalg.norm(turned) / np.linalg.norm(line[1] - line[0]) / np.linalg.norm(X[5] - X[4])
    return row | {
        "verdict": trace.verdict,
        "reason": trace.reason,
        "mm": 1e3 * np.linalg.norm(tip - X[:4].mean(axis=0)),
        "stated_mm": trace.incidence_mm[0],
        "deg": math.degrees(math.asin(min(1.0, sine))),
        "stated_deg": trace.incidence_deg[1],
    }


def main():
    given = parser_of("object_features", __doc__, [("draws", 200, "displacements of the part")]).parse_args()
    rows = in_two_processes(driven, range(given.draws), "runs")
    rows = written(given.output, COLUMNS, ([row] for row in rows))
    there = [row for row in rows if row["verdict"] == "converged"]
    for verdict, count in Counter(row["verdict"] for row in rows).items():
        print(f"{count} {verdict}")
    for unit in ("mm", "deg"):
        off, stated = (np.array([row[f"{key}{unit}"] for row in there]) for key in ("", "stated_"))
        held = rate(int(np.sum(off <= 2.0 * stated)), len(off))
        print(f"{unit}: true {quantiles(off)}, stated {quantiles(stated)}, true ≤ 2 × stated {held}")


if __name__ == "__main__":
    main()
