"""The pages in a real browser: no complaints, nothing fetched, everything seen, and the robot moves."""

import io
import os
import shutil
from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image

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
ROBOT = """() => {
  const traces = document.getElementById("scene")._fullData;
  const trace = traces.find(trace => trace.name === "robot" && trace.visible === true);
  return [Array.from(trace.x), Array.from(trace.y), Array.from(trace.z)];
}"""


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


def robot(page):
    return np.transpose(page.evaluate(ROBOT))


def picture(page):
    return np.asarray(Image.open(io.BytesIO(page.locator(".scene").screenshot())).convert("L"), dtype=float)


def to_the_end(page):
    """Move the slider to its end, as a pointer does."""
    box = page.locator(".slider-rail-touch-rect").bounding_box()
    page.mouse.click(box["x"] + box["width"] - 2, box["y"] + box["height"] / 2)


def drawn(page):
    page.wait_for_function("document.querySelector('#scene canvas') !== null")
    page.wait_for_timeout(1000)


def test_the_slider_moves_the_robot_of_every_law(browser, run, view):
    ends = {}
    with opened(browser, view, 390) as page:
        drawn(page)
        before = robot(page)
        seen = picture(page)
        to_the_end(page)
        drawn(page)
        moved, label = picture(page), page.locator(".slider-label").first.text_content()
        for number, name in enumerate(run.traces):
            page.locator(".updatemenu-header").click()
            page.locator(".updatemenu-dropdown-button").nth(number).click()
            page.wait_for_timeout(300)
            to_the_end(page)
            page.wait_for_timeout(300)
            ends[name] = robot(page)
    trace = run.traces["direct_three"]
    # A tenth of a millimetre is what the page keeps.
    np.testing.assert_allclose(before[-1], trace.pose[0, :3, 3], atol=1e-4)
    for name, after in ends.items():
        np.testing.assert_allclose(after[-1], run.traces[name].pose[-1, :3, 3], atol=1e-4)
        assert np.linalg.norm(after[-1] - before[-1]) > 1e-2
    scene = slice(80, -150)  # without the slider, which moves too
    assert np.count_nonzero(np.abs(moved - seen)[scene] > 60) > 30
    assert label == f"time {trace.period * trace.steps:.2f} s, {trace.verdict}, {trace.steps} steps"
