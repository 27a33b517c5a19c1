"""Sentences that name a fault: which, how far, what to do."""

import numpy as np

from projservo_cli.monitoring.hypotheses import Explanation
from projservo_cli.records import CORNERS, VIEWS, Calibration, FloatArray

# By so much a link may flex under its load, rad, which looks like a joint that slipped.
_FLEXIBLE = np.radians(1.0)
# Sentences by the kind of a cause; those of cameras, tags, markers and joints that slipped have functions.
_SENTENCES = {
    "exchanged": "the left and the right camera are exchanged; exchange their sources or cables",
    "mirrored": "{joint} has the other sign than when it was calibrated; restore its sign, or recalibrate",
    "flexible": "links flex, or several joints slipped, by {px}; less load, or recalibrate",
    "frozen": "the reading of {joint} stands still while the arm moves; look at its encoder and cable",
    "late": "images of {camera} come {ms} ms later than was taken; give plant.time_offset_s, or recalibrate",
    "sized": "the image size of {camera} is {first:.4g} times that of the calibration; set the size of "
    "before, or recalibrate",
    "focused": "{camera} was moved along its optical axis, or its focal length changed by {percent:+.2g} % "
    "(focus or zoom); put it back and lock focus and zoom, or recalibrate",
    "camera": "{camera} was moved, by {px}; put it back, or recalibrate",
    "cropped": "images are cropped otherwise, or both cameras were moved alike, by {px}; put it back, or "
    "recalibrate",
    "rig": "both cameras were moved alike, or the base was, by {px}; put it back, or recalibrate",
    "larger": "all tags are {size} than those of the calibration; print them in their size, or recalibrate",
    "tool": "the tool was moved in its holder, by {px}; put it back, or recalibrate",
}


def group_of(explanation: Explanation) -> tuple[str, int]:
    """Kind and index that a cause is named by: those with the same sentence have the same."""
    kind, which = explanation.cause.kind, explanation.cause.which
    if kind in ("shifted", "camera", "cameras"):
        return ("camera", which) if which >= 0 else ("rig", -1)
    return kind, which


def is_slight(angles: FloatArray | float) -> bool:
    """Whether angles, rad, are such as a link flexes by under its load."""
    return bool(np.abs(angles).max() <= _FLEXIBLE)


def sentence(explanation: Explanation, calibration: Calibration) -> str:
    """Sentence on a cause, with its amount and its remedy."""
    kind, i = explanation.cause.kind, explanation.cause.which
    if kind == "slipped":
        return _slipped(i, float(explanation.theta[0]), calibration)
    if kind in ("tag", "marker"):
        return _moved(explanation, calibration)
    if kind in ("shifted", "camera", "cameras"):
        kind = "camera" if i >= 0 else "cropped" if kind == "shifted" else "rig"
    first = float(explanation.theta[0]) if explanation.theta.size else 0.0
    return _SENTENCES[kind].format(
        joint="all joints" if i < 0 else f"joint {i + 1}",
        camera="both cameras" if i < 0 else f"the {VIEWS[min(i, 1)]} camera",
        px=f"{explanation.changed_px:.2g} px",
        ms=" and ".join(f"{1e3 * value:+.3g}" for value in explanation.theta),
        first=first,
        percent=100.0 * first,
        size=f"{100.0 * abs(first):.2g} % {'larger' if first > 0.0 else 'smaller'}",
    )


def _moved(explanation: Explanation, calibration: Calibration) -> str:
    """Sentence on markers that moved on the tool, those of a tag together."""
    moved = sorted(int(calibration.marker[j]) for j in explanation.cause.markers)
    px, listed = explanation.changed_px, ", ".join(map(str, moved))
    tag = moved[0] // CORNERS
    if len(moved) == CORNERS and moved[-1] // CORNERS == tag:
        return f"tag {tag} (markers {listed}) moved on the tool, by {px:.2g} px; put it back, or recalibrate"
    markers = f"marker{'s' * (len(moved) > 1)} {listed}"
    return f"{markers} moved on the tool, by {px:.2g} px; put back what moved, or recalibrate"


def _slipped(i: int, amount: float, calibration: Calibration) -> str:
    slides = calibration.joint_types[i] == "P"
    far = f"{1e3 * amount:.2g} mm" if slides else f"{np.degrees(amount):.2g} deg"
    alike = " or the base turned likewise" if i == 0 else ""
    alike += " or the tool turned likewise in its holder" if i == len(calibration.H_hat_0) - 1 else ""
    alike += " or its link flexes" if not slides and is_slight(amount) else ""
    return f"joint {i + 1} slipped by {far}{alike}; home it again, or recalibrate"
