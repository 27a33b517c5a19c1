"""What each stage of a run found, as plain values: what words, JSON and the page tell."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from projservo_cli.config import Config
from projservo_cli.records import Calibration
from projservo_cli.store import Run

PAGE_FILE, VIEW_FILE, ANIMATION_FILE = "report.html", "view.html", "animation.gif"
CLAIMS_FILE = "claims.json"
NEAREST = ("visibility", "border_px", "joints", "condition")  # smallest along the planned motion
LISTS = ("outliers", "suspect_joint_readings", "swapped")  # single observations that do not fit
_COUNTS = ("merged_poses", "merged_markers")
_NUMBERS = ("rms_px", "sigma_px", "chi2_per_dof", "seconds")


def stage_object(stage: str, run: Run, config: Config, laws: Sequence[str]) -> dict[str, Any]:
    """The JSON object of a stage that was made or is up to date."""
    path = {"run": run.path.resolve()}
    if stage == "calibrate":
        return path | _calibration(run, config)
    if stage == "plan":
        return path | _plan(run)
    if stage == "servo":
        return path | {"laws": [scalars(run.traces[law]) for law in laws]}
    page = run.path.parent / PAGE_FILE
    report = run.results["report"].records[""]
    return path | {"page": page.resolve() if page.is_file() else None} | scalars(report)


def failed_object(stage: str, run: Run, reason: str, at: str, laws: Sequence[str]) -> dict[str, Any]:
    """The JSON object of a stage that could not be made, or lacks what it needs."""
    result: dict[str, Any] = {"run": run.path.resolve(), "reason": reason, "failed": at}
    if stage == "calibrate":
        lists: dict[str, list[Any]] = {name: [] for name in ("advice", "joints", *LISTS)}
        return (
            result
            | {"usable": False, "lens": None}
            | dict.fromkeys(_NUMBERS)
            | dict.fromkeys(_COUNTS, 0)
            | lists
        )
    if stage == "plan":
        return result | {"feasible": False}
    if stage == "servo":
        return result | {"laws": [scalars(run.traces[law]) for law in laws]}
    return result


def scalars(record: Any) -> dict[str, Any]:
    """All fields of a record but its arrays."""
    fields = [field.name for field in dataclasses.fields(record) if "dims" not in field.metadata]
    return {name: getattr(record, name) for name in fields}


def _calibration(run: Run, config: Config) -> dict[str, Any]:
    from projservo_cli.calibration import findings  # heavy; only this object needs it

    calibration = run.calibration
    given = config.robot.joints if config.robot is not None else ()
    joints = [
        {
            "name": (given[i].name if i < len(given) else None) or f"q{i + 1}",
            "type": letter,
            "excitation": float(calibration.excitation[i]),
            "noise": float(calibration.prediction_noise[i]),
            "defect": float(calibration.operator_defect[i]),
            "weak": bool(calibration.weak[i]),
        }
        for i, letter in enumerate(calibration.joint_types)
    ]
    held_out = {"cross_validation": scalars(run.cross_validation)} if run.cross_validation else {}
    return (
        scalars(calibration)
        | {"joints": joints, "lens": _lens(calibration)}
        | findings(calibration)
        | held_out
    )


def _lens(calibration: Calibration) -> dict[str, Any] | None:
    """Radial distortion of both views, None where it was not estimated."""
    if calibration.lens is None:
        return None
    return {
        view: {"center_px": terms[:2], "radius_px": terms[2], "k1": terms[3], "k2": terms[4]}
        for view, terms in zip(("left", "right"), calibration.lens.tolist(), strict=True)
    }


def _plan(run: Run) -> dict[str, Any]:
    plan = run.plan
    angles = {f"{name}_deg": math.degrees(getattr(plan, name)) for name in ("theta_r", "theta_p", "theta_s")}
    radians = ("theta_r", "theta_p", "theta_s")
    rest = {name: value for name, value in scalars(plan).items() if name not in radians}
    nearest = {
        name: {"least": value, "mu": mu}
        for name, value, mu in zip(NEAREST, plan.least, plan.least_mu, strict=True)
    }
    found = {
        "tau_0": plan.tau_0,
        "smallest_margin": plan.margin.min(axis=0),
        "margins": nearest,
    }
    return rest | angles | found
