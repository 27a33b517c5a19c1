"""The pages in a real browser: no complaints, nothing fetched, nothing beyond the page."""

import os
import shutil
from contextlib import contextmanager

import pytest

from projservo_cli.report.figure_inputs import PAGE_FILE
from tests.configured import compared, view_of

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
# A machine without a graphics processor draws three dimensions by software.
ARGUMENTS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# Elements that reach beyond the page, but those within what scrolls by itself.
BEYOND = """width => [...document.querySelectorAll("body *")]
  .filter(e => e.getBoundingClientRect().right > width + 1 && !e.closest(".scene")
    && !(e.parentElement.closest(".wide, pre") && getComputedStyle(e.parentElement.closest(".wide, pre"))
         .overflowX === "auto"))
  .map(e => `${e.tagName} ${e.className} ${e.textContent.trim().slice(0, 40)}`)"""


@pytest.fixture(scope="module")
def browser():
    """A Chromium: that of the variable CHROMIUM, else the first there is."""
    program = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no Chromium is installed; set CHROMIUM to one")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=program, args=ARGUMENTS)
        yield started
        started.close()


@contextmanager
def opened(browser, path, width=1400, dark=False):
    """A page as it is shown; on leaving, it must have had nothing to say and nothing to fetch."""
    context = browser.new_context(
        viewport={"width": width, "height": 900}, color_scheme="dark" if dark else "light"
    )
    page = context.new_page()
    said, fetched = [], []
    page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: fetched.append(request.url))
    page.goto(path.as_uri())
    yield page
    context.close()
    assert said == []
    assert [url for url in fetched if not url.startswith(("data:", "blob:"))] == [path.as_uri()]


@pytest.fixture(scope="module")
def view(run):
    pytest.importorskip("plotly", reason="plotly is not installed: pip install '.[view]'")
    return view_of(run)


@pytest.fixture(scope="module")
def pages(run, view, tmp_path_factory):
    comparison = tmp_path_factory.mktemp("comparison") / "compare.html"
    compared([run, run], comparison)
    return {"report": run.path.parent / PAGE_FILE, "comparison": comparison, "view": view}


@pytest.mark.parametrize(("width", "dark"), [(390, False), (1400, True)])
@pytest.mark.parametrize("name", ["report", "comparison", "view"])
def test_pages_fit_every_width_in_light_and_in_dark(browser, pages, name, width, dark):
    with opened(browser, pages[name], width, dark) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= width, page.evaluate(BEYOND, width)
        ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (ground == "rgb(255, 255, 255)") != dark
