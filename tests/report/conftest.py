"""A run with a report of some figures, and a page read as a browser reads it."""

import dataclasses
from html.parser import HTMLParser

import pytest

from projservo_cli.config import to_yaml
from projservo_cli.stages import report
from projservo_cli.store.run_file import Result, Run
from tests.configured import draw_only, report_on
from tests.known import configured
from tests.report.cases import SHORT, case

SOME = ("fig01_partition", "fig08_drift", "fig11_image_errors", "fig13_calibration")
VOID = {"meta", "br", "img", "link", "hr", "input"}
MADE = {"argv": ["projservo", "servo"], "host": "here", "projservo": "0.1.0", "date": "2026-01-02"}


def stored(folder, *overrides, material=None):
    """A run file as the stages before the report leave it."""
    material = material or case()[2]
    config = configured("paper", f"stop.max_steps={SHORT}", *overrides)
    fit = {"calibration": material.calibration, "observation": material.observation}
    results = {
        "calibrate": Result("k", "", MADE, {}, fit),
        "plan": Result("k", "", MADE, {}, {"": material.plan}),
        **{f"servo/{law}": Result("k", "", MADE, {}, {"": t}) for law, t in material.traces.items()},
    }
    return Run(folder / "run.h5", to_yaml(config), results)


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A run with its report, which stands in its folder; tests only read it."""
    folder = tmp_path_factory.mktemp("run")
    run = stored(folder, "report.formats=[svg]")
    with pytest.MonkeyPatch.context() as patch:
        draw_only(patch, *SOME)
        patch.setattr(report, "run_studies", lambda bench, progress: case()[2].studies)
        record = report_on(run, folder)
    return dataclasses.replace(run, results=run.results | {"report": Result("k", "", MADE, {}, {"": record})})


@dataclasses.dataclass
class Element:
    tag: str
    attributes: dict
    children: list = dataclasses.field(default_factory=list)

    @property
    def text(self):
        text = "".join(child if isinstance(child, str) else child.text for child in self.children)
        return f"{text} " if self.tag in ("th", "td") else text

    def all(self, *tags):
        for child in self.children:
            if not isinstance(child, str):
                if not tags or child.tag in tags:
                    yield child
                yield from child.all(*tags)


class Reader(HTMLParser):
    """Strict: every element is closed by its own end, in order."""

    def __init__(self, text):
        super().__init__()
        self.root = Element("", {})
        self.open = [self.root]
        self.feed(text)
        self.close()
        assert self.open == [self.root], [element.tag for element in self.open]

    def handle_starttag(self, tag, attrs):
        assert len(dict(attrs)) == len(attrs), (tag, attrs)
        element = Element(tag, dict(attrs))
        self.open[-1].children.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_endtag(self, tag):
        assert self.open.pop().tag == tag

    def handle_data(self, data):
        self.open[-1].children.append(data)


def read(path):
    return Reader(path.read_text(encoding="utf-8")).root


def words(text):
    return " ".join(text.split())
