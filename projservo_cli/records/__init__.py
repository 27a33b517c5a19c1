"""The named arrays that pass from stage to stage, and the model every kernel reads.

Records hold plain arrays with documented shapes and units. ``array`` attaches the names of the
dimensions and the unit to a field, so that the run file can label what it stores; nothing here
knows how it is stored.
"""

from projservo_cli.records.calibration import (
    FREE,
    NO_LENS,
    PRISMATIC,
    REVOLUTE,
    Calibration,
    CrossValidation,
    Model,
    Observation,
)
from projservo_cli.records.errors import InputError, WorkFailed
from projservo_cli.records.fields import SIZES, BoolArray, FloatArray, IntArray, array, scalar
from projservo_cli.records.report import Report
from projservo_cli.records.task import BODY_LAWS, LAWS, METRIC_LAWS, POINT_LAWS, Plan, Trace, signed

__all__ = [
    "BODY_LAWS",
    "FREE",
    "LAWS",
    "METRIC_LAWS",
    "NO_LENS",
    "POINT_LAWS",
    "PRISMATIC",
    "REVOLUTE",
    "SIZES",
    "BoolArray",
    "Calibration",
    "CrossValidation",
    "FloatArray",
    "InputError",
    "IntArray",
    "Model",
    "Observation",
    "Plan",
    "Report",
    "Trace",
    "WorkFailed",
    "array",
    "scalar",
    "signed",
]
