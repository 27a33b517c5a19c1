"""Write the generated regions of all pages: ``python -m docs.generate``."""

from docs.generate import DOCS, generated

for page in sorted(DOCS.rglob("*.md")):
    old = page.read_text(encoding="utf-8")
    new = generated(old)
    if new != old:
        page.write_text(new, encoding="utf-8")
        print(f"written: {page.relative_to(DOCS.parent)}")
