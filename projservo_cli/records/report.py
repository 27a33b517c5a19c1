"""What a report wrote and found."""

from dataclasses import dataclass
from typing import Any

from projservo_cli.records.fields import BoolArray, FloatArray, array, scalar


@dataclass(frozen=True, eq=False)
class Report:
    """What a report wrote, the claims of the paper against the runs, and the numbers of the extra runs.

    Laws are direct_three and direct_two, operators true and calibrated, limits none and the limit
    per step. Deviations are NaN where the goal pose is unknown.
    """

    figures: tuple[str, ...] = scalar(about="files written, relative to the folder of the run")
    left_out: tuple[dict[str, str], ...] = scalar(about="figures and studies left out, each with the reason")
    claims: tuple[dict[str, Any], ...] = scalar(about="claim, source, measured, criterion, holds")
    step_limit_deg: float = scalar(units="deg", about="joint motion per step of the limited runs")
    gain_per_step: FloatArray = array("gain_per_step", about="share of the error taken in one step")
    drift_mm: FloatArray = array(
        "law", "operators", "limit", "gain_per_step", units="mm", about="largest deviation of the centre"
    )
    drift_at_samples_mm: FloatArray = array(
        "law", "operators", "limit", "gain_per_step", units="mm", about="the same at the sampling instants"
    )
    drift_converged: BoolArray = array(
        "law", "operators", "limit", "gain_per_step", about="whether the run converged"
    )
    period: FloatArray = array("period", units="s", about="control period at the configured gains")
    period_drift_mm: FloatArray = array(
        "law", "period", units="mm", about="largest deviation of the centre, true operators, no limit"
    )
    share: FloatArray = array("share", about="share of the task in both sides of (22)")
    composition_mm: FloatArray = array(
        "share", units="mm", about="distance of the centre between both sides of (22)"
    )
