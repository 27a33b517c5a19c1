"""The command line called in this process, with stages that only pretend to work."""

import shutil
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from projservo_cli import cli
from projservo_cli.calibration.checks import validation
from projservo_cli.chain import outdated
from projservo_cli.laws import law_and_mode
from projservo_cli.records import Calibration, Observation, Plan, Refits, Report, Trace, WorkFailed
from projservo_cli.stages import calibrate, plan, report, servo, validate
from projservo_cli.stages.stage_inputs import CalibrationInputs, PlanInputs, RefitInputs, ServoInputs, Table
from projservo_cli.store.observation_tables import read_table
from tests.fake_records import fake

CONFIGURATION = """\
name: tiny
robot:
  dh:
    joints:
      - {type: R, d_m: 0.1, alpha_deg: 90}
      - {type: R, a_m: 0.3, name: elbow}
rig:
  image_size_px: [640, 480]
  left: {matrix: [[600, 0, 320, 0], [0, 600, 240, 0], [0, 0, 1, 1]]}
  right: {matrix: [[600, 0, 320, 60], [0, 600, 240, 0], [0, 0, 1, 1]]}
markers:
  positions_m: [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]
  face: [0, 1, 2]
task:
  start: {joints: [0.1, 0.2], unit: rad}
  goal: {roll_deg: 180}
control: {laws: [direct_three, stacked]}
"""
TABLE = "pose,marker,q1,q2,u_left,v_left,u_right,v_right\n0,0,0.1,0.2,1,2,3,4\n1,0,0.1,0.3,1,2,3,4\n"


class Law:
    """A law of somebody, which pretended stages never ask."""

    def __call__(self, s: Any, q: Any) -> None: ...


@dataclass
class Stages:
    """What the pretended stages were called for, and how they are to end."""

    made: list[str] = field(default_factory=list)
    fails: dict[str, Exception] = field(default_factory=dict)
    verdicts: dict[str, str] = field(default_factory=dict)
    gone: bool = False

    def _make(self, name: str) -> None:
        if name in self.fails:
            raise self.fails[name]
        self.made.append(name)

    def calibrate(self, inputs: CalibrationInputs, before: Any, table: Any, *, progress: Any) -> Any:
        progress("trial motions", 1, 2)
        if isinstance(inputs, RefitInputs):
            self._make(f"refit of {inputs.view}")
            assert before is not None
            observation, found, held_out = before
            names = *(found.refits.refit if found.refits else ()), inputs.view
            found = replace(found, refits=Refits(refit=names, refit_numbers=np.ones((len(names), 3))))
            return observation, found, held_out
        told = inputs.source
        if isinstance(told, Table):
            types, seed, source = told.joint_types, told.seed, "recorded"
            observation = read_table(told.file.path, types, told.joint_unit)
        else:
            types, seed, source = told.joints.types, told.motions.seed, "simulated"
            observation = fake(Observation, 1, {"joint": len(types)})
        self._make("calibrate")
        n = observation.q.shape[1]
        types = types or "R" * n
        given = {"source": source, "joint_types": types, "chi2_per_dof": float("nan"), "advice": ("more",)}
        given |= {"outlier": np.array([[3, 1, 0], [4, 2, 2]]), "suspect": np.zeros((0, 2), dtype=np.int64)}
        return observation, fake(Calibration, seed, {"joint": n}, **given), None

    def plan(self, inputs: PlanInputs, calibration: Any) -> Any:
        self._make("plan")
        verdict = self.verdicts.get("plan", "")
        given = {"profile": inputs.trajectory.profile, "feasible": verdict != "infeasible"}
        joints = {"joint": len(calibration.q_reference)}
        return fake(Plan, inputs.seed, joints, reason="too near", **given)

    def servo(self, inputs: ServoInputs, calibration: Any, plan: Any, law: str) -> Any:
        self._make(law)
        name, mode = law_and_mode(law)
        given = {"law": name, "mode": mode, "verdict": self.verdicts.get(law, "converged")}
        return fake(Trace, inputs.plan.seed, {"joint": len(calibration.q_reference)}, **given)

    def report(self, inputs: Any, run: Any, directory: Any, *, progress: Any) -> Any:
        self._make("report")
        claim = {"claim": "c", "source": "s", "measured": "3 mm", "criterion": "< 4 mm", "holds": True}
        left_out = {"what": "fig_9", "reason": "no run"}
        claims = (claim, {**claim, "claim": "it is large", "measured": "1 mm", "holds": False})
        return fake(Report, 9, figures=("figures/fig_1.svg",), claims=claims, omitted=(left_out,))


def pretend(patch, folder):
    """Pretended stages, in a folder with a configuration and a table."""
    pretended = Stages()
    patch.setattr(calibrate, "run", lambda *given, **named: pretended.calibrate(*given, **named))
    patch.setattr(plan, "run", lambda *given, **brought: pretended.plan(*given))
    patch.setattr(servo, "run", lambda *given, **brought: pretended.servo(*given))
    patch.setattr(report, "run", lambda *given, **named: pretended.report(*given, **named))
    patch.setattr(outdated, "_missing", lambda run: pretended.gone)
    patch.chdir(folder)
    (folder / "tiny.yaml").write_text(CONFIGURATION, encoding="utf-8")
    (folder / "t.csv").write_text(TABLE, encoding="utf-8")
    return pretended


@pytest.fixture
def stages(monkeypatch, tmp_path):
    return pretend(monkeypatch, tmp_path)


@pytest.fixture
def reported(stages, made_once, tmp_path):
    """The pretended stages, and a run through all of them in out."""

    def make(folder):
        with pytest.MonkeyPatch.context() as patch:
            pretend(patch, folder)
            assert cli.run(["report", "-c", "tiny.yaml", "-o", "out", "-q"]) == 0

    shutil.copytree(made_once("pretended", make) / "out", tmp_path / "out")
    return stages


@pytest.fixture
def statistics(monkeypatch):
    """What every validation is made to find."""
    value = {
        "count": 2,
        "rms_px": 0.5,
        "median_px": 0.25,
        "p95_px": float("nan"),
        "stated_px": 0.3,
        "noise_px": 0.4,
        "limit_px": 1.5,
        "views": [
            {"view": "left", "count": 2, "median_px": 0.25, "limit_px": 1.5},
            {"view": "right", "count": 0, "median_px": None, "limit_px": None},
        ],
        "skipped": {"unknown_marker": 1, "behind_camera": 0, "missing": 3},
    }

    def found(*_):
        return value | {"findings": [*validation.contradicted_views(value)]}

    monkeypatch.setattr(validate, "compared", found)
    return value


@pytest.fixture
def refused():
    """The failure of a stage whose data do not support its work."""
    return WorkFailed("joint 3 was not moved; move it")
