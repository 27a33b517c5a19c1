"""Causes of a fault as findings."""

from itertools import product

import numpy as np

from projservo_cli.deviations import CHANGES, JOINT, MARKERS, PX, READING, SECONDS
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.monitoring.hypotheses import ALL, Explanation
from projservo_cli.records import CORNERS, Calibration, FloatArray, IntArray

# Angle by which a link may flex under its load, rad, which looks like a joint that slipped.
_FLEXIBLE = np.radians(1.0)
# A tag that errs by less than this share of its side is neither turned by quarters nor exchanged; share of
# that which may be left where it is.
_SIDE, _FITS = 0.5, 0.15


def group_of(explanation: Explanation) -> tuple[str, int, tuple[int, ...]]:
    """Kind, index and views that a cause is named by: those with the same sentence have the same."""
    cause = explanation.cause
    if cause.row.code in ("displaced_camera", "cropped_images", "displaced_rig"):
        return "rig" if cause.which == ALL else "camera", ALL, cause.views
    return cause.kind, cause.which, cause.views


def is_slight(angles: FloatArray | float) -> bool:
    """Whether angles, rad, are such as a link flexes by under its load."""
    return bool(np.abs(angles).max() <= _FLEXIBLE)


def finding_of(explanation: Explanation, calibration: Calibration) -> Finding:
    """Return the finding on a cause."""
    cause, theta = explanation.cause, explanation.theta.tolist()
    row, i, views = cause.row, cause.which, cause.views
    if row.part == MARKERS:
        return _displaced(explanation, calibration)
    amount, unit, others = theta[0] if theta else np.nan, row.unit, tuple[Finding, ...]()
    if cause.kind == "exchanged":
        views = tuple(v for v, shown in enumerate(views) if v != shown)
    if unit == PX:
        amount = explanation.seen_px
    elif unit == READING and calibration.joint_types[i] == "P":
        unit = "m"
    elif unit == READING and is_slight(amount):
        others = (Finding("flexing_links"),)
    elif unit == SECONDS:
        others = tuple(Finding("delay", amount=delay, unit=unit) for delay in theta)
    of_joint = row.part == JOINT and i >= 0
    subject = Subject((i + 1,) if of_joint else (), tuple(calibration.view[v] for v in views))
    return Finding(row.code, REFUSES, subject, amount, unit=unit, others=others)


def _displaced(explanation: Explanation, calibration: Calibration) -> Finding:
    """Return the finding on markers that moved on the tool or in the scene, markers of a tag together."""
    moved = sorted(int(calibration.marker[j]) for j in explanation.cause.markers)
    whole = len(moved) == CORNERS and moved[0] // CORNERS == moved[-1] // CORNERS
    subject = Subject(markers=tuple(moved), tag=moved[0] // CORNERS if whole else None)
    code = CHANGES["tag" if whole else "marker"].code
    return Finding(code, REFUSES, subject, explanation.seen_px, unit="px")


def misplaced_tags(pixels: FloatArray, expected: FloatArray, numbers: IntArray) -> tuple[Finding, ...]:
    """Return the tags that are turned by quarters, or in each other's places.

    pixels, expected : (V, m, 2) px. If most are, the tool is: its body looks alike from several sides.
    """
    tags = {int(tag): np.flatnonzero(numbers // CORNERS == tag) for tag in np.unique(numbers // CORNERS)}
    tags = {tag: at for tag, at in tags.items() if len(at) == CORNERS and np.isfinite(pixels[:, at]).any()}
    moved_to: dict[int, tuple[int, int]] = {}

    def rms(tag: int, place: int, turn: int) -> float:
        off = pixels[:, tags[tag]] - np.roll(expected[:, tags[place]], turn, axis=1)
        return float(np.sqrt(np.nanmean(np.square(off).sum(axis=-1))))

    for tag, at in tags.items():
        side = np.linalg.norm(expected[:, at] - np.roll(expected[:, at], 1, axis=1), axis=-1).mean()
        own, best = rms(tag, tag, 0), min(product(tags, range(CORNERS)), key=lambda to: rms(tag, *to))
        if own > _SIDE * side and best != (tag, 0) and rms(tag, *best) < _FITS * own:
            moved_to[tag] = best
    found = []
    for tag, (place, turn) in moved_to.items():
        if place == tag:
            by = np.pi if turn == 2 else np.pi / 2.0
            found.append(Finding("turned_tag", subject=Subject(tag=tag), amount=by, unit="rad"))
        elif place not in moved_to or tag < place:
            found.append(Finding("exchanged_tags", subject=Subject(markers=(tag, place))))
    return () if 2 * len(moved_to) > len(tags) else tuple(found)
