"""All rows of words by their codes, and the row for an arm and its cameras."""

from collections.abc import Sequence
from typing import NamedTuple

from projservo_cli.findings import Finding
from projservo_cli.messages import (
    calibrations,
    monitoring,
    plans,
    robots,
    validations,
    verdict_causes,
)
from projservo_cli.messages.row_form import Row
from projservo_cli.records import TOOL, VIEWS, WORLD

TABLES = (
    *(calibrations.OF_MODEL, calibrations.CALIBRATION, calibrations.REFUSALS),
    *(validations.VALIDATIONS, plans.PLANS, monitoring.FAULTS, verdict_causes.REASONS, robots.ROBOTS),
)
ROWS: dict[str, Row] = {code: row for rows in TABLES for code, row in rows.items()}
_ON_THE_TOOL = calibrations.ON_THE_TOOL | monitoring.ON_THE_TOOL


class Setup(NamedTuple):
    """An arm and its cameras, as far as words depend on them."""

    mount: str = WORLD
    view: Sequence[str] = VIEWS
    joints: int = 6  # number of the joints
    coordinates: Sequence[str] = ()  # names of the joints, if these are coordinates of poses of the flange


def row_of(one: Finding, setup: Setup) -> Row:
    """Return the row of a finding."""
    if setup.coordinates and one.code in calibrations.BY_FLANGE:
        return calibrations.BY_FLANGE[one.code]
    special = _ON_THE_TOOL if setup.mount == TOOL else monitoring.BY_ONE if len(setup.view) == 1 else {}
    return special.get(one.code, ROWS[one.code])
