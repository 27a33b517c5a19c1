"""Every link and every file that a built page asks for is there, on this site: no network."""

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from sphinx.application import Sphinx
from sphinx.util import logging

LOG = logging.getLogger(__name__)
# What a browser loads by itself, beside what a reader may follow.
LOADED = {"script": "src", "img": "src", "link": "href"}


class Page(HTMLParser):
    """What a page asks for, where it leads to, and the places in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.followed: list[str] = []
        self.places: set[str] = {""}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what one element asks for."""
        values = dict(attrs)
        self.places.add(values.get("id") or "")
        if tag in LOADED:
            self.loaded.append(values.get(LOADED[tag]) or "")
        elif tag == "a":
            self.followed.append(values.get("href") or "")


def broken(folder: Path) -> list[str]:
    """What is wrong with the links of the pages in a folder, one line each."""
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.html"))}
    found = []
    for path, page in pages.items():
        for target in (*page.loaded, *page.followed):
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                if target in page.loaded and parts.scheme != "data":
                    found.append(f"{path.name}: loads {target} from the network")
                continue
            file = path.parent / unquote(parts.path) if parts.path else path
            if not file.exists():
                found.append(f"{path.name}: links to {target}, which is not there")
            elif file in pages and unquote(parts.fragment) not in pages[file].places:
                found.append(f"{path.name}: links to {target}, a place that is not on the page")
    return found


def _check(app: Sphinx, error: Exception | None) -> None:
    if error is None and app.builder.format == "html":
        for line in broken(Path(app.outdir)):
            LOG.warning("%s", line)


def setup(app: Sphinx) -> dict[str, bool]:
    """Check the pages when all are written."""
    app.connect("build-finished", _check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
