"""Sentences on findings: the only place that knows the words for them, units, numbers and mounts.

A row of ``ROWS`` belongs to each code. Its texts are formats of the values that ``_values`` makes of a
finding.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.findings import DEVIATIONS, LIMITS, NOTE, REFUSES, Finding, columns, first, usable
from projservo_cli.records import TOOL, VIEWS, WORLD, Calibration

# Maximum number of names in a list of examples, of deviations from the model in advice.
_EXAMPLES, _MAX_NAMED = 3, 3
# Maximum number of runs of poses that a sentence lists.
_MAX_RUNS = 4


class Setup(NamedTuple):
    """An arm and its cameras, as far as words depend on them."""

    mount: str = WORLD
    view: Sequence[str] = VIEWS
    joints: int = 6  # number of the joints


class Row(NamedTuple):
    """Words for a code."""

    limit: str  # after "limited by"; empty where predictions are as exact
    sentence: str
    remedy: str = ""


# Deviations of an arm or a rig from the model, by the score tests.
_CURVE, _AGAIN = "fit it (--joint-model auto), or mend the joint", "fix what moved, and record again"
_OF_MODEL = {
    "scale": Row("gear of {joints}", "{joints} {moves} {size} {more} than {reads}", _CURVE),
    "quadratic": Row(
        "curve of {joints}", "readings of {joints} follow a curve, off by {size} at the ends", _CURVE
    ),
    "cubic": Row(
        "curve of {joints}",
        "readings of {joints} follow a curve, off by {size} at the ends",
        _CURVE,
    ),
    "harmonic": Row(
        "eccentric encoder of {joints}", "readings of {joints} swing by {size} once a turn", _CURVE
    ),
    "coupling": Row(
        "coupling of {joints}", "joint {of[0]} turns joint {of[1]} by {size} of its motion", _CURVE
    ),
    "sag": Row("sag of {joints}", "{joints} sags under load, by up to {size}", _CURVE),
    "joint_drift": Row(
        "drift of {joints}",
        "the zero of {joints} drifts by {size} over the recording",
        "home the arm, and record again",
    ),
    "joint_step": Row(
        "step of {joints}", "the zero of {joints} jumps by {size}{begin}", "home the arm, and record again"
    ),
    "camera_drift": Row(
        "drift of the {view} camera", "the {view} camera drifts, by {size} over the recording", _AGAIN
    ),
    "camera_step": Row("motion of the {view} camera", "the {view} camera moved{begin}, by {size}", _AGAIN),
    "base": Row(
        "motion of the base or the cameras",
        "the base of the arm or {all_cameras} moved{begin}, by {size}",
        _AGAIN,
    ),
    "tool": Row("markers that moved on the tool", "{markers} moved on the tool{begin}, by {size}", _AGAIN),
    "lens": Row(
        "lens of the {view} camera",
        "the lens of the {view} camera distorts, by {size}",
        "calibrate with --lens",
    ),
    "lens_center": Row(
        "lens of the {view} camera", "the {view} lens is decentred, by {size}", "calibrate with --lens"
    ),
    "focus": Row(
        "focus of the {view} camera",
        "the {view} image is scaled with depth, by {size}",
        "fix the focus, switch autofocus off, and record again",
    ),
}
# A calibration: its fit, and the data that it took or left out.
_CALIBRATION = {
    "deviations": Row("", "all of them move predictions by {effect}; {number} px are allowed"),
    "unshown": Row("", "these poses do not show whether {unshown}; predictions would move by {effect}"),
    "noise": Row("noise", "residuals of {amount} a coordinate agree with the {limit} {origin}"),
    "residuals": Row(
        "more than pixel noise",
        "more than pixel noise is left: residuals of {amount} a coordinate are {ratio} times the {limit} "
        "{origin}",
    ),
    "closed_form": Row(
        "the method",
        "the closed_form method explains the images only to {amount} a coordinate, {ratio} times the {limit} "
        "{origin}",
        "use bundle_adjustment",
    ),
    "joint_noise": Row("noise", "joint readings off by {amount} rms{ticks}"),
    "coarse_joints": Row(
        "joint readings, which move images by {effect}",
        "errors of joint readings move images by {effect}, more than pixel noise",
        "finer or stiffer joints would help",
    ),
    "lagging_joints": Row("joint readings", "look for joint readings that lag behind the images"),
    "unmodelled_lens": Row(
        "lens",
        "lens distortion would explain {percent} % of the squared residuals",
        "try --lens",
    ),
    "no_lens": Row("lens", "the images show no lens distortion", "omit --lens"),
    "lens_off_center": Row(
        "lens",
        "the lens distortion is centred on the region where markers were seen",
        "give --image-size to centre it on the image",
    ),
    "outliers": Row(
        "outliers: {count} of {total}{shared}",
        "{count} {observations} rejected as {outliers}{shared}",
        "check the detection of markers",
    ),
    "suspect_readings": Row(
        "",
        "{count} joint {disagree} with the images",
        "check how poses and images are paired",
    ),
    "id_switches": Row(
        "",
        "{times} a marker was seen under the number of another",
        "check the numbering",
    ),
    "hopeless_joint": Row(
        "{name}", "{joints} moved {amount}", "no motion of {it}{only} would do: record {elsewhere}"
    ),
    "joint_together": Row(
        "{name}",
        "{joints} moved {amount} but hardly apart from the other joints",
        "move {it} alone, by {limit} or more",
    ),
    "joint_in_few_poses": Row(
        "{name}",
        "{joints} moved {amount}, in too few poses",
        "record further ones{by_itself}, by {limit} or more",
    ),
    "little_motion": Row("{name}", "{joints} moved only {amount}", "move {it} at least {limit}"),
    "noisy_view": Row(
        "",
        "the {view} camera is {ratio} times as noisy as the {other_view} one ({amount} and {limit}), "
        "and counts less",
        "check its focus, light and mount",
    ),
    "exact_images": Row(
        "exact images",
        "the images have no noise ({amount}): they were made from poses, whose errors no two markers "
        "show apart",
        "give the noise of these (--noise-px)",
    ),
    "unsettled_camera": Row(
        "motion of the {view} camera",
        "the {view} camera settled over poses {runs}: images that disagree are rejected",
        "fix the camera",
    ),
    "moved_camera": Row(
        "motion of the {view} camera",
        "the {view} camera moved at pose{s} {runs}: images that disagree are rejected",
        "fix the camera",
    ),
    "seldom_fitting": Row(
        "", "hardly any detection of marker {numbers} fits: rejected", "record it in more poses"
    ),
    "unused_start": Row(
        "",
        "{name} was not used as a start: it {leads}; the calibration comes from the images alone",
        "check whether the file describes this robot and rig",
    ),
    "undecided_order": Row(
        "",
        "the order of {joints} is taken from the table; no pose shows it",
        "add poses in which several move",
    ),
    "unseen_poses": Row(
        "", "poses that no camera saw: {count} ({poses}), dropped", "look why they show no marker"
    ),
    "circular_readings": Row(
        "",
        "readings of {joints} pass {part} to {of_part}: taken as a range of {amount}, as given {limit}",
    ),
    "placeholders": Row("", "{stands}: no camera saw that, so it was taken as unseen", "empty these cells"),
    "turned_board": Row(
        "",
        "the board looks the same turned by {amount}: {of_images}, and were turned right",
        "a ChArUco board, or one with an odd and an even side, needs no turn",
    ),
    "told": Row("", "{name}"),  # by an earlier version, which stored sentences alone
    "whole_seconds": Row(
        "",
        "{name} of poses in motion are whole seconds, so no latency of the images was estimated",
        "record their fractions",
    ),
    "refitted_camera": Row(
        "the {view} camera",
        "the {view} camera, fitted again from {rest} poses, errs by {amount} within the joint ranges, "
        "{limit} before it moved",
        "add poses that spread farther",
    ),
    "refit_too_coarse": Row(
        "the {view} camera, which errs by {amount}, more than calibration.max_predicted_px = {number}",
        "the {view} camera, fitted again from {rest} poses, errs by {amount} within the joint ranges, more "
        "than calibration.max_predicted_px = {number}",
        "add poses that spread farther",
    ),
    "images_before_readings": Row(
        "readings of other poses",
        "each image shows the pose before its reading",
        "let each pose settle for longer (plant.settle_s), and take the newest frame",
    ),
    "images_after_readings": Row(
        "readings of other poses",
        "each image shows the pose after its reading",
        "store readings with the image of the same pose, and take the newest frame",
    ),
    "other_mount": Row(
        "the mount", "by the images the cameras are {there}", "give --mount {mount} (data.mount)"
    ),
    "joint_type": Row(
        "joint types",
        "by the images {joints} is {fits}, not {given}",
        "check the types of joints, --joints or joint_types ({name} would fit)",
    ),
    "standing_joint": Row(
        "joint readings",
        "by the images {joints} stands still while its readings move",
        "check that they are its own",
    ),
}
# A fit that does not pass, and what would explain it.
_READINGS = "check the joint readings and types (R or P)"
_MISFIT = "the fit does not describe the data: "
_NO_FIT = _MISFIT + "{percent} % of the detections do not fit it, and "
_REFUSALS = {
    "misfit": Row(
        "the model",
        _MISFIT + "residuals of {amount} a coordinate are {ratio} times the {limit} {origin}",
        "check the joint readings, their units and types, and the marker numbers",
    ),
    "chi2": Row("the model", _MISFIT + "χ² per degree of freedom is {chi} at {chi2}", "{check_noise}"),
    "no_start": Row(
        "the joint readings",
        "the data contradict the joint readings from the start",
        "check that they belong to their poses, their units (rad, m) and types (R or P), and that rows of "
        "one pose belong together",
    ),
    "no_turn": Row("joint types", "residuals of {amount} show no turn of it"),
    "rejects_most": Row(
        "outliers",
        _NO_FIT + "that is most of them",
        "remove markers that are not on the robot, and check the joint readings",
    ),
    "rest_is_off": Row("the model", _NO_FIT + "the rest errs {part} times as much as noise", _READINGS),
    "rest_predicts_nothing": Row(
        "the data",
        _NO_FIT + "the rest does not predict held-out poses",
        "record more poses and more markers",
    ),
    "cameras_agree": Row(
        "the model",
        _MISFIT
        + "in {count} of {total} observations both cameras agree with each other but not with the robot",
        _READINGS,
    ),
    "other_joints": Row(
        "joint readings",
        _MISFIT + "{count} of {total} observations, at {rest} of {of_rest} poses, show other joints than "
        "those read",
        "check how poses and images are paired, and the joint readings and types (R or P)",
    ),
    "rejected_motion": Row(
        "joint readings",
        "the fit rejects most motion of {joints}",
        "check its readings and its type (R or P)",
    ),
    "rejected_poses": Row(
        "poses",
        "the fit rejects nearly all of the {name} {count} poses{in_view}: the base, a camera, the tool "
        "or the readings of joints changed there",
        "record again, or remove these poses",
    ),
    "joint_order": Row(
        "the order of joints",
        "the fit rejects {count} of the {total} poses in which several joints move, and {rest} of the "
        "{of_rest} others",
        "check the order of the joints (q1, q2, ...) and the readings of these poses",
    ),
}
ROWS: dict[str, Row] = _OF_MODEL | _CALIBRATION | _REFUSALS
_CAUSES = ("other_mount", "images_before_readings", "images_after_readings", "joint_type", "standing_joint")
# With cameras on the tool the chain ends at them, and the markers are in the scene.
_ON_THE_TOOL = {
    "base": Row(
        "motion of the cameras on the tool", "the cameras moved on the tool{begin}, by {size}", _AGAIN
    ),
    "tool": Row("markers that moved in the scene", "{markers} moved in the scene{begin}, by {size}", _AGAIN),
}
_ORIGINS = {
    "given": "that were given",
    "stated": "that the sigmas of the markers state",
    "views": "that the epipolar geometry shows",
    "body": "that a rigid body shows",
    "stated, by views": "that the sigmas of the markers state, times {amount:.3g} as both views show",
    "stated, by body": "that the sigmas of the markers state, times {amount:.3g} as a rigid body shows",
}
# Findings of which one line names all that are alike.
_TOGETHER = ("placeholders", "hopeless_joint", "joint_together", "joint_in_few_poses", "little_motion")
# Those that the reason of a calibration or its stated error says, and advice does not repeat.
_OF_REASON = ("noise", "residuals", "closed_form", "joint_noise", "deviations", "unshown")
_UNITS = {
    "px": (1.0, " px"),
    "rad": (float(np.degrees(1.0)), "°"),
    "m": (1e3, " mm"),
    "s": (1.0, " s"),
    "1": (1.0, ""),
    "": (1.0, ""),
}


def quantity(value: float, unit: str, digits: int = 3) -> str:
    """Format a number of a unit, angles in degrees and lengths in mm."""
    factor, name = _UNITS[unit]
    return f"{factor * value:.{digits}g}{name}"


def joined(words: Iterable[object]) -> str:
    """Join words by commas, the last by "and"."""
    told = [*map(str, words)]
    return " and ".join(filter(None, (", ".join(told[:-1]), *told[-1:])))


def limit(one: Finding, setup: Setup) -> str:
    """Return what a finding limits predictions by, after "limited by"."""
    return _row(one, setup).limit.format_map(_values([one], setup))


def sentence(one: Finding, setup: Setup) -> str:
    """Return the sentence on a finding, without its remedy."""
    return _sentence([one], setup)


def line(one: Finding, setup: Setup) -> str:
    """Return the sentence on a finding and its remedy."""
    return _line([one], setup)


def lines(findings: Iterable[Finding], setup: Setup) -> tuple[str, ...]:
    """Return a line on each finding, one for all joints that are alike."""
    groups = groupby(findings, key=lambda one: one.code if one.code in _TOGETHER else id(one))
    return tuple(_line(list(group), setup) for _, group in groups)


def reason(findings: Sequence[Finding], setup: Setup) -> str:
    """Return why a calibration is usable or not: its residuals, and what limits it."""
    about, *rest = findings
    text = sentence(about, setup)
    if about.code == "closed_form":
        return f"{text}: {_row(about, setup).remedy}"
    if about.code == "told" and first(rest, REFUSES) is None:
        return text
    text += "".join(f", with {sentence(one, setup)}" for one in rest if one.code == "joint_noise")
    cause = _cause(findings)
    text += f"; limited by {limit(cause, setup)}"
    if cause.code in DEVIATIONS:
        together = next((one for one in rest if one.code == "deviations"), cause)
        text += f", which moves predictions by {quantity(together.effect_px, 'px')}"
        if cause.severity == REFUSES:
            text += f", more than calibration.max_predicted_px = {together.limit:.3g}"
    return text


def advice(findings: Iterable[Finding], setup: Setup) -> tuple[str, ...]:
    """Return what to do about a calibration, a line each, of deviations from the model the largest."""
    told = [one for one in findings if one.code not in _OF_REASON]
    least = [one for one in told if one.code in DEVIATIONS][_MAX_NAMED:]
    return lines((one for one in told if one not in least), setup)


def refused(findings: Sequence[Finding], setup: Setup) -> str:
    """Return why data make no calibration: a cause that would explain them, the misfit, and a hint."""
    told, words = list(findings), ""
    while told and told[0].code in _CAUSES and len(told) > 1:
        words += f"{line(told.pop(0), setup)}; as given, "
    main, *hints = told
    words += sentence(main, setup) if hints and main.code == "misfit" else line(main, setup)
    for hint in hints:
        look = f"the residuals look as if {sentence(hint, setup)}"
        words += f"; {look if hint.code in DEVIATIONS else line(hint, setup)}"
    return words


def judged(findings: Iterable[Finding], setup: Setup) -> dict[str, Any]:
    """Return the fields of a calibration that follow from findings, the first on its residuals."""
    about, *rest = findings
    found = (about, *sorted(rest, key=lambda one: one.severity == NOTE))
    return columns(found) | {
        "usable": usable(found),
        "reason": reason(found, setup),
        "advice": advice(found, setup),
        "limit": limit(_cause(found), setup),
        "notes": advice((one for one in found if one.severity == NOTE), setup),
        "findings": found,
    }


def with_findings(
    calibration: Calibration, more: Iterable[Finding], ahead: Iterable[Finding] = ()
) -> Calibration:
    """Return a calibration with further findings, those ``ahead`` before its own, judged by all."""
    about, *rest = calibration.findings
    return replace(calibration, **judged((about, *ahead, *rest, *more), setup_of(calibration)))


def order_advice(calibration: Calibration) -> str:
    """Return the line on joints whose order nothing shows; empty if there are none, or it was not tested."""
    return "".join(line(one, setup_of(calibration)) for one in calibration.open_order)


def setup_of(calibration: Calibration) -> Setup:
    """Return the arm and the cameras of a calibration."""
    return Setup(calibration.mount, calibration.view, len(calibration.joint_types))


def _cause(findings: Sequence[Finding]) -> Finding:
    """Return the finding that limits predictions most: one that refuses, else the first that limits."""
    about, *rest = findings
    limiting = [one for one in rest if ROWS[one.code].limit]
    return first(limiting, REFUSES) or first(limiting, LIMITS) or about


def _row(one: Finding, setup: Setup) -> Row:
    return (_ON_THE_TOOL if setup.mount == TOOL else {}).get(one.code, ROWS[one.code])


def _line(alike: list[Finding], setup: Setup) -> str:
    remedy = _row(alike[0], setup).remedy.format_map(_values(alike, setup))
    text = _sentence(alike, setup)
    return text + (("; " if ": " in text else ": ") + remedy if remedy else "")


def _sentence(alike: list[Finding], setup: Setup) -> str:
    one = alike[0]
    text = _row(one, setup).sentence.format_map(_values(alike, setup))
    if one.code in DEVIATIONS and one.others:
        others = ", or ".join(limit(other, setup) for other in one.others)
        text += f" (or {others}: the images do not tell)"
    return text


def _values(alike: Sequence[Finding], setup: Setup) -> dict[str, Any]:
    """Values by the names that texts have for them."""
    one, subject = alike[0], alike[0].subject
    joints = [joint for each in alike for joint in each.subject.joints]
    amount, limit = one.amount, one.limit
    single, alone, many = len(joints) == 1, setup.joints == 1, amount != 1.0
    all_cameras = "the camera" if len(setup.view) == 1 else "all cameras"
    cameras = "both cameras" if len(setup.view) == 2 else all_cameras
    values: dict[str, Any] = {
        "all_cameras": all_cameras,
        "of": subject.joints,
        "name": subject.name,
        "joints": "all joints" if one.code == "scale" and not single else _named("joint", joints),
        "it": "it" if single else "each",
        "moves": "moves" if single else "move",
        "reads": "it reads" if single else "they read",
        "more": "less" if amount < 0.0 else "more" if single else "more or less",
        "size": _size(one),
        "amount": joined([quantity(each.amount, each.unit) for each in alike]),
        "limit": joined([quantity(each.limit, each.unit) for each in alike]),
        "number": f"{limit:.3g}",
        "ratio": f"{amount / limit:.3g}" if limit else "",
        "percent": f"{100.0 * amount:.0f}",
        "effect": quantity(one.effect_px, "px"),
        "count": f"{amount:.0f}",
        "total": f"{limit:.0f}",
        "view": subject.views[0] if subject.views else "",
        "other_view": subject.views[-1] if subject.views else "",
        "begin": f" at pose {subject.poses[0]}" if subject.poses else "",
        "markers": "the markers" if subject.tag is None else f"tag {subject.tag}",
        "numbers": _examples(subject.markers),
        "poses": _examples(subject.poses),
        "runs": _runs(subject.poses),
        "s": "s" if len(set(subject.poses)) > 1 else "",
        # Of counts.
        "observations": "observations were" if many else "observation was",
        "outliers": "outliers" if many else "an outlier",
        "disagree": "readings disagree" if many else "reading disagrees",
        "times": f"{amount:.0f} times" if many else "once",
        "shared": _shared(one.others),
        # Of arms of one joint, and of several.
        "elsewhere": "markers farther from its axis" if alone else "trials of every joint",
        "by_itself": "" if alone else f" in which {'it' if single else 'each'} moves alone",
        "only": "" if alone else " alone",
        "ticks": " (ticks that were counted)" if subject.name == "ticks" else "",
    }
    rest = one.others[0] if one.others else one
    values |= {
        "rest": f"{rest.amount:.0f}",
        "part": quantity(rest.amount, rest.unit),
        "of_part": quantity(rest.limit, rest.unit),
        "of_rest": f"{rest.limit:.0f}",
        "in_view": f" in the {subject.views[0]} view" if subject.views else "",
        "there": "on the tool" if subject.name == TOOL else "fixed",
        "mount": subject.name,
        "fits": "prismatic" if one.unit == "m" else "revolute",
        "given": "revolute" if one.unit == "m" else "prismatic",
        "leads": f"does not put the markers in front of {cameras}"
        if math.isnan(one.amount)
        else f"leads to residuals of {quantity(amount, 'px')} instead of {quantity(limit, 'px')}",
        "stands": _stands(alike),
        "of_images": _of_images(one.others) if one.code == "turned_board" else "",
        "check_noise": "check joint_noise_deg" if len(one.others) > 2 else "",
        "chi": f"{amount:.4g}",
        "chi2": _band(one.others) if one.code == "chi2" else "",
    }
    if one.code == "unshown":
        values["unshown"] = ", ".join(sentence(other, setup) for other in one.others)
    return values | {"origin": _ORIGINS.get(subject.name, "").format(amount=_scale(one))}


def _stands(alike: Sequence[Finding]) -> str:
    """Say in how many rows numbers stand that no camera saw, the most frequent first."""
    several = "several markers and poses", "several poses of one marker"
    each = [
        f"{one.subject.name} stands in {one.amount:.0f} rows of {several[len(one.subject.markers) == 1]}"
        for one in alike[:_EXAMPLES]
    ]
    more = [f"{len(alike) - _EXAMPLES} further numbers"] * (len(alike) > _EXAMPLES)
    return "; ".join([*each, *more])


def _scale(one: Finding) -> float:
    """Factor of stated deviations that the images show."""
    return next((other.amount for other in one.others), 1.0)


def _of_images(others: Sequence[Finding]) -> str:
    """Say how many images of all, and of each view, were numbered from another end."""
    each = ", ".join(
        f"{one.subject.views[0]} {one.amount:.0f} of {one.limit:.0f}" for one in others if one.limit
    )
    turned, seen = (sum(getattr(one, name) or 0.0 for one in others) for name in ("amount", "limit"))
    return f"{turned:.0f} of {seen:.0f} images number it from another end ({each})"


def _band(others: Sequence[Finding]) -> str:
    """Noise of images and joints, and the band in which χ² per degree of freedom is expected."""
    noise, band, *joints = others
    of_joints = "".join(f" and {quantity(one.amount, 'rad')} rms of joint noise" for one in joints)
    within = f"expected within {band.amount:.4g} and {band.limit:.4g}"
    return f"{quantity(noise.amount, 'px', 6)} of noise{of_joints}, {within}"


def _size(one: Finding) -> str:
    """Format an amount with its deviation, shares in %."""
    factor, unit = (100.0, " %") if one.unit == "1" else _UNITS[one.unit]
    spread = f" ± {factor * one.deviation:.1g}{unit}" if one.deviation > 0.0 else ""
    return f"{factor * abs(one.amount):.2g}{unit}{spread}"


def _named(kind: str, numbers: Sequence[int]) -> str:
    """Name things of a kind by their numbers."""
    return f"{kind}{'s' * (len(numbers) > 1)} {joined(numbers)}"


def _examples(numbers: Sequence[int]) -> str:
    """List the first of some numbers, and say how many more there are."""
    more = f" and {len(numbers) - _EXAMPLES} more" if len(numbers) > _EXAMPLES else ""
    return ", ".join(map(str, numbers[:_EXAMPLES])) + more


def _runs(ends: Sequence[int]) -> str:
    """List runs of poses by the first and the last of each."""
    runs = [" to ".join(map(str, dict.fromkeys(ends[i : i + 2]))) for i in range(0, len(ends), 2)]
    return ", ".join(runs[:_MAX_RUNS]) + (
        f" and {len(runs) - _MAX_RUNS} more" if len(runs) > _MAX_RUNS else ""
    )


def _shared(others: Sequence[Finding]) -> str:
    """Say which marker, pose or view most outliers share."""
    for one in others:
        subject, most = one.subject, "all" if one.limit == one.amount else f"{one.amount:.0f}"
        for kind, values in (("marker", subject.markers), ("pose", subject.poses), ("view", subject.views)):
            if values:
                return f", {most} of {kind} {values[0]}"
    return ""
