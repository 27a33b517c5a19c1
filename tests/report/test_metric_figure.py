"""Cameras, axes and tool in metres on the page: against the data sheet of the arm, and where they lack."""

import numpy as np
import pytest
from scipy.stats import chi2

from projservo_cli.config.inputs import report_inputs
from projservo_cli.metric.frame import links
from projservo_cli.report.figure_inputs import Fit
from projservo_cli.report.figures.scene import chosen_poses, metric_rows
from projservo_cli.stages.carried_goals import in_metres
from tests.configured import calibrate, truth_of
from tests.known import configured


def test_rows_agree_with_the_data_sheet_within_their_deviations():
    """Of a UR5, calibrated from 0.5 px."""
    config = configured("ur5")
    observation, calibration, *_ = calibrate.run(config)
    metric, why = in_metres(calibration, report_inputs(config).lengths)
    assert why == ""
    q = chosen_poses(metric, Fit(calibration, observation.at_rest))
    assert len(np.unique(q, axis=0)) == 5
    rows = {row["quantity"]: row for row in metric_rows(metric, q)}
    # Angles and lengths of a UR5, of its maker; the distance of the cameras as configured.
    centers = [-np.linalg.solve(P[:, :3], P[:, 3]) for P in truth_of(config).P]
    expected = {"distance of the cameras": 1e3 * np.linalg.norm(np.subtract(*centers))}
    for joint, angle, distance in (
        *((2, 90.0, 0.0), (3, 0.0, 425.0), (4, 0.0, 392.25)),
        *((5, 90.0, 0.0), (6, 90.0, 0.0)),
    ):
        name = f"joint {joint}, axis from that of joint {joint - 1}"
        expected |= {f"{name}, angle": angle, f"{name}, distance": distance}
    off = [(rows[name]["value"][0] - value) / rows[name]["deviation"][0] for name, value in expected.items()]
    assert np.square(off).sum() < chi2.ppf(0.999, len(off))


def test_links_are_angles_and_common_normals_with_signs_nearby():
    """Screws whose links are known by construction, and changes of first order through zero."""
    #                 along z        parallel, 0.3 off      across, crossing 0.2 above
    axes = np.array(
        [[0, 0, 1, 0, 0, 0], [0, 0, 1, 0, -0.3, 0], [1, 0, 0, 0, 0.2, -0.1], [0, 0, 0, 0, 1, 0]], dtype=float
    )
    prismatic = np.array([False, False, False, True])
    angle, distance = links(axes, prismatic, axes)
    assert angle == pytest.approx([0.0, np.pi / 2, np.pi / 2])
    assert distance[:2] == pytest.approx([0.3, 0.1])
    assert np.isnan(distance[2])
    moved = axes.copy()
    moved[2, 5] = 0.1  # to the other side of the second axis
    assert links(moved, prismatic, axes)[1][1] == pytest.approx(-0.1)
