"""Sentences on findings: the only place that knows the words for them, units, numbers and mounts.

A row of ``ROWS`` belongs to each code. Its texts are formats of ``values.VALUES``.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby

from projservo_cli.deviations import DEVIATIONS
from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, first, to_columns, usable
from projservo_cli.messages.placeholders import Wording, quantity
from projservo_cli.messages.rows_by_code import ROWS, Setup
from projservo_cli.records import Calibration, CalibrationVerdict, WorkFailed, coordinate_names

_SETUP = Setup()
# Severities as levels of a table on a robot.
_LEVELS = {NOTE: "fine", LIMITS: "warning", REFUSES: "fault"}
# Maximum number of deviations from the model in advice.
_MAX_NAMED = 3
_CAUSES = (
    *("other_mount", "images_before_readings", "images_after_readings", "joint_type", "standing_joint"),
    *("exchanged_joints", "full_coupling", "level_hand", "joint_unit", "image_size_changed"),
    *("images_late_from", "images_early_from", "tracker_memory"),
)
# Findings of which one line names all that are alike.
_TOGETHER = ("placeholders", "hopeless_joint", "joint_together", "joint_in_few_poses", "little_motion")
# Those that the reason of a calibration or its stated error says, and advice does not repeat.
_OF_REASON = ("noise", "residuals", "joint_noise", "deviations", "unshown")


def limit(one: Finding, setup: Setup) -> str:
    """Return the limit that a finding sets to predictions, after "limited by"."""
    return Wording([one], setup).text("limit")


def sentence(one: Finding, setup: Setup = _SETUP) -> str:
    """Return the sentence on a finding, without its remedy."""
    return _sentence([one], setup)


def sentence_and_remedy(one: Finding, setup: Setup = _SETUP) -> str:
    """Return the sentence on a finding and its remedy."""
    return _line([one], setup)


def lines(findings: Iterable[Finding], setup: Setup = _SETUP) -> tuple[str, ...]:
    """Return a line on each finding, one for all joints that are alike."""
    groups = groupby(findings, key=lambda one: one.code if one.code in _TOGETHER else id(one))
    return tuple(_line(list(group), setup) for _, group in groups)


def table_row(one: Finding, setup: Setup) -> dict[str, str]:
    """Return a finding as a row of a table: level, subject, message and remedy."""
    wording = Wording([one], setup)
    where, remedy = wording.text("where") or "robot and cameras", wording.text("remedy")
    return {"level": _LEVELS[one.severity], "where": where, "text": sentence(one, setup), "remedy": remedy}


def failed(
    findings: Iterable[Finding],
    setup: Setup = _SETUP,
    end: str = "",
    *,
    begin: str = "",
    stage: str = "",
    refutes: bool = False,
) -> WorkFailed:
    """Return the error of findings, worded between a beginning and an end, after the work that failed."""
    found = tuple(findings)
    return WorkFailed(f"{begin}{text(found, setup)}{end}", stage=stage, refutes=refutes, findings=found)


def text(findings: Iterable[Finding], setup: Setup = _SETUP) -> str:
    """Return the lines on findings as one text."""
    return "; ".join(lines(findings, setup))


def reason(findings: Sequence[Finding], setup: Setup) -> str:
    """Return why a calibration is usable or not: its residuals and its limits."""
    about, *rest = findings
    text = sentence(about, setup)
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
    """Return the remedies for a calibration, a line each, with the largest deviations from the model."""
    remaining = [one for one in findings if one.code not in _OF_REASON]
    unnamed = [one for one in remaining if one.code in DEVIATIONS][_MAX_NAMED:]
    return lines((one for one in remaining if one not in unnamed), setup)


def refused(findings: Sequence[Finding], setup: Setup) -> str:
    """Return why data make no calibration: a cause that would explain them, the misfit, and a hint."""
    remaining, words = list(findings), ""
    while remaining and remaining[0].code in _CAUSES and len(remaining) > 1:
        words += f"{sentence_and_remedy(remaining.pop(0), setup)}; as given, "
    main, *hints = remaining
    words += sentence(main, setup) if hints and main.code == "misfit" else sentence_and_remedy(main, setup)
    for hint in hints:
        hint_text = f"the residuals look as if {sentence(hint, setup)}"
        words += f"; {hint_text if hint.code in DEVIATIONS else sentence_and_remedy(hint, setup)}"
    return words


def judged(findings: Iterable[Finding], setup: Setup) -> CalibrationVerdict:
    """Return the verdict on a calibration that follows from findings, the first on its residuals."""
    about, *rest = findings
    found = (about, *sorted(rest, key=lambda one: one.severity == NOTE))
    return CalibrationVerdict(
        usable=usable(found),
        reason=reason(found, setup),
        advice=advice(found, setup),
        limit=limit(_cause(found), setup),
        notes=advice((one for one in found if one.severity == NOTE), setup),
        findings=found,
    )


def with_findings(
    calibration: Calibration, more: Iterable[Finding], ahead: Iterable[Finding] = ()
) -> Calibration:
    """Return a calibration with further findings, those ``ahead`` before its own, judged by all."""
    about, *rest = calibration.findings
    verdict = judged((about, *ahead, *rest, *more), setup_of(calibration))
    return replace(
        calibration, verdict=verdict, stated=replace(calibration.stated, **to_columns(verdict.findings))
    )


def order_advice(calibration: Calibration) -> str:
    """Return the line on joints whose order nothing shows; empty if there are none, or it was not tested."""
    return "".join(sentence_and_remedy(one, setup_of(calibration)) for one in calibration.open_order)


def setup_of(calibration: Calibration) -> Setup:
    """Return the arm and the cameras of a calibration."""
    names = coordinate_names(calibration.flange_chart)
    return Setup(calibration.mount, calibration.view, len(calibration.joint_types), names)


def _cause(findings: Sequence[Finding]) -> Finding:
    """Return the finding that limits predictions most: one that refuses, otherwise the first that limits."""
    about, *rest = findings
    limiting = [one for one in rest if ROWS[one.code].limit]
    return first(limiting, REFUSES) or first(limiting, LIMITS) or about


def _line(alike: list[Finding], setup: Setup) -> str:
    remedy = Wording(alike, setup).text("remedy")
    text = _sentence(alike, setup)
    return text + (("; " if ": " in text else ": ") + remedy if remedy else "")


def _sentence(alike: list[Finding], setup: Setup) -> str:
    one = alike[0]
    text = Wording(alike, setup).text("sentence")
    if one.code in DEVIATIONS and one.others:
        others = ", or ".join(limit(other, setup) for other in one.others)
        text += f" (or {others}: the images do not tell)"
    return text
