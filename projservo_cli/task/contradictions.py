"""Whether the incidences of a list agree: some displacement meets them all, as far as images tell."""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.records import BoolArray, FloatArray, Model
from projservo_cli.task.body import Body
from projservo_cli.task.incidences import (
    Incidence,
    Incidences,
    each_in_pixels,
    incidences_of,
    least_errors,
    only,
    turned_about,
)

# Deviations by which incidences are apart, from which that is said, and from which they cannot all be meant.
_TOLD, _APART = 2.0, 5.0
# Contradiction, px, below which no other place is sought, and least deviation: of round-off.
_NEGLIGIBLE_PX = 1e-3


def contradictions(
    model: Model, body: Body, H: FloatArray, asked: Sequence[Incidence], shows: BoolArray, sigma_px: float
) -> Iterator[Finding]:
    """Yield the pairs of incidences that contradict each other, or all of them, where no pair does.

    H : (4, 4) displacement of the body where the goal was taught.
    shows : (V, m) markers that images show there.
    sigma_px : deviation of a coordinate by images and calibration, px.
    Raises as ``incidences_of`` and ``weighted``.
    """
    each = each_in_pixels(incidences_of(model, body, H, asked), model, body, H, shows)
    numbers, sigma_px = range(len(asked)), max(sigma_px, _NEGLIGIBLE_PX)
    if (apart := _apart(each, body, H, numbers)) <= _TOLD * sigma_px:
        return
    pairs = [(_apart(each, body, H, pair), pair) for pair in combinations(numbers, 2)]
    found: list[tuple[float, Sequence[int]]] = [(px, pair) for px, pair in pairs if px > _TOLD * sigma_px]
    for px, some in found or [(apart, numbers)]:
        refuses = max(px, apart) > _APART * sigma_px
        yield Finding(
            "contradictory_incidences",
            REFUSES if refuses else LIMITS,
            amount=px,
            limit=(_APART if refuses else _TOLD) * sigma_px,
            unit="px",
            others=tuple(Finding("incidence_name", subject=Subject(name=asked[k].name)) for k in some),
        )


def _apart(incidences: Incidences, body: Body, H: FloatArray, numbers: Sequence[int]) -> float:
    """Return by how much some incidences contradict each other, px; of two equal ones their difference.

    H : (4, 4) displacement beside which a better one is sought first; then to all sides.
    """
    rows = only(incidences, numbers)
    _, squares = least_errors(rows, body, H[None])
    if math.sqrt(2.0 * squares[0]) > _NEGLIGIBLE_PX:
        squares = least_errors(rows, body, turned_about(body, H))[1]
    return math.sqrt(2.0 * float(np.min(squares)))
