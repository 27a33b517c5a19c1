"""Validate: further images against a calibration, by their residuals, and the changes that they show."""

from dataclasses import replace
from typing import Any

import numpy as np

from projservo_cli.calibration.checks.validation import comparable, residual_statistics
from projservo_cli.calibration.detections import SAME_READING, even_choice
from projservo_cli.findings import LIMITS
from projservo_cli.image_size import ImageSize, image_sizes
from projservo_cli.messages import lines, setup_of
from projservo_cli.monitoring.fault_at_rest import fault_at_rest
from projservo_cli.records import Calibration, Observation

# Maximum number of frames to identify a change.
_MOST_TOLD = 300


def compared(
    calibration: Calibration, observation: Observation, image_size: ImageSize | None = None
) -> dict[str, Any]:
    """Return statistics of residuals as ``residual_statistics``, with the changes since the calibration.

    Frames of one posture show that as they do to ``doctor``, and no view has a separate limit. Of several
    postures the medians decide, as some images of a recording may err: changes are reported with them.

    Raises InputError as ``residual_statistics``.
    """
    value = residual_statistics(calibration, observation)
    seen, told = comparable(calibration, observation)
    seen = seen.rows(np.isin(np.arange(len(seen.q)), even_choice(len(seen.q), _MOST_TOLD)))
    if not value["count"]:
        return value
    fault = fault_at_rest(calibration, seen, image_sizes(image_size, calibration.view))
    if (np.ptp(seen.q, axis=0) <= SAME_READING).all():
        views = [one | {"limit_px": None} for one in value["views"]]  # medians of one posture decide nothing
        return value | {"views": views, "findings": [*told, *([fault] if fault else ())]}
    changed = [replace(fault, severity=LIMITS)] if fault else []
    advice = (f"at some poses {text}" for text in lines(changed, setup_of(calibration)))
    return value | {
        "findings": [*value["findings"], *changed],
        "advice": [*value["advice"], *advice],
    }
