"""The page of a run: whole, self-contained, safe, and in agreement with the run."""

import base64
import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

from projservo_cli.cli.output import words_of
from projservo_cli.config import load_config, to_yaml
from projservo_cli.records import CrossValidation, changed
from projservo_cli.report.animation import write_animation
from projservo_cli.report.claims import claims_of
from projservo_cli.report.figure_inputs import PAGE_FILE
from projservo_cli.report.json_objects import stage_object
from projservo_cli.store.observation_tables import to_csv
from projservo_cli.store.run_file import Result
from tests.configured import compared, page_of
from tests.fake_records import fake
from tests.report.cases import SPECS, case, seen
from tests.report.conftest import SOME, read, stored, words


@pytest.fixture(scope="session")
def page(run):
    return read(run.path.parent / PAGE_FILE)


def altered(run, folder, *, report=None, **results):
    """The run in another folder, with other results, and some fields of its report replaced."""
    record = dataclasses.replace(run.results["report"].records[""], **(report or {}))
    made = {"report": Result("", "", {}, {}, {"": record})}
    return dataclasses.replace(run, path=folder / "run.h5", results=run.results | made | results)


def shown(run):
    return read(page_of(run))


def test_the_page_loads_nothing_and_runs_nothing(page, run):
    assert not list(page.all("script", "link", "iframe", "object", "embed", "base"))
    for element in page.all():
        for name, value in element.attributes.items():
            assert not name.startswith("on")
            assert name not in ("src", "srcset", "action", "data") or value.startswith(
                "data:image/svg+xml;base64,"
            )
            if name == "href":
                assert element.tag == "a" or value.startswith("#")
                assert ":" not in value
                assert value.startswith("#") or (run.path.parent / value).is_file() or value == "run.h5"
    (style,) = page.all("style")
    assert "url(" not in style.text
    assert "@import" not in style.text


@pytest.mark.parametrize("names", [("hand",), ("left", "right", "ceiling")])
def test_page_and_words_name_the_cameras(tmp_path, run, names):
    material = seen(names)
    with_names = stored(tmp_path, material=material)
    results = with_names.results | {"report": run.results["report"]}
    with_names = dataclasses.replace(with_names, results=results)
    text = words(shown(with_names).text)
    for name in names:
        assert f"hidden {name}" in text
    assert "hidden right" not in text or "right" in names
    laws = stage_object("servo", with_names, (), [*material.traces])
    head, *_, last = words_of("servo", laws)
    assert head.endswith(f"self-occluded steps {'/'.join(names)}")
    assert "/".join("0" for _ in names) in last
    for claim in claims_of(material, None):
        assert ("both" in claim.criterion) <= (len(names) == 2)
    film = tmp_path / "film.gif"
    some = {name: material.traces[name] for name in ("direct_three", "stacked")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("projservo_cli.report.animation._FRAMES", 2)
        write_animation(film, some, material.plant.order, None, lambda *_: None)
    with Image.open(film) as pictures:
        assert pictures.n_frames == 2


def test_every_figure_has_a_text_a_caption_and_its_numbers(page, run):
    figures = list(page.all("figure"))
    assert sorted(figure.attributes["id"] for figure in figures) == sorted(SOME)
    for figure in figures:
        spec = SPECS[figure.attributes["id"]]
        (image,) = figure.all("img")
        assert image.attributes["alt"] == spec.alt
        drawn = run.path.parent / "figures" / f"{spec.name}.svg"
        content = base64.b64encode(drawn.read_bytes()).decode()
        assert image.attributes["src"] == f"data:image/svg+xml;base64,{content}"
        (caption,) = figure.all("figcaption")
        assert spec.title in words(caption.text)
        assert not spec.paper.startswith("Fig") or spec.paper in words(caption.text)
        links = {a.text: a.attributes["href"] for a in caption.all("a")}
        assert set(links) == {"numbers (CSV)", "SVG"}
        assert (run.path.parent / links["numbers (CSV)"]).stat().st_size > 100
    assert len({spec.alt or spec.title for spec in SPECS.values()}) == len(SPECS)


def test_numbers_of_a_figure_are_those_that_are_drawn(run):
    text = (run.path.parent / "figures" / "fig08_drift.csv").read_bytes().decode()
    assert text == to_csv(SPECS["fig08_drift"].data(case()[2]))


def test_all_that_the_claims_say_is_on_the_page(page, run):
    told = (run.path.parent / "claims.json").read_text(encoding="utf-8")
    content, text = json.loads(told), words(page.text)
    for claim in content["claims"]:
        for key in ("claim", "source", "measured", "criterion"):
            assert words(claim[key]) in text
    shown = {element.attributes["value"] for element in page.all("data")}
    numbers = (item for row in content["drift"] for item in row.items())
    values = {value for key, value in numbers if "_mm" in key or "_per" in key}
    assert len(values) > 15
    assert {repr(value) for value in values - {None}} <= shown
    holding = sum(claim["holds"] is True for claim in content["claims"])
    left = sum(claim["holds"] is None for claim in content["claims"])
    judged = len(content["claims"]) - left
    assert f"{holding} of {judged} judged claims hold, {left} not judged" in text


HOSTILE = "<script>alert(1)</script>\"'&{{ 7*7 }}"


def test_hostile_texts_are_shown_and_not_run(run, tmp_path):
    claims = ({"claim": HOSTILE, "source": "s", "measured": HOSTILE, "criterion": "c", "holds": None},)
    left_out = ({"what": HOSTILE, "reason": HOSTILE},)
    files = ("figures/../x.svg", "javascript:alert(1)//fig01_partition.svg", "figures/fig01_partition.svg")
    trace = dataclasses.replace(run.traces["stacked"], verdict=HOSTILE, reason=HOSTILE)
    made = {"argv": ["projservo", HOSTILE], "host": HOSTILE}
    report = {"claims": claims, "omitted": left_out, "figures": files}
    other = altered(run, tmp_path, report=report, **{"servo/stacked": Result("", "", made, {}, {"": trace})})
    configuration = run.configuration.replace("PUMA 560", "</pre><script>")
    other = dataclasses.replace(other, configuration=configuration)
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "fig01_partition.svg").write_text(f'"><svg>{HOSTILE}</svg>')
    page = shown(other)
    assert not list(page.all("script", "svg"))  # an image runs nothing and fetches nothing
    assert words(page.text).count(HOSTILE) >= 6
    assert not any("javascript" in a.attributes["href"] for a in page.all("a"))
    assert "</pre><script>" in next(page.all("pre")).text


def test_runs_stand_side_by_side_and_a_figure_that_one_lacks_leaves_its_place_empty(run, tmp_path):
    other = altered(run, run.path.parent, report={"figures": [f"figures/{name}.svg" for name in SOME[1:]]})
    other = dataclasses.replace(other, configuration=run.configuration.replace("seed: 1", "seed: 22"))
    path = tmp_path / "both.html"
    compared([run, other], path)
    page = read(path)
    names = [element.attributes["id"] for element in page.all() if "id" in element.attributes]
    assert len(set(names)) == len(names)
    assert words(page.text).count("lacks the figure") == 1
    classes = (div for div in page.all("div") if div.attributes.get("class") == "runs")
    rows = [list(div.all("figure")) for div in classes]
    named = {tuple(figure.attributes["id"].partition("-")[2] for figure in row) for row in rows if row}
    assert named == {(SOME[0],), *((name, name) for name in SOME[1:])}
    *_, row = [tr for tr in page.all("tr") if "seed" in words(tr.text) and "22" in tr.text]
    assert words(row.text) == "seed 1 22"
    (table,) = [t for t in page.all("table") if "What the paper claims" in t.text]
    assert len(list(table.all("tr"))) == 1 + len(run.results["report"].records[""].claims)
    for link in page.all("a"):
        target = link.attributes["href"]
        assert target.startswith("#") or target.endswith("run.h5") or (tmp_path / target).is_file()


def test_what_is_known_of_a_calibration_is_told(run, tmp_path):
    table = tmp_path / "table.csv"
    table.write_text("pose,marker\n")
    calibration = changed(
        run.calibration,
        usable=False,
        prediction_noise=np.array([0.5, 7.25, 1.0, 1.0, 1.0, 1.0]),
        outlier=np.zeros((2, 3), dtype=np.int64),
        suspect=np.zeros((1, 2), dtype=np.int64),
        advice=("move joint 2",),
        lens=np.array([[640, 512, 800, -0.0625, 0.5], [640, 512, 800, 0.25, 0.0]]),
    )
    held_out = fake(CrossValidation, folds=5, unit="poses", rms_px=0.321, reason="as predicted")

    configuration = to_yaml(load_config(None, [f"data.table={table}"]))

    def told(calibration):
        records = {"calibration": calibration, "cross_validation": held_out}
        fit = run.results["calibrate"]
        other = altered(run, tmp_path, calibrate=dataclasses.replace(fit, records=fit.records | records))
        return words(shown(dataclasses.replace(other, configuration=configuration)).text)

    text = told(calibration)
    for part in (
        "✗ not usable",
        "Not usable: ",
        "an estimate from these images",
        "Joint 2 is known worst: 0.5 rad from the reference it adds 7.25 times",
        "so this one is poorly observable.",
        "Held out, in 5 parts of poses: rms 0.321 px",
        "As predicted.",
        "What to do next: move joint 2",
        "lens of the left camera, k1 −0.0625",
    ):
        assert part in text, part
