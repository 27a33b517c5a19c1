import dataclasses
import json
import math

import numpy as np
import pytest

from projservo_cli.control.law import Gains
from projservo_cli.geometry.displacements import screws, twists
from projservo_cli.records import changed
from projservo_cli.report.claims import claims_of
from projservo_cli.report.figure_inputs import Composition
from projservo_cli.report.figures.path_deviation import study_numbers
from projservo_cli.stages import report
from projservo_cli.stages.report import run_studies
from projservo_cli.store.run_file import Result, load, save
from tests.configured import draw_only, report_on
from tests.report.cases import GAINS, PERIODS_S, SPECS, case
from tests.report.conftest import stored

# The gains of the paper, a tenth of the error in each period.
GAINS_OF_LAWS = Gains(2.5, 2.5, 2.5, 2.5, 1.0, 2.5, 0.04, 0.9)


def with_traces(material, **traces):
    """The material with some traces replaced; None drops one."""
    kept = {law: trace for law, trace in (material.traces | traces).items() if trace is not None}
    return dataclasses.replace(material, traces=kept)


@pytest.fixture
def few(monkeypatch):
    """Studies of few gains and periods."""
    monkeypatch.setattr(report, "run_studies", lambda bench, *_, **__: run_studies(bench, GAINS, PERIODS_S))


@pytest.mark.usefixtures("few")
def test_a_report_writes_what_it_says_and_fits_the_run_file(tmp_path, monkeypatch):
    draw_only(monkeypatch, "fig01_partition", "fig04_classical", "fig08_drift")
    material = with_traces(case()[2], **dict.fromkeys(SPECS["fig04_classical"].laws))
    stale = tmp_path / "figures" / "fig04_classical.svg"
    stale.parent.mkdir()
    stale.write_text("of an earlier report")
    (tmp_path / "figures" / "fig01_partition.pdf").write_text("of an earlier report")
    steps = []
    run = stored(tmp_path, "report.formats=[png]", material=material)
    record = report_on(run, tmp_path, progress=lambda *step: steps.append(step))
    assert not stale.exists()
    assert not (tmp_path / "figures" / "fig01_partition.pdf").exists()
    assert record.figures == ("figures/fig01_partition.png", "figures/fig08_drift.png")
    for name in record.figures:
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert [entry["what"] for entry in record.omitted] == ["fig04_classical"]
    assert steps[-1] == ("figures", 3, 3)
    content = json.loads((tmp_path / "claims.json").read_text(encoding="utf-8"))
    assert content["claims"] == list(record.claims)
    assert len(content["drift"]) == 2 * 2 * 2 * len(GAINS)
    save(dataclasses.replace(run, results={**run.results, "report": Result("k", "", {}, {}, {"": record})}))
    again = load(run.path).results["report"].records[""]
    assert again.claims == record.claims
    np.testing.assert_array_equal(again.path_deviation_mm, record.path_deviation_mm)


def test_an_unknown_goal_leaves_out_what_needs_it_and_nothing_else(tmp_path, monkeypatch):
    material = case()[2]

    def unknown(trace):
        return changed(
            trace,
            goal_pose=np.full((4, 4), np.nan),
            position_error_mm=None,
            rotation_error_deg=None,
            center_deviation_mm=None,
            center_deviation_at_samples_mm=None,
        )

    extra = material.studies
    material = dataclasses.replace(
        material,
        traces={law: unknown(trace) for law, trace in material.traces.items()},
        studies=dataclasses.replace(
            extra,
            sweep={key: unknown(trace) for key, trace in extra.sweep.items()},
            own={key: unknown(trace) for key, trace in extra.own.items()},
            rate={key: unknown(trace) for key, trace in extra.rate.items()},
            further={key: unknown(trace) for key, trace in extra.further.items()},
        ),
    )
    for spec in SPECS.values():
        assert ("pose of the goal is unknown" in spec.lacking(material)) == spec.goal
    draw_only(monkeypatch, "fig03_scene", "fig12_joints")
    monkeypatch.setattr(report, "run_studies", lambda bench, progress: material.studies)
    record = report_on(stored(tmp_path, "report.formats=[svg]", material=material), tmp_path)
    assert len(record.figures) == 2
    assert not any("drift" in claim["claim"] or "nan" in claim["measured"] for claim in record.claims)
    content = json.loads((tmp_path / "claims.json").read_text(encoding="utf-8"))
    assert all(row["path_deviation_mm"] is None for row in content["drift"])


def test_both_sides_of_eq_22_agree_to_first_order_only():
    _, bench, material = case()
    plan = report.metric_plan(bench)
    lambdas = np.array([0.02, 0.01, 0.005])
    distance = report.composition_error(plan, lambdas)
    # the third order adds a few per mille at λ = 0.02
    np.testing.assert_allclose(distance[:-1] / distance[1:], 4.0, rtol=2e-2)
    # without a translation both sides are the same
    still = changed(plan, tau=0.0)
    assert report.composition_error(still, lambdas).max() < 1e-12
    *_, differs = claims_of(material, Composition(lambdas, distance, math.pi / 2, np.zeros(2)))
    *_, same = claims_of(material, Composition(lambdas, np.zeros(3), 0.0, np.zeros(2)))
    assert (differs.holds, same.holds) == (False, True)
    assert "λ^2.0" in differs.measured


def test_eq_22_has_its_counter_example_in_the_turn_of_the_paper_and_holds_along_the_axis():
    """The translation of a pure turn is perpendicular to its axis; along the axis both sides are the same."""
    plan = report.metric_plan(case()[1])
    of_paper = report.composition_of(plan, GAINS_OF_LAWS)
    assert math.degrees(of_paper.axis_angle) == pytest.approx(90.0, abs=1e-6)
    assert of_paper.distance[0] > 0.4
    turn = screws(plan.H_hat[1])[:3]
    for direction, angle in ((turn, 0.0), (np.cross(turn, [0.3, 0.5, 0.7]), math.pi / 2)):
        along = twists(np.r_[0.0, 0.0, 0.0, direction])
        H_hat = np.array([along, *plan.H_hat[1:]])
        other = report.composition_of(changed(plan, H_hat=H_hat, theta_p=0.0), GAINS_OF_LAWS)
        assert other.axis_angle == pytest.approx(angle, abs=1e-7)
        assert (other.distance.max() < 1e-12) == (angle == 0.0)
    # Rotations that do not commute turn the face off its planned rotation, one rotation does not: eq. (21).
    assert np.degrees(of_paper.bias) == pytest.approx([8.3, 0.0], abs=0.05)
    assert np.degrees(of_paper.bias[1]) < 1e-9
    assert report.orientation_bias(changed(plan, theta_p=0.0), GAINS_OF_LAWS).max() < 1e-3


@pytest.mark.volume
def test_claims_of_a_whole_run_with_exact_operators():
    """All runs to their end: every claim has its number, and those that follow from the mathematics hold."""
    _, bench, material = case("paper", 2000, whole=True)
    plan = report.metric_plan(bench)
    claims = claims_of(material, report.composition_of(plan, bench.scenario.gains))
    assert len({claim.claim for claim in claims}) == len(claims) >= 24
    for claim in claims:
        assert claim.holds is not None
        assert claim.criterion
        assert claim.source.startswith(("section", "eq."))
        assert "nan" not in claim.measured
    assert {
        "No self-occlusion under direct control",
        "The block-wise law does not converge",
        "Projective and Euclidean models give the same θ_r and θ_p",
        *(f"{law}: the control errors decay exponentially" for law in ("directTHREE", "directTWO")),
        *(f"{law}: the drift falls with the gain" for law in ("directTHREE", "directTWO")),
        *(f"{law}: the drift falls with a limit of 5° per step" for law in ("directTHREE", "directTWO")),
        "θ_s starts at the overall rotation of the task, 180° in the paper",
        "The image error does not decay exponentially",
        "The image error does not even decay monotonically",
        "stacked Jacobians: runs through self-occlusion, then converges",
        "Euclidean points: runs through self-occlusion, then converges",
    } <= {claim.claim for claim in claims if claim.holds}
    assert study_numbers(material.studies)["path_deviation_converged"].all()  # converged
