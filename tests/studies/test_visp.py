"""ViSP as a law beside the laws of the package."""

import numpy as np
import pytest

from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.servo import drive
from tests.configured import calibrate, plan, scenario_of, truth_of
from tests.known import configured

cv2 = pytest.importorskip("cv2")
if not hasattr(cv2, "calibrateHandEye"):
    pytest.skip("OpenCV 5 has no hand-eye calibration", allow_module_level=True)

from tests.studies import visp  # noqa: E402


@pytest.mark.skipif(bool(visp.missing()), reason=f"ViSP cannot be run: {visp.missing()}")
def test_visp_by_two_cameras_goes_the_way_of_the_stacked_law():
    """Of perfect pixels both compute −λ J⁺ e, of the same four points in pixels or in focal lengths."""
    config = configured("ur5", "control.features=points", "noise.calibration_px=0")
    calibration = calibrate.run(config)[1]
    planned, scenario = plan.run(config, calibration), scenario_of(config, calibration)
    with visp.Program() as program:
        law = program.law("ibvs", visp.true_cell(truth_of(config)), (0, 1), 0.01)
        run = trace_of(drive(scenario, planned, "ViSP", factory=law))
    stacked = trace_of(drive(scenario, planned, "stacked"))
    assert run.verdict == stacked.verdict == "converged"
    assert run.position_error_mm < 0.1
    # Focal lengths of 1175 to 1190 px weigh the points otherwise.
    assert np.abs(run.q - stacked.q).max() < 0.05
