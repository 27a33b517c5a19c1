"""The command tags: true scale for the detector of the project, and a net that folds to the roof."""

import numpy as np
import pytest

from projservo_cli.detection.finders import TagFinder
from projservo_cli.hardware import tag_sheets

pdfium = pytest.importorskip("pypdfium2")
pytest.importorskip("cv2")

DPI = 300
PX_MM = DPI / 25.4


def page(path):
    """Grey values of the page of a PDF, and its width and height, mm."""
    document = pdfium.PdfDocument(path)
    size = np.array(document[0].get_size()) * 25.4 / 72
    image = np.asarray(document[0].render(scale=DPI / 72, grayscale=True).to_pil(), dtype=float)
    document.close()
    return image, size


def sides(corners):
    return np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1) / PX_MM


@pytest.mark.parametrize(
    ("kind", "size_mm", "dictionary", "paper", "count"),
    [
        ("single", 30, "4X4_50", "a4", 16),
        ("plate", 55, "APRILTAG_36H11", "letter", 4),
        ("roof", 42, "5X5_100", "a4", 5),
    ],
)
def test_printed_tags_are_found_at_their_size(projservo, tmp_path, kind, size_mm, dictionary, paper, count):
    file = tmp_path / "tags.pdf"
    given = ("--kind", kind, "--size-mm", size_mm, "--dictionary", dictionary, "--paper", paper)
    value = projservo("tags", "-o", file, *map(str, given), "--json").json
    image, size = page(file)
    assert size == pytest.approx(tag_sheets.PAPERS[paper], abs=0.01)
    found, ambiguous = TagFinder(dictionary).find(image)
    assert (len(found), ambiguous) == (count, ())
    assert sorted(found) == sorted(value["tags"])
    for tag in found.values():
        assert tag.clean.all()
        assert sides(tag.pixels) == pytest.approx(size_mm, rel=2e-3)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("--kind", "roof", "--size-mm", "60"), "a4 has 194 x 225 mm for them: take about 44 mm"),
        (("--size-mm", "150"), "a4 takes 0 tags with margins of 200 mm, not 1: take 145 mm at most"),
        (("--numbers", "3,2-4"), "--numbers 3,2-4: tag 3 occurs 2 times"),
        (("--numbers", "3,60"), "there is no tag 60 in the dictionary, which has tags 0 to 49"),
        (("--numbers", "3,a"), "expected numbers of tags such as 0-4,7"),
        (
            ("--numbers", "0-40"),
            "a4 takes 16 tags with margins of 40 mm, not 41: take 19 mm at most or fewer --numbers",
        ),
        (("--numbers", "0-4000"), "not 4001: take fewer --numbers"),
        (("--kind", "roof", "--numbers", "3"), "--numbers: is for --kind single"),
        (("--dictionary", "4X4"), "--dictionary 4X4: unknown; valid: 4X4_100"),
    ],
)
def test_a_sheet_that_cannot_be_is_refused(projservo, tmp_path, given, words):
    answer = projservo("tags", "-o", tmp_path / "tags.pdf", *given)
    assert answer.code == 2
    assert words in answer.err
    assert not (tmp_path / "tags.pdf").exists()
