"""The report of a sweep: statistics as JSON, figures with their numbers."""

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.config.sweep import LAW
from projservo_cli.files import replacing
from projservo_cli.report import style
from projservo_cli.report.figures.sweeps import draw_basin, draw_final_errors, draw_success
from projservo_cli.report.material import Data
from projservo_cli.stages import Progress
from projservo_cli.store import SweepTable
from projservo_cli.sweep.folder import Folder
from projservo_cli.sweep.statistics import Rows, statistics, success_by
from projservo_cli.tables import to_csv

STATISTICS = "statistics.json"
OFFSET = "task.start_offset."
ANGLES = tuple(range(0, 181, 30))
BINS = 8  # of a value that is drawn
POINTS = 2_000  # of a curve


class _Picture(NamedTuple):
    """A figure: the name of its files, its numbers, how it is drawn, its height in inches."""

    name: str
    data: Data
    draw: Any
    height: float


def report(folder: Folder, formats: Sequence[str], progress: Progress) -> tuple[dict[str, Any], list[Path]]:
    """Write statistics and figures of a sweep, of the runs that are done.

    Returns the statistics, and the files.
    """
    if folder.stored():
        folder.assemble(folder.design())
    table = SweepTable(folder.table)
    rows = Rows(table)
    found = {"runs": table.rows, "total": table.attributes["total"], **statistics(rows)}
    files = [folder.path / STATISTICS]
    with replacing(files[0]) as temporary:
        temporary.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    pictures = list(_pictures(rows))
    for done, picture in enumerate(pictures):
        progress("figures", done, len(pictures))
        files += _drawn(picture, folder.path, formats)
    progress("figures", len(pictures), len(pictures))
    return found, files


def _drawn(picture: _Picture, folder: Path, formats: Sequence[str]) -> Iterator[Path]:
    width = 0.65 * style.WIDTH if picture.height < 4 else style.WIDTH
    made = style.contents(style.drawn(picture.draw, picture.data, picture.height, width), formats)
    for kind, content in made.items():
        path = folder / f"{picture.name}.{kind}"
        with replacing(path) as temporary:
            temporary.write_bytes(content)
        yield path
    path = folder / f"{picture.name}.csv"
    with replacing(path) as temporary:
        temporary.write_text(to_csv(picture.data), encoding="utf-8")
    yield path


def _pictures(rows: Rows) -> Iterator[_Picture]:
    """Every figure that the columns of a sweep allow."""
    axes = {name: values for name, values in rows.axes if len(values) > 1 and _numeric(values)}
    for name in axes:
        yield _Picture(f"success_over_{name}", _success(rows, name, name, None), draw_success, 2.9)
    drawn = [name for name in rows.table.names if name in rows.table.attributes["random"]]
    for name in (name for name in drawn if rows[name].dtype.kind == "f"):
        edges = np.linspace(rows[name].min(), np.nextafter(rows[name].max(), math.inf), BINS + 1)
        yield _Picture(f"success_over_{name}", _success(rows, name, name, edges.tolist()), draw_success, 2.9)
    if np.nanmax(rows["rotation_deg"], initial=0.0) - np.nanmin(rows["rotation_deg"], initial=180.0) > 1.0:
        data = _success(rows, "rotation_deg", "rotation from start to goal (deg)", [*ANGLES[:-1], 180.1])
        yield _Picture("success_over_rotation", data, draw_success, 2.9)
    offsets = [name for name in axes if name.startswith(OFFSET)]
    if len(offsets) >= 2:
        yield _Picture("basin", _basin(rows, offsets[0], offsets[1]), draw_basin, 4.0)
    errors = _final_errors(rows)
    if errors:
        yield _Picture("final_error", errors, draw_final_errors, 2.9)


def _numeric(values: Sequence[Any]) -> bool:
    return all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)


def _success(rows: Rows, name: str, label: str, edges: Sequence[float] | None) -> Data:
    found = success_by(rows, name, edges)
    columns = {f"{law}.{key}": values for law, by in found.items() for key, values in by.items()}
    return {"label": np.array(label), **columns}


def _basin(rows: Rows, first: str, second: str) -> Data:
    x, y, begun = np.unique(rows[first]), np.unique(rows[second]), rows["steps"] >= 0
    data: Data = {"x": x, "y": y, "label_x": np.array(first), "label_y": np.array(second)}
    for law in dict.fromkeys(rows[LAW].tolist()):
        mine = rows[LAW] == law
        share = np.full((len(y), len(x)), np.nan)
        for i, j in np.ndindex(*share.shape):
            these = mine & begun & (rows[first] == x[j]) & (rows[second] == y[i])
            if these.any():
                share[i, j] = rows["success"][these].mean()
        data[f"{law}.share"] = share
    return data


def _final_errors(rows: Rows) -> Data:
    data: Data = {}
    for law in dict.fromkeys(rows[LAW].tolist()):
        errors = rows["position_error_mm"][rows[LAW] == law]
        finite = np.sort(errors[np.isfinite(errors)])
        if len(finite):
            shown = np.unique(np.linspace(0, len(finite) - 1, POINTS).astype(np.int64))
            data[f"{law}.error"] = np.maximum(finite[shown], 1e-6)
            data[f"{law}.share"] = (shown + 1) / len(errors)
    return data
