"""Sentences that name a fault: which, how far, what to do."""

from collections.abc import Sequence

import numpy as np

from projservo_cli.monitoring.hypotheses import ALL, Explanation
from projservo_cli.records import CORNERS, TOOL, WORLD, Calibration, FloatArray
from projservo_cli.words.values import joined

# By so much a link may flex under its load, rad, which looks like a joint that slipped.
_FLEXIBLE = np.radians(1.0)
# Place of the markers, by the mount of the cameras.
PLACE = {WORLD: "on the tool", TOOL: "in the scene"}
# Sentences by the kind of a cause; those of tags, markers and joints that slipped have functions.
_SENTENCES = {
    "exchanged": "{each} are exchanged; exchange their sources or cables",
    "mirrored": "{joint} has the other sign than when it was calibrated; restore its sign, or recalibrate",
    "flexible": "links flex, or several joints slipped, by {px}; less load, or recalibrate",
    "frozen": "the reading of {joint} stands still while the arm moves; look at its encoder and cable",
    "late": "images of {camera} come {ms} ms later than was taken; give plant.time_offset_s, or recalibrate",
    "sized": "the image size of {camera} is {first:.4g} times that of the calibration; set the size of "
    "before, or recalibrate",
    "focused": "{camera} was moved along its optical axis, or its focal length changed by {percent:+.2g} % "
    "(focus or zoom); put it back and lock focus and zoom, or recalibrate",
    "camera": "{camera} {was} moved, by {px}; put {it} back, or recalibrate",
    "cropped": "images are cropped otherwise, or {camera} were moved alike, by {px}; put it back, or "
    "recalibrate",
    "rig": "{camera} were moved alike, or the base was, by {px}; put it back, or recalibrate",
    "larger": "all tags are {size} than those of the calibration; print them in their size, or recalibrate",
    "tool": "the tool was moved in its holder, by {px}; put it back, or recalibrate",
}
# Where they differ: of one camera, which does not tell its own motion from one of the base, and of cameras on
# the tool.
_BY_ONE = {"camera": "{camera} was moved, or the base was, by {px}; put it back, or recalibrate"}
_ON_THE_TOOL = {
    "camera": "{camera} slipped on the tool, by {px}; put {it} back, or recalibrate",
    "cropped": "images are cropped otherwise, or {camera} slipped alike on the tool, by {px}; put it back, "
    "or recalibrate",
    "rig": "{camera} slipped alike on the tool, by {px}; put them back, or recalibrate",
    "tool": "the scene was moved, or the base was, by {px}; put it back, or recalibrate",
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


def sentence(explanation: Explanation, calibration: Calibration) -> str:
    """Sentence on a cause, with its amount and its remedy."""
    kind, i = explanation.cause.kind, explanation.cause.which
    if kind == "slipped":
        return _slipped(i, float(explanation.theta[0]), calibration)
    if kind in ("tag", "marker"):
        return _moved(explanation, calibration)
    if kind in ("shifted", "camera", "cameras"):
        kind = "camera" if i != ALL else "cropped" if kind == "shifted" else "rig"
    first = float(explanation.theta[0]) if explanation.theta.size else 0.0
    views, names = explanation.cause.views, calibration.view
    special = _ON_THE_TOOL if calibration.mount == TOOL else _BY_ONE if len(names) == 1 else {}
    return (_SENTENCES | special)[kind].format(
        joint="all joints" if i < 0 else f"joint {i + 1}",
        camera=_cameras(views, names),
        each=joined([f"the {names[v]}" for v, shown in enumerate(views) if v != shown]) + " camera",
        was="was" if len(views) == 1 else "were",
        it="it" if len(views) == 1 else "them",
        px=f"{explanation.seen_px:.2g} px",
        ms=" and ".join(f"{1e3 * value:+.3g}" for value in explanation.theta),
        first=first,
        percent=100.0 * first,
        size=f"{100.0 * abs(first):.2g} % {'larger' if first > 0.0 else 'smaller'}",
    )


def _cameras(views: tuple[int, ...], names: Sequence[str]) -> str:
    """Name the cameras of some of the views."""
    if 1 < len(views) == len(names):
        return "both cameras" if len(views) == 2 else "all cameras"
    return f"the {joined([names[v] for v in views])} camera{'s' * (len(views) > 1)}"


def _moved(explanation: Explanation, calibration: Calibration) -> str:
    """Sentence on markers that moved on the tool or in the scene, those of a tag together.

    One camera does not tell a marker that moved from one whose edge is covered.
    """
    moved = sorted(int(calibration.marker[j]) for j in explanation.cause.markers)
    listed, where = ", ".join(map(str, moved)), PLACE[calibration.mount]
    by = f"by {explanation.seen_px:.2g} px"
    by += ", or is covered in part" if len(calibration.view) == 1 else ""
    tag = moved[0] // CORNERS
    if len(moved) == CORNERS and moved[-1] // CORNERS == tag:
        return f"tag {tag} (markers {listed}) moved {where}, {by}; put it back, or recalibrate"
    markers = f"marker{'s' * (len(moved) > 1)} {listed}"
    return f"{markers} moved {where}, {by}; put back what moved, or recalibrate"


def _slipped(i: int, amount: float, calibration: Calibration) -> str:
    slides, on_tool = calibration.joint_types[i] == "P", calibration.mount == TOOL
    far = f"{1e3 * amount:.2g} mm" if slides else f"{np.degrees(amount):.2g} deg"
    first, last = (
        ("or the base or the scene turned likewise", "or what holds the cameras turned likewise on the tool")
        if on_tool
        else ("or the base turned likewise", "or the tool turned likewise in its holder")
    )
    alike = f" {first}" if i == 0 else ""
    alike += f" {last}" if i == len(calibration.H_hat_0) - 1 else ""
    alike += " or its link flexes" if not slides and is_slight(amount) else ""
    return f"joint {i + 1} slipped by {far}{alike}; home it again, or recalibrate"
