"""One claim of the paper: its measure, when it holds, and whether it does."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from projservo_cli.records import FloatArray


@dataclass(frozen=True)
class Claim:
    """One claim of the paper and its measure.

    Attributes
    ----------
    claim : what is claimed.
    source : where in the paper.
    measured : the number, in words.
    criterion : when the claim holds.
    holds : whether it does; None where it could not be measured.
    """

    claim: str
    source: str
    measured: str
    criterion: str
    holds: bool | None

    def row(self) -> dict[str, Any]:
        """Plain values for the run file and for JSON."""
        return {
            "claim": self.claim,
            "source": self.source,
            "measured": self.measured,
            "criterion": self.criterion,
            "holds": self.holds,
        }


def listed(values: FloatArray) -> str:
    """Numbers as a list in words, three digits each, large ones whole."""
    return ", ".join(f"{value:.0f}" if value >= 100 else f"{value:.3g}" for value in np.atleast_1d(values))
