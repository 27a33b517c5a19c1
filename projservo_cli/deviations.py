"""The one table of possible errors of an arm or a rig, for tests, joint models, monitors, files and words.

``DEVIATIONS`` are from the model, over a recording: a calibration tests each by its tangent at the fit, and
rows with functions of a reading can be fitted (``--joint-model``). ``CHANGES`` are since the calibration: a
monitor fits each as it changes images. The size of a row is the width of its prior. The sentences, with what
mends each, are in ``messages.calibrations`` and ``messages.monitoring``.
"""

import math
from typing import NamedTuple

# Subject of a row: each joint, a joint that another one reads, each camera, all cameras or all markers as one
# body, markers, or all images.
JOINT, PAIR, VIEW, BODY, MARKERS, IMAGES = "joint", "pair", "view", "body", "markers", "images"
# Units: a share, rad of a reading (prismatic × 0.3 m/rad), the rms motion of the images, s, or none.
SHARE, READING, PX, SECONDS, NONE = "1", "rad", "px", "s", ""
# When it acts: in all images, from none to all over the recording, from a pose on, or by the image before.
ALWAYS, DRIFT, STEP, PAST = range(4)


class Deviation(NamedTuple):
    """One thing that the model leaves out, or that changed since."""

    part: str
    unit: str
    size: float  # usual amplitude, beyond which none is expected unless it is seen
    times: tuple[int, ...] = (ALWAYS,)
    curve: tuple[str, ...] = ()  # functions of a reading that describe it, of ``BASIS``
    turns: bool = False  # whether it is of revolute joints alone
    range_rad: float = 0.0  # range of a joint, from which its readings show it
    cause: str = ""  # code of another row that has the same cause
    code: str = ""  # code of findings on it, if it is not the key of the row
    contains: tuple[str, ...] = ()  # rows that it explains as well, with more parameters
    undone: bool = False  # whether images that it takes far are taken back before the last of a fit


def _since(part: str, unit: str, code: str, *contains: str, undone: bool = False) -> Deviation:
    """Return a row that changes images by 30 px rms or so since the calibration."""
    return Deviation(part, unit, 30.0, code=code, contains=contains, undone=undone)


# Functions of a reading from the reference, in the order of files, as texts name them.
ARGUMENTS = {
    "linear": "reading {}",
    "square": "square of reading {}",
    "cube": "cube of reading {}",
    "sine": "sine of reading {}",
    "versine": "1 − cosine of reading {}",
    "torque": "torque, of which the largest is 1",
    "sine of twice": "sine of twice reading {}",
    "versine of twice": "1 − cosine of twice reading {}",
}
BASIS = tuple(ARGUMENTS)
_DEGREE = math.radians(1.0)
DEVIATIONS = {
    "scale": Deviation(JOINT, SHARE, 0.01, curve=("linear",)),
    "quadratic": Deviation(JOINT, READING, 0.3 * _DEGREE, curve=("linear", "square")),
    "cubic": Deviation(JOINT, READING, 0.3 * _DEGREE, curve=("linear", "square", "cube"), cause="quadratic"),
    "harmonic": Deviation(JOINT, READING, 0.5 * _DEGREE, curve=("sine", "versine"), turns=True),
    "second_harmonic": Deviation(
        *(JOINT, READING, 0.5 * _DEGREE),
        curve=("sine of twice", "versine of twice"),
        turns=True,
        range_rad=math.pi,  # over a smaller range it is a cubic
    ),
    "coupling": Deviation(PAIR, SHARE, 0.01, curve=("linear",)),
    "sag": Deviation(JOINT, READING, 0.5 * _DEGREE, curve=("torque",), turns=True),
    "cyclic": Deviation(JOINT, READING, 0.2 * _DEGREE),
    "joint_drift": Deviation(JOINT, READING, 0.2 * _DEGREE, (DRIFT,)),
    "joint_step": Deviation(JOINT, READING, 0.2 * _DEGREE, (STEP,)),
    "camera_drift": Deviation(VIEW, PX, 1.0, (DRIFT,)),
    "camera_step": Deviation(VIEW, PX, 1.0, (STEP,)),
    "lens": Deviation(VIEW, PX, 2.0),
    "lens_center": Deviation(VIEW, PX, 2.0, cause="lens"),
    "focus": Deviation(VIEW, PX, 1.0),
    "memory": Deviation(IMAGES, SHARE, 0.03, (PAST,)),
    "base": Deviation(BODY, PX, 1.0, (DRIFT, STEP)),
    "tool": Deviation(BODY, PX, 1.0, (DRIFT, STEP)),
}
# Kinds of curves that a joint model has.
CURVES = tuple(code for code, row in DEVIATIONS.items() if row.curve)
_OF_IMAGE = ("shifted", "cropped", "focused", "sized", "camera")
CHANGES = {
    "exchanged": _since(VIEW, PX, "exchanged_cameras", undone=True),
    "mirrored": _since(JOINT, NONE, "mirrored_joint", undone=True),
    "slipped": _since(JOINT, READING, "slipped_joint", "mirrored", undone=True),
    "frozen": _since(JOINT, NONE, "frozen_reading"),
    "flexible": _since(JOINT, PX, "flexing_links", "slipped"),
    "late": _since(VIEW, SECONDS, "late_images"),
    "shifted": _since(VIEW, PX, "displaced_camera"),
    "cropped": _since(VIEW, PX, "cropped_images"),
    "sized": _since(VIEW, NONE, "resized_images", undone=True),
    "focused": _since(VIEW, SHARE, "refocused_camera", "shifted", "cropped"),
    "camera": _since(VIEW, PX, "displaced_camera", *_OF_IMAGE),
    "cameras": _since(VIEW, PX, "displaced_camera", *_OF_IMAGE, "rig"),
    "all_cameras": _since(VIEW, PX, "displaced_rig", *_OF_IMAGE, "rig"),
    "rig": _since(BODY, PX, "displaced_rig"),
    "tool": _since(BODY, PX, "displaced_tool", "larger"),
    "larger": _since(BODY, SHARE, "larger_tags"),
    "tag": _since(MARKERS, PX, "displaced_tag", "marker"),
    "marker": _since(MARKERS, PX, "displaced_markers"),
}
