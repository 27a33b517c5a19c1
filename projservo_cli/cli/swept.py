"""``projservo report SWEEP``: statistics and figures of a sweep."""

from typing import Any

from projservo_cli.cli.options import wrapped
from projservo_cli.cli.output import Console, print_json
from projservo_cli.records import InputError

UNUSED = ("config", "sets", "output", "data", "dry_run", "view", "animation")


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Write the report and print the tables; the exit code."""
    del names
    for name in UNUSED:
        if options[name]:
            flag = name.replace("_", "-").removesuffix("s")
            raise InputError(f"--{flag}: not used by report {rest[0]}, which is of a sweep")
    from projservo_cli.figures.style import FORMATS
    from projservo_cli.lock import working_in
    from projservo_cli.sweep.again import folder_of
    from projservo_cli.sweep.report import report

    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    folder = folder_of(rest[0])
    try:
        with working_in(folder.path):
            found, files = report(folder, FORMATS, console.progress)
    finally:
        console.finish()
    if options["json"]:
        print_json({"sweep": folder.path.resolve(), **found, "files": [path.resolve() for path in files]})
        return 0
    console.show(
        f"report: {found['runs']} of {found['total']} runs; shares in %, 95 % interval; "
        "medians of converged runs"
    )
    for line in (*_cells(found["cells"]), *_pairs(found["paired"])):
        console.show(line)
    console.show(wrapped(f"files: {folder.path}: {', '.join(path.name for path in files)}"))
    return 0


def _cells(cells: list[dict[str, Any]]) -> list[str]:
    known = ("cell", "runs", "converged", "success_rate", "success_interval", "verdicts", "quantiles")
    axes = [name for name in cells[0] if name not in known and not name.endswith("_rate")]
    widths = [max(len(name), *(len(str(cell[name])) for cell in cells)) + 2 for name in axes]
    head = "".join(f"{name:<{width}}" for name, width in zip(axes, widths, strict=True))
    lines = [f"  {head}{'converged %':>15}{'hidden':>7}{'outside':>8}{'steps':>6}{'mm':>8}{'path':>7}"]
    for cell in cells:
        low, high = (100.0 * value for value in cell["success_interval"])
        rate = f"{100.0 * cell['success_rate']:.1f} ({low:.0f}-{high:.0f})"
        middle = [
            cell["quantiles"][name]["0.5"] for name in ("steps", "position_error_mm", "path_length_ratio")
        ]
        numbers = [
            f"{'-' if value is None else format(value, '.3g'):>{w}}"
            for value, w in zip(middle, (6, 8, 7), strict=True)
        ]
        text = "".join(f"{cell[name]!s:<{width}}" for name, width in zip(axes, widths, strict=True))
        hidden, outside = 100.0 * cell["self_occluded_rate"], 100.0 * cell["left_image_rate"]
        lines.append(f"  {text}{rate:>15}{hidden:>7.1f}{outside:>8.1f}{''.join(numbers)}")
    return lines


def _pairs(pairs: list[dict[str, Any]]) -> list[str]:
    lines = [
        "paired on the same tasks: both converged, only the first, only the second,",
        "neither; p: chance if alike",
    ]
    for pair in pairs:
        known = ("laws", "pairs", "both", "only", "neither", "p_success", "median_difference", "p_difference")
        where = ", ".join(f"{name} {value}" for name, value in pair.items() if name not in known)
        counts = f"{pair['both']}, {pair['only'][0]}, {pair['only'][1]}, {pair['neither']}"
        laws = " : ".join(pair["laws"]) + (f" ({where})" if where else "")
        lines.append(f"  {laws}: {counts}; p {pair['p_success']:.2g}")
    return lines if pairs else []
