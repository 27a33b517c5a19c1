"""The 3D view and the animation beside a report, without a browser."""

import dataclasses
import re

import pytest
from PIL import Image

from projservo_cli.report import animation as film
from projservo_cli.report.figure_inputs import ANIMATION_FILE, PAGE_FILE, VIEW_FILE
from projservo_cli.stages import report
from projservo_cli.store.run_file import Result
from tests.configured import animation_of, page_of, report_on, view_of
from tests.report.cases import case
from tests.report.conftest import MADE, read, stored

MOST_BYTES = {VIEW_FILE: 8_000_000, ANIMATION_FILE: 3_000_000}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return stored(tmp_path_factory.mktemp("extras"))


@pytest.fixture(scope="module")
def view(run):
    pytest.importorskip("plotly", reason="plotly is not installed: pip install '.[view]'")
    return view_of(run)


def test_the_view_is_one_file_that_loads_nothing(view):
    assert view.stat().st_size < MOST_BYTES[VIEW_FILE]
    root = read(view)
    assert not list(root.all("link", "iframe", "object", "embed", "base", "img"))
    for element in root.all():
        assert "src" not in element.attributes
        assert not any(name.startswith("on") for name in element.attributes)
        assert element.attributes.get("href", PAGE_FILE) == PAGE_FILE
    (policy,) = [e for e in root.all("meta") if "http-equiv" in e.attributes]
    allowed = dict(part.split(maxsplit=1) for part in policy.attributes["content"].split("; "))
    assert allowed["default-src"] == "'none'"
    assert not re.search(r"https?:|\*|'self'", policy.attributes["content"])


def test_the_animation_is_small_and_has_all_frames(run, monkeypatch):
    monkeypatch.setattr(film, "_FRAMES", 3)  # a tenth of them, each of which takes its time
    told = []
    path = animation_of(run, lambda *progress: told.append(progress))
    assert told == [("animation", k, 3) for k in range(1, 4)]
    assert path.stat().st_size < MOST_BYTES[ANIMATION_FILE] / 10
    with Image.open(path) as image:
        assert image.format == "GIF"
        assert image.info["loop"] == 0
        assert image.n_frames == 3
        last = []
        for k in range(image.n_frames):
            image.seek(k)
            last.append(image.info["duration"])
        assert last == [film.FRAME_MS] * 2 + [film.LAST_MS]
        assert image.convert("RGB").getpixel((1, 1)) == (255, 255, 255)
    before = path.read_bytes()
    animation_of(run)
    assert path.read_bytes() == before


def test_the_page_links_to_what_there_is_and_a_new_report_removes_it(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "_draw_all", lambda *arguments: [])
    monkeypatch.setattr(report, "run_studies", lambda bench, progress: case()[2].studies)
    run = stored(tmp_path)
    made = Result("k", "", MADE, {}, {"": report_on(run, tmp_path)})
    run = dataclasses.replace(run, results={**run.results, "report": made})
    assert "See it move" not in (tmp_path / PAGE_FILE).read_text(encoding="utf-8")
    (tmp_path / VIEW_FILE).touch()
    (tmp_path / ANIMATION_FILE).touch()
    page_of(run)
    links = {a.attributes["href"] for a in read(tmp_path / PAGE_FILE).all("a")}
    assert {VIEW_FILE, ANIMATION_FILE} <= links
    report_on(run, tmp_path)
    assert not (tmp_path / VIEW_FILE).exists()
    assert not (tmp_path / ANIMATION_FILE).exists()
    assert "See it move" not in (tmp_path / PAGE_FILE).read_text(encoding="utf-8")
