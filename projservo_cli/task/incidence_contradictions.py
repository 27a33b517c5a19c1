"""Whether the incidences of a list agree: some displacement meets them all, as far as images show."""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.records import BoolArray, FloatArray, Model
from projservo_cli.task.body_pose import Body
from projservo_cli.task.incidences import (
    Incidence,
    Incidences,
    each_in_pixels,
    incidences_of,
    min_errors,
    turned_about,
)

# Deviations by which incidences are apart, from which that is reported, and from which the list is refused.
_TOLD, _APART = 2.0, 5.0
# Contradiction, px, below which no other place is sought, and minimum deviation: round-off.
_NEGLIGIBLE_PX = 1e-3


def contradicting_incidences(
    model: Model,
    body: Body,
    H: FloatArray,
    scenes: Sequence[FloatArray],
    asked: Sequence[Incidence],
    shows: BoolArray,
    sigma_px: float,
) -> Iterator[Finding]:
    """Yield the pairs of incidences that contradict each other, or all of them, if no pair does.

    H : (4, 4) displacement of the body near which places are sought.
    scenes : for each incidence the points (…, 4) that span its feature of the scene.
    shows : (V, m) markers that images show there.
    sigma_px : deviation of a coordinate by images and calibration, px.
    Raises as ``incidences_of`` and ``weighted``.
    """
    each = each_in_pixels(incidences_of(model, body, scenes, asked), model, body, H, shows)
    numbers, sigma_px = range(len(asked)), max(sigma_px, _NEGLIGIBLE_PX)
    if (apart := _apart(each, body, H, numbers)) <= _TOLD * sigma_px:
        return
    refuses = apart > _APART * sigma_px
    max_px = (_APART if refuses else _TOLD) * sigma_px
    pairs = combinations(numbers, 2) if len(asked) > 2 else ()
    found: list[tuple[float, Sequence[int]]] = [(_apart(each, body, H, pair), pair) for pair in pairs]
    for px, some in [one for one in found if one[0] > max_px] or [(apart, numbers)]:
        names = tuple(Finding("incidence_name", subject=Subject(name=asked[k].name)) for k in some)
        severity = REFUSES if refuses else LIMITS
        yield Finding("contradictory_incidences", severity, amount=px, limit=max_px, unit="px", others=names)


def _apart(incidences: Incidences, body: Body, H: FloatArray, numbers: Sequence[int]) -> float:
    """Return by how much some incidences contradict each other, px; of two equal ones their difference.

    H : (4, 4) displacement near which a better one is sought first; then to all sides.
    """
    rows = incidences.of(numbers)
    _, squares = min_errors(rows, body, H[None])
    if math.sqrt(2.0 * squares[0]) > _NEGLIGIBLE_PX:
        squares = min_errors(rows, body, turned_about(body, H))[1]
    return math.sqrt(2.0 * float(np.min(squares)))
