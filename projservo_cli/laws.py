"""Control laws of the package, one row each in one table, and the names of their runs.

A law is added by its kernel in a file of ``control`` and a row here; one that is of none of the families
has its function in ``control`` too.
"""

from collections.abc import Iterable, Sequence
from enum import Enum
from typing import NamedTuple

from projservo_cli.records import InputError

REGULATE = "regulate"
TRACK = "track"
IMAGE_TRACK = "image_track"
INCIDENCES = "incidences"
# Behaviour of a law in each of its modes.
MODES = {
    REGULATE: "regulates to the goal in each step",
    TRACK: "follows the joints of the plan, and corrects them by images",
    IMAGE_TRACK: "follows the planned image paths",
}


class Family(Enum):
    """Laws that share one function in ``control``."""

    DIRECT = "direct"
    CLASSICAL = "classical"  # needs the points of the face themselves; the others can measure with the body
    EXACT = "exact"
    INCIDENCES = "incidences"


class _LawSpec(NamedTuple):
    """Specification of one law for driving, storing, drawing and the reference."""

    title: str  # as figures write it
    family: Family
    modes: tuple[str, ...]  # it follows a plan in all but ``REGULATE``
    velocity: str  # that it asks of the joints, in Markdown
    source: str  # reference, in Markdown
    metric: bool = False  # is given the metric model
    paper: bool = True  # is one of [RH00]


LAW_SPECS = {
    "direct_three": _LawSpec(
        "directTHREE",
        Family.DIRECT,
        (REGULATE, TRACK),
        r"$\lambda_t\tau\hat q_t+\lambda_r\theta_r\hat q_r+\lambda_p\theta_p\hat q_p$",
        "(20) as corrected",
    ),
    "direct_two": _LawSpec(
        "directTWO",
        Family.DIRECT,
        (REGULATE, TRACK),
        r"$\lambda_t\tau\hat q_t+\lambda_s\theta_s\hat q_s$",
        "(23) as corrected",
    ),
    "stacked": _LawSpec(
        "stacked Jacobians",
        Family.CLASSICAL,
        (REGULATE, IMAGE_TRACK),
        r"$-\lambda J^+(s-s^*)$, both views stacked",
        "[RH00] reference 8",
    ),
    "blockwise": _LawSpec(
        "block-wise",
        Family.CLASSICAL,
        (REGULATE,),
        r"$-\lambda(J_l^+e_l+J_r^+e_r)$, a pseudo-inverse a view",
        "[RH00] reference 10",
    ),
    "euclidean_points": _LawSpec(
        "Euclidean points",
        Family.CLASSICAL,
        (REGULATE,),
        r"$-\lambda J^+(X-X^*)$ on triangulated metric points, given the metric model",
        "[RH00] section 6",
        metric=True,
    ),
    "exact": _LawSpec(
        "exact",
        Family.EXACT,
        (REGULATE, TRACK),
        "the joint step that displaces the face as (22) wants, solved on (6)",
        "[the exact law](../explanation/mathematics.md#the-exact-law)",
        paper=False,
    ),
    INCIDENCES: _LawSpec(
        "incidences",
        Family.INCIDENCES,
        (REGULATE,),
        r"$-\lambda J^+e+(I-J^+J)z$ on the [incidences of the goal](../how-to/align-and-insert.md), or on "
        "the whole pose",
        "[incidences](../explanation/mathematics.md#incidences)",
        paper=False,
    ),
}
LAWS = tuple(LAW_SPECS)
CODES = {law: code for code, law in enumerate(LAWS)}  # codes of the laws in compiled code
PAPER_LAWS = tuple(law for law, spec in LAW_SPECS.items() if spec.paper)
# Laws of the field and those of the projective calibration, which figures and the animation compare.
CLASSICAL_LAWS = tuple(law for law, spec in LAW_SPECS.items() if spec.family is Family.CLASSICAL)
PROJECTIVE_LAWS = tuple(law for law in LAWS if law not in CLASSICAL_LAWS)
# Laws that measure the points of the face themselves, and laws that can measure the face with its whole body.
FACE_LAWS, BODY_LAWS = CLASSICAL_LAWS, PROJECTIVE_LAWS
# Laws that fail the call by default if they do not converge; a classical law may end in any verdict.
CONVERGING_LAWS = PROJECTIVE_LAWS
_NAMES = {
    f"{law}_{mode}": (law, mode) for law, spec in LAW_SPECS.items() for mode in spec.modes if mode != REGULATE
}


def title_of(law: str) -> str:
    """Return the title of a law: its name if it is not built in."""
    return LAW_SPECS[law].title if law in LAW_SPECS else law


def must_converge(law: str, required: Sequence[str] | None) -> bool:
    """Tell whether a law that does not converge fails the call: by default all but classical ones."""
    return law in CONVERGING_LAWS or law not in LAWS if required is None else law in required


def fault_fails(law: str) -> bool:
    """Tell whether a fault that ends a run fails the call: classical laws lead where images mean nothing."""
    return law not in CLASSICAL_LAWS


def run_name(law: str, mode: str) -> str:
    """Return the name of the run of a law in a mode: ``exact`` if it replans, otherwise ``exact_track``."""
    return law if mode == REGULATE else f"{law}_{mode}"


def law_and_mode(name: str) -> tuple[str, str]:
    """Law and mode of the run of a name."""
    return _NAMES.get(name, (name, REGULATE))


def codes_of(names: Iterable[str]) -> set[int]:
    """Codes of the built-in laws of runs, by their names."""
    return {CODES[law] for name in names if (law := law_and_mode(name)[0]) in CODES}


def mode_in(name: str) -> str:
    """Say which setting to use if a given law is the name of a run in another mode; otherwise empty."""
    law, mode = law_and_mode(name)
    if mode == REGULATE:
        return ""
    return f"is the run of {law} in mode {mode}: name {law}, with --set control.mode=[{mode}]"


def run_names(laws: Sequence[str], modes: Sequence[str]) -> tuple[str, ...]:
    """Names of the runs of laws, each in the modes that it has.

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
