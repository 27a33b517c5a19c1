"""Whether kernels are still to be compiled, as a call says before it makes anything."""

import os
from collections.abc import Iterable

from projservo_cli.geometry.jit import CACHE_FOLDER
from projservo_cli.laws import codes_of


def compilation(names: Iterable[str] = ()) -> str:
    """Whether kernels will have to be compiled, in words; empty if they are there or are not used.

    names : of the runs of laws that will be made.
    """
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return ""
    if CACHE_FOLDER is None:
        return "compiling kernels (in every run: no cache folder can be written)"
    found = any(CACHE_FOLDER.rglob("*.nbi"))
    if found and (codes := codes_of(names)):
        from projservo_cli.loop.jit_warmup import are_cached  # loads all laws

        found = are_cached(codes)
    return "" if found else "compiling kernels, once"
