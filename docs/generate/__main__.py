"""Write all that is generated, pages, schemas and the names of pages: ``python -m docs.generate``."""

from pathlib import Path

from docs.generate import DOCS, files
from tests.documentation import test_documented_names as names


def write(path: Path, text: str) -> None:
    """Write a file whose text is another one, and say so."""
    if path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
        print(f"written: {path.relative_to(DOCS.parent)}")


for path, text in files():
    write(path, text)
write(names.STORED, names.to_store())
