"""Studies are run by name; that they can be is all that is tested of them."""

from importlib import import_module
from pathlib import Path

import pytest

STUDIES = sorted(
    path.stem
    for path in Path(__file__).parent.glob("*.py")
    if "\ndef main(" in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_can_be_run(name):
    pytest.importorskip("cv2")
    assert callable(import_module(f"tests.studies.{name}").main)
