"""What a run says, in sentences and in numbers for the eye."""

import math
from typing import Any

import numpy as np
from markupsafe import Markup

from projservo_cli.calibration.excitation import REACH_M, REACH_RAD, WEAK_NOISE
from projservo_cli.calibration.quality import chi2_band
from projservo_cli.figures.material import title
from projservo_cli.modes import name_of
from projservo_cli.records import Calibration, CrossValidation, Trace

MINUS = "\N{MINUS SIGN}"
NONE = "\N{EN DASH}"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def short(value: float | None, digits: int = 3) -> str:
    """A number with few digits, powers of ten set as such; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return NONE
    if value == 0 or isinstance(value, (int, np.integer)):
        return f"{value:.0f}".replace("-", MINUS)
    power = math.floor(math.log10(abs(value)))
    if digits <= power + 1 <= 6:
        return f"{value:.0f}".replace("-", MINUS)
    text = f"{value:.{digits}g}"
    mantissa, sign, exponent = text.partition("e")
    if sign:
        text = f"{mantissa} × 10{str(int(exponent)).translate(_SUPERSCRIPT)}"
    return text.replace("-", MINUS)


def number(value: Any, digits: int = 3) -> Markup:
    """A number for the eye that carries all of its digits for programs."""
    plain = value.item() if isinstance(value, np.generic) else value
    if plain is None or not math.isfinite(plain):
        return Markup(NONE)
    return Markup('<data value="{}">{}</data>').format(repr(plain), short(plain, digits))


def calibration_words(calibration: Calibration, *, estimated: bool) -> list[str]:
    """Whether a calibration is good, why, and which joint is known worst, a sentence each.

    Parameters
    ----------
    calibration : the calibration.
    estimated : whether the noise was estimated from the same images, so that χ² alone decides nothing.
    """
    found = [f"{'Usable' if calibration.usable else 'Not usable'}: {calibration.reason}."]
    if math.isfinite(calibration.chi2_per_dof) and calibration.dof > 0:
        low, high = chi2_band(calibration.dof)
        found.append(
            f"χ² per degree of freedom is {short(calibration.chi2_per_dof)} at "
            f"{short(calibration.sigma_px)} px of noise per coordinate, with {calibration.dof} degrees of "
            f"freedom; where model and noise are true it stays within {short(low)} and {short(high)}."
            + (" The noise is itself an estimate from these images." if estimated else "")
        )
    found.append(_worst_joint(calibration))
    if calibration.worst_determined:
        found.append(f"Worst determined of all is {calibration.worst_determined}.")
    if calibration.predicted_rms_px is not None and calibration.predicted_p99_px is not None:
        found.append(
            f"Within the ranges of the joints images are expected to err by "
            f"{short(calibration.predicted_rms_px)} px rms, and in 99 of 100 calibrations by less than "
            f"{short(calibration.predicted_p99_px)} px."
        )
    left_out = (
        (len(calibration.outlier), "reading", "left out as an outlier", "left out as outliers"),
        (len(calibration.suspect), "joint reading", "contradicts the images", "contradict the images"),
        (len(calibration.swapped), "marker", "was renumbered", "were renumbered"),
    )
    for count, what, one, many in left_out:
        if count:
            found.append(f"{count} {what}{'s' * (count > 1)} {many if count > 1 else one}.")
    return found


def _worst_joint(calibration: Calibration) -> str:
    noise = calibration.prediction_noise
    if not np.isfinite(noise).any():
        return f"The method {calibration.method} states no uncertainty, so no joint can be called the worst."
    worst = int(np.nanargmax(noise))
    reach = f"{REACH_M:g} m" if calibration.joint_types[worst] == "P" else f"{REACH_RAD:g} rad"
    weak = "weak" if noise[worst] > WEAK_NOISE else "well determined"
    return (
        f"Joint {worst + 1} is known worst: {reach} from the reference it adds {short(float(noise[worst]))} "
        f"times the pixel noise to predicted images; a joint is weak above {WEAK_NOISE:g}, so this one is "
        f"{weak}."
    )


def held_out_words(value: CrossValidation) -> str:
    """How well poses were predicted that the fit had not seen, in a sentence or two."""
    text = (
        f"Held out, in {value.folds} parts of {value.unit}: rms {short(value.rms_px)} px where noise and "
        f"covariance predict {short(value.predicted_rms_px)} px, median {short(value.median_px)} px, 95th "
        f"percentile {short(value.p95_px)} px. {value.reason[:1].upper()}{value.reason[1:]}."
    )
    return text.replace("..", ".")


def law_words(trace: Trace) -> str:
    """Verdict of a law, its reason, and where it ended, in one sentence."""
    seconds = short(trace.steps * trace.period)
    steps = f"{trace.steps} step{'s' * (trace.steps != 1)}"
    text = f"{title(name_of(trace.law, trace.mode))}: {trace.verdict} after {steps} ({seconds} s)"
    if trace.reason:
        text += (
            f", because the {trace.reason}" if trace.reason.startswith("image error") else f": {trace.reason}"
        )
    if trace.position_error_mm is not None and trace.rotation_error_deg is not None:
        text += (
            f"; the face is then {short(trace.position_error_mm)} mm and {short(trace.rotation_error_deg)}° "
            "from its goal"
        )
    return f"{text}."
