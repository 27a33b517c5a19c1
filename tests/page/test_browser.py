"""The page in a real browser: nothing is complained about, every figure is seen at every width."""

import json
import os
import re
import shutil
import subprocess

import pytest

from projservo_cli.page import PAGE_FILE

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
POLICY = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*>')
# What the page looks like once it is laid out, told to the frame around it.
MEASURE = """<script>
addEventListener("load", () => {
  const wide = path => path.getBoundingClientRect().width > 20;
  const boxes = [...document.querySelectorAll("figure")].map(figure => {
    const box = figure.querySelector("svg, img").getBoundingClientRect();
    const ink = [...figure.querySelectorAll("svg path")].some(wide);
    return [box.left, box.right, box.width, box.height, ink];
  });
  parent.postMessage({boxes, width: innerWidth, scroll: document.documentElement.scrollWidth,
    ground: getComputedStyle(document.body).backgroundColor}, "*");
});
</script></body>"""
# A window has a least width; a frame has none. The text of this page is what --dump-dom prints.
FRAME = """<!DOCTYPE html><title>frame</title><body><script>
addEventListener("message", event => document.body.dataset.measured = JSON.stringify(event.data));
</script><iframe src="report.html" width="WIDTH" height="900" style="border: 0"></iframe></body>"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Function that opens a file and returns what the browser prints and what it says."""
    program = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no Chromium is installed; set CHROMIUM to one")
    profile = tmp_path_factory.mktemp("profile")
    common = [
        *("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"),
        *("--hide-scrollbars", "--enable-logging=stderr", f"--user-data-dir={profile}"),
    ]

    def show(path, *options):
        done = subprocess.run(
            [program, *common, *options, path.as_uri()],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]

    return show


def test_the_browser_has_nothing_to_say(browser, run):
    text, console = browser(run.path.parent / PAGE_FILE, "--dump-dom")
    assert console == []
    assert "</html>" in text


@pytest.mark.parametrize("width", [390, 1400])
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_every_figure_is_seen(browser, run, tmp_path, width, dark):
    text = (run.path.parent / PAGE_FILE).read_text(encoding="utf-8")
    text, count = POLICY.subn("", text)
    assert count == 1
    page = tmp_path / PAGE_FILE
    page.write_text(text.replace("</body>", MEASURE), encoding="utf-8")
    frame = tmp_path / "frame.html"
    frame.write_text(FRAME.replace("WIDTH", str(width)), encoding="utf-8")
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    text, _ = browser(frame, "--dump-dom", "--virtual-time-budget=5000", scheme, "--window-size=1600,1000")
    found = json.loads(re.search(r'data-measured="([^"]*)"', text)[1].replace("&quot;", '"'))
    assert found["width"] == width
    assert found["scroll"] <= width
    assert (found["ground"] == "rgb(255, 255, 255)") != dark
    assert len(found["boxes"]) == 4
    for left, right, wide, high, ink in found["boxes"]:
        assert left >= 0
        assert right <= width
        assert wide >= 0.85 * min(width, 700)
        assert high > 100
        assert ink
