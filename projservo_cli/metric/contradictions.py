"""Contradictions of a known length, and errors of a model, in words."""

from collections.abc import Iterator

import numpy as np

from projservo_cli.metric.frame import Metric
from projservo_cli.metric.kinematic_errors import KinematicErrors
from projservo_cli.records import TOOL

# Deviations beyond which the links of a model contradict the known length.
_CONTRADICTED = 4.0
# Relative deviation of a known length that is not given, as by a ruler, and that of an axis by rounding.
_UNMEASURED, _ROUNDING = 0.0025, 1e-9
# Largest distance of a tool or a camera from the base, m.
_FARTHEST = 20.0


def contradictions(metric: Metric, errors: KinematicErrors | None, *, measured: bool) -> Iterator[str]:
    """Yield what contradicts the known length: far cameras, readings of prismatic joints, links of a model.

    measured : whether the deviation of the length is known; otherwise one per cent passes.
    """
    least = _ROUNDING if measured else _UNMEASURED
    of_axes = metric.deviations("axes")
    for i in np.flatnonzero(metric.prismatic):
        v = metric.axes[i, 3:]
        size = float(np.linalg.norm(v))
        std = float(np.linalg.norm(of_axes[:, i, 3:] @ v)) / size
        if abs(size - 1.0) > _CONTRADICTED * np.hypot(std, least):
            yield f"joint {i + 1} moves {size:.4g} ± {std:.1g} m for each m of its readings"
    if errors is not None and abs(errors.length) > _CONTRADICTED * np.hypot(errors.length_std, least):
        wrong = "short" if errors.length > 0.0 else "long"
        share, std = 100.0 * abs(errors.length), 100.0 * errors.length_std
        yield f"the known length is {share:.2g} % ± {std:.1g} % too {wrong} for the links of the model"
    places = [
        (f"the {view} camera", metric.carrier, T) for view, T in zip(metric.view, metric.poses, strict=True)
    ]
    hand = "flange" if metric.mount == TOOL else "tool"
    for what, frame, T in (*places, (f"the {hand} at readings of zero", "base", metric.body.tool)):
        if (far := float(np.linalg.norm(T[:3, 3]))) > _FARTHEST:
            yield f"{what} is {far:.3g} m from the {frame}, {_FARTHEST:g} m allowed"


def kinematic_words(errors: KinematicErrors, joint_types: str) -> Iterator[str]:
    """Yield what to mend in a model: zeros of joints, then axes, of each the most significant first."""
    zeros = [one for one in errors.joints if one.zero is not None and one.zero_std is not None]
    for one in sorted(zeros, key=lambda one: -abs((one.zero or 0.0) / (one.zero_std or 1.0))):
        scale, unit = (1e3, " mm") if joint_types[one.joint - 1] == "P" else (float(np.degrees(1.0)), "°")
        zero, std = scale * (one.zero or 0.0), scale * (one.zero_std or 0.0)
        summary = f"joint {one.joint}: zero off by {round(zero, 2) + 0.0:+.2f}{unit} ± {std:.2f}{unit}"
        yield summary.replace("-", "\N{MINUS SIGN}")
    for one in sorted(errors.joints, key=lambda one: -one.offset_m / max(one.offset_std_m, 1e-12)):
        yield (
            f"joint {one.joint}: axis off by {1e3 * one.offset_m:.2f} mm ± {1e3 * one.offset_std_m:.2f} mm, "
            f"{np.degrees(one.tilt_rad):.3f}° ± {np.degrees(one.tilt_std_rad):.3f}°"
        )
