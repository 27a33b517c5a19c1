"""A report as one page of HTML that needs nothing else: no network, no scripts, no other file."""

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from projservo_cli.files import replacing
from projservo_cli.report.content import (
    View,
    claim_rows,
    differences,
    number,
    picture_rows,
    short,
    view_of,
)
from projservo_cli.report.values import PAGE_FILE
from projservo_cli.store import Run

if TYPE_CHECKING:
    from jinja2 import Template


@cache
def template(name: str) -> "Template":
    """Template of a page; a value it names and is not given is an error."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"number": number, "short": short}
    return environment.get_template(name)


def write_page(run: Run) -> Path:
    """Write the page of a run into its folder, from the run and the figures that lie there.

    Raises
    ------
    InputError
        If the configuration cannot be read or the page cannot be written.
    """
    path = run.path.parent / PAGE_FILE
    _write(path, [view_of(run)])
    return path


def write_comparison(runs: Sequence[Run], path: Path) -> None:
    """Write one page that shows runs side by side; their figures are read from their folders.

    Raises
    ------
    InputError
        If a configuration cannot be read or the page cannot be written.
    """
    base = path.parent.resolve()
    views = []
    for k, run in enumerate(runs, 1):
        folder = os.path.relpath(run.path.parent.resolve(), base)
        views.append(view_of(run, folder=Path(folder).as_posix() + "/", prefix=f"run{k}-"))
    shared = {view.name for view in views if sum(view.name == other.name for other in views) > 1}
    named = [
        replace(view, name=f"{view.name} ({view.folder.rstrip('/')})") if view.name in shared else view
        for view in views
    ]
    _write(path, named)


def _write(path: Path, views: list[View]) -> None:
    text = template("page.html").render(
        views=views, claims=claim_rows(views), differences=differences(views), pictures=picture_rows(views)
    )
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
