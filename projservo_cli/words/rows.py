"""The form of the words for a code."""

from typing import NamedTuple


class Row(NamedTuple):
    """Words for a code."""

    limit: str  # after "limited by"; empty where predictions are as exact
    sentence: str
    remedy: str = ""
