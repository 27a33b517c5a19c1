"""Where machine code is cached: keyed by every source it depends on, or not at all."""

import re
import shutil
from pathlib import Path

import pytest

import projservo_cli
from projservo_cli.geometry.jit import COMPILED_PACKAGES, cache_folder, source_hash

PACKAGE = Path(projservo_cli.__file__).parent


@pytest.fixture
def copy(tmp_path):
    """Copy of the package whose sources may be edited."""
    root = tmp_path / "package"
    shutil.copytree(PACKAGE, root, ignore=shutil.ignore_patterns("__pycache__"))
    return root


@pytest.mark.parametrize("package", COMPILED_PACKAGES)
def test_an_edited_helper_makes_another_cache(copy, package):
    before = source_hash(copy)
    assert before == source_hash(copy) == source_hash(PACKAGE)
    file = max((copy / package).glob("*.py"))
    file.write_text(file.read_text(encoding="utf-8") + "\n# edited\n", encoding="utf-8")
    assert source_hash(copy) != before


def test_records_and_new_files_count(copy):
    hashes = {source_hash(copy)}
    (copy / "records.py").write_text("# edited\n", encoding="utf-8")
    hashes.add(source_hash(copy))
    (copy / "control" / "new_law.py").write_text("", encoding="utf-8")
    hashes.add(source_hash(copy))
    assert len(hashes) == 3


def test_every_compiled_function_lies_in_a_hashed_package():
    for file in PACKAGE.rglob("*.py"):
        if re.search("^@(njit|inline)$", file.read_text(encoding="utf-8"), re.MULTILINE):
            assert file.relative_to(PACKAGE).parts[0] in COMPILED_PACKAGES


def test_the_folder_is_the_one_asked_for(copy, tmp_path, monkeypatch):
    monkeypatch.setenv("PROJSERVO_CACHE_DIR", str(tmp_path / "cache"))
    folder = cache_folder(copy)
    assert folder.parent == tmp_path / "cache" / "projservo"
    assert folder.is_dir()
    assert source_hash(copy) in folder.name


def test_no_cache_where_nothing_can_be_written(copy, tmp_path, monkeypatch):
    (tmp_path / "occupied").write_text("a file, not a folder", encoding="utf-8")
    monkeypatch.setenv("PROJSERVO_CACHE_DIR", str(tmp_path / "occupied"))
    assert cache_folder(copy) is None
