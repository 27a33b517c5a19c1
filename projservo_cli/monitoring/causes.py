"""Causes of a fault as findings."""

from itertools import product

import numpy as np

from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.monitoring.hypotheses import ALL, Explanation
from projservo_cli.records import CORNERS, Calibration, FloatArray, IntArray

# By so much a link may flex under its load, rad, which looks like a joint that slipped.
_FLEXIBLE = np.radians(1.0)
# A tag that is off by less than this share of its side is neither turned by quarters nor exchanged; share of
# that which may be left where it is.
_SIDE, _FITS = 0.5, 0.15
# Codes by the kind of a cause whose amount is by how much images show it, and of others with their units.
_SEEN = {
    "exchanged": "exchanged_cameras",
    "flexible": "flexing_links",
    "camera": "displaced_camera",
    "cropped": "cropped_images",
    "rig": "displaced_rig",
    "tool": "displaced_tool",
}
_FITTED = {
    "mirrored": ("mirrored_joint", ""),
    "frozen": ("frozen_reading", ""),
    "late": ("late_images", "s"),
    "sized": ("resized_images", ""),
    "focused": ("refocused_camera", "1"),
    "larger": ("larger_tags", "1"),
}


def group_of(explanation: Explanation) -> tuple[str, int, tuple[int, ...]]:
    """Kind, index and views that a cause is named by: those with the same sentence have the same."""
    cause = explanation.cause
    if cause.kind in ("shifted", "camera", "cameras", "rig"):
        return "rig" if cause.which == ALL else "camera", ALL, cause.views
    return cause.kind, cause.which, cause.views


def is_slight(angles: FloatArray | float) -> bool:
    """Whether angles, rad, are such as a link flexes by under its load."""
    return bool(np.abs(angles).max() <= _FLEXIBLE)


def finding_of(explanation: Explanation, calibration: Calibration) -> Finding:
    """Return the finding on a cause."""
    cause, theta = explanation.cause, explanation.theta.tolist()
    kind, i, names = cause.kind, cause.which, calibration.view
    if kind in ("tag", "marker"):
        return _displaced(explanation, calibration)
    if kind == "slipped":
        slides = calibration.joint_types[i] == "P"
        flexes = (Finding("flexing_links"),) if not slides and is_slight(theta[0]) else ()
        return Finding(
            "slipped_joint",
            REFUSES,
            Subject((i + 1,)),
            theta[0],
            unit="m" if slides else "rad",
            others=flexes,
        )
    if kind in ("shifted", "camera", "cameras"):
        kind = "camera" if i != ALL else "cropped" if kind == "shifted" else "rig"
    if kind in ("mirrored", "frozen"):
        subject = Subject(joints=() if i < 0 else (i + 1,))
    elif kind == "exchanged":
        subject = Subject(views=tuple(names[v] for v, shown in enumerate(cause.views) if v != shown))
    else:
        subject = Subject(views=tuple(names[v] for v in cause.views))
    if kind in _SEEN:
        return Finding(_SEEN[kind], REFUSES, subject, explanation.seen_px, unit="px")
    code, unit = _FITTED[kind]
    each = tuple(Finding("delay", amount=delay, unit="s") for delay in theta) if kind == "late" else ()
    return Finding(code, REFUSES, subject, theta[0] if theta else np.nan, unit=unit, others=each)


def _displaced(explanation: Explanation, calibration: Calibration) -> Finding:
    """Return the finding on markers that moved on the tool or in the scene, those of a tag together."""
    moved = sorted(int(calibration.marker[j]) for j in explanation.cause.markers)
    whole = len(moved) == CORNERS and moved[0] // CORNERS == moved[-1] // CORNERS
    subject = Subject(markers=tuple(moved), tag=moved[0] // CORNERS if whole else None)
    code = "displaced_tag" if whole else "displaced_markers"
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
