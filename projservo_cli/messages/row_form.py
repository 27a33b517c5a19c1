"""The form of the words for a code."""

from typing import NamedTuple


class Row(NamedTuple):
    """Words for a code."""

    sentence: str
    remedy: str = ""
    limit: str = ""  # after "limited by"; empty where predictions are as exact
    where: str = ""  # that it is about, in a table on a robot; empty for robot and cameras
