"""A sound run file of made-up records, for tests that read, damage or rewrite one."""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from projservo_cli.records import Calibration, CrossValidation, Observation, Plan, Report, Trace
from projservo_cli.store.run_file import Result, Run, save
from tests.conftest import ROOT
from tests.fake_records import fake

CONFIGURATION = (ROOT / "configs" / "paper.yaml").read_text(encoding="utf-8")
CLAIM = {"claim": "a", "source": "b", "measured": "c", "criterion": "d", "holds": True}


def result(**named):
    return Result(
        "key", CONFIGURATION, {"date": "2000-06-26T12:00:00+02:00", "seed": 1}, {"table": "t.csv"}, named
    )


def sound_run(path, **extents):
    """A run with every record, fields of every kind with a value and without, and a run of no step."""
    report = fake(Report, 6, figures=("a.svg",), omitted=({"what": "b", "reason": "é"},), claims=(CLAIM,))
    return Run(
        Path(path),
        CONFIGURATION,
        {
            "calibrate": result(
                observation=fake(Observation, 1, extents),
                calibration=fake(Calibration, 2, extents, advice=("a", "é"), outlier=np.array([[1, 0, 2]])),
                cross_validation=fake(CrossValidation, 7, extents, rms_px=0.5),
            ),
            "plan": result(**{"": fake(Plan, 3, tau_limit=float("inf"))}),
            "servo/stacked": result(**{"": fake(Trace, 4, position_error_mm=0.25)}),
            "servo/direct_three": result(**{"": fake(Trace, 5, {"step": 0, "instant": 1}, law="ä")}),
            "report": result(**{"": report}),
        },
    )


@cache
def sound_file():
    """Its content."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.h5")
        save(sound_run(path))
        return path.read_bytes()
