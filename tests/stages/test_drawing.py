"""Figures drawn by two processes are those that one draws."""

import pytest

from projservo_cli.records import InputError
from projservo_cli.report.figures import FIGURES
from projservo_cli.stages import report as drawing
from tests.figures.cases import case

FORMATS = ("svg", "pdf", "png")
FEW = tuple(spec for spec in FIGURES if spec.name in ("fig01_partition", "fig03_scene", "fig07_three_two"))


@pytest.fixture
def few(monkeypatch):
    """Three figures, and two processors to draw them on."""
    monkeypatch.setattr(drawing, "FIGURES", FEW)
    monkeypatch.setattr(drawing, "_processors", lambda: 2)


def contents(folder):
    return {path.name: path.read_bytes() for path in (folder / drawing.FOLDER).iterdir()}


def test_a_second_process_draws_the_same_bytes(few, tmp_path):
    material = case()[2]
    alone = drawing.draw_all(material, tmp_path / "alone", FORMATS, [])
    with drawing.drawing_beside() as beside:
        both = drawing.draw_all(material, tmp_path / "both", FORMATS, [], beside=beside)
        assert beside.returncode == 0
    assert alone == both
    assert contents(tmp_path / "alone") == contents(tmp_path / "both")
    assert len(contents(tmp_path / "both")) == len(FEW) * (len(FORMATS) + 1)


def test_what_the_second_process_left_undone_is_drawn_by_the_first(few, tmp_path):
    with drawing.drawing_beside() as beside:
        beside.kill()
        beside.wait()
        written = drawing.draw_all(case()[2], tmp_path, ("svg",), [], beside=beside)
    assert {f"{drawing.FOLDER}/{name}" for name in contents(tmp_path) if name.endswith("svg")} == set(written)
    assert len(written) == len(FEW)


def test_what_cannot_be_written_beside_is_told(few, tmp_path):
    folder = tmp_path / drawing.FOLDER
    (folder / "fig03_scene.svg").mkdir(parents=True)  # the second figure is drawn beside
    with drawing.drawing_beside() as beside, pytest.raises(InputError, match=r"fig03_scene\.svg"):
        drawing.draw_all(case()[2], tmp_path, ("svg",), [], beside=beside)
    assert not list(folder.glob(".*.part"))


def test_the_second_process_ends_with_the_block(few):
    with drawing.drawing_beside() as beside:
        pass
    assert beside.returncode is not None


def test_one_processor_draws_alone(monkeypatch):
    monkeypatch.setattr(drawing, "_processors", lambda: 1)
    with drawing.drawing_beside() as beside:
        assert beside is None
