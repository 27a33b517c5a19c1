"""What each stage reports, in words: what a person reads in ten seconds, or all of it."""

import math
import textwrap
from collections.abc import Iterator
from typing import Any

from projservo_cli.cli.output import wrapped
from projservo_cli.records import name_of
from projservo_cli.report.material import LISTS, NEAREST

_NOTES = {  # on runs, and their reasons
    "unplanned": "driven without a plan",
    "untested": "images were not tested against the calibration",
}


def summary(stage: str, value: dict[str, Any], *, detailed: bool = False) -> Iterator[str]:
    """Lines on a stage's object, at most 80 columns wide; ``detailed`` tells every claim and margin."""
    if "failed" in value:  # the reason is told with the exit code
        yield f"{stage}: {'failed' if value['failed'].split('/')[0] == stage else 'not made'}"
    elif stage == "calibrate":
        yield from _of_calibration(value)
    elif stage == "plan":
        yield from _of_plan(value, detailed)
    elif stage == "servo":
        yield from _of_laws(value)
    else:
        yield from _of_report(value, detailed)


def _of_calibration(value: dict[str, Any]) -> Iterator[str]:
    yield wrapped(f"calibrate: {'usable' if value['usable'] else 'NOT usable'}: {value['reason']}")
    yield (
        f"  residual {value['rms_px']:.4g} px rms, sigma {value['sigma_px']:.4g} px, "
        f"chi2/dof {value['chi2_per_dof']:.4g}, {value['seconds']:.1f} s"
    )
    for view, terms in (value["lens"] or {}).items():  # at the radius of the view, half the image size
        yield (
            f"  lens {view}: k1 {terms['k1']:.3g}, k2 {terms['k2']:.3g} at {terms['radius_px']:.4g} px from "
            f"({terms['center_px'][0]:.4g}, {terms['center_px'][1]:.4g})"
        )
    weak = ", ".join(joint["name"] for joint in value["joints"] if joint["weak"])
    found = [f"{len(value[name])} {name.replace('_', ' ')}" for name in LISTS if value[name]]
    if weak or found:
        yield wrapped("; ".join([f"weak joints: {weak or 'none'}", *found]), "  ")
    if value["predicted_rms_px"] is not None:
        rms, bound = _number(value["predicted_rms_px"]), _number(value["predicted_p99_px"])
        text = f"predicted error within the ranges of the joints: {rms} px rms, 99 % below {bound} px"
        yield wrapped(text, "  ")
    if held_out := value.get("cross_validation"):
        numbers = ("rms_px", "median_px", "p95_px", "predicted_rms_px")
        rms, median, p95, predicted = (_number(held_out[name]) for name in numbers)
        text = f"held out, {held_out['folds']} parts of {held_out['unit']}: rms {rms} px"
        yield wrapped(f"{text} (predicted {predicted}), median {median}, p95 {p95}", "  ")
        yield wrapped(held_out["reason"], "  ")
    for text in value["advice"]:
        yield wrapped(f"advice: {text}", "  ")
    yield from _of_suggestions(value)


def _of_suggestions(value: dict[str, Any]) -> Iterator[str]:
    """The suggestions of a calibration's object as a table, deltas in deg and mm."""
    rows = value.get("suggestions")
    if not rows:
        return
    revolute = [joint["type"] == "R" for joint in value["joints"]]
    names = "".join(f"{f'q{i} ' + ('deg' if turns else 'mm'):>9}" for i, turns in enumerate(revolute, 1))
    now = math.sqrt(rows[0]["variance_before"])
    yield f"  poses to add, as the way from a recorded one; predicted error {now:.3g} px now"
    yield f"  {'from pose':>9}{names}{'then px':>9}"
    for row in rows:
        way = (math.degrees(d) if turns else 1e3 * d for d, turns in zip(row["delta"], revolute, strict=True))
        then = math.sqrt(row["variance_after"])
        yield f"  {row['from_pose']:>9}" + "".join(f"{d:>+9.1f}" for d in way) + f"{then:>9.3g}"
    yield f"  joints of these poses: {value['suggestions_file']} ({value['suggestions_unit']}, m)"
    if not value["suggestions_limited"]:
        yield "  joint limits are not known here: leave out what your robot cannot reach"


def _of_plan(value: dict[str, Any], detailed: bool) -> Iterator[str]:
    feasible = "feasible" if value["feasible"] else "NOT feasible"
    yield wrapped(f"plan: {value['profile']}, {feasible}: {value['reason']}")
    if detailed:
        yield (
            "  rotation {theta_s_deg:.2f} deg = {theta_r_deg:.2f} deg onto the plane, "
            "{theta_p_deg:.2f} deg within it".format_map(value)
        )
        least = (f"{name} {_number(value['margins'][name]['least'])}" for name in NEAREST)
        yield f"  least: {', '.join(least)}"
        if value["duration"]:
            yield f"  duration {value['duration']:.3g} s"


def _of_laws(value: dict[str, Any]) -> Iterator[str]:
    yield "servo: true errors at the end, self-occluded steps left/right"
    yield f"  {'law':<20}{'verdict':<13}{'steps':>6}{'mm':>9}{'deg':>9}{'occluded':>11}{'drift mm':>10}"
    for trace in value["laws"]:
        yield (
            f"  {name_of(trace['law'], trace['mode']):<20}{trace['verdict']:<13}{trace['steps']:>6}"
            f"{_number(trace['position_error_mm']):>9}"
            f"{_number(trace['rotation_error_deg']):>9}"
            f"{trace['self_occluded_steps_left']:>6}/{trace['self_occluded_steps_right']:<4}"
            f"{_number(trace['center_deviation_mm']):>10}"
        )
    for name, said in _NOTES.items():
        for reason in dict.fromkeys(trace[name] for trace in value["laws"] if trace[name]):
            yield wrapped(f"{said}: {reason}", "  ")


def _of_report(value: dict[str, Any], detailed: bool) -> Iterator[str]:
    claims = value["claims"]
    told = [claim for claim in claims if detailed or claim["holds"] is False]
    holding = sum(claim["holds"] is True for claim in claims)
    held = f"; {holding} of {len(claims)} claims hold" if claims else ""
    but = "; it does not hold that" if told and not detailed else ""
    count = len(value["figures"])
    yield f"report: {count} file{'s' * (count != 1)} of figures{held}{but}"
    words = {True: "holds", False: "does not hold", None: "not measured"}
    for claim in told:
        if detailed:
            yield wrapped(f"{words[claim['holds']]}: {claim['claim']}: {claim['measured']}", "  ")
        else:
            yield f"  - {textwrap.shorten(claim['claim'], 76, placeholder='…')}"
    reasons: dict[str, list[str]] = {}
    for row in value["left_out"]:
        reasons.setdefault(row["reason"], []).append(row["what"])
    for reason, what in reasons.items():
        left_out = f"left out: {', '.join(what)}" if detailed else f"{len(what)} left out"
        yield wrapped(f"{left_out}: {reason}", "  ")
    for name in ("page", "view", "animation"):
        if value.get(name):
            yield f"{name}: {value[name]}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
