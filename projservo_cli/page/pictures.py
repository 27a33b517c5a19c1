"""The figures of a run as a page shows them."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from projservo_cli.figures import FIGURES, FigureSpec
from projservo_cli.figures.style import FORMATS
from projservo_cli.files import inside
from projservo_cli.page.vector import inline

SECTIONS = ("calibration", "plan", "control")
_MOST_BYTES = 20_000_000  # of a file; figures have some 100,000


@dataclass(frozen=True)
class Picture:
    """One figure.

    Attributes
    ----------
    anchor : its name within the page.
    number : as in the names of its files.
    caption, paper : what it shows, and which figure and section of the paper it follows.
    drawing : the figure itself; None where there is no file that a page can show.
    links : (label, path) of its files and of the numbers behind it.
    """

    anchor: str
    number: str
    caption: str
    paper: str
    drawing: Markup | None
    links: tuple[tuple[str, str], ...]


def pictures(directory: Path, files: Sequence[str], folder: str, prefix: str) -> dict[str, list[Picture]]:
    """Figures by section, in their order.

    Parameters
    ----------
    directory : of the run.
    files : those the report wrote, relative to it.
    folder : of the run as seen from the page, empty or ending in a slash.
    prefix : of all names within the page.
    """
    found: dict[str, list[Picture]] = {section: [] for section in SECTIONS}
    for spec in FIGURES:
        kinds = [kind for kind in FORMATS if _file(spec, kind) in files]
        if kinds:
            found[_section(spec)].append(_picture(spec, directory, kinds, folder, prefix))
    return found


def _file(spec: FigureSpec, kind: str) -> str:
    return f"figures/{spec.name}.{kind}"


def _section(spec: FigureSpec) -> str:
    if not spec.task:
        return "calibration"
    return "control" if spec.laws or spec.studies or spec.modes else "plan"


def _picture(spec: FigureSpec, directory: Path, kinds: list[str], folder: str, prefix: str) -> Picture:
    drawing = None
    for kind in ("svg", "png"):
        content = _content(directory, _file(spec, kind)) if kind in kinds and drawing is None else None
        if content is not None:
            drawing = _drawn(content, kind, f"{prefix}{spec.name}-", spec.alt or spec.title)
    links = [(kind.upper(), folder + _file(spec, kind)) for kind in kinds]
    if (directory / _file(spec, "csv")).is_file():
        links.insert(0, ("numbers (CSV)", folder + _file(spec, "csv")))
    digits = "".join(c for c in spec.name.partition("_")[0] if c.isdigit())
    return Picture(
        f"{prefix}{spec.name}", str(int(digits or 0)), spec.title, spec.paper, drawing, tuple(links)
    )


def _content(directory: Path, name: str) -> bytes | None:
    """Content of a figure; None where it is none, or one that a link takes from elsewhere."""
    path = directory / name
    try:
        return path.read_bytes() if inside(path, directory) and path.stat().st_size <= _MOST_BYTES else None
    except OSError:
        return None


def _drawn(content: bytes, kind: str, prefix: str, alt: str) -> Markup | None:
    if kind == "svg":
        return inline(content, prefix, alt)
    data = base64.b64encode(content).decode()
    return Markup('<img src="data:image/png;base64,{}" alt="{}">').format(data, alt)
