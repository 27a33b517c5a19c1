"""Causes of a fault as findings."""

import numpy as np

from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.monitoring.hypotheses import ALL, Explanation
from projservo_cli.records import CORNERS, Calibration, FloatArray

# By so much a link may flex under its load, rad, which looks like a joint that slipped.
_FLEXIBLE = np.radians(1.0)
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
