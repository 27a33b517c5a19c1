"""What each stage reports, in words."""

import math
from typing import Any

import click

from projservo_cli.cli.options import wrapped
from projservo_cli.config import Config
from projservo_cli.records import WorkFailed, name_of
from projservo_cli.report.values import LISTS, NEAREST
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
    from projservo_cli.stages import calibrate as stage

    calibration = run.calibration
    try:
        found = stage.suggested(config, run.observation, calibration, count)
    except WorkFailed as error:
        return {"suggestions": [], "suggestions_reason": str(error)}
    path = run.path.parent / FILE
    prismatic = [letter == "P" for letter in calibration.joint_types]
    unit = config.data.joint_unit if config.data is not None else None
    stage.write_suggestions(found, path, prismatic, unit)
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


NOTES = {  # on runs, and their reasons
    "unplanned": "driven without a plan",
    "untested": "images were not tested against the calibration",
}


def summary(stage: str, value: dict[str, Any]) -> str:
    """A stage's object in words, at most 80 columns wide."""
    if "failed" in value:  # the reason is told with the exit code
        return f"{stage}: {'failed' if value['failed'].split('/')[0] == stage else 'not made'}"
    words = {
        "calibrate": _calibrate_words,
        "plan": _plan_words,
        "servo": _servo_words,
        "report": _report_words,
    }
    return "\n".join(words[stage](value))


def _calibrate_words(value: dict[str, Any]) -> list[str]:
    weak = [joint["name"] for joint in value["joints"] if joint["weak"]]
    found = [f"{len(value[name])} {name.replace('_', ' ')}" for name in LISTS if value[name]]
    return [
        wrapped(f"calibrate: {'usable' if value['usable'] else 'NOT usable'}: {value['reason']}"),
        f"  residual {value['rms_px']:.4g} px rms, sigma {value['sigma_px']:.4g} px, "
        f"chi2/dof {value['chi2_per_dof']:.4g}, {value['seconds']:.1f} s",
        *(_lens_words(value["lens"]) if value["lens"] else []),
        wrapped(f"weak joints: {', '.join(weak) or 'none'}" + "".join(f"; {text}" for text in found), "  "),
        *_predicted_words(value["predicted_rms_px"], value["predicted_p99_px"]),
        *_held_out_words(value.get("cross_validation")),
        *(wrapped(f"advice: {text}", "  ") for text in value["advice"]),
        *suggested_words(value),
    ]


def _predicted_words(rms: float | None, bound: float | None) -> list[str]:
    """Expected error of images, where the method has a covariance."""
    if rms is None or bound is None:
        return []
    text = f"predicted error within the ranges of the joints: {_number(rms)} px rms, 99 % below"
    return [wrapped(f"{text} {_number(bound)} px", "  ")]


def _held_out_words(value: dict[str, Any] | None) -> list[str]:
    if value is None:
        return []
    numbers = ("rms_px", "median_px", "p95_px", "predicted_rms_px")
    rms, median, p95, predicted = (_number(value[name]) for name in numbers)
    text = f"held out, {value['folds']} parts of {value['unit']}: rms {rms} px (predicted {predicted})"
    return [
        wrapped(f"{text}, median {median}, p95 {p95}", "  "),
        wrapped(value["reason"], "  "),
    ]


def _lens_words(lens: dict[str, Any]) -> list[str]:
    """Distortion at the radius of each view, half the image size."""
    return [
        f"  lens {view}: k1 {terms['k1']:.3g}, k2 {terms['k2']:.3g} at {terms['radius_px']:.4g} px from "
        f"({terms['center_px'][0]:.4g}, {terms['center_px'][1]:.4g})"
        for view, terms in lens.items()
    ]


def _plan_words(value: dict[str, Any]) -> list[str]:
    feasible = "feasible" if value["feasible"] else "NOT feasible"
    return [
        wrapped(f"plan: {value['profile']}, {feasible}: {value['reason']}"),
        "  rotation {theta_s_deg:.2f} deg = {theta_r_deg:.2f} deg onto the plane, "
        "{theta_p_deg:.2f} deg within it".format_map(value),
        "  least: " + ", ".join(f"{name} {_number(value['margins'][name]['least'])}" for name in NEAREST),
        *([f"  duration {value['duration']:.3g} s"] if value["duration"] else []),
    ]


def _servo_words(value: dict[str, Any]) -> list[str]:
    head = f"  {'law':<20}{'verdict':<13}{'steps':>6}{'mm':>9}{'deg':>9}{'occluded':>11}{'drift mm':>10}"
    rows = [
        f"  {name_of(trace['law'], trace['mode']):<20}{trace['verdict']:<13}{trace['steps']:>6}"
        f"{_number(trace['position_error_mm']):>9}"
        f"{_number(trace['rotation_error_deg']):>9}"
        f"{trace['self_occluded_steps_left']:>6}/{trace['self_occluded_steps_right']:<4}"
        f"{_number(trace['center_deviation_mm']):>10}"
        for trace in value["laws"]
    ]
    notes = [
        wrapped(f"{said}: {reason}", "  ")
        for name, said in NOTES.items()
        for reason in dict.fromkeys(trace[name] for trace in value["laws"] if trace[name])
    ]
    return ["servo: true errors at the end, self-occluded steps left/right", head, *rows, *notes]


def _report_words(value: dict[str, Any]) -> list[str]:
    words = {True: "holds", False: "does not hold", None: "not measured"}
    holding = sum(row["holds"] is True for row in value["claims"])
    claims = [f"{words[row['holds']]}: {row['claim']}: {row['measured']}" for row in value["claims"]]
    reasons: dict[str, list[str]] = {}
    for row in value["left_out"]:
        reasons.setdefault(row["reason"], []).append(row["what"])
    left_out = [f"left out: {', '.join(what)}: {reason}" for reason, what in reasons.items()]
    return [
        f"report: {len(value['figures'])} files of figures; {holding} of {len(claims)} claims hold",
        *(wrapped(text, "  ") for text in (*claims, *left_out)),
        *(f"{name}: {value[name]}" for name in ("page", "view", "animation") if value.get(name)),
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
