"""Control laws of the package, one line each in one table, and the names of their runs.

A law is added by its kernel in a file of ``control``, a line here and its function in ``control``.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from projservo_cli.records import InputError

REGULATE = "regulate"
TRACK = "track"
IMAGE_TRACK = "image_track"
INCIDENCES = "incidences"
_POINTS = "points"
_BODY = "body"


class _LawSpec(NamedTuple):
    """Specification of one law for driving, storing and drawing."""

    title: str  # as figures write it
    modes: tuple[str, ...]  # it follows a plan in all but ``REGULATE``
    features: str  # needs the ``_POINTS`` of the face themselves, or can measure with the ``_BODY``
    metric: bool = False  # is given the metric model
    paper: bool = True  # is one of [RH00]


LAW_SPECS = {
    "direct_three": _LawSpec("directTHREE", (REGULATE, TRACK), _BODY),
    "direct_two": _LawSpec("directTWO", (REGULATE, TRACK), _BODY),
    "stacked": _LawSpec("stacked Jacobians", (REGULATE, IMAGE_TRACK), _POINTS),
    "blockwise": _LawSpec("block-wise", (REGULATE,), _POINTS),
    "euclidean_points": _LawSpec("Euclidean points", (REGULATE,), _POINTS, metric=True),
    "exact": _LawSpec("exact", (REGULATE, TRACK), _BODY, paper=False),
    INCIDENCES: _LawSpec("incidences", (REGULATE,), _BODY, paper=False),
}
LAWS = tuple(LAW_SPECS)
CODES = {law: code for code, law in enumerate(LAWS)}  # codes of the laws in compiled code
POINT_LAWS = tuple(law for law, spec in LAW_SPECS.items() if spec.features == _POINTS)
BODY_LAWS = tuple(law for law, spec in LAW_SPECS.items() if spec.features == _BODY)
_NAMES = {
    f"{law}_{mode}": (law, mode) for law, spec in LAW_SPECS.items() for mode in spec.modes if mode != REGULATE
}


def title_of(law: str) -> str:
    """Return the title of a law: its name if it is not built in."""
    return LAW_SPECS[law].title if law in LAW_SPECS else law


def must_converge(law: str, required: Sequence[str] | None) -> bool:
    """Tell whether a law that does not converge fails the call: by default all but classical ones."""
    return law not in POINT_LAWS if required is None else law in required


def run_name(law: str, mode: str) -> str:
    """Return the name of the run of a law in a mode: ``exact`` where it replans, else ``exact_track``."""
    return law if mode == REGULATE else f"{law}_{mode}"


def law_and_mode(name: str) -> tuple[str, str]:
    """Law and mode of the run of a name."""
    return _NAMES.get(name, (name, REGULATE))


def codes_of(names: Iterable[str]) -> set[int]:
    """Codes of the built-in laws of runs, by their names."""
    return {CODES[law] for name in names if (law := law_and_mode(name)[0]) in CODES}


def mode_in(name: str) -> str:
    """Tell, where a name given as a law is that of a run in another mode, what to set instead; else empty."""
    law, mode = law_and_mode(name)
    if mode == REGULATE:
        return ""
    return f"is the run of {law} in mode {mode}: name {law}, with --set control.mode=[{mode}]"


def run_names(laws: Sequence[str], modes: Sequence[str]) -> tuple[str, ...]:
    """Names of the runs of laws, each in those of the modes that it has.

    Raises InputError if a law has none of them.
    """
    names = []
    for law in laws:
        own = LAW_SPECS[law].modes if law in LAW_SPECS else (REGULATE,)
        if not set(own) & set(modes):
            able = [other for other, spec in LAW_SPECS.items() if set(spec.modes) & set(modes)]
            raise InputError(
                f"control.mode {' and '.join(modes)}: {law} has no such mode, only "
                f"{' and '.join(own)}; laws that have one: {', '.join(able)} (--law, control.laws)"
            )
        names += [run_name(law, mode) for mode in modes if mode in own]
    return tuple(dict.fromkeys(names))
