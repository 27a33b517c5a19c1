"""The options --view and --animation of a report."""

from projservo_cli.records import InputError
from projservo_cli.report import page
from projservo_cli.stages import report as extras


def test_a_view_and_an_animation_are_made_beside_a_report_that_is_up_to_date(projservo, stages, monkeypatch):
    made = []

    def make(name):
        def write(run, progress):
            made.append((name, list(run.traces)))
            return run.path.parent / name

        return write

    monkeypatch.setattr(extras, "plotly", lambda: None)
    monkeypatch.setattr(extras, "view", make("view.html"))
    monkeypatch.setattr(extras, "animation", make("animation.gif"))
    monkeypatch.setattr(page, "write_page", lambda run: made.append(("page", sorted(run.results))))
    assert projservo("report", "-c", "tiny.yaml", "-o", "out", "-q").code == 0
    assert made == []
    projservo("servo", "-o", "out", "--law", "blockwise")
    projservo("report", "-o", "out")
    done = len(stages.made)
    answer = projservo("report", "-o", "out", "--animation", "--view", "--json")
    assert answer.code == 0
    laws = ["direct_three", "stacked"]
    results = ["calibrate", "plan", "report", *(f"servo/{law}" for law in laws)]
    assert made == [("view.html", laws), ("animation.gif", laws), ("page", results)]
    assert [answer.json[name].rpartition("/")[2] for name in ("view", "animation")] == [
        *("view.html", "animation.gif")
    ]
    assert "view: " in projservo("report", "-o", "out", "--view").out
    assert len(stages.made) == done


def test_a_view_that_cannot_be_made_is_refused_before_any_work(projservo, stages, monkeypatch):
    def lacks():
        raise InputError("the 3D view needs plotly: pip install 'projservo[view]'")

    monkeypatch.setattr(extras, "plotly", lacks)
    answer = projservo("report", "-c", "tiny.yaml", "-o", "out", "--view")
    assert answer.code == 2
    assert answer.err == "projservo: the 3D view needs plotly: pip install 'projservo[view]'\n"
    assert projservo("calibrate", "-c", "tiny.yaml", "--view").code == 2
    answer = projservo("calibrate", "report", "--data", "t.csv", "--joints", "RR", "-o", "new", "--animation")
    assert answer.code == 2
    assert "--animation: shows runs of laws, which need a task" in answer.err
    assert stages.made == []
