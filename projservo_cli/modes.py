"""Modes of the control: whether each step plans anew, or follows the plan that was made once."""

from collections.abc import Sequence

from projservo_cli.records import InputError

REPLAN, TRACK, IMAGE_TRACK = "replan", "track", "image_track"
MODES = (REPLAN, TRACK, IMAGE_TRACK)
MODES_OF = {
    "direct_three": (REPLAN, TRACK),
    "direct_two": (REPLAN, TRACK),
    "exact": (REPLAN, TRACK),
    "stacked": (REPLAN, IMAGE_TRACK),
}
NAMES = {f"{law}_{mode}": (law, mode) for law, modes in MODES_OF.items() for mode in modes if mode != REPLAN}


def modes_of(law: str) -> tuple[str, ...]:
    """Modes a law has; one of somebody else, and one that compares, sees to its steps itself."""
    return MODES_OF.get(law, (REPLAN,))


def following_mode(law: str) -> str:
    """The mode in which a law follows a plan."""
    return next(mode for mode in modes_of(law) if mode != REPLAN)


def name_of(law: str, mode: str) -> str:
    """Name of the run of a law in a mode: the law's own where it replans, such as ``exact_track`` else."""
    return law if mode == REPLAN else f"{law}_{mode}"


def law_and_mode(name: str) -> tuple[str, str]:
    """Law and mode of the run of a name."""
    return NAMES.get(name, (name, REPLAN))


def names_of(laws: Sequence[str], modes: Sequence[str]) -> tuple[str, ...]:
    """Names of the runs of laws, each in those of the modes that it has.

    Raises
    ------
    InputError
        If a law has none of them.
    """
    found = []
    for law in laws:
        own = [mode for mode in modes if mode in modes_of(law)]
        if not own:
            able = [other for other in MODES_OF if any(mode in MODES_OF[other] for mode in modes)]
            raise InputError(
                f"control.mode {' and '.join(modes)}: {law} has no such mode, only "
                f"{' and '.join(modes_of(law))}; laws that have one: {', '.join(able)} (--law, control.laws)"
            )
        found += [name_of(law, mode) for mode in own]
    return tuple(dict.fromkeys(found))
