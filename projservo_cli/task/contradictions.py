"""Whether the incidences of a list agree: some displacement meets them all, as far as images tell."""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.records import FloatArray
from projservo_cli.task.body import Body
from projservo_cli.task.incidences import Incidences, least_errors, only, turned_about

# Deviations by which incidences are apart, from which that is said, and from which they cannot all be meant.
_TOLD, _APART = 2.0, 5.0
# Contradiction, px, below which no other place is sought, and least deviation: of round-off.
_NEGLIGIBLE_PX = 1e-3


def _apart(incidences: Incidences, body: Body, H: FloatArray, numbers: Sequence[int]) -> float:
    """Return by how much some incidences contradict each other, px; of two equal ones their difference.

    H : (4, 4) displacement beside which a better one is sought first; then to all sides.
    """
    rows = only(incidences, numbers)
    _, squares = least_errors(rows, body, H[None])
    if math.sqrt(2.0 * squares[0]) > _NEGLIGIBLE_PX:
        squares = least_errors(rows, body, turned_about(body, H))[1]
    return math.sqrt(2.0 * float(np.min(squares)))


def contradictions(
    incidences: Incidences, names: Sequence[str], body: Body, H: FloatArray, sigma_px: float
) -> Iterator[Finding]:
    """Yield the pairs of incidences that contradict each other, or all of them, where no pair does.

    incidences : weighted at the goal; H : (4, 4) displacement of the body there.
    sigma_px : deviation of a coordinate by images and calibration, px.
    """
    sigma_px = max(sigma_px, _NEGLIGIBLE_PX)
    if (apart := _apart(incidences, body, H, range(len(names)))) <= _TOLD * sigma_px:
        return
    pairs = [(_apart(incidences, body, H, pair), pair) for pair in combinations(range(len(names)), 2)]
    found: list[tuple[float, Sequence[int]]] = [(px, pair) for px, pair in pairs if px > _TOLD * sigma_px]
    for px, some in found or [(apart, range(len(names)))]:
        refuses = max(px, apart) > _APART * sigma_px
        each = tuple(Finding("incidence_name", subject=Subject(name=names[k])) for k in some)
        yield Finding(
            "contradictory_incidences",
            REFUSES if refuses else LIMITS,
            amount=px,
            limit=(_APART if refuses else _TOLD) * sigma_px,
            unit="px",
            others=each,
        )
