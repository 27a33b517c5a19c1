"""How far each joint moves the images: refusals and advice that name the joint."""

import numpy as np

from projservo_cli.calibration.readings import Readings
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

# Reach at which predictions are judged, rad and m, and their noise there in units of the pixel
# noise: above the first a joint is weak, above the second undetermined.
REACH_RAD, REACH_M = 0.5, 0.15
WEAK_NOISE, UNDETERMINED_NOISE = 3.0, 1000.0
# Farthest trial motion that is advised, in reaches.
MOST_REACHES = 4.0
# Least motion of the images over the range of a joint, in units of the pixel noise.
LEAST_MOTION = 5.0
# Share of the reach beyond which a joint that moves no image stands still; below, it moved too little.
STANDING = 0.1


def amount(value: float, prismatic: bool) -> str:
    """A joint motion in words, mm or degrees."""
    return f"{1e3 * value:.3g} mm" if prismatic else f"{np.degrees(value):.3g}°"


def require_motion(readings: Readings) -> FloatArray:
    """Range of each joint over the poses, (n,) rad or m.

    Raises
    ------
    WorkFailed
        If a joint never moves, fewer than three markers were seen, or there is only one pose.
    """
    m = readings.marker.size
    if m < 3:
        what = ("no marker was", "only one marker was", "only two markers, which lie on a line, were")[m]
        raise WorkFailed(
            f"{what} seen: a rotation about a line through them shows in no image; "
            "use three or more markers that are not on one line"
        )
    if len(readings.q) < 2:
        raise WorkFailed("only one pose: trial motions of every joint are needed")
    present = np.unique(readings.pose_of)
    span: FloatArray = np.ptp(readings.q[present], axis=0)
    for i in np.flatnonzero(span <= 1e-6):
        raise WorkFailed(
            f"joint {i + 1} has no trial motion: it never moves in the data; record poses in which it does"
        )
    return span


def describe_joint(i: int, span: float, prismatic: bool, needed: float | None = None) -> str:
    """Advice for a joint that moved too little, or never apart from the others.

    Parameters
    ----------
    i : index of the joint.
    span : its range in the data, rad or m.
    prismatic : its type.
    needed : range of a trial motion that determines it, rad or m; NaN where none does, None where it
        is not known.
    """
    reach = REACH_M if prismatic else REACH_RAD
    moved = amount(span, prismatic)
    if needed is not None and not needed <= MOST_REACHES * reach:
        return f"joint {i + 1} moved {moved}; no motion of it alone would do: record trials of every joint"
    if span >= reach:
        far = "" if needed is None else f", by {amount(needed, prismatic)} or more"
        return f"joint {i + 1} moved {moved} but hardly apart from the other joints: move it alone{far}"
    if needed is None:
        needed = min(2.0 * reach, max(4.0 * span, 0.5 * reach))
    if needed <= span:
        return (
            f"joint {i + 1} moved {moved}, in too few poses: record further ones in which it moves alone, by "
            f"{amount(needed, prismatic)} or more"
        )
    return f"joint {i + 1} moved only {moved}: move it at least {amount(needed, prismatic)}"


def describe_still(i: int, span: float, prismatic: bool, motion_px: float, sigma_px: float) -> str:
    """Refusal of a joint whose range moves no image: it was too short, or the joint did not follow it."""
    seen = (
        f"the images by {motion_px:.3g} px, less than {LEAST_MOTION:g} times their noise of {sigma_px:.3g} px"
    )
    if span < STANDING * (REACH_M if prismatic else REACH_RAD):
        return (
            f"too little excitation: the range of joint {i + 1} moves {seen}; "
            f"{describe_joint(i, span, prismatic)}"
        )
    return (
        f"joint {i + 1} stands still: its readings range over {amount(span, prismatic)} but move {seen}; "
        "check that it moved and that its readings are its own, or move a marker off its axis"
    )


def require_moved(motion_px: FloatArray, sigma_px: float, span: FloatArray, prismatic: BoolArray) -> None:
    """Refuse a joint whose operator moves no image over the joint's range.

    Parameters
    ----------
    motion_px : (n,) how far the joint's range moves the images, px.
    sigma_px : pixel noise per coordinate.
    span, prismatic : (n,) as in ``require_determined``.

    Raises
    ------
    WorkFailed
        Naming the worst joint.
    """
    i = int(np.argmin(motion_px))
    if motion_px[i] < LEAST_MOTION * sigma_px:
        raise WorkFailed(describe_still(i, float(span[i]), bool(prismatic[i]), float(motion_px[i]), sigma_px))


def require_determined(noise: FloatArray, span: FloatArray, needed: FloatArray, prismatic: BoolArray) -> None:
    """Refuse a joint whose operator the data leave open.

    Parameters
    ----------
    noise : (n,) predicted noise of images at the reach of each joint, in units of the pixel noise.
    span : (n,) range of each joint in the data, rad or m.
    needed : (n,) range of a trial motion that would determine it, rad or m, NaN where none does.
    prismatic : (n,) types of the joints.

    Raises
    ------
    WorkFailed
        Naming the worst joint.
    """
    i = int(np.argmax(noise))
    if noise[i] > UNDETERMINED_NOISE:
        raise WorkFailed(
            f"joint {i + 1} is not determined: near the reference its images would be wrong by "
            f"{noise[i]:.3g} times the pixel noise; "
            + describe_joint(i, float(span[i]), bool(prismatic[i]), float(needed[i]))
        )
