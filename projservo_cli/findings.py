"""Findings: judgements of a calibration, a robot, a plan or a run, as data.

``projservo_cli.messages`` has the sentences.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from projservo_cli.deviations import DEVIATIONS, SHARE

# Distance and angle by which a joint moves as far as another, m and rad: predictions are assessed there.
REACH_M, REACH_RAD = 0.15, 0.5
# Severities: a note changes nothing, a finding that limits makes the result less exact, and one that refuses
# makes it useless.
NOTE, LIMITS, REFUSES = "note", "limits", "refuses"


@dataclass(frozen=True)
class Subject:
    """The thing that a finding is about; fields that do not apply are empty."""

    joints: tuple[int, ...] = ()  # numbers along the arm, from 1; of a coupling the moved one last
    views: tuple[str, ...] = ()
    markers: tuple[int, ...] = ()
    tag: int | None = None
    poses: tuple[int, ...] = ()  # numbers of the poses; of a step the one at which it begins
    name: str = ""  # name of an object, a feature, a law, a column, a file, an origin or a limit


@dataclass(frozen=True)
class Finding:
    """One error, limit or reason to refuse."""

    code: str  # a key of ``messages.ROWS``
    severity: str = NOTE
    subject: Subject = Subject()
    amount: float = math.nan  # in ``unit``; NaN if there is none, as of the next fields
    deviation: float = math.nan  # standard deviation of the amount
    limit: float = math.nan  # that the amount is held against
    unit: str = ""  # px, rad, m, s, or 1 for a share or a count
    effect_px: float = math.nan  # rms error of predicted images by it, per marker and view
    period: float = math.nan  # period of an error that repeats over a joint, rad or m
    others: tuple["Finding", ...] = ()  # indistinguishable by the data, or its parts

    def plain(self) -> dict[str, Any]:
        """Return its fields for JSON: NaN is null, and the subject has the fields that apply."""
        values = asdict(self)
        del values["others"]
        subject = {name: value for name, value in values["subject"].items() if value not in ((), "", None)}
        known = {name: value for name, value in values.items() if value == value}  # but NaN
        return dict.fromkeys(values) | known | {"subject": subject}


def from_text(text: str, severity: str = LIMITS) -> Finding:
    """Return a finding with words of another source: another version, a robot class, an error."""
    return Finding("told", severity, Subject(name=text))


def sparse(record: Any) -> Any:
    """Return the fields of a finding or a subject for a file, those that are not NaN or as by default.

    Numbers of NumPy are plain ones there.
    """
    if isinstance(record, np.generic):
        return record.item()
    own = {one.name: (getattr(record, one.name), one.default) for one in fields(record)}
    return {name: value for name, (value, default) in own.items() if value == value and value != default}


def first(findings: Iterable[Finding], *severities: str) -> Finding | None:
    """Return the first finding of some severities, or None."""
    return next((one for one in findings if one.severity in severities), None)


def usable(findings: Iterable[Finding]) -> bool:
    """Whether no finding refuses."""
    return first(findings, REFUSES) is None


def named(one: Finding) -> str:
    """Return code, joints and view of a finding in one word."""
    return f"{one.code}|{','.join(map(str, one.subject.joints))}|{''.join(one.subject.views)}"


def of_readings(one: Finding) -> tuple[float, float]:
    """Return amount and deviation, of a prismatic joint in rad × 0.3 m."""
    per = REACH_M / REACH_RAD if one.unit == "m" else 1.0
    return one.amount / per, one.deviation / per


def to_columns(findings: Iterable[Finding]) -> dict[str, Any]:
    """Return the deviations from the model as the columns of a run file, and the one that is not shown."""
    of_model = [one for one in findings if one.code in DEVIATIONS]
    hidden = [other for one in findings if one.code == "unshown" for other in one.others]
    return {
        "model_error": tuple(_word(one) for one in of_model),
        "model_error_numbers": np.array([_numbers(one) for one in of_model]) if of_model else None,
        "unshown_error": tuple(_word(one) for one in hidden),
        "unshown_numbers": np.array(_numbers(hidden[0])) if hidden else None,
    }


def _word(one: Finding) -> str:
    """Return a deviation and the others that explain the images as well in one word."""
    return "/".join(map(named, (one, *one.others)))


def _numbers(one: Finding) -> tuple[float, ...]:
    """Return amount, deviation, effect and first pose of a deviation, NaN if it holds in all."""
    return (*of_readings(one), one.effect_px, *(one.subject.poses or (math.nan,)))


def from_columns(name: str, numbers: Iterable[float], units: Sequence[str]) -> Finding:
    """Return a deviation from its columns in a run file; units : of the joints, rad or m."""
    one, *others = (_parsed(word, units) for word in name.split("/"))
    estimate, deviation, effect, pose = map(float, numbers)
    per = REACH_M / REACH_RAD if one.unit == "m" else 1.0
    subject = replace(one.subject, poses=() if math.isnan(pose) else (int(pose),))
    sizes = per * estimate, per * deviation
    return Finding(one.code, LIMITS, subject, *sizes, unit=one.unit, effect_px=effect, others=tuple(others))


def _parsed(word: str, units: Sequence[str]) -> Finding:
    """Return a finding from the output of ``named``."""
    code, joints, view = word.split("|")
    which = tuple(int(joint) for joint in joints.split(",") if joint)
    subject, unit = Subject(joints=which, views=(view,) if view else ()), DEVIATIONS[code].unit
    of_joint = units[which[-1] - 1] if which else unit
    return Finding(code, LIMITS, subject, unit=unit if unit == SHARE else of_joint)
