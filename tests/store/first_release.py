"""The run file that the first release wrote, as later ones must be able to read it."""

import gzip
from functools import cache
from pathlib import Path

FILE = Path(__file__).parent / "data" / "first_release.h5.gz"


@cache
def first_release() -> bytes:
    """Its content."""
    return gzip.decompress(FILE.read_bytes())
