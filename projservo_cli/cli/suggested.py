"""``projservo calibrate --suggest``: further poses to record, as a table, JSON and a list of motions."""

import math
from typing import Any

import click

from projservo_cli.config import Config
from projservo_cli.records import WorkFailed
from projservo_cli.store import Run

FILE = "suggestions.csv"


def require_covariance(config: Config) -> None:
    """Refuse before any work what has no covariance to judge poses by."""
    if config.calibration.method != "refined":
        raise click.UsageError(
            f"--suggest: the method {config.calibration.method} has no covariance to judge poses by; "
            "use --set calibration.method=refined"
        )


def suggested(config: Config, run: Run, count: int) -> dict[str, Any]:
    """Further poses for the calibration of a run, as JSON values; the list of them is written beside it.

    Parameters
    ----------
    config, run : what is calibrated.
    count : poses to suggest.
    """
    from projservo_cli.stages import suggest

    calibration = run.calibration
    try:
        found = suggest.run(config, run.observation, calibration, count)
    except WorkFailed as error:
        return {"suggestions": [], "suggestions_reason": str(error)}
    path = run.path.parent / FILE
    prismatic = [letter == "P" for letter in calibration.joint_types]
    unit = config.data.joint_unit if config.data is not None else None
    suggest.write(found, path, prismatic, unit)
    rows = [
        {
            "q": one.q,
            "from_pose": one.from_pose,
            "delta": one.delta,
            "variance_before": one.variance_before,
            "variance_after": one.variance_after,
        }
        for one in found
    ]
    return {
        "suggestions": rows,
        "suggestions_file": path.resolve(),
        "suggestions_unit": unit or "rad",
        "suggestions_limited": config.robot is not None,
    }


def suggested_words(value: dict[str, Any]) -> list[str]:
    """The suggestions of a calibration's object as a table, deltas in deg and mm."""
    rows = value.get("suggestions")
    if not rows:
        return []
    types = [joint["type"] for joint in value["joints"]]
    names = "".join(f"{f'q{i} ' + ('deg' if t == 'R' else 'mm'):>9}" for i, t in enumerate(types, 1))
    lines = [
        f"  poses to add, as the way from a recorded one; predicted error {_error(rows[0], 'before')} px now",
        f"  {'from pose':>9}{names}{'then px':>9}",
    ]
    for row in rows:
        way = (math.degrees(d) if t == "R" else 1e3 * d for d, t in zip(row["delta"], types, strict=True))
        lines.append(
            f"  {row['from_pose']:>9}" + "".join(f"{d:>+9.1f}" for d in way) + f"{_error(row, 'after'):>9}"
        )
    lines.append(f"  joints of these poses: {value['suggestions_file']} ({value['suggestions_unit']}, m)")
    if not value["suggestions_limited"]:
        lines.append("  joint limits are not known here: leave out what your robot cannot reach")
    return lines


def _error(row: dict[str, Any], when: str) -> str:
    """Predicted error of a coordinate, px."""
    return f"{math.sqrt(row[f'variance_{when}']):.3g}"
