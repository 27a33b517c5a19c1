"""Sentences that name a fault: which, how far, what to do."""

import numpy as np

from projservo_cli.monitoring.hypotheses import Explanation
from projservo_cli.records import CORNERS, VIEWS, Calibration, FloatArray

# By so much a link may flex under its load, rad, which looks like a joint that slipped.
_FLEXIBLE = np.radians(1.0)


def group_of(found: Explanation) -> tuple[str, int]:
    """Kind and index that a cause is named by: those with the same sentence have the same."""
    kind, which = found.cause.kind, found.cause.which
    if kind in ("shifted", "camera", "cameras"):
        return ("camera", which) if which >= 0 else ("rig", -1)
    return kind, which


def is_slight(angles: FloatArray | float) -> bool:
    """Whether angles, rad, are such as a link flexes by under its load."""
    return bool(np.abs(angles).max() <= _FLEXIBLE)


def sentence(found: Explanation, calibration: Calibration) -> str:
    """Sentence on a cause."""
    kind, i = found.cause.kind, found.cause.which
    theta, px = found.theta, f"{found.changed_px:.2g} px"
    side = "both cameras" if i < 0 else f"the {VIEWS[min(i, 1)]} camera"
    if kind == "exchanged":
        return "the left and the right camera are exchanged; exchange their sources or cables"
    if kind == "mirrored":
        return (
            f"joint {i + 1} has the other sign than when it was calibrated; restore its sign, or recalibrate"
        )
    if kind == "slipped":
        return _slipped(i, float(theta[0]), calibration)
    if kind == "flexible":
        return f"links flex, or several joints slipped, by {px}; less load, or recalibrate"
    if kind == "frozen":
        which = "all joints" if i < 0 else f"joint {i + 1}"
        return f"the reading of {which} stands still while the arm moves; look at its encoder and cable"
    if kind == "late":
        ms = " and ".join(f"{1e3 * value:+.3g}" for value in theta)
        return f"images of {side} come {ms} ms later than was taken; give plant.time_offset_s, or recalibrate"
    if kind == "sized":
        return (
            f"the image size of {side} is {theta[0]:.4g} times that of the calibration; set the size of "
            "before, or recalibrate"
        )
    if kind == "focused":
        return (
            f"{side} was moved along its optical axis, or its focal length changed by "
            f"{100.0 * theta[0]:+.2g} % (focus or zoom); put it back and lock focus and zoom, or recalibrate"
        )
    if kind in ("camera", "shifted") and i >= 0:
        return f"{side} was moved, by {px}; put it back, or recalibrate"
    if kind == "larger":
        size = "larger" if theta[0] > 0.0 else "smaller"
        return (
            f"all tags are {100.0 * abs(theta[0]):.2g} % {size} than those of the calibration; print them in "
            "their size, or recalibrate"
        )
    if kind in ("tag", "marker"):
        return _moved(found, calibration)
    if kind == "tool":
        return f"the tool was moved in its holder, by {px}; put it back, or recalibrate"
    if kind == "shifted":
        return (
            f"images are cropped otherwise, or both cameras were moved alike, by {px}; put it back, or "
            "recalibrate"
        )
    return f"both cameras were moved alike, or the base was, by {px}; put it back, or recalibrate"


def _moved(found: Explanation, calibration: Calibration) -> str:
    """Sentence on markers that moved on the tool, those of a tag together."""
    moved = sorted(int(calibration.marker[j]) for j in found.cause.markers)
    px, listed = found.changed_px, ", ".join(map(str, moved))
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
